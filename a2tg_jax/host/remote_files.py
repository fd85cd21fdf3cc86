"""Files in object storage and anything else that fsspec supports, as paths of universal_pathlib.

Such a path has pathlib's methods and is annotated as `Path`. Each request to a store takes a while, so every folder is
listed once, and files are fetched whole. Failed requests are repeated. URLs must not contain secrets, because the run
folder keeps them.
"""

import errno
import functools
import os
import re
import tempfile
import threading
import time
import urllib.request
import warnings
from collections.abc import Callable
from io import BufferedReader
from pathlib import Path
from typing import IO, Any, NamedTuple, Protocol, TypeVar, cast

from a2tg_jax.host.optional import optional
from a2tg_jax.host.text import shortened

PAUSES = (1.0, 4.0, 15.0)
"""Seconds between attempts to read."""
PIECE = 1 << 26
"""Largest number of bytes per request."""
LIBRARIES = ("s3fs", "gcsfs", "adlfs", "paramiko", "aiohttp")
"""Store libraries whose packages have the name of their module."""
FINAL = (FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError, NotImplementedError)
"""Errors that another attempt would not fix."""
URL = re.compile(r"[A-Za-z][\w+.:-]+://")
USER = re.compile(r"([\w+.-]+)://([^/]*)@")
"""Scheme and user information, also inside chained URLs."""
QUERY = re.compile(r"(https?://[^?]*)\?.+", re.IGNORECASE | re.DOTALL)
REVISIONS = ("git", "github")
"""Schemes with an owner, a repository and a revision where others have a user and a password."""

Result = TypeVar("Result")


class Unreachable(OSError):
    """Error of a store that does not answer or refuses a request."""


class RemotePath(Protocol):
    """Path of universal_pathlib (`UPath`)."""

    @property
    def fs(self) -> Any:
        """File system of fsspec."""

    @property
    def path(self) -> str:
        """Path in the file system."""


class Entry(NamedTuple):
    """Entry of a listing: fsspec's kind ("file", "directory", "link", ...), and the size in bytes, if it is known."""

    kind: str
    size: int | None


Listing = dict[str, Entry]
_listings: dict[tuple[Any, str], Listing] = {}
"""Entries of folders by name, by file system and path."""
_lock = threading.RLock()  # listed calls itself for a parent (_may_exist).


def is_remote(path: object) -> bool:
    """Return whether a path is one of universal_pathlib that the operating system cannot open."""
    # universal_pathlib has os.PathLike for local paths only.
    return not isinstance(path, str | os.PathLike)


def is_url(text: str) -> bool:
    """Return whether a text is a URL, such as s3://bucket/scene."""
    return URL.match(text) is not None


def path_here(text: str) -> Path | None:
    """Return the path on this machine for a path, perhaps with a leading ~, or a file:// URL; None for the URL of a
    store.

    Raises:
      ValueError: if file:// has a host, or no path.
    """
    if not is_url(text):
        return Path(os.path.expanduser(text))
    scheme, _, place = text.partition("://")
    if scheme.lower() != "file":
        return None
    host, _, path = place.partition("/")
    if host.lower() not in ("", "localhost") or not path:
        raise ValueError(f"{text}: is not a file on this machine; write file:///full/path")
    return Path(urllib.request.url2pathname(f"/{path}"))


def checked_url(url: str) -> str:
    """Return the URL of a store, without slashes at its end.

    Raises:
      ValueError: if it contains a secret, which the message leaves out, or names no folder.
    """
    public = without_secrets(url)
    if public != url:
        raise ValueError(
            f"{public}: has a password, token or signature, which the run folder would keep; leave it out, and give it "
            "in fsspec's configuration (~/.config/fsspec)"
        )
    kept = url.rstrip("/")
    if kept.endswith(":"):
        raise ValueError(f"{url}: names no folder; write {kept}//bucket/scene")
    return kept


def without_secrets(url: str) -> str:
    """Return a URL with "…" for passwords, and for users and queries of web addresses."""

    def without_password(match: re.Match[str]) -> str:
        scheme, (user, colon, _) = match[1], match[2].partition(":")
        if scheme.lower().endswith(("http", "https")):
            return f"{scheme}://…@"
        return f"{scheme}://{user}:…@" if colon and scheme.lower() not in REVISIONS else match[0]

    return QUERY.sub(r"\1?…", USER.sub(without_password, url))


def located(path: str | os.PathLike[str] | RemotePath) -> Path:
    """Return a path of universal_pathlib for the URL of a store, and a path on this machine for any other text.

    Raises:
      ValueError: if it is no path, a library is missing, fsspec has no such protocol, or the URL has a secret.
    """
    if not isinstance(path, str | os.PathLike):
        if hasattr(type(path), "fs") and hasattr(type(path), "path"):
            return cast(Path, path)
        raise ValueError(f"path must be a path, a URL, or a UPath of universal_pathlib; got {path!r}")
    if (here := path_here(os.fspath(path))) is not None:
        return here
    url = checked_url(os.fspath(path))
    library = optional("upath", f"{url}: a URL needs universal_pathlib", "remote")
    try:
        found = library.UPath(url)
        _ = found.fs, found.path  # The file system is made now, with its errors.
    except ImportError as error:
        package = getattr(error.__cause__ or error, "name", None)  # fsspec's own error has no name.
        advice = f": pip install {package}" if package in LIBRARIES else ""
        raise ValueError(f"{url}: {error}{advice}") from None
    except Exception as error:
        raise ValueError(f"{url}: cannot be opened ({_reason(error)})") from None
    return cast(Path, found)


def check_reachable(folder: Path) -> None:
    """List a folder again, in one attempt, so that a mistake in a URL or in credentials is reported at once."""
    _listings.clear()
    cast(Any, folder).fs.invalidate_cache()  # fsspec keeps listings as well.
    if not listed(folder, pauses=()):
        raise FileNotFoundError(f"{folder}: no such scene folder, or it is empty")


def listed(folder: Any, pauses: tuple[float, ...] | None = None) -> Listing:
    """Return the files and folders in a folder, by name, from its first listing; nothing if there is no such folder."""
    with _lock:  # Several threads that read photographs need the same listing.
        if _key(folder) not in _listings:
            _listings[_key(folder)] = _retried(folder, lambda: _list(folder), pauses) if _may_exist(folder) else {}
        return _listings[_key(folder)]


def remote_entry(path: Any) -> Entry | None:
    """Return the entry of a path, or of its target if it is a link; None if nothing is there."""
    listing = listed(path.parent)
    entry = listing.get(path.name)
    if entry is not None and entry.kind == "link":
        try:
            found = _retried(path, lambda: path.fs.info(path.path))
            entry = Entry(found["type"], found.get("size"))
        except FileNotFoundError:
            entry = Entry("nothing", None)
        listing[path.name] = entry
    return entry


def fetched(path: Any, most_bytes: int) -> BufferedReader:
    """Return an open temporary file with the bytes of a remote file. It has no name and is deleted when it is closed.

    Args:
      path: the remote file.
      most_bytes: largest size.

    Raises:
      OSError: naming the file, if it is missing, may not be read, or cannot be after all attempts (`Unreachable`).
      ValueError: naming the file, if it is larger.
    """
    entry = remote_entry(path)
    if entry is None or entry.kind != "file":
        raise _missing(path)
    size = entry.size or 0  # Listed sizes need not be true.
    if size > most_bytes:
        raise ValueError(too_large(path, size, most_bytes))
    file = tempfile.TemporaryFile()  # noqa: SIM115 - the caller closes it
    try:
        for start in range(0, size, PIECE):
            end = start + PIECE if start + PIECE < size else size + 1  # One byte more shows whether the file is longer.
            file.write(_retried(path, functools.partial(path.fs.cat_file, path.path, start=start, end=end)))
        # The size was not listed, or is too small: read to the end.
        if not size or file.tell() > size:
            _retried(path, lambda: _stream(path, file, most_bytes))
        if file.tell() > most_bytes:
            raise ValueError(f"{path}: has more than {most_bytes:,} bytes, the most that such a file may have")
    except BaseException:
        file.close()
        raise
    file.seek(0)
    return cast(BufferedReader, file)


def too_large(path: object, size: int, most_bytes: int) -> str:
    """Return the message about a file of too many bytes."""
    return f"{path}: has {size:,} bytes, and {most_bytes:,} are the most that such a file may have"


def _stream(path: Any, file: IO[bytes], most_bytes: int) -> None:
    """Write a file of unknown size in pieces, up to one byte beyond the bound."""
    file.seek(0)
    file.truncate()
    with path.fs.open(path.path, "rb") as source:
        while file.tell() <= most_bytes and (data := source.read(min(PIECE, most_bytes + 1 - file.tell()))):
            file.write(data)


def _key(folder: Any) -> tuple[Any, str]:
    return folder.fs, folder.path.rstrip("/")


def _may_exist(folder: Any) -> bool:
    """Return False if a folder is below a listed one and in no listing; some stores refuse to list such a folder."""
    if ".." in folder.parts:  # Parents by name are not the real ones.
        return True
    is_below = any(_key(parent) in _listings for parent in folder.parents if _key(parent) != _key(folder))
    return not is_below or folder.name in listed(folder.parent)


def _list(folder: Any) -> Listing:
    try:
        entries = folder.fs.ls(folder.path, detail=True)
    except (FileNotFoundError, NotADirectoryError):
        return {}
    own = folder.path.strip("/")  # Some stores list the folder itself.
    return {
        entry["name"].rstrip("/").rpartition("/")[2]: Entry(entry["type"], entry.get("size"))
        for entry in entries
        if entry["name"].strip("/") != own
    }


def _retried(path: Path, read: Callable[[], Result], pauses: tuple[float, ...] | None = None) -> Result:
    """Return the result of a function, in several attempts with pauses; None: `PAUSES`."""
    for pause in (*(PAUSES if pauses is None else pauses), None):
        try:
            return read()
        except FileNotFoundError:
            raise _missing(path) from None
        except Exception as error:  # Stores' libraries have their own classes of errors.
            if pause is None or isinstance(error, FINAL):
                raise Unreachable(f"{path}: cannot be read from its store ({_reason(error)})") from error
            warnings.warn(f"{path}: {_reason(error)}; it is read again in {pause:g} s", stacklevel=2)
        time.sleep(pause)
    raise AssertionError("the last attempt returns or raises")


def _missing(path: Path) -> FileNotFoundError:
    return FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))


def _reason(error: Exception) -> str:
    return shortened(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__, 200)
