"""Messages for errors that a user can fix."""

import contextlib
import errno
import os
import shlex
import shutil
from pathlib import Path

from a2tg_jax.base.atomic import NO_ROOM
from a2tg_jax.base.text import shortened

PLENTY = 1 << 30
"""Free bytes above which a disk that accepts no file is likely to lack inodes."""


def error_text(error: Exception, less_memory: str) -> str | None:
    """Return the message of a user's error, or of full memory or disk; None for an error of the program itself.

    Args:
      error: any error.
      less_memory: advice if the machine or a device has run out of memory.
    """
    if isinstance(error, ModuleNotFoundError) and error.name == "matplotlib":  # What commands import first of [train].
        return "this command needs matplotlib, which is not installed: pip install 'a2tg-jax[train]'"
    if isinstance(error, ImportError) and "failed to map segment" in str(error):
        return f"not enough memory to load a library ({shortened(str(error), 120)}): {less_memory}"
    # JAX's errors are RuntimeErrors; jax.errors itself takes a second to import.
    is_of_device = isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" in str(error)
    if is_of_device or isinstance(error, MemoryError):
        details = shortened(str(error), 120)
        # Not "out of memory": cli.main prints a first word that was typed as an option as --out.
        return f"not enough memory{f' ({details})' if details else ''}: {less_memory}"
    if not (isinstance(error, OSError) and error.errno in NO_ROOM):
        return str(error) if isinstance(error, ValueError | OSError) else None
    # Of two files, the second one was written.
    written = error.filename2 or error.filename
    if not isinstance(written, str | os.PathLike):
        return "the disk is full: make room, or write to another disk"
    details = ""
    path = Path(written).absolute()
    if error.errno == errno.ENOSPC:  # Free bytes say nothing about a quota.
        with contextlib.suppress(OSError):
            # The file's folder may be missing.
            free = shutil.disk_usage(next(above for above in (path, *path.parents) if above.is_dir())).free
            inodes = " or has no inodes left" if free > PLENTY else ""
            details = f"{inodes}, {free / 1e6:.1f} MB are free"
    return f"{written}: the disk is full{details}: make room, or write to another disk"


def as_argument(path: Path) -> str:
    """Return a path quoted for a shell, relative to the current folder if it is inside."""
    here = Path.cwd()
    return shlex.quote(str(path.relative_to(here) if path.is_relative_to(here) else path))
