"""Archives: named arrays with a JSON header in one uncompressed .npz, readable by numpy alone.

The entry "header" is JSON text as bytes; its "format" and "version" identify the file.
"""

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax.base.atomic import replacing
from a2tg_jax.base.json_text import parse_json
from a2tg_jax.base.npz import read_npz
from a2tg_jax.base.regular_files import check_exists
from a2tg_jax.base.text import shortened

FORMAT = "a2tg-jax checkpoint"
VERSION = 1
HEADER = "header"


def write_archive(
    path: Path,
    header: Mapping[str, object],
    arrays: Mapping[str, np.ndarray],
    *,
    format: str = FORMAT,
) -> None:
    """Write an archive; an existing file is replaced once the new one is complete.

    Args:
      path: the file, conventionally *.npz.
      header: JSON-able values; "format" and "version" are added.
      arrays: named arrays of plain dtypes; the name "header" is reserved.
      format: what kind of archive this is; `read_archive` expects the same.
    """
    # NaN is not JSON: strict parsers, browsers among them, reject it.
    text = json.dumps({**header, "format": format, "version": VERSION}, allow_nan=False)
    # The header is bytes, not a NumPy string: `read_npz` accepts numbers only.
    entries = {HEADER: np.frombuffer(text.encode(), np.uint8), **{name: np.asarray(a) for name, a in arrays.items()}}
    # An open file, because NumPy appends .npz to paths without it, and `replacing` would not find the result.
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **entries)  # type: ignore[arg-type]


def read_archive(
    path: Path, *, format: str = FORMAT, names: Collection[str] | None = None
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the header and the arrays of `write_archive`; `names` selects arrays. FileNotFoundError: there is no such
    file. ValueError: it is not such an archive, is damaged, lacks one of the names, or has another version."""
    # Naming a run folder instead of its model is a likely mistake.
    if path.is_dir():
        models = sorted(path.glob("models/*.npz"))
        such_as = f", such as {models[0]}" if models else ""
        raise ValueError(f"{path}: is a folder; name a file{such_as}")
    check_exists(path, format)
    try:
        arrays = read_npz(path, lambda name: name == HEADER or names is None or name in names)
        for name in (HEADER, *(names or ())):
            if name not in arrays:
                raise ValueError(f"it has no {name}")
        header = parse_json(arrays.pop(HEADER).tobytes())
        if not isinstance(header, dict):
            raise ValueError("its header is not a JSON object")
    except ValueError as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise ValueError(f"{path}: is not an {format}, or is damaged ({reason}); copy or write it again") from error
    if header.get("format") != format:
        # Naming a checkpoint instead of its run folder is another one.
        run = path.parent.parent
        advice = f"; give its run folder, {run}" if (run / "run.toml").is_file() else ""
        raise ValueError(f"{path}: is an {shortened(header.get('format'))}, not an {format}{advice}")
    if header.get("version") != VERSION:
        raise ValueError(
            f"{path}: is an {format} of version {shortened(header.get('version'))}; this program reads version "
            f"{VERSION}, so use the version of a2tg-jax that wrote it"
        )
    return header, arrays


def read_archive_header(path: Path, *, format: str = FORMAT) -> dict[str, Any]:
    """Return the header, without reading the arrays. Raises as `read_archive` does."""
    return read_archive(path, format=format, names=())[0]


def arrays_below(prefix: str, arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arrays whose names have a prefix, by the rest of their names."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
