"""Files of figures."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from a2tg_jax.base.json_text import read_json
from a2tg_jax.base.text import shortened

Figures = Mapping[str, Any]


def read_kept(path: Path) -> dict[str, Figures]:
    """Return figures by key, as a file keeps them; empty if there is no file.

    Raises:
      ValueError: naming the file, if it is damaged.
    """
    kept = read_figures(path) if path.is_file() else {}
    for key, figures in kept.items():
        if not isinstance(figures, dict):
            raise ValueError(f"{path}: {key!r} must be an object of figures; got {shortened(figures)}")
    return kept


def read_figures(path: Path) -> dict[str, Any]:
    """Return the figures in a file.

    Raises:
      ValueError: naming the file, if it is damaged.
    """
    found = read_json(path)
    if not isinstance(found, dict):
        raise ValueError(f"{path} must hold an object; got {shortened(found)}")
    return found
