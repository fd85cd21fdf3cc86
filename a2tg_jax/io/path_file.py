"""Camera paths as JSON: views saved in the viewer for a flight."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from a2tg_jax.core.cameras import Camera
from a2tg_jax.host.json_text import MOST_BYTES, parse_json
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.host.text import shortened

FORMAT, VERSION = "a2tg-jax path", 1
LARGEST_SIDE = 16384
MOST_VIEWS = 10_000
LARGEST_NUMBER = 1e9
ROUNDING = 1e-3
"""Largest deviation of a matrix from a rotation."""


def load_views(path: Path) -> list[Camera]:
    """Return the cameras of a file, in the world of the model that was looked at, float32.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: naming the file, if it holds anything else.
    """
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


def _camera(view: Any, where: str) -> Camera:
    if not isinstance(view, dict):
        raise ValueError(f"{where} must be an object; got {shortened(view)}")
    viewmat, K = _numbers(view, "viewmat", (4, 4), where), _numbers(view, "K", (3, 3), where)
    width, height = _numbers(view, "size", (2,), where)
    rotation = viewmat[:3, :3]
    is_rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() < ROUNDING and np.linalg.det(rotation) > 0
    if not is_rigid or np.abs(viewmat[3] - [0, 0, 0, 1]).max() > ROUNDING:
        raise ValueError(f"{where}.viewmat must be a rigid motion")
    if not (K[0, 0] > 0 and K[1, 1] > 0) or np.abs(K[2] - [0, 0, 1]).max() > ROUNDING:
        raise ValueError(f"{where}.K must be intrinsics with positive focal lengths")
    if not all(1 <= side <= LARGEST_SIDE and side == int(side) for side in (width, height)):
        raise ValueError(f"{where}.size must be 1 to {LARGEST_SIDE} pixels; got {width:g} and {height:g}")
    return Camera(jnp.asarray(viewmat, jnp.float32), jnp.asarray(K, jnp.float32), int(width), int(height))


def _numbers(view: Mapping[str, Any], name: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    """Return finite numbers of a shape from a list in row order."""
    values, count = view.get(name), int(np.prod(shape))
    is_number = lambda x: isinstance(x, int | float) and not isinstance(x, bool)  # noqa: E731
    if not isinstance(values, list) or len(values) != count or not all(map(is_number, values)):
        raise ValueError(f"{where}.{name} must be {count} numbers; got {shortened(values)}")
    if max(map(abs, values)) > LARGEST_NUMBER:
        raise ValueError(f"{where}.{name} must be numbers up to {LARGEST_NUMBER:g}; got {shortened(values)}")
    return np.array(values, np.float64).reshape(shape)
