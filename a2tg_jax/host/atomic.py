"""Files that appear whole or not at all, and are on the disk before they take the place of others."""

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

PARTIAL = re.compile(r"\.(.+)\.\d+\.partial")
"""Name of a file that is being written: that of the file that it becomes, and the process."""


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """Yields a temporary path beside `path` to write to, and renames it to `path` if the block ends well.

    A run killed while it writes, or a machine that loses its power, leaves the old file, or none, never half of one.
    Missing parent folders are made.
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
    """Files of a folder that were being written, and what they were to become."""
    if not folder.is_dir():
        return {}
    names = {entry: PARTIAL.fullmatch(entry.name) for entry in folder.iterdir()}
    return {entry: folder / match[1] for entry, match in names.items() if match}


def flush_folder(folder: Path) -> None:
    """Has the names of a folder's files on the disk, where the operating system lets folders be flushed."""
    if os.name == "nt":
        return
    number = os.open(folder, os.O_RDONLY)
    try:
        # Some file systems of networks refuse it; they keep names in another way.
        with contextlib.suppress(OSError):
            os.fsync(number)
    finally:
        os.close(number)


def _flush(path: Path) -> None:
    with open(path, "rb+") as file:
        os.fsync(file.fileno())
