"""JSON files that the viewer saves: paths and edits."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from a2tg_jax.host.json_text import read_json
from a2tg_jax.host.regular_files import is_regular
from a2tg_jax.host.text import shortened

T = TypeVar("T")
VERSION = 1


def load_saved(path: Path, kind: str, parse: Callable[[dict[str, Any]], T]) -> T:
    """Return what `parse` makes of the object in a file of a kind, "path" or "edit".

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: naming the file, if it is of another kind or version, or `parse` raises ValueError.
    """
    if not is_regular(path):
        raise FileNotFoundError(f"{path}: no such {kind}; the viewer's 'Save {kind}' makes one")
    data = read_json(path, allow_nan=False)
    try:
        if not isinstance(data, dict) or (data.get("format"), data.get("version")) != (f"a2tg-jax {kind}", VERSION):
            article = "an" if kind[0] in "aeiou" else "a"
            raise ValueError(f"is not {article} {kind} of version {VERSION} that the viewer saved")
        return parse(data)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def numbers_of(values: object, count: int, name: str, null: float | None = None) -> np.ndarray:
    """Return a list of numbers as an array [count]; null becomes `null`, if that is given. Raises ValueError with
    `name` for anything else."""
    kinds = (int, float) if null is None else (int, float, type(None))
    if not isinstance(values, list) or len(values) != count or not all(type(x) in kinds for x in values):
        wanted = f"{count} numbers{'' if null is None else ' or null'}"
        raise ValueError(f"{name} must be {wanted}; got {shortened(values)}")
    return np.array([null if x is None else x for x in values], np.float64)
