"""Files in object storage and wherever else fsspec reaches, at paths of universal_pathlib.

Such a path has pathlib's methods and is annotated as `Path`. Each request to a store takes a while, so every folder is
listed once, and files are fetched whole. A request that fails is tried again. URLs hold no secrets, because the run
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
from concurrent.futures import Future
from io import BufferedReader
from pathlib import Path
from typing import IO, Any, NamedTuple, Protocol, TypeVar, cast

from a2tg_jax.host.text import shortened

PAUSES = (1.0, 4.0, 15.0)
"""Seconds between the attempts to read something."""
PIECE = 1 << 26
"""Largest number of bytes of one request."""
LIBRARIES = ("s3fs", "gcsfs", "adlfs", "paramiko", "aiohttp")
"""Libraries of stores whose packages have their modules' names."""
FINAL = (FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError, NotImplementedError)
"""Errors for which another attempt makes no sense."""
URL = re.compile(r"[A-Za-z][\w+.:-]+://")
USER = re.compile(r"([\w+.-]+)://([^/]*)@")
"""Scheme, and what precedes the host; in chained URLs too."""
QUERY = re.compile(r"(https?://[^?]*)\?.+", re.IGNORECASE | re.DOTALL)
REVISIONS = ("git", "github")
"""Schemes that write an owner, a repository and a revision where others have a user and a password."""

Result = TypeVar("Result")


class Unreachable(OSError):
    """Error of a store that does not answer, or does not give what is requested."""


class RemotePath(Protocol):
    """Path of universal_pathlib (`UPath`)."""

    @property
    def fs(self) -> Any:
        """File system of fsspec."""

    @property
    def path(self) -> str:
        """Path in the file system."""


class Entry(NamedTuple):
    """File, folder or link in a listing."""

    kind: str
    """ "file", "directory", "link", or another word of fsspec's."""
    size: int | None
    """Number of bytes; None if the store does not say it."""


Listing = dict[str, Entry]
_listings: dict[tuple[Any, str], "Future[Listing]"] = {}
"""Listings of folders, by file system and path."""
_lock = threading.Lock()


def is_remote(path: str | os.PathLike[str] | RemotePath) -> bool:
    """Return whether a path is one of universal_pathlib that the operating system does not know."""
    return not isinstance(path, str | os.PathLike)


def is_url(text: str) -> bool:
    """Return whether a text is a URL, such as s3://bucket/scene."""
    return URL.match(text) is not None


def path_here(text: str) -> Path | None:
    """Return the path on this machine that a text means, file:// included; None for the URL of a store.

    Raises:
      ValueError: if file:// has a host, or no path.
    """
    if not is_url(text):
        return Path(text)
    scheme, _, place = text.partition("://")
    if scheme.lower() != "file":
        return None
    host, _, path = place.partition("/")
    if host.lower() not in ("", "localhost") or not path:
        raise ValueError(f"{text}: is no file of this machine; write file:///full/path")
    return Path(urllib.request.url2pathname(f"/{path}"))


def checked_url(url: str) -> str:
    """Return the URL of a store, without slashes at its end.

    Raises:
      ValueError: if it holds a secret, which is left out of the message, or names no folder.
    """
    told = without_secrets(url)
    if told != url:
        raise ValueError(
            f"{told}: has a password, token or signature, which the run folder would keep; leave it out, and give it "
            "in fsspec's configuration (~/.config/fsspec)"
        )
    kept = url.rstrip("/")
    if kept.endswith(":"):
        raise ValueError(f"{url}: names no folder; write {kept}//bucket/scene")
    return kept


def without_secrets(url: str) -> str:
    """Return a URL with "…" for passwords, and for users and queries of web addresses."""
    return QUERY.sub(r"\1?…", USER.sub(_without_password, url))


def _without_password(match: re.Match[str]) -> str:
    scheme, (user, colon, _) = match[1], match[2].partition(":")
    if scheme.lower().endswith(("http", "https")):
        return f"{scheme}://…@"
    return f"{scheme}://{user}:…@" if colon and scheme.lower() not in REVISIONS else match[0]


def located(path: str | os.PathLike[str] | RemotePath) -> Path:
    """Return the path that a text means: of universal_pathlib for a URL, but of this machine for file://.

    Raises:
      ValueError: if it is no path, a library is missing, fsspec has no such protocol, or the URL has a secret.
    """
    if isinstance(path, str | os.PathLike):
        text = os.fspath(path)
        here = path_here(text)
        return _of_store(checked_url(text)) if here is None else here
    if not (hasattr(type(path), "fs") and hasattr(type(path), "path")):
        raise ValueError(f"path must be a path, a URL, or a UPath of universal_pathlib; got {path!r}")
    return cast(Path, path)


def _of_store(url: str) -> Path:
    """Return the path of universal_pathlib of a URL, whose file system can be used."""
    try:
        from upath import UPath
    except ImportError:
        raise ValueError(f"{url}: a URL needs universal_pathlib: pip install 'a2tg-jax[remote]'") from None
    try:
        path = UPath(url)
        _ = path.fs, path.path
    except ImportError as error:
        package = getattr(error.__cause__ or error, "name", None)
        advice = f": pip install {package}" if package in LIBRARIES else ""
        raise ValueError(f"{url}: {error}{advice}") from None
    except Exception as error:  # what file systems raise when they are made
        raise ValueError(f"{url}: cannot be opened ({_reason(error)})") from None
    return cast(Path, path)


def check_reachable(folder: Path) -> None:
    """List a folder again, in one attempt, so that a mistake in a URL or in credentials is reported at once."""
    with _lock:
        _listings.clear()
    cast(Any, folder).fs.invalidate_cache()
    if not _listed(folder, ()):
        raise FileNotFoundError(f"{folder}: no such scene folder, or it is empty")


def is_remote_file(path: Path) -> bool:
    """Return whether a file is listed in its folder. Links are followed."""
    entry = _entry(path)
    return entry is not None and entry.kind == "file"


def is_remote_folder(path: Path) -> bool:
    """Return whether anything is listed in a folder. Object storage has no empty ones."""
    return bool(_listed(path))


def remote_names(folder: Path) -> list[str]:
    """Return the sorted names in a folder; none if there is no such folder."""
    return sorted(_listed(folder))


def remote_size(path: Path) -> int | None:
    """Return the number of bytes of a file that is listed in its folder; None if its store does not say it."""
    entry = _entry(path)
    if entry is None or entry.kind != "file":
        raise _missing(path)
    return entry.size


def fetched(path: Path, size: int | None, most_bytes: int) -> BufferedReader:
    """Return an open temporary file with the bytes of a remote one. It has no name, and goes when it is closed.

    Args:
      path: the remote file.
      size: its number of bytes as listed, which need not be true; None: unknown.
      most_bytes: size above which it is refused.

    Raises:
      OSError: naming the file, if it has gone, may not be read, or cannot be after all attempts (`Unreachable`).
      ValueError: naming the file, if it is larger.
    """
    file = tempfile.TemporaryFile()  # noqa: SIM115 - the caller closes it
    try:
        if not size or not _is_filled(file, path, size):
            _tried(path, functools.partial(_stream, path, file, most_bytes))
        if file.tell() > most_bytes:
            raise ValueError(f"{path}: has more than {most_bytes:,} bytes, the most that such a file may have")
    except BaseException:
        file.close()
        raise
    file.seek(0)
    return cast(BufferedReader, file)


def _is_filled(file: IO[bytes], path: Path, size: int) -> bool:
    """Write a file of a listed size in pieces, and return whether it has no more bytes. The last piece asks for one."""
    store: Any = path
    for start in range(0, size, PIECE):
        end = start + PIECE if start + PIECE < size else size + 1
        file.write(_tried(path, functools.partial(store.fs.cat_file, store.path, start=start, end=end)))
    return file.tell() <= size


def _stream(path: Any, file: IO[bytes], most_bytes: int) -> None:
    """Write a file of unknown size in pieces, up to the first one beyond the bound."""
    file.seek(0)
    file.truncate()
    with path.fs.open(path.path, "rb") as source:
        while file.tell() <= most_bytes and (data := source.read(min(PIECE, most_bytes + 1 - file.tell()))):
            file.write(data)


def _entry(path: Any) -> Entry | None:
    """Return what is listed of a path, or what a link leads to; None if there is nothing."""
    listing = _listed(path.parent)
    entry = listing.get(path.name)
    if entry is not None and entry.kind == "link":
        try:
            found = _tried(path, functools.partial(path.fs.info, path.path))
            entry = Entry(found["type"], found.get("size"))
        except FileNotFoundError:
            entry = Entry("nothing", None)
        listing[path.name] = entry
    return entry


def _listed(folder: Any, pauses: tuple[float, ...] | None = None) -> Listing:
    """Return the files and folders in a folder, by name, from its first listing; nothing if there is no such folder.

    Other threads that want the same folder wait for this listing.
    """
    with _lock:
        listing = _listings.get(_key(folder))
        if is_first := listing is None:
            listing = _listings[_key(folder)] = Future()
    assert listing is not None
    if is_first:
        try:
            listing.set_result(_tried(folder, functools.partial(_list, folder), pauses) if _may_exist(folder) else {})
        except BaseException as error:
            with _lock:
                _listings.pop(_key(folder), None)
            listing.set_exception(error)
    return listing.result()


def _key(folder: Any) -> tuple[Any, str]:
    return folder.fs, folder.path.rstrip("/")


def _may_exist(folder: Any) -> bool:
    """Return False if a folder is below a listed one, and is in no listing itself. Some stores refuse to list it."""
    if ".." in folder.parts:
        return True
    with _lock:
        is_below = any(_key(parent) in _listings for parent in folder.parents if _key(parent) != _key(folder))
    return not is_below or folder.name in _listed(folder.parent)


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
