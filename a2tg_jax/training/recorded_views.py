"""Training views as checkpoints record them, so that training is resumed with the same ones."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from a2tg_jax.base.checks import check_shape
from a2tg_jax.base.text import first_names, shortened
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.scene import View

UNKNOWN = -1
"""Checksum of pixels that were not read, or of a missing mask."""
SHAPES: dict[str, tuple[int, ...]] = {"viewmats": (4, 4), "Ks": (3, 3), "sizes": (2,), "pixels": (), "masks": ()}
"""Shape of a view in each array of the records."""
CAMERA_TOLERANCE = 1e-4
"""Difference of cameras by which two machines may disagree."""


@dataclasses.dataclass(frozen=True, eq=False)
class RecordedViews:
    """Names, cameras and checksums of V training views, in their order."""

    names: tuple[str, ...]
    viewmats: np.ndarray
    """[V, 4, 4] world to camera, as the scene gives them."""
    Ks: np.ndarray
    """[V, 3, 3]"""
    sizes: np.ndarray
    """[V, 2] (height, width)."""
    pixels: np.ndarray
    """[V] CRC-32 of the pixels of the photographs."""
    masks: np.ndarray
    """[V] CRC-32 of the masks."""

    @staticmethod
    def of(views: Sequence[View]) -> "RecordedViews":
        """Return the record of some views; no photograph is read."""
        pixels = [UNKNOWN if view.picture.checksum is None else view.picture.checksum for view in views]
        masks = [UNKNOWN if view.mask is None else view.mask.checksum for view in views]
        return RecordedViews(
            names=tuple(view.name for view in views),
            viewmats=np.array([view.camera.viewmat for view in views], np.float64),
            Ks=np.array([view.camera.K for view in views], np.float64),
            sizes=np.array([view.picture.size for view in views], np.int64),
            pixels=np.array(pixels, np.int64),
            masks=np.array(masks, np.int64),
        )

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by name."""
        return {name: getattr(self, name) for name in SHAPES}

    @staticmethod
    def of_arrays(names: object, arrays: Mapping[str, np.ndarray]) -> "RecordedViews":
        """Return the record of names and `arrays` from a file. ValueError: they do not fit each other."""
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"views must be a list of names; got {shortened(names)}")
        for name, shape in SHAPES.items():
            check_shape(f"views.{name}", arrays[name], (len(names), *shape))
            if arrays[name].dtype.kind not in "if":
                raise ValueError(f"views.{name} must be numbers; got {arrays[name].dtype}")
        return RecordedViews(tuple(names), **{name: arrays[name] for name in SHAPES})

    def check(self, views: Sequence[View]) -> None:
        """Raise ValueError if a training is resumed with other views, sizes or cameras; warn of other pixels."""
        present = RecordedViews.of(views)
        advice = "resume with the scene that it was made from, or give its model to fit as start"
        check_names(self.names, present.names, "the checkpoint", advice)
        differ = (self.sizes != present.sizes).any(axis=1)
        for field in ("viewmats", "Ks"):
            recorded = getattr(self, field)
            is_close = np.isclose(recorded, getattr(present, field), rtol=CAMERA_TOLERANCE, atol=CAMERA_TOLERANCE)
            differ |= ~is_close.all(axis=(1, 2))
        if differ.any():
            raise ValueError(f"the checkpoint was trained with other cameras of {self._named(differ)}: {advice}")
        is_known = (self.pixels != UNKNOWN) & (present.pixels != UNKNOWN)
        changed = (is_known & (self.pixels != present.pixels)) | (self.masks != present.masks)
        if changed.any():
            warn(
                f"photographs or masks have changed since the checkpoint was made: {self._named(changed)}; what was "
                "learned from the former ones stays in the model"
            )

    def _named(self, chosen: np.ndarray) -> str:
        return first_names([self.names[index] for index in np.flatnonzero(chosen)])


def check_names(recorded: Sequence[str], present: Sequence[str], what: str, advice: str) -> None:
    """Raise ValueError, naming the views that are missing or new, unless training has the same views as before."""
    if list(recorded) == list(present):
        return
    missing = [name for name in recorded if name not in present]
    new = [name for name in present if name not in recorded]
    parts = [f"{first_names(missing)} missing"] if missing else []
    parts += [f"{first_names(new)} new"] if new else []
    difference = ", ".join(parts) or "their order differs"
    raise ValueError(
        f"{what} was trained on {len(recorded)} views, and the scene has {len(present)} to train on: {difference}; "
        f"{advice}"
    )
