"""Contents of a COLMAP model's files, which the binary and the text format have in common.

    cameras   id, camera model, width, height, the model's parameters
    images    id, pose from world to camera, id of the camera, name, ids of the points that it observed
    points3D  id, position, colour, error; the track, which no reader here needs, is skipped
    rigs      id, sensors, of which the first is the reference, with poses from the rig
    frames    id, id of the rig, pose, data (an image each) that the rig took at one time

A pose is a quaternion (w, x, y, z) and a translation. References to records that do not exist are ignored, so that an
image can be removed from its file alone.
"""

import functools
from pathlib import Path
from typing import NamedTuple

import numpy as np

from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.host.text import shortened

KINDS = ("cameras", "images", "points3D", "rigs", "frames")
"""Names of a model's files without suffix. A model has cameras and images, and the others if it needs them."""
POINT = np.dtype([("id", "<u8"), ("position", "<f8", 3), ("color", "u1", 3), ("error", "<f8")])
NO_POINT = (1 << 64) - 1
"""Id of the point of a feature that observed none."""


class CameraRecord(NamedTuple):
    """Camera with a lens."""

    id: int
    model: str
    width: int
    height: int
    params: list[float]


class ImageRecord(NamedTuple):
    """Registered photograph."""

    id: int
    pose: list[float]
    """Quaternion and translation from world to camera."""
    camera_id: int
    name: str
    point_ids: np.ndarray
    """[N] uint64 ids of the points that its features observed, or `NO_POINT`."""


class RigRecord(NamedTuple):
    """Sensors that are fixed to each other."""

    id: int
    translations: list[list[float] | None]
    """Translations from the rig to each sensor but the first; None if it is unknown."""


class FrameRecord(NamedTuple):
    """Images that a rig took at one time."""

    id: int
    rig_id: int
    image_ids: list[int]


def decoded_name(path: Path, name: bytes) -> str:
    """Return the name of an image. Raise ValueError, naming the file, unless it is UTF-8."""
    try:
        return name.decode()
    except UnicodeDecodeError:
        told = shortened(name.decode(errors="backslashreplace"))
        raise ValueError(
            f"{path}: the image name {told} is not UTF-8; rename the photograph, and export the model again"
        ) from None


@functools.cache
def camera_models() -> dict[int, tuple[str, int]]:
    """Return the name and the number of parameters of COLMAP's camera models, by their number."""
    return {
        int(model): (name, len(pycolmap().Camera.create_from_model_name(0, name, 1.0, 1, 1).params))
        for name, model in pycolmap().CameraModelId.__members__.items()
        if name != "INVALID"
    }
