"""Scenes of other programs, read as frames of `transforms.json`."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from a2tg_jax.data.lenses import LensUse
from a2tg_jax.data.masks import Mask
from a2tg_jax.data.photo_store import Picture, Shelf
from a2tg_jax.data.scene import PointCloud, Scene, Shot, assemble_scene, every_kth, scene_name
from a2tg_jax.data.transforms import check_meta, read_shots
from a2tg_jax.host.text import shortened


class Frames(NamedTuple):
    """Frames as `transforms.json` has them, made of files of another program."""

    file: Path
    """File that messages name; paths of images start from its folder."""
    frames: list[dict[str, Any]]
    cloud: PointCloud | None = None
    counted: Callable[[np.ndarray], np.ndarray] | None = None
    """Function from pixels [H, W, C] to a mask [H, W] of those that count."""


def load_frames(
    made: Frames, *, downscale: int, test_every: int, room: int | None = None, lens: LensUse = "undistort"
) -> Scene:
    """Make a scene of frames of another program.

    Args:
      made: the frames.
      downscale, test_every, room, lens: as in `load_scene`.

    Raises:
      FileNotFoundError, ValueError: as `load_transforms`.
    """
    meta = {"frames": made.frames}
    check_meta(made.file, meta)
    shots = sorted(read_shots(made.file, meta, downscale, Shelf(room), lens), key=lambda shot: shot.name)
    if made.counted is not None:
        shots = [_masked(shot, made.counted) for shot in shots]
    folder = made.file.resolve().parent
    return assemble_scene(scene_name(folder), *every_kth(shots, test_every), made.cloud, source=str(made.file))


def warn_of_missing_images(file: Path, lacking: Sequence[str], num_cameras: int) -> None:
    """Warn if some cameras have no image, whose names or numbers are given."""
    if lacking:
        message = f"{file}: {len(lacking)} of {num_cameras} cameras have no image beside them, such as "
        warnings.warn(f"{message}{shortened(lacking[0])}: not used", stacklevel=3)


def _masked(shot: Shot, counted: Callable[[np.ndarray], np.ndarray]) -> Shot:
    """Return a shot with a mask of its own pixels, unless it has one or all of them count."""
    mask = counted(Picture.of(shot.pixels).read()) if shot.mask is None else None
    return shot if mask is None or mask.all() else dataclasses.replace(shot, mask=Mask.of(mask))
