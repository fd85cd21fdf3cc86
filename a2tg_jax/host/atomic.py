"""Atomic writes: files appear whole or not at all, and reach the disk before they replace others."""

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

from a2tg_jax.host.operating_system import flush_folder

PARTIAL = re.compile(r"\.(.+)\.\d+\.partial")
"""Name pattern of a partial file: the name of the final file, and the process."""


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path` to write to, and rename it to `path` if the block succeeds.

    If the process is killed or the machine loses power, the old file or none is left, never half of one. Missing parent
    folders are made.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield temporary
        _flush(temporary)
        os.replace(temporary, path)
        flush_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def left_over(folder: Path) -> dict[Path, Path]:
    """Return the partial files of a folder, with the files they were to become."""
    if not folder.is_dir():
        return {}
    names = {entry: PARTIAL.fullmatch(entry.name) for entry in folder.iterdir()}
    return {entry: folder / match[1] for entry, match in names.items() if match}


def _flush(path: Path) -> None:
    with open(path, "rb+") as file:
        os.fsync(file.fileno())
