"""Record3D's frames: images named by number beside metadata with ARKit's poses, read as frames of `transforms.json`."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from a2tg_jax.data.frames import Frames, warn_of_missing_images
from a2tg_jax.data.images import PHOTO_SUFFIXES
from a2tg_jax.host.json_text import MOST_BYTES, read_object
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.host.text import shortened

METADATA = ("metadata", "metadata.json")
IMAGE_FOLDERS = ("rgb", "rgbd", ".")


def record3d_file(path: Path) -> Path | None:
    """Return the metadata of Record3D's frames in a folder, or None."""
    for file in (path / name for name in METADATA):
        if is_regular(file) and b'"poses"' in read_regular(file, MOST_BYTES):
            return file
    return None


def record3d_frames(file: Path) -> Frames:
    """Return the frames of Record3D: image N has pose N of the metadata, a quaternion (x, y, z, w) and a position.

    Raises:
      ValueError: if the metadata lack poses or intrinsics, or no image lies beside them.
    """
    values = read_object(file)
    poses = _matrix(values.get("poses"), 7, f"{file}: poses")
    intrinsics = _record3d_intrinsics(file, values, len(poses))
    size: dict[str, Any] = {key: values[key] for key in ("w", "h") if key in values}
    frames = []
    images = _numbered_images(file.parent)
    for number, image in sorted(images.items()):
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
    unposed = [image.name for number, image in sorted(images.items()) if number >= len(poses)]
    if unposed:
        message = f"{file}: {len(unposed)} of {len(images)} images have no pose, such as {unposed[0]}: not used"
        warnings.warn(message, stacklevel=2)
    lacking = sorted(set(range(len(poses))) - set(images))
    warn_of_missing_images(file, [str(number) for number in lacking], len(poses))
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


def _numbered_images(folder: Path) -> dict[int, Path]:
    """Return the images that are named by their number."""
    for base in (folder / name for name in IMAGE_FOLDERS):
        images = [file for file in base.glob("*") if file.suffix.lower() in PHOTO_SUFFIXES and file.stem.isdecimal()]
        if images:
            return {int(file.stem): file for file in sorted(images, reverse=True)}
    return {}


def _matrix(value: Any, width: int, what: str) -> np.ndarray:
    """Return rows [N, width] of finite numbers, or raise ValueError."""
    try:
        rows = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        rows = np.empty(0)
    if rows.ndim != 2 or rows.shape[1] != width or not np.isfinite(rows).all():
        raise ValueError(f"{what} must be rows of {width} finite numbers; got {shortened(value)}")
    return rows
