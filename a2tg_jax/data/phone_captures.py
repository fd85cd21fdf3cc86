"""Captures of phones whose poses come from ARKit: Polycam's raw data and Record3D's frames.

Both are read as frames of `transforms.json`, for their camera frames are OpenGL's too.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from a2tg_jax.data.transforms import Frames
from a2tg_jax.host.json_text import MOST_BYTES, parse_json
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.host.text import shortened

POLYCAM_FOLDERS = (("corrected_cameras", "corrected_images"), ("cameras", "corrected_images"), ("cameras", "images"))
"""Folders of cameras and images in Polycam's keyframes; those after its optimisation come first."""
RECORD3D_FILES = ("metadata", "metadata.json")
RECORD3D_IMAGES = ("rgb", "rgbd", ".")
SUFFIXES = (".jpg", ".jpeg", ".png")


def polycam_folders(path: Path) -> tuple[Path, Path] | None:
    """Return the folders of cameras and of images of Polycam's raw data, or None."""
    for base in (path / "keyframes", path):
        for cameras, images in POLYCAM_FOLDERS:
            if (base / cameras).is_dir() and (base / images).is_dir() and any((base / cameras).glob("*.json")):
                return base / cameras, base / images
    return None


def polycam_frames(cameras: Path, images: Path) -> Frames:
    """Return the frames of Polycam's raw data: a JSON file for each image, of the same name.

    Raises:
      ValueError: if a file is no JSON object, or lacks a number of the pose.
    """
    frames = []
    for file in sorted(cameras.glob("*.json")):
        image = next(
            (images / f"{file.stem}{suffix}" for suffix in SUFFIXES if is_regular(images / f"{file.stem}{suffix}")),
            None,
        )
        if image is None:
            continue
        values = _object(file)
        missing = [name for name in _pose_names() if not isinstance(values.get(name), int | float)]
        if missing:
            raise ValueError(f"{file}: lacks {missing[0]}, a number of the pose; export the raw data again")
        rows = [[values[f"t_{row}{column}"] for column in range(4)] for row in range(3)]
        intrinsics = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "w": "width", "h": "height"}
        frame: dict[str, Any] = {key: values[name] for key, name in intrinsics.items() if name in values}
        frames.append({**frame, "file_path": f"{images.name}/{image.name}", "transform_matrix": rows})
    return Frames(cameras, frames)


def _pose_names() -> list[str]:
    return [f"t_{row}{column}" for row in range(3) for column in range(4)]


def record3d_file(path: Path) -> Path | None:
    """Return the metadata of Record3D's frames in a folder, or None."""
    for file in (path / name for name in RECORD3D_FILES):
        if is_regular(file) and b'"poses"' in read_regular(file, MOST_BYTES):
            return file
    return None


def record3d_frames(file: Path) -> Frames:
    """Return the frames of Record3D: image N has pose N of the metadata, a quaternion (x, y, z, w) and a position.

    Raises:
      ValueError: if the metadata lack poses or intrinsics, or no image lies beside them.
    """
    values = _object(file)
    poses = _matrix(values.get("poses"), 7, f"{file}: poses")
    intrinsics = _record3d_intrinsics(file, values, len(poses))
    size: dict[str, Any] = {key: values[key] for key in ("w", "h") if key in values}
    frames = []
    for number, image in _numbered_images(file.parent):
        if number < len(poses):
            if not np.linalg.norm(poses[number, :4]) > 0:
                raise ValueError(f"{file}: pose {number} has a quaternion of length 0")
            turned = Rotation.from_quat(poses[number, :4]).as_matrix()
            pose = np.concatenate([turned, poses[number, 4:, None]], axis=1)
            fl_x, fl_y, cx, cy = intrinsics[number]
            lens: dict[str, Any] = {"fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy, **size}
            name = image.relative_to(file.parent).as_posix()
            frames.append({**lens, "file_path": name, "transform_matrix": pose.tolist()})
    if not frames:
        raise ValueError(f"{file}: no images rgb/0.jpg, rgb/1.jpg, … lie beside it; export RGB frames with Record3D")
    return Frames(file, frames)


def _record3d_intrinsics(file: Path, values: dict[str, Any], count: int) -> list[list[float]]:
    """Return (fx, fy, cx, cy) of each frame: its own, or those of the matrix K, which is stored by columns."""
    if values.get("perFrameIntrinsicCoeffs"):
        own: list[list[float]] = _matrix(
            values["perFrameIntrinsicCoeffs"], 4, f"{file}: perFrameIntrinsicCoeffs"
        ).tolist()
        if len(own) >= count:
            return own
    K = _matrix([values.get("K")], 9, f"{file}: K")[0].reshape(3, 3).T
    return [[float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]] * count


def _numbered_images(folder: Path) -> list[tuple[int, Path]]:
    """Return the images that are named by their number, sorted by it."""
    for base in (folder / name for name in RECORD3D_IMAGES):
        images = [file for file in base.glob("*") if file.suffix.lower() in SUFFIXES and file.stem.isdecimal()]
        if images:
            return sorted((int(file.stem), file) for file in images)
    return []


def _matrix(value: Any, width: int, what: str) -> np.ndarray:
    """Return rows [N, width] of finite numbers, or raise ValueError."""
    try:
        rows = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        rows = np.empty(0)
    if rows.ndim != 2 or rows.shape[1] != width or not np.isfinite(rows).all():
        raise ValueError(f"{what} must be rows of {width} finite numbers; got {shortened(value)}")
    return rows


def _object(file: Path) -> dict[str, Any]:
    try:
        values = parse_json(read_regular(file, MOST_BYTES))
    except ValueError as error:
        raise ValueError(f"{file}: cannot be read as JSON ({error})") from None
    if not isinstance(values, dict):
        raise ValueError(f"{file}: must hold an object; got {shortened(values)}")
    return values
