"""Polycam's raw data: keyframes with ARKit's poses and depth maps, read as frames of `transforms.json`.

Polycam describes the format at <https://github.com/PolyCam/polyform>.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, label

from a2tg_jax.data.assembly import PointCloud
from a2tg_jax.data.decoding import picture_size, read_depth, read_pixels
from a2tg_jax.data.frames import Frames, warn_of_missing_images
from a2tg_jax.data.images import map_in_threads, named_image
from a2tg_jax.host.json_text import read_object
from a2tg_jax.host.regular_files import is_regular

FOLDERS = (("corrected_cameras", "corrected_images"), ("cameras", "corrected_images"), ("cameras", "images"))
"""Folders of cameras and images of the keyframes; those after Polycam's optimisation come first."""
INTRINSICS = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}
NUM_POINTS = 50_000
"""Number of points taken from all depth maps."""
FARTHEST_MM, LEAST_CONFIDENCE = 5000, 127
"""Depth up to which the sensor measures, and ARKit's medium confidence."""
BLACKEST, MARGIN = 8, 2
"""Largest value of a pixel of the black border, and pixels beside it that undistortion and JPEG mix with it."""


def polycam_folders(path: Path) -> tuple[Path, Path] | None:
    """Return the folders of cameras and of images of Polycam's raw data, or None."""
    for base in (path / "keyframes", path):
        for cameras, images in FOLDERS:
            if (base / cameras).is_dir() and (base / images).is_dir() and any((base / cameras).glob("*.json")):
                return base / cameras, base / images
    return None


def polycam_frames(cameras: Path, images: Path) -> Frames:
    """Return the frames of Polycam's raw data: a JSON file for each image, of the same name, and perhaps a depth map.

    Corrected images have a black border where undistortion found nothing, which is masked. Newer exports have no width
    and height: the image's own are taken.

    Raises:
      ValueError: if a file is no JSON object, or lacks a number of the pose, or no camera has an image.
    """
    frames, lacking = [], []
    for file in sorted(cameras.glob("*.json")):
        image = named_image(images, file.stem)
        if image is None:
            lacking.append(file.name)
            continue
        values = read_object(file)
        missing = [name for name in _number_names() if not isinstance(values.get(name), int | float)]
        if missing:
            raise ValueError(f"{file}: lacks {missing[0]}, a number of the camera; export the raw data again")
        rows = [[values[f"t_{row}{column}"] for column in range(4)] for row in range(3)]
        frame: dict[str, Any] = {key: values[name] for key, name in INTRINSICS.items()}
        size = values.get("width"), values.get("height")
        frame["w"], frame["h"] = (
            size if all(isinstance(side, int | float) and side > 0 for side in size) else picture_size(image)
        )
        frames.append({**frame, "file_path": f"{images.name}/{image.name}", "transform_matrix": rows})
    if not frames:
        raise ValueError(
            f"{cameras}: none of its cameras has an image of its name in {images}; export the raw data again"
        )
    warn_of_missing_images(cameras, lacking, len(frames) + len(lacking))
    cloud = _depth_points(images.parent, frames)
    return Frames(cameras, frames, cloud, counted=_within_border if images.name.startswith("corrected") else None)


def _number_names() -> list[str]:
    return [*INTRINSICS.values(), *(f"t_{row}{column}" for row in range(3) for column in range(4))]


def _depth_points(base: Path, frames: list[dict[str, Any]]) -> PointCloud | None:
    """Return points of the depth maps of the frames that have one, or None."""
    files = [base / "depth" / f"{Path(frame['file_path']).stem}.png" for frame in frames]
    with_depth = [(base, frame, file) for frame, file in zip(frames, files, strict=True) if is_regular(file)]
    if not with_depth:
        return None
    share = NUM_POINTS // len(with_depth) + 1
    parts = map_in_threads(lambda item: _points_of(*item, share), with_depth)
    return PointCloud(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _points_of(base: Path, frame: dict[str, Any], file: Path, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points [P, 3] and colours [P, 3] uint8 of at most `count` measured pixels of a depth map."""
    depth = read_depth(file)
    is_measured = (depth > 0) & (depth <= FARTHEST_MM)
    confidence = base / "confidence" / file.name
    if is_regular(confidence):
        sure = read_depth(confidence)
        is_measured &= (sure >= LEAST_CONFIDENCE) if sure.shape == depth.shape else True
    rows, columns = np.nonzero(is_measured)
    chosen = np.random.default_rng(0).permutation(len(rows))[:count]
    photograph = read_pixels(base / frame["file_path"])
    x = (columns[chosen] + 0.5) / depth.shape[1]
    y = (rows[chosen] + 0.5) / depth.shape[0]
    colors = photograph[(y * photograph.shape[0]).astype(int), (x * photograph.shape[1]).astype(int), :3]
    ahead = depth[rows, columns][chosen] / 1000.0
    with np.errstate(all="ignore"):  # Cameras are checked later, points beyond all bounds are left out.
        return _placed(frame, x, y, ahead), colors


def _placed(frame: dict[str, Any], x: np.ndarray, y: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return points [P, 3] at places of an image, as shares of its sides, and distances ahead of its camera."""
    right = (x * frame["w"] - frame["cx"]) / frame["fl_x"] * ahead
    down = (y * frame["h"] - frame["cy"]) / frame["fl_y"] * ahead
    pose = np.array(frame["transform_matrix"], np.float64)
    points: np.ndarray = np.stack([right, -down, -ahead], axis=-1) @ pose[:, :3].T + pose[:, 3]
    return points


def _within_border(pixels: np.ndarray) -> np.ndarray:
    """Return [H, W] bool, False at the black border of an image and next to it."""
    parts, _ = label(pixels[..., :3].max(axis=-1) <= BLACKEST)
    at_edge = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
    border = np.isin(parts, at_edge[at_edge > 0])
    counts: np.ndarray = ~binary_dilation(border, iterations=MARGIN)
    return counts
