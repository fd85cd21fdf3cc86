"""Camera paths as JSON: views saved in the viewer for a flight."""

import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from a2tg_jax.core.cameras import Camera, check_calibration, check_camera
from a2tg_jax.host.json_text import MOST_BYTES, parse_json
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.host.text import shortened

FORMAT, VERSION = "a2tg-jax path", 1
# A file may come from a stranger: sides decide how much memory a frame takes.
LARGEST_SIDE, MOST_VIEWS = 16384, 10_000


def load_views(path: Path) -> list[Camera]:
    """Return the cameras of a file, in the world of the viewed model, float32. FileNotFoundError: there is no such
    file. ValueError, naming the file: it is invalid."""
    if not is_regular(path):
        raise FileNotFoundError(f"{path}: no such path; the viewer's 'Save path' makes one")
    try:
        data = parse_json(read_regular(path, MOST_BYTES))
        if not isinstance(data, dict) or data.get("format") != FORMAT or data.get("version") != VERSION:
            raise ValueError(f"is not a path of version {VERSION} that the viewer saved")
        views = data.get("views")
        if not isinstance(views, list) or not 1 <= len(views) <= MOST_VIEWS:
            raise ValueError(f"must hold 1 to {MOST_VIEWS:,} views")
        return [_camera(view, f"views[{index}]") for index, view in enumerate(views)]
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _camera(view: object, where: str) -> Camera:
    if not isinstance(view, dict):
        raise ValueError(f"{where} must be an object; got {shortened(view)}")

    def numbers(name: str, *shape: int) -> np.ndarray:
        values, count = view.get(name), math.prod(shape)
        if not isinstance(values, list) or len(values) != count or not all(type(x) in (int, float) for x in values):
            raise ValueError(f"{where}.{name} must be {count} numbers; got {shortened(values)}")
        return np.array(values, np.float64).reshape(shape)

    viewmat, K, (width, height) = numbers("viewmat", 4, 4), numbers("K", 3, 3), numbers("size", 2)
    if not all(1 <= side <= LARGEST_SIDE and side == int(side) for side in (width, height)):
        raise ValueError(f"{where}.size must be 1 to {LARGEST_SIDE} pixels; got {width:g} and {height:g}")
    check_calibration(viewmat, K, int(width), int(height), where)
    camera = Camera(jnp.asarray(viewmat, jnp.float32), jnp.asarray(K, jnp.float32), int(width), int(height))
    check_camera(camera, where)
    return camera
