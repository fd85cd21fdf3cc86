"""Untrusted files: only regular files up to a largest size are opened.

Links are followed, because their owner makes them on purpose. Their target must be a regular file: a device never ends,
and a pipe waits for a writer. Remote files (`host.remote_files`) are fetched to temporary ones.
"""

import hashlib
import os
import stat
from io import BufferedReader
from pathlib import Path
from typing import cast

from a2tg_jax.host.remote_files import fetched, is_remote, is_remote_file, is_remote_folder, remote_names, remote_size

MOST_ARRAY_BYTES = 1 << 34
"""Largest file of arrays: models, checkpoints, weights, point clouds and COLMAP's models."""
READING = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
"""Flags to open a file for reading bytes: never waiting for a pipe's writer, never changing newlines."""


def is_regular(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is a regular file; False if it is missing or a folder.

    Raises:
      ValueError: naming the path, if a device, a pipe or a socket is there.
    """
    if is_remote(path):
        return is_remote_file(cast(Path, path))
    path = Path(path)
    if path.is_file():
        return True
    if not path.exists() or path.is_dir():
        return False
    raise ValueError(_refusal(path))


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder."""
    return is_remote_folder(path) if is_remote(path) else path.is_dir()


def names_in(folder: Path) -> list[str]:
    """Return the sorted names of the files and folders in a folder; none if there is no such folder."""
    if is_remote(folder):
        return remote_names(folder)
    return sorted(os.listdir(folder)) if folder.is_dir() else []


def open_regular(path: str | os.PathLike[str], most_bytes: int = MOST_ARRAY_BYTES) -> BufferedReader:
    """Open a regular file for reading bytes, of at most a given size.

    Raises:
      OSError: if it cannot be opened.
      ValueError: naming the path, if it is not a regular file, or is larger.
    """
    if is_remote(path):
        size = remote_size(cast(Path, path))
        if size is not None and size > most_bytes:
            raise ValueError(_too_large(path, size, most_bytes))
        return fetched(cast(Path, path), size, most_bytes)
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise ValueError(_refusal(path))
    # It may have been replaced by a pipe meanwhile, for whose writer this does not wait.
    file = open(os.open(path, READING), "rb")  # noqa: SIM115 - the caller closes it
    status = os.fstat(file.fileno())
    if stat.S_ISREG(status.st_mode) and status.st_size <= most_bytes:
        return file
    file.close()
    raise ValueError(_too_large(path, status.st_size, most_bytes) if stat.S_ISREG(status.st_mode) else _refusal(path))


def read_regular(path: str | os.PathLike[str], most_bytes: int) -> bytes:
    """Read the bytes of a regular file, up to the size that it has when it is opened. Raises as `open_regular`."""
    with open_regular(path, most_bytes) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _refusal(path: str | os.PathLike[str]) -> str:
    return f"{path}: is not a regular file but a folder, device, pipe or socket; put a file there"


def _too_large(path: str | os.PathLike[str], size: int, most_bytes: int) -> str:
    return f"{path}: has {size:,} bytes, and {most_bytes:,} are the most that such a file may have"
