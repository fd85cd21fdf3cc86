"""Captures of phones, whose cameras and depth maps are ARKit's, read as frames of `transforms.json`.

Polycam's raw data are keyframes with a JSON file each (<https://github.com/PolyCam/polyform>). Record3D's are images
named by number, next to metadata with all poses.
"""

import functools
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, label
from scipy.spatial.transform import Rotation

from a2tg_jax.base.json_text import MOST_BYTES, lenient_number, number_rows, read_object
from a2tg_jax.base.regular_files import is_regular, read_regular
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.data.assembly import PointCloud
from a2tg_jax.data.decoding import picture_size, read_grey, read_pixels
from a2tg_jax.data.image_files import find_image, is_photo, map_in_threads
from a2tg_jax.data.transforms import Cameras, Frames, check_images

POLYCAM_FOLDERS = (("corrected_cameras", "corrected_images"), ("cameras", "corrected_images"), ("cameras", "images"))
"""Folders of cameras and images of the keyframes; those after Polycam's optimisation come first."""
INTRINSICS = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}
"""Polycam's names of intrinsics."""
NUM_POINTS = 50_000
"""Number of points taken from all depth maps."""
FARTHEST_MM = 5000
LEAST_CONFIDENCE = 127
"""Depth up to which the sensor measures, and ARKit's medium confidence."""
BLACKEST = 8
MARGIN = 2
"""Largest value of a pixel of the black border, and pixels next to it that undistortion and JPEG mix with it."""
METADATA = ("metadata", "metadata.json")
"""Names of Record3D's file."""
IMAGE_FOLDERS = ("rgb", "rgbd", ".")


def polycam(path: Path) -> list[Cameras]:
    """Return the cameras of Polycam's raw data in a folder, the preferred ones first."""
    cameras = []
    for base in (path / "keyframes", path):
        for name, images in POLYCAM_FOLDERS:
            folder = base / name
            files = sorted(folder.glob("*.json"))
            if files and (base / images).is_dir():
                cameras.append(Cameras(folder, functools.partial(_polycam_frames, folder, base / images), files))
                break
    return cameras


def _polycam_frames(cameras: Path, images: Path) -> Frames:
    """Return the frames of Polycam's raw data: a JSON file, and perhaps a depth map, for each image."""
    frames = []
    lacking = []
    for file in sorted(cameras.glob("*.json")):
        image = find_image(images, file.stem)
        if image is None:
            lacking.append(file.name)
        else:
            frames.append(_polycam_frame(file, image))
    nothing = f"{cameras}: none of its cameras has an image of its name in {images}; export the raw data again"
    check_images(cameras, frames, lacking, nothing)
    base = images.parent
    with_depths = []
    for frame in frames:
        depth = base / "depth" / f"{Path(frame['file_path']).stem}.png"
        if is_regular(depth):
            with_depths.append((frame, depth))
    cloud = None
    if with_depths:
        count = NUM_POINTS // len(with_depths) + 1
        clouds = map_in_threads(lambda pair: _points_of(base, pair[0], pair[1], count), with_depths)
        cloud = PointCloud(
            np.concatenate([cloud.points for cloud in clouds]), np.concatenate([cloud.colors for cloud in clouds])
        )
    # Corrected images have a black border where undistortion found nothing.
    return Frames(cameras, frames, cloud, _within_border if images.name.startswith("corrected") else None)


def _polycam_frame(file: Path, image: Path) -> dict[str, Any]:
    """Return the frame of an image and the JSON file of its camera."""
    values = read_object(file)

    def number(name: str) -> float:
        if values.get(name) is None:
            raise ValueError(f"{file}: lacks {name}, a number of the camera; export the raw data again")
        return lenient_number(values[name], f"{file}: {name}")

    frame: dict[str, Any] = {key: number(name) for key, name in INTRINSICS.items()}
    frame["transform_matrix"] = [[number(f"t_{row}{column}") for column in range(4)] for row in range(3)]
    size = [lenient_number(values.get(side) or 0, f"{file}: {side}") for side in ("width", "height")]
    # Newer exports have none.
    frame["w"], frame["h"] = size if min(size) > 0 else picture_size(image)
    frame["file_path"] = f"{image.parent.name}/{image.name}"
    return frame


def _points_of(base: Path, frame: dict[str, Any], file: Path, count: int) -> PointCloud:
    """Return at most `count` measured pixels of a depth map as points."""
    depth, _ = read_grey(file)
    is_measured = (depth > 0) & (depth <= FARTHEST_MM)
    confidence_file = base / "confidence" / file.name
    if is_regular(confidence_file):
        confidence, _ = read_grey(confidence_file)
        if confidence.shape == depth.shape:
            is_measured &= confidence >= LEAST_CONFIDENCE
    rows, columns = np.nonzero(is_measured)
    chosen = np.random.default_rng(0).permutation(len(rows))[:count]  # The same in every run.
    row = rows[chosen]
    column = columns[chosen]
    photograph = read_pixels(base / frame["file_path"])
    # As shares of the height and the width, which differ between the photograph and the map.
    y = (row + 0.5) / depth.shape[0]
    x = (column + 0.5) / depth.shape[1]
    colors = photograph[(y * photograph.shape[0]).astype(int), (x * photograph.shape[1]).astype(int), :3]
    ahead = depth[row, column] / 1000.0  # From mm to the m of poses.
    with np.errstate(all="ignore"):  # Cameras are checked later, points beyond all bounds are left out.
        right = (x * frame["w"] - frame["cx"]) / frame["fl_x"] * ahead
        down = (y * frame["h"] - frame["cy"]) / frame["fl_y"] * ahead
        pose = np.array(frame["transform_matrix"], np.float64)
        # ARKit's cameras look along -z with y up, as OpenGL's.
        return PointCloud(np.stack([right, -down, -ahead], axis=-1) @ pose[:, :3].T + pose[:, 3], colors)


def _within_border(pixels: np.ndarray) -> np.ndarray:
    """Return [H, W] bool, False at the black border of an image and next to it."""
    # Black regions belong to the border if they touch the edge of the image.
    parts, _ = label(pixels[..., :3].max(axis=-1) <= BLACKEST)
    at_edge = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
    border = np.isin(parts, at_edge[at_edge > 0])
    return ~binary_dilation(border, iterations=MARGIN)


def record3d(path: Path) -> list[Cameras]:
    """Return the cameras of Record3D's metadata in a folder, the preferred ones first."""
    cameras = []
    for name in METADATA:
        file = path / name
        # The name alone says little.
        if is_regular(file) and b'"poses"' in read_regular(file, MOST_BYTES):
            cameras.append(Cameras(file, functools.partial(_record3d_frames, file)))
    return cameras


def _record3d_frames(file: Path) -> Frames:
    """Return the frames of Record3D: image N has pose N of the metadata, a quaternion (x, y, z, w) and a position."""
    values = read_object(file)
    poses = number_rows(values.get("poses"), 7, f"{file}: poses")
    given = values.get("perFrameIntrinsicCoeffs")
    intrinsics = number_rows(given, 4, f"{file}: perFrameIntrinsicCoeffs") if given else np.empty((0, 4))
    if not given or len(intrinsics) < len(poses):
        # K is stored by columns: fx, 0, 0, 0, fy, 0, cx, cy, 1.
        K = number_rows([values.get("K")], 9, f"{file}: K")
        intrinsics = np.repeat(K[:, [0, 4, 6, 7]], len(poses), axis=0)
    size: dict[str, Any] = {key: values[key] for key in ("w", "h") if key in values}
    images = _numbered_images(file.parent)
    frames = []
    for number, image in images.items():
        if number >= len(poses):
            continue
        quaternion = poses[number, :4]
        if not np.linalg.norm(quaternion) > 0:
            raise ValueError(f"{file}: pose {number} has a quaternion of length 0")
        pose = np.column_stack([Rotation.from_quat(quaternion).as_matrix(), poses[number, 4:]])
        fx, fy, cx, cy = intrinsics[number].tolist()
        lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, **size}
        name = image.relative_to(file.parent).as_posix()
        frames.append({**lens, "file_path": name, "transform_matrix": pose.tolist()})
    nothing = f"{file}: no images rgb/0.jpg, rgb/1.jpg, … are beside it; export RGB frames with Record3D"
    check_images(file, frames, [str(number) for number in range(len(poses)) if number not in images], nothing)
    unposed = [image.name for number, image in images.items() if number >= len(poses)]
    if unposed:
        warn(f"{file}: {len(unposed)} of {len(images)} images have no pose, such as {unposed[0]}: not used")
    return Frames(file, frames)


def _numbered_images(folder: Path) -> dict[int, Path]:
    """Return the images in the first of `IMAGE_FOLDERS` that has some named by number, in order of these."""
    for name in IMAGE_FOLDERS:
        images = [image for image in (folder / name).glob("*") if is_photo(image) and image.stem.isdecimal()]
        if images:
            # Reversed, because a dict keeps the last: of 0.jpg and 0.png the first by name.
            by_number = {int(image.stem): image for image in sorted(images, reverse=True)}
            return dict(sorted(by_number.items()))
    return {}
