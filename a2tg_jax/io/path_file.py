"""Camera paths as JSON: views saved in the viewer for a flight."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp

from a2tg_jax import Camera
from a2tg_jax.base.json_text import number_array
from a2tg_jax.base.text import shortened
from a2tg_jax.core.cameras import check_calibration
from a2tg_jax.io.saved_file import load_saved

# A file may come from a stranger: sides decide how much memory a frame takes.
LARGEST_SIDE = 16384
MOST_VIEWS = 10_000


def load_views(path: Path) -> list[Camera]:
    """Return the cameras of a file, in the world of the viewed model, float32. FileNotFoundError: there is no such
    file. ValueError, naming the file: it is invalid."""
    return load_saved(path, "path", _cameras)


def _cameras(data: dict[str, Any]) -> list[Camera]:
    views = data.get("views")
    if not isinstance(views, list) or not 1 <= len(views) <= MOST_VIEWS:
        raise ValueError(f"must hold 1 to {MOST_VIEWS:,} views")
    return [_camera(view, f"views[{index}]") for index, view in enumerate(views)]


def _camera(view: object, where: str) -> Camera:
    if not isinstance(view, dict):
        raise ValueError(f"{where} must be an object; got {shortened(view)}")
    viewmat = number_array(view.get("viewmat"), 16, f"{where}.viewmat").reshape(4, 4)
    K = number_array(view.get("K"), 9, f"{where}.K").reshape(3, 3)
    width, height = number_array(view.get("size"), 2, f"{where}.size")
    if not all(1 <= side <= LARGEST_SIDE and side == int(side) for side in (width, height)):
        raise ValueError(f"{where}.size must be 1 to {LARGEST_SIDE} pixels; got {width:g} and {height:g}")
    check_calibration(viewmat, K, int(width), int(height), where)
    return Camera(jnp.asarray(viewmat, jnp.float32), jnp.asarray(K, jnp.float32), int(width), int(height))
