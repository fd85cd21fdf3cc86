"""Atomic writes: files appear whole or not at all, and reach the disk before they replace others."""

import contextlib
import errno
import functools
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path

from a2tg_jax.host.operating_system import flush_folder

PARTIAL = re.compile(r"\.(.+)\.\d+\.partial")
"""Name pattern of a partial file: the name of the final file, and the process."""
STALE_SECONDS = 3600.0
"""Age without a change after which a partial file is assumed to be left by a killed process."""
NO_ROOM = frozenset({errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)})
"""Errors of a full disk and of a used-up quota."""


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path next to `path` to write to, and rename it to `path` if the block succeeds.

    If the process is killed or the machine loses power, the old file or none is left, never half of one. Missing parent
    folders are made. Partial files that killed processes left of the same file are deleted after an hour; a process
    looks for them once in a folder.

    Raises:
      OSError: as the block does. The error of a full disk names the file.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(OSError):  # Another process may delete them, and another user's stay.
        for partial, whole in _left_over_once(path.absolute().parent).items():
            if whole == path.absolute() and time.time() - partial.stat().st_mtime > STALE_SECONDS:
                partial.unlink()
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with named_if_full(path):
            yield temporary
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
            flush_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def named_if_full(path: Path) -> Iterator[None]:
    """Have the error of a full disk name a file that is written in the block."""
    try:
        yield
    except OSError as error:
        if error.errno in NO_ROOM:
            error.filename = os.fspath(path)
        raise


def left_over(folder: Path) -> dict[Path, Path]:
    """Return the partial files of a folder, with the files they were to become."""
    if not folder.is_dir():
        return {}
    return {entry: final_of(entry) for entry in folder.iterdir() if PARTIAL.fullmatch(entry.name)}


_left_over_once = functools.lru_cache(maxsize=64)(left_over)  # Folders of frames are long.


def final_of(path: Path) -> Path:
    """Return the file that a partial file was to become; any other path is returned unchanged."""
    match = PARTIAL.fullmatch(path.name)
    return path.with_name(match[1]) if match else path
