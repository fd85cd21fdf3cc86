"""Files in object storage and wherever else fsspec reaches. Their paths are those of universal_pathlib.

Such a path has pathlib's methods and is annotated as `Path`. Each question to a store takes a while, so every folder is
listed once, and files are fetched whole. What fails is tried again.
"""

import errno
import functools
import os
import re
import tempfile
import threading
import time
import urllib.parse
import urllib.request
import warnings
from collections.abc import Callable
from io import BufferedReader
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

from a2tg_jax.host.text import shortened

PAUSES = (1.0, 4.0, 15.0)
"""Seconds between the attempts to read something."""
PIECE = 1 << 26
"""Largest number of bytes of one request."""
URL = re.compile(r"[A-Za-z][\w+.:-]+://")
FINAL = (FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError, NotImplementedError)
"""Errors that another attempt does not mend."""

Result = TypeVar("Result")


class Unreachable(OSError):
    """Error of a store that does not answer, or does not give what it is asked for."""


class Entry(NamedTuple):
    """File or folder in a listing."""

    is_file: bool
    size: int | None
    """Number of bytes; None if the store does not tell it."""


Listing = dict[str, Entry]
_listings: dict[tuple[Any, str], Listing] = {}
"""Listings of folders, by file system and path."""
_lock = threading.Lock()


def is_url(text: str) -> bool:
    """Return whether a text is a URL, such as s3://bucket/scene."""
    return URL.match(text) is not None


def is_remote(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is one of universal_pathlib that the operating system does not know."""
    return not isinstance(path, str | os.PathLike)


def located(path: str | os.PathLike[str]) -> Path:
    """Return the path that a text means: of universal_pathlib for a URL, but of this machine for file://.

    Raises:
      ValueError: if a library is missing, fsspec does not know the protocol, or the URL has a password.
    """
    if is_remote(path):
        return cast(Path, path)
    text = os.fspath(path)
    if not is_url(text):
        return Path(path)
    parts = urllib.parse.urlsplit(text)
    if parts.scheme == "file":
        return Path(urllib.request.url2pathname(parts.path))
    if parts.password is not None:
        raise ValueError(
            f"{text.replace(parts.password, '…')}: has a password, which the run folder would keep; leave it out, and "
            "give it in fsspec's configuration (~/.config/fsspec)"
        )
    return _of_store(text.rstrip("/"))


def _of_store(url: str) -> Path:
    """Return the path of universal_pathlib of a URL, whose file system can be used."""
    try:
        from upath import UPath
    except ImportError:
        raise ValueError(f"{url}: a URL needs universal_pathlib: pip install 'a2tg-jax[remote]'") from None
    try:
        path = UPath(url)
        _ = path.fs
    except ImportError as error:
        package = getattr(error.__cause__ or error, "name", None) or "its library"
        raise ValueError(f"{url}: {error}: pip install {package}") from None
    except Exception as error:  # what file systems raise when they are made
        raise ValueError(f"{url}: cannot be opened ({_reason(error)})") from None
    return cast(Path, path)


def reach(folder: Path) -> None:
    """List a folder anew, in one attempt, so that a mistake in a URL or in credentials is told at once.

    Raises:
      OSError: naming the folder, if it is missing or empty, or the store does not list it.
    """
    with _lock:
        _listings.clear()
    cast(Any, folder).fs.invalidate_cache()
    if not _listed(folder, ()):
        raise FileNotFoundError(f"{folder}: no such scene folder, or it is empty")


def is_remote_file(path: Path) -> bool:
    """Return whether a file is listed in its folder."""
    entry = _listed(path.parent).get(path.name)
    return entry is not None and entry.is_file


def is_remote_folder(path: Path) -> bool:
    """Return whether anything is listed in a folder. Object storage knows no empty ones."""
    return bool(_listed(path))


def remote_size(path: Path) -> int | None:
    """Return the number of bytes of a file; None if its store does not tell it.

    Raises:
      FileNotFoundError: if it is not listed in its folder.
    """
    entry = _listed(path.parent).get(path.name)
    if entry is None or not entry.is_file:
        raise _missing(path)
    return entry.size


def fetched(path: Path, size: int | None) -> BufferedReader:
    """Return an open temporary file with the bytes of a remote one. It has no name, and goes when it is closed.

    Args:
      path: the remote file.
      size: its number of bytes; None: unknown.

    Raises:
      OSError: naming the file, if it has gone, may not be read, or cannot be after all attempts (`Unreachable`).
    """
    ranges = [(None, None)] if size is None or size <= PIECE else [(at, at + PIECE) for at in range(0, size, PIECE)]
    file = tempfile.TemporaryFile()  # noqa: SIM115 - the caller closes it
    try:
        for start, end in ranges:
            file.write(_tried(path, functools.partial(_piece, path, start, end)))
    except BaseException:
        file.close()
        raise
    file.seek(0)
    return cast(BufferedReader, file)


def _piece(path: Any, start: int | None, end: int | None) -> bytes:
    data: bytes = path.fs.cat_file(path.path, start=start, end=end)
    return data


def _listed(folder: Path, pauses: tuple[float, ...] | None = None) -> Listing:
    """Return the files and folders in a folder, by name, from its first listing; nothing if there is no such folder."""
    place = cast(Any, folder)
    key = place.fs, place.path
    with _lock:
        if key not in _listings:
            _listings[key] = _tried(folder, functools.partial(_list, place), pauses)
        return _listings[key]


def _list(folder: Any) -> Listing:
    own = folder.path.strip("/")
    try:
        found = [(entry["name"].rstrip("/"), entry) for entry in folder.fs.ls(folder.path, detail=True)]
    except (FileNotFoundError, NotADirectoryError):
        return {}
    return {
        name.rpartition("/")[2]: Entry(entry["type"] == "file", entry.get("size"))
        for name, entry in found
        if name.strip("/") != own
    }


def _tried(path: Path, read: Callable[[], Result], pauses: tuple[float, ...] | None = None) -> Result:
    """Return what a function reads, in several attempts with pauses; None: `PAUSES`."""
    for pause in (*(PAUSES if pauses is None else pauses), None):
        try:
            return read()
        except FileNotFoundError:
            raise _missing(path) from None
        except Exception as error:  # libraries of stores raise errors of their own
            if pause is None or isinstance(error, FINAL):
                raise Unreachable(f"{path}: cannot be read from its store ({_reason(error)})") from error
            warnings.warn(f"{path}: {_reason(error)}; it is read again in {pause:g} s", stacklevel=2)
        time.sleep(pause)
    raise AssertionError("the last attempt returns or raises")


def _missing(path: Path) -> FileNotFoundError:
    return FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))


def _reason(error: Exception) -> str:
    return shortened(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__, 200)
