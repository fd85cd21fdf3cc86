"""Errors that a user can do something about, and their texts."""

import errno
import shutil
from pathlib import Path

import jax

from a2tg_jax.host.atomic import NO_ROOM
from a2tg_jax.host.text import shortened


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
    if error.filename is None:
        return "the disk is full: make room, or write to another disk"
    folder = next(above for above in Path(error.filename).absolute().parents if above.exists())
    free = f", {shutil.disk_usage(folder).free / 1e6:.1f} MB are free" if error.errno == errno.ENOSPC else ""
    return f"{error.filename}: the disk is full{free}: make room, or write to another disk"
