"""Captures of phones, whose cameras and depth maps are ARKit's, read as frames of `transforms.json`.

Polycam's raw data are keyframes with a JSON file each (<https://github.com/PolyCam/polyform>). Record3D's are images
named by number, next to metadata with all poses.
"""

import functools
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, label
from scipy.spatial.transform import Rotation

from a2tg_jax.data.assembly import PointCloud
from a2tg_jax.data.decoding import picture_size, read_grey, read_pixels
from a2tg_jax.data.image_files import PHOTO_SUFFIXES, find_image, map_in_threads
from a2tg_jax.data.transforms import Frames, check_images, reading_one
from a2tg_jax.host.json_text import MOST_BYTES, number_of, read_object
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.host.text import shortened

POLYCAM_FOLDERS = (("corrected_cameras", "corrected_images"), ("cameras", "corrected_images"), ("cameras", "images"))
"""Folders of cameras and images of the keyframes; those after Polycam's optimisation come first."""
INTRINSICS = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}
"""Polycam's names of intrinsics."""
POSE = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]
"""Polycam's names of the numbers of a pose."""
NUM_POINTS = 50_000
"""Number of points taken from all depth maps."""
FARTHEST_MM, LEAST_CONFIDENCE = 5000, 127
"""Depth up to which the sensor measures, and ARKit's medium confidence."""
BLACKEST, MARGIN = 8, 2
"""Largest value of a pixel of the black border, and pixels next to it that undistortion and JPEG mix with it."""
METADATA = ("metadata", "metadata.json")
"""Names of Record3D's file."""
IMAGE_FOLDERS = ("rgb", "rgbd", ".")


def polycam(path: Path) -> Callable[[], Frames] | None:
    """Return the function that reads Polycam's raw data in a folder; None if there are none."""
    found = []
    for base in (path / "keyframes", path):
        pairs = [(base / cameras, base / images) for cameras, images in POLYCAM_FOLDERS]
        found += [pair for pair in pairs if pair[0].is_dir() and pair[1].is_dir() and any(pair[0].glob("*.json"))][:1]
    if not found:
        return None
    return reading_one(found[0][0], [cameras for cameras, _ in found], functools.partial(_polycam_frames, *found[0]))


def _polycam_frames(cameras: Path, images: Path) -> Frames:
    """Return the frames of Polycam's raw data: a JSON file, and perhaps a depth map, for each image."""
    frames, lacking = [], []
    for file in sorted(cameras.glob("*.json")):
        image = find_image(images, file.stem)
        if image is None:
            lacking.append(file.name)
            continue
        values = read_object(file)
        names = [*INTRINSICS.values(), *(name for row in POSE for name in row)]
        missing = [name for name in names if values.get(name) is None]
        if missing:
            raise ValueError(f"{file}: lacks {missing[0]}, a number of the camera; export the raw data again")
        values |= {name: number_of(values[name], f"{file}: {name}") for name in names}
        frame: dict[str, Any] = {key: values[name] for key, name in INTRINSICS.items()}
        size = [number_of(values.get(side) or 0, f"{file}: {side}") for side in ("width", "height")]
        # Newer exports have none.
        frame["w"], frame["h"] = size if min(size) > 0 else picture_size(image)
        rows = [[values[name] for name in row] for row in POSE]
        frames.append({**frame, "file_path": f"{images.name}/{image.name}", "transform_matrix": rows})
    nothing = f"{cameras}: none of its cameras has an image of its name in {images}; export the raw data again"
    check_images(cameras, frames, lacking, nothing)
    base = images.parent
    depths = [(frame, base / "depth" / f"{Path(frame['file_path']).stem}.png") for frame in frames]
    depths = [(frame, file) for frame, file in depths if is_regular(file)]
    share = NUM_POINTS // len(depths) + 1 if depths else 0
    parts = map_in_threads(lambda item: _points_of(base, item[0], item[1], share), depths)
    cloud = PointCloud(*(np.concatenate(part) for part in zip(*parts, strict=True))) if parts else None
    # Corrected images have a black border where undistortion found nothing.
    return Frames(cameras, frames, cloud, _within_border if images.name.startswith("corrected") else None)


def _points_of(base: Path, frame: dict[str, Any], file: Path, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points [P, 3] and colours [P, 3] uint8 of at most `count` measured pixels of a depth map."""
    depth, _ = read_grey(file)
    is_measured = (depth > 0) & (depth <= FARTHEST_MM)
    confidence = base / "confidence" / file.name
    if is_regular(confidence):
        sure, _ = read_grey(confidence)
        is_measured &= (sure >= LEAST_CONFIDENCE) if sure.shape == depth.shape else True
    rows, columns = np.nonzero(is_measured)
    chosen = np.random.default_rng(0).permutation(len(rows))[:count]  # The same in every run.
    photograph = read_pixels(base / frame["file_path"])
    x = (columns[chosen] + 0.5) / depth.shape[1]
    y = (rows[chosen] + 0.5) / depth.shape[0]
    colors = photograph[(y * photograph.shape[0]).astype(int), (x * photograph.shape[1]).astype(int), :3]
    ahead = depth[rows, columns][chosen] / 1000.0  # From mm to the m of poses.
    with np.errstate(all="ignore"):  # Cameras are checked later, points beyond all bounds are left out.
        right = (x * frame["w"] - frame["cx"]) / frame["fl_x"] * ahead
        down = (y * frame["h"] - frame["cy"]) / frame["fl_y"] * ahead
        pose = np.array(frame["transform_matrix"], np.float64)
        # ARKit's cameras look along -z with y up, as OpenGL's.
        return np.stack([right, -down, -ahead], axis=-1) @ pose[:, :3].T + pose[:, 3], colors


def _within_border(pixels: np.ndarray) -> np.ndarray:
    """Return [H, W] bool, False at the black border of an image and next to it."""
    # Black regions belong to the border if they touch the edge of the image.
    parts, _ = label(pixels[..., :3].max(axis=-1) <= BLACKEST)
    at_edge = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
    border = np.isin(parts, at_edge[at_edge > 0])
    return ~binary_dilation(border, iterations=MARGIN)


def record3d(path: Path) -> Callable[[], Frames] | None:
    """Return the function that reads Record3D's frames in a folder; None if there are none."""
    # The name alone says little.
    files = [file for file in (path / name for name in METADATA) if is_regular(file)]
    files = [file for file in files if b'"poses"' in read_regular(file, MOST_BYTES)]
    if not files:
        return None
    return reading_one(files[0], files, functools.partial(_record3d_frames, files[0]))


def _record3d_frames(file: Path) -> Frames:
    """Return the frames of Record3D: image N has pose N of the metadata, a quaternion (x, y, z, w) and a position."""
    values = read_object(file)
    poses = _rows(values.get("poses"), 7, f"{file}: poses")
    given = values.get("perFrameIntrinsicCoeffs")
    intrinsics = _rows(given, 4, f"{file}: perFrameIntrinsicCoeffs") if given else np.empty((0, 4))
    if not given or len(intrinsics) < len(poses):  # K is stored by columns.
        K = _rows([values.get("K")], 9, f"{file}: K")[0].reshape(3, 3).T
        intrinsics = np.tile([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], (len(poses), 1))
    size: dict[str, Any] = {key: values[key] for key in ("w", "h") if key in values}
    numbered: list[list[Path]] = [
        [image for image in base.glob("*") if image.suffix.lower() in PHOTO_SUFFIXES and image.stem.isdecimal()]
        for base in (file.parent / name for name in IMAGE_FOLDERS)
    ]
    # Reversed, because a dict keeps the last: of 0.jpg and 0.png the first by name.
    images = {int(image.stem): image for image in sorted(next(filter(None, numbered), []), reverse=True)}
    frames = []
    for number, image in sorted(images.items()):
        if number < len(poses):
            if not np.linalg.norm(poses[number, :4]) > 0:
                raise ValueError(f"{file}: pose {number} has a quaternion of length 0")
            turned = Rotation.from_quat(poses[number, :4]).as_matrix()
            pose = np.concatenate([turned, poses[number, 4:, None]], axis=1)
            lens: dict[str, Any] = dict(zip(INTRINSICS, intrinsics[number].tolist(), strict=True)) | size
            name = image.relative_to(file.parent).as_posix()
            frames.append({**lens, "file_path": name, "transform_matrix": pose.tolist()})
    nothing = f"{file}: no images rgb/0.jpg, rgb/1.jpg, … are beside it; export RGB frames with Record3D"
    check_images(file, frames, [str(number) for number in range(len(poses)) if number not in images], nothing)
    unposed = [image.name for number, image in sorted(images.items()) if number >= len(poses)]
    if unposed:
        message = f"{file}: {len(unposed)} of {len(images)} images have no pose, such as {unposed[0]}: not used"
        warnings.warn(message, stacklevel=2)
    return Frames(file, frames)


def _rows(value: object, width: int, what: str) -> np.ndarray:
    """Return rows [N, width] of finite numbers, or raise ValueError."""
    try:
        rows = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        rows = np.empty(0)
    if rows.ndim != 2 or rows.shape[1] != width or not np.isfinite(rows).all():
        raise ValueError(f"{what} must be rows of {width} finite numbers; got {shortened(value)}")
    return rows
