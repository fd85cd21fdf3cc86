"""Atomic writes: files appear whole or not at all, and reach the disk before they replace others."""

import contextlib
import errno
import functools
import os
import platform
import re
import time
from collections.abc import Iterator
from pathlib import Path

import psutil

from a2tg_jax.base.operating_system import flush_folder

PARTIAL = re.compile(r"\.(.+)\.(\d+)(?:@([^@]*))?\.partial")
"""Name of a partial file: the name of the final file, the process, and its machine, because disks may be shared.
Earlier files lack the machine."""
STALE_SECONDS = 3600.0
"""Seconds without a change after which a partial file counts as left over, though its process seems to run: another
process may have got the number."""
NO_ROOM = frozenset({errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)})
"""Errors of a full disk and of an exceeded quota."""


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to `path` to write to, and rename it to `path` if the block succeeds.

    If the process is killed or the machine loses power, the old file or none is left, never half of one. Missing parent
    folders are made. A link stays, and the file that it leads to is written. Partial files of it, left over by killed
    processes, are deleted.

    Raises:
      OSError: from the block, or if `file_to_write` refuses the path. The error of a full disk names the file.
    """
    path = file_to_write(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(OSError):  # Another process may delete them; another user's cannot be deleted.
        for partial, whole in _left_over_once(path.absolute().parent).items():
            if whole == path.absolute() and is_left_over(partial):
                partial.unlink()
    # In the same folder, because os.replace cannot move between disks.
    temporary = path.with_name(f".{path.name}.{os.getpid()}@{platform.node()}.partial")
    try:
        with named_if_full(path):
            yield temporary
            with open(temporary, "rb+") as file:  # Windows flushes only what is open for writing.
                os.fsync(file.fileno())
            os.replace(temporary, path)
            flush_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def file_to_write(path: Path) -> Path:
    """Return the path itself or, if it is a link, the file that it leads to, which need not exist.

    Raises:
      OSError: if links lead in a circle, to a device, a pipe or a socket, which renaming would replace, or to a folder
        that does not exist, such as on a disk that is not mounted.
    """
    for folder in path.parents:
        if folder.is_symlink() and not folder.exists():
            raise FileNotFoundError(f"{folder} is a link to {os.readlink(folder)}, which does not exist: make it first")
    target = path
    if path.is_symlink():
        # Unlike Path.resolve, realpath accepts circular links, and returns one of them.
        target = Path(os.path.realpath(path))
        if target.is_symlink():
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), os.fspath(path))
        if not target.parent.is_dir():
            raise FileNotFoundError(
                f"{path} is a link to {target}, but there is no folder {target.parent}: make it first"
            )
    if target.exists() and not target.is_file() and not target.is_dir():
        raise FileExistsError(f"{path} is a device, pipe or socket, or a link to one: give the path of a file")
    return target


def write_whole(path: Path, data: bytes | str) -> None:
    """Write a file as `replacing` does; text is written as UTF-8, with line ends as they are."""
    with replacing(path) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


@contextlib.contextmanager
def named_if_full(path: Path) -> Iterator[None]:
    """Add the name of a file that is written in the block to the error of a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno in NO_ROOM:
            error.filename = os.fspath(path)
        raise


def left_over(folder: Path) -> dict[Path, Path]:
    """Return the partial files of a folder, with the files they were to become."""
    partials = {}
    for name in os.listdir(folder) if folder.is_dir() else ():
        match = PARTIAL.fullmatch(name)
        if match:
            partials[folder / name] = folder / match[1]
    return partials


def is_left_over(partial: Path) -> bool:
    """Return whether the process of a partial file was one of this machine and has ended, or has not written to it for
    an hour."""
    match = PARTIAL.fullmatch(partial.name)
    assert match is not None, "one of `left_over`"
    is_here = match[3] in (None, platform.node())
    has_ended = is_here and not psutil.pid_exists(int(match[2]))
    return has_ended or time.time() - partial.stat().st_mtime > STALE_SECONDS


# Once per folder and process: a folder of frames has thousands of entries.
_left_over_once = functools.lru_cache(maxsize=64)(left_over)
