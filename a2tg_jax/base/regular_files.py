"""Untrusted files: only regular files up to a size limit are opened.

Links are followed if they lead to a regular file: reading a device never ends, and a pipe waits for a writer.
"""

import contextlib
import hashlib
import os
import re
import stat
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path

from a2tg_jax.base.text import shortened

LONGEST_REASON = 500
"""Largest number of characters of an error that quotes a file."""
MOST_ARRAY_BYTES = 1 << 34
"""Largest file of arrays: models, checkpoints, weights, point clouds and COLMAP's models."""
LARGEST_RATIO = 64
"""Largest growth of an untrusted file that is unpacked, as a multiple of its size."""
FREE_ROOM = 1 << 20
"""Bytes that any file may unpack to."""
LFS_POINTER = b"version https://git-lfs.github.com/spec/"
"""Beginning of the text that git-lfs leaves for a file (https://github.com/git-lfs/git-lfs, spec)."""
MOST_POINTER_BYTES = 1024
"""Largest size of that text."""
URL = re.compile(r"[A-Za-z][\w+.:-]+://")
READING = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
"""Flags to open a file for reading bytes, without waiting for a pipe's writer or changing newlines."""


def expanded(path: str | os.PathLike[str]) -> Path:
    """Return a path of the user, with the home folder for a leading ~, as a shell expands it.

    Not for names in files: a scene in the current folder might name a photograph ~/private.png.

    Raises:
      ValueError: if it is no path, or a URL. The message leaves out what follows its scheme, such as a password.
    """
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"a path must be text or a Path; got {path!r}")
    scheme = URL.match(os.fspath(path))
    if scheme is not None:
        raise ValueError(f"{scheme[0]}…: is a URL; mount the bucket (rclone mount), or copy the files to this machine")
    # Unlike Path.expanduser, it leaves the name of an unknown user as it is.
    return Path(os.path.expanduser(path))


def room_of(num_bytes: int) -> int:
    """Return the number of bytes that an untrusted file of this size may unpack to."""
    return FREE_ROOM + LARGEST_RATIO * num_bytes


def is_regular(path: Path) -> bool:
    """Return whether a path is a regular file; False if it is missing or a folder.

    Raises:
      ValueError: naming the path, if a device, a pipe or a socket is there.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise ValueError(_refusal(path))
    return path.is_file()


def names_in(folder: Path) -> list[str]:
    """Return the sorted names of the files and folders in a folder; none if there is no such folder."""
    return sorted(os.listdir(folder)) if folder.is_dir() else []


def open_regular(path: Path, most_bytes: int = MOST_ARRAY_BYTES) -> BufferedReader:
    """Open a regular file for reading bytes, of at most a given size.

    Raises:
      OSError: if it cannot be opened.
      ValueError: naming the path, if it is not a regular file, is larger, or is a pointer of git-lfs.
    """
    # Opening alone can have effects on a device.
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise ValueError(_refusal(path))
    # A pipe may have replaced it meanwhile; opening does not wait for its writer.
    file = open(os.open(path, READING), "rb")  # noqa: SIM115 - the caller closes it
    status = os.fstat(file.fileno())
    if not stat.S_ISREG(status.st_mode):
        reason = _refusal(path)
    elif status.st_size > most_bytes:
        reason = f"{path}: has {status.st_size:,} bytes, and {most_bytes:,} are the most that such a file may have"
    elif status.st_size < MOST_POINTER_BYTES and file.peek().startswith(LFS_POINTER):
        reason = f"{path}: is a pointer of git-lfs, a text that replaces the file; run `git lfs pull` in its repository"
    else:
        return file
    file.close()
    raise ValueError(reason)


def read_regular(path: Path, most_bytes: int) -> bytes:
    """Read the bytes of a regular file, up to its size when opened. Errors as in `open_regular`."""
    with open_regular(path, most_bytes) as file:
        # A file may grow beyond the bound while it is read.
        return file.read(os.fstat(file.fileno()).st_size)


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _refusal(path: Path) -> str:
    return f"{path}: is not a regular file but a folder, device, pipe or socket; put a file there"


def check_exists(path: Path, what: str) -> None:
    """Raise FileNotFoundError, calling it `what`, unless there is a regular file."""
    if not is_regular(path):
        raise FileNotFoundError(f"{path}: no such {what}")


def existing_bytes(path: Path, what: str) -> bytes:
    """Return the bytes of a regular file. FileNotFoundError, calling it `what`: there is none."""
    check_exists(path, what)
    return read_regular(path, MOST_ARRAY_BYTES)


@contextlib.contextmanager
def reading(path: Path | str) -> Iterator[None]:
    """Turn errors about a file's content into one ValueError that names it."""
    where = str(path)
    try:
        yield
    except KeyError as error:
        raise ValueError(f"{where}: lacks {shortened(str(error))}; it is damaged or of another version") from error
    # What JSON of another shape than expected raises on access.
    except (TypeError, IndexError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{where}: is damaged or of another version ({shortened(repr(error))})") from error
    except ValueError as error:
        reason = shortened(str(error), LONGEST_REASON)
        # Inner readers may have named the file already.
        raise ValueError(reason if reason.startswith(where) else f"{where}: {reason}") from error
