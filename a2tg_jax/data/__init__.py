"""Readers that turn input into a Scene: COLMAP, transforms.json, plain photographs, the built-in scene.

Names are imported at their first use. A program without photographs loads neither Pillow nor a COLMAP reader.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from a2tg_jax.core.similarity import Similarity as Similarity
    from a2tg_jax.data.arrays import scene_from_arrays as scene_from_arrays
    from a2tg_jax.data.load import load_scene as load_scene
    from a2tg_jax.data.masks import Mask as Mask
    from a2tg_jax.data.observations import ObservedPoints as ObservedPoints
    from a2tg_jax.data.observations import observed_points as observed_points
    from a2tg_jax.data.photo_store import Picture as Picture
    from a2tg_jax.data.scene import Scene as Scene
    from a2tg_jax.data.scene import View as View
    from a2tg_jax.data.scene import counted_pixels as counted_pixels
    from a2tg_jax.data.scene import view_image as view_image
    from a2tg_jax.data.scene import views_by_kind as views_by_kind
    from a2tg_jax.data.sfm import SfmSummary as SfmSummary
    from a2tg_jax.data.sfm import run_sfm as run_sfm
    from a2tg_jax.data.splits import with_validation_views as with_validation_views
    from a2tg_jax.data.synthetic import synthetic_scene as synthetic_scene

_NAMES = {
    "a2tg_jax.core.similarity": ("Similarity",),
    "a2tg_jax.data.arrays": ("scene_from_arrays",),
    "a2tg_jax.data.load": ("load_scene",),
    "a2tg_jax.data.masks": ("Mask",),
    "a2tg_jax.data.observations": ("ObservedPoints", "observed_points"),
    "a2tg_jax.data.photo_store": ("Picture",),
    "a2tg_jax.data.scene": ("Scene", "View", "counted_pixels", "view_image", "views_by_kind"),
    "a2tg_jax.data.sfm": ("SfmSummary", "run_sfm"),
    "a2tg_jax.data.splits": ("with_validation_views",),
    "a2tg_jax.data.synthetic": ("synthetic_scene",),
}
"""Module of each public name; the imports above repeat them for type checkers."""

_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names}
__all__ = sorted(_MODULE_OF)

if not TYPE_CHECKING:  # Type checkers see the imports above, and that no other name exists.

    def __getattr__(name: str) -> Any:
        """Import a public name at its first use."""
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = value = getattr(importlib.import_module(_MODULE_OF[name]), name)
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
