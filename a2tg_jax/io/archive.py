"""Archives: named arrays with a JSON header in one uncompressed .npz, readable by numpy alone.

The entry "header" holds the JSON text as bytes; its "format" and "version" say what the file is.
"""

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.json_text import parse_json
from a2tg_jax.host.npz import read_npz
from a2tg_jax.host.regular_files import is_folder, is_regular
from a2tg_jax.host.text import shortened

FORMAT = "a2tg-jax checkpoint"
VERSION = 1
HEADER = "header"


def write_archive(
    path: str | os.PathLike[str], header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], *, format: str = FORMAT
) -> None:
    """Write an archive; an older file of that name is replaced once the new one is whole.

    Args:
      path: the file, by custom *.npz.
      header: JSON-able values; "format" and "version" are added.
      arrays: named arrays of plain dtypes; the name "header" is taken.
      format: what kind of archive this is; `read_archive` wants the same.
    """
    text = json.dumps({**header, "format": format, "version": VERSION}, allow_nan=False)
    entries = {HEADER: np.frombuffer(text.encode(), np.uint8), **{name: np.asarray(a) for name, a in arrays.items()}}
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **entries)  # type: ignore[arg-type]


def read_archive(path: str | os.PathLike[str], *, format: str = FORMAT) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the header and the arrays that `write_archive` was given.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is not such an archive, is damaged, or is of another version.
    """
    header = read_archive_header(path, format=format)
    return header, _read_entries(Path(path), format, lambda name: name != HEADER)


def read_archive_array(path: str | os.PathLike[str], name: str, *, format: str = FORMAT) -> np.ndarray:
    """Return one array, without reading the others. Raises as `read_archive` does."""
    read_archive_header(path, format=format)
    entries = _read_entries(Path(path), format, lambda found: found == name)
    if name not in entries:
        raise _damaged(Path(path), format, f"it has no {name}")
    return entries[name]


def read_archive_header(path: str | os.PathLike[str], *, format: str = FORMAT) -> dict[str, Any]:
    """Return the header alone, without reading the arrays. Raises as `read_archive` does."""
    path = Path(path)
    entries = _read_entries(path, format, lambda name: name == HEADER)
    if HEADER not in entries:
        raise _damaged(path, format, "it has no header")
    try:
        header = parse_json(entries[HEADER].tobytes())
    except ValueError as error:
        raise _damaged(path, format, f"its header: {error}") from error
    if not isinstance(header, dict):
        raise _damaged(path, format, "its header is no JSON object")
    found, version = header.get("format"), header.get("version")
    if found != format:
        raise ValueError(f"{path}: is an {shortened(found)}, not an {format}")
    if version != VERSION:
        raise ValueError(
            f"{path}: is an {format} of version {shortened(version)}; this program reads version {VERSION}, "
            "so use the version of a2tg-jax that wrote it"
        )
    return header


def _read_entries(path: Path, format: str, is_wanted: Callable[[str], bool]) -> dict[str, np.ndarray]:
    """Return the wanted arrays of an .npz; whatever is wrong with the file becomes one ValueError."""
    if is_folder(path):
        found = sorted(path.glob("models/*.npz"))
        raise ValueError(f"{path}: is a folder; name a file{f', such as {found[0]}' if found else ''}")
    if not is_regular(path):
        raise FileNotFoundError(f"{path}: no such {format}")
    try:
        return read_npz(path, is_wanted)
    except ValueError as error:
        raise _damaged(path, format, str(error).removeprefix(f"{path}: ")) from error


def _damaged(path: Path, format: str, reason: str) -> ValueError:
    return ValueError(f"{path}: is not an {format}, or is damaged ({reason}); copy or write it again")
