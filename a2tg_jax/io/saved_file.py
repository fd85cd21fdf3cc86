"""JSON files that the viewer saves: paths and edits."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from a2tg_jax.host.atomic import write_whole
from a2tg_jax.host.json_text import read_json
from a2tg_jax.host.regular_files import is_regular

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


def save_saved(path: Path, kind: str, content: Mapping[str, Any]) -> None:
    """Write a file of a kind, as the viewer does."""
    text = json.dumps({"format": f"a2tg-jax {kind}", "version": VERSION, **content}, indent=1)
    write_whole(path, text + "\n")
