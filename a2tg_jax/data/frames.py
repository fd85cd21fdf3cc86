"""Scenes of other programs, read as frames of `transforms.json`."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from a2tg_jax.data.assembly import PointCloud, Shot, assemble_scene
from a2tg_jax.data.division import Division, divided_masks
from a2tg_jax.data.lenses import LensUse
from a2tg_jax.data.masks import Mask
from a2tg_jax.data.photo_store import Picture, Shelf
from a2tg_jax.data.scene import Scene, scene_name
from a2tg_jax.data.splits import every_kth
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
    made: Frames, *, downscale: int, test_every: int, room: int | None = None, lens: LensUse = "undistort",
    division: Division | None = None,
) -> Scene:  # fmt: skip
    """Make a scene of frames of another program.

    Args:
      made: the frames.
      downscale, test_every, room, lens: as in `load_scene`.
      division: processes that call this together; None: one.

    Raises:
      FileNotFoundError, ValueError: as `load_transforms`.
    """
    meta = {"frames": made.frames}
    check_meta(made.file, meta)
    (group,) = read_shots([(made.file, meta)], downscale, Shelf(room), lens, division)
    shots = sorted(group, key=lambda shot: shot.name)
    if made.counted is not None:
        shots = _masked(shots, made.counted, division)
    folder = made.file.resolve().parent
    return assemble_scene(scene_name(folder), *every_kth(shots, test_every), made.cloud, source=str(made.file))


def warn_of_missing_images(file: Path, lacking: Sequence[str], num_cameras: int) -> None:
    """Warn if some cameras have no image, whose names or numbers are given."""
    if lacking:
        message = f"{file}: {len(lacking)} of {num_cameras} cameras have no image beside them, such as "
        warnings.warn(f"{message}{shortened(lacking[0])}: not used", stacklevel=3)


def _masked(shots: list[Shot], counted: Callable[[np.ndarray], np.ndarray], division: Division | None) -> list[Shot]:
    """Return shots with a mask of their own pixels, unless they have one or all of them count."""

    def mask_of(number: int) -> Mask | None:
        shot = shots[number]
        mask = counted(Picture.of(shot.pixels).read()) if shot.mask is None else None
        return shot.mask if mask is None or mask.all() else Mask.of(mask)

    masks = divided_masks([shot.name for shot in shots], mask_of, division)
    return [dataclasses.replace(shot, mask=mask) for shot, mask in zip(shots, masks, strict=True)]
