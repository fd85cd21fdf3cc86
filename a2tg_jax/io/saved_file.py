"""JSON files that the viewer saves: paths and edits."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from a2tg_jax.base.json_text import read_json
from a2tg_jax.base.regular_files import check_exists, expanded

T = TypeVar("T")
VERSION = 1
WRITERS = {"path": "the viewer's 'Save path'", "edit": "a2tg edit or the viewer's 'Save edit'"}
"""Programs that write each kind of file, in words."""


def load_saved(path: Path, kind: str, parse: Callable[[dict[str, Any]], T]) -> T:
    """Return what `parse` makes of the object in a file of a kind, "path" or "edit".

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: naming the file, if it is of another kind or version, or `parse` raises ValueError.
    """
    path = expanded(path)
    check_exists(path, f"{kind}; {WRITERS[kind]} makes one")
    wanted = f"give {kind}.json, which {WRITERS[kind]} makes"
    try:
        data = read_json(path, allow_nan=False)
    except ValueError as error:
        raise ValueError(f"{error}; {wanted}") from None
    try:
        if not isinstance(data, dict) or (data.get("format"), data.get("version")) != (f"a2tg-jax {kind}", VERSION):
            article = "an" if kind[0] in "aeiou" else "a"
            raise ValueError(f"is not {article} {kind} of version {VERSION}; {wanted}")
        return parse(data)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
