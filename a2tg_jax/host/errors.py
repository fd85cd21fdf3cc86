"""Errors that a user can do something about, and their texts."""

import contextlib
import errno
import os
import shutil
from pathlib import Path

import jax

from a2tg_jax.host.atomic import NO_ROOM
from a2tg_jax.host.text import shortened

PLENTY = 1 << 30
"""Free bytes above which a disk that takes no file may lack inodes."""


def error_text(error: Exception, less_memory: str) -> str | None:
    """Return the text of a user's error, or of a lack of memory or disk; None for an error of the program itself.

    Args:
      error: any error.
      less_memory: advice that follows if the machine or a device has run out of memory.
    """
    is_of_device = isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" in str(error)
    if is_of_device or isinstance(error, MemoryError):
        details = shortened(str(error), 120)
        return f"the memory does not suffice{f' ({details})' if details else ''}: {less_memory}"
    if isinstance(error, OSError) and error.errno in NO_ROOM:
        return _full_disk_text(error)
    return str(error) if isinstance(error, ValueError | OSError) else None


def _full_disk_text(error: OSError) -> str:
    """Return which file a disk has no room for, how much is free, and what to do."""
    is_named = isinstance(error.filename, str | os.PathLike)
    free = _free_bytes(Path(error.filename)) if is_named and error.errno == errno.ENOSPC else None
    inodes = " or has no inodes left" if free is not None and free > PLENTY else ""
    room = "" if free is None else f", {free / 1e6:.1f} MB are free"
    text = f"{error.filename}: the disk is full{inodes}{room}: make room, or write to another disk"
    return text if is_named else text.removeprefix(f"{error.filename}: ")


def _free_bytes(path: Path) -> int | None:
    """Return the free bytes of the disk of a file or folder that need not exist; None if nobody knows them."""
    path = path.absolute()
    with contextlib.suppress(OSError):
        return shutil.disk_usage(next(above for above in (path, *path.parents) if above.is_dir())).free
    return None
