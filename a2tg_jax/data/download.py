"""Download of archives: continued where it stopped, checked against a checksum, unpacked within one folder."""

import hashlib
import http.client
import shutil
import tarfile
import time
import urllib.error
import urllib.request
import zipfile
import zlib
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from a2tg_jax.host.progress_bars import progress_over

CHUNK_BYTES = 1 << 20
TIMEOUT_SECONDS = 60
ATTEMPTS = 5
"""Number of times a connection may break before it is an error."""
PAUSE_SECONDS = 2.0
"""Pause before the second attempt; each further one is twice as long."""
LEFT_OUT = "__MACOSX"
"""Folder of a system's own files in archives, which is not unpacked."""
FULL = 416
"""HTTP status of a request for bytes beyond the end."""


class Archive(NamedTuple):
    """A file to download and unpack."""

    url: str
    folder: str
    """Folder below that of all scenes in which it is unpacked."""
    num_bytes: int | None = None
    """Size, as far as it is known beforehand."""
    sha256: str | None = None


def fetch(archive: Archive, scenes: Path, *, progress: bool = True) -> bool:
    """Download and unpack an archive, unless that was done before.

    Args:
      archive: what to fetch.
      scenes: folder for all scenes; archives lie in `archives` below it until they are unpacked.
      progress: show progress bars.

    Returns:
      Whether there was anything to do.

    Raises:
      OSError: if the address cannot be read or the disk has no room; what came stays, and the next call continues.
      FileExistsError: if another file has the name of one in the archive, and was not left by an earlier call.
      ValueError: if the checksum is another, the archive is damaged, or it would write outside its folder.
    """
    file = scenes / "archives" / archive.url.partition("?")[0].rpartition("/")[2]
    done, begun = (file.with_name(f"{file.name}.{state}") for state in ("unpacked", "unpacking"))
    if done.is_file() or file.with_suffix(".unpacked").is_file():  # The second is what earlier versions wrote.
        return False
    file.parent.mkdir(parents=True, exist_ok=True)
    if not file.is_file():
        _download(archive, file, progress)
    if archive.sha256 is not None and _sha256(file) != archive.sha256:
        file.unlink()
        raise ValueError(f"{archive.url}: its SHA-256 is not {archive.sha256}; the file was deleted, call again")
    try:
        unpack(file, scenes / archive.folder, begun, progress=progress)
    except (zipfile.BadZipFile, tarfile.TarError, EOFError, zlib.error) as error:
        file.unlink()
        raise ValueError(f"{file} is damaged, and was deleted: call again to fetch it anew ({error})") from error
    done.touch()
    begun.unlink()
    file.unlink()
    return True


def _download(archive: Archive, file: Path, progress: bool) -> None:
    """Download a file, from where an earlier attempt stopped, and go on when the connection breaks."""
    partial = file.with_name(f"{file.name}.partial")
    if archive.num_bytes is not None:
        _check_room(file.parent, 2 * archive.num_bytes - _size(partial), archive.url)
    total = None
    for attempt in range(ATTEMPTS):
        if attempt:
            time.sleep(PAUSE_SECONDS * 2 ** (attempt - 1))
        try:
            total = _receive(archive.url, partial, progress)
        except urllib.error.HTTPError as error:
            raise OSError(f"{archive.url}: {error}") from error
        except (urllib.error.URLError, ConnectionError, TimeoutError, http.client.HTTPException) as error:
            if attempt == ATTEMPTS - 1 or (attempt == 0 and isinstance(error, urllib.error.URLError)):
                raise OSError(f"{archive.url}: the connection broke ({error}); call again to go on") from error
            continue
        if total is None or _size(partial) >= total:
            break
    if total is not None and _size(partial) > total:
        partial.unlink()
        raise OSError(f"{archive.url}: more bytes were there than it has; they were deleted, call again")
    if total is not None and _size(partial) < total:
        raise OSError(f"{archive.url}: {_size(partial):,} of {total:,} bytes came; call again to go on")
    partial.replace(file)
    _version_of(partial).unlink(missing_ok=True)


def _receive(url: str, partial: Path, progress: bool) -> int | None:
    """Receive what is missing of a file. Return its size if the server tells."""
    have, version = _size(partial), _version_of(partial)
    request = urllib.request.Request(url)
    if have:
        request.add_header("Range", f"bytes={have}-")
        if version.is_file():
            request.add_header("If-Range", version.read_text(encoding="ascii"))
    try:
        with urllib.request.urlopen(request, timeout=TIMEOUT_SECONDS) as response:
            is_rest = response.status == http.HTTPStatus.PARTIAL_CONTENT
            length = response.headers.get("Content-Length")
            total = None if length is None else int(length) + (have if is_rest else 0)
            _check_room(partial.parent, int(length or 0), url)
            _keep_version(version, response.headers.get("ETag"))
            bar = tqdm(
                desc=partial.name.removesuffix(".partial"), initial=have if is_rest else 0, total=total, unit="B",
                unit_scale=True, disable=not progress,
            )  # fmt: skip
            with open(partial, "ab" if is_rest else "wb") as opened, bar:
                while chunk := response.read(CHUNK_BYTES):
                    opened.write(chunk)
                    bar.update(len(chunk))
            return total
    except urllib.error.HTTPError as error:
        if error.code != FULL:
            raise
        # No bytes are left to come: the server says how many there are.
        with error:
            return int(error.headers.get("Content-Range", f"*/{have}").rpartition("/")[2])


def _version_of(partial: Path) -> Path:
    """Return the file that keeps the server's name of the version of which a part has come."""
    return partial.with_name(f"{partial.name}.etag")


def _keep_version(path: Path, etag: str | None) -> None:
    """Keep a strong ETag, the only kind that parts may be joined by."""
    if etag and not etag.startswith("W/") and etag.isascii():
        path.write_text(etag, encoding="ascii")
    else:
        path.unlink(missing_ok=True)


def unpack(file: Path, folder: Path, begun: Path, *, progress: bool = True) -> None:
    """Unpack a zip or tar archive.

    Args:
      file: the archive.
      folder: where its members are written.
      begun: a file that is made before the first of them; if it is there, files of other sizes are replaced.
      progress: show a progress bar.

    Raises:
      OSError: if the disk has no room for its members, or there is another file of the name of one.
      ValueError: if a member leads outside the folder, as links and devices may.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if tarfile.is_tarfile(file):
        with tarfile.open(file) as opened:
            members = [member for member in opened.getmembers() if _is_wanted(member.name)]
            odd = next((member.name for member in members if not (member.isfile() or member.isdir())), None)
            if odd is not None:
                raise ValueError(f"{file}: the member {odd!r} is a link or a device, which may lead outside {folder}")
            sizes = [member.size if member.isfile() else None for member in members]
            _check_members(file, folder, [member.name for member in members], sizes, begun)
            if hasattr(tarfile, "data_filter"):  # Pythons before 3.11.4 know no filters.
                opened.extraction_filter = tarfile.data_filter
            for member in progress_over(members, "unpacking", "file", is_shown=progress):
                opened.extract(member, folder)
        return
    with zipfile.ZipFile(file) as opened_zip:
        infos = [info for info in opened_zip.infolist() if _is_wanted(info.filename)]
        sizes = [None if info.is_dir() else info.file_size for info in infos]
        _check_members(file, folder, [info.filename for info in infos], sizes, begun)
        for info in progress_over(infos, "unpacking", "file", is_shown=progress):
            opened_zip.extract(info, folder)


def _is_wanted(name: str) -> bool:
    return LEFT_OUT not in Path(name).parts


def _check_members(file: Path, folder: Path, names: list[str], sizes: list[int | None], begun: Path) -> None:
    """Check names and sizes (None for folders) of the members of an archive, then make the file `begun`."""
    for name, num_bytes in zip(names, sizes, strict=True):
        target = folder / name
        if not target.resolve().is_relative_to(folder.resolve()):
            raise ValueError(f"{file}: the member {name!r} would be written outside {folder}")
        if num_bytes is not None and not begun.is_file() and target.exists() and _size(target) != num_bytes:
            raise FileExistsError(
                f"{target}: exists already and is not what {file.name} has there; move it away, or choose another --out"
            )
    _check_room(folder, sum(num_bytes or 0 for num_bytes in sizes), str(file))
    begun.touch()


def _check_room(folder: Path, num_bytes: int, what: str) -> None:
    """Raise OSError if the disk of a folder has no room for so many bytes."""
    free = shutil.disk_usage(folder).free
    if num_bytes > free:
        raise OSError(
            f"{what} needs {num_bytes / 1e9:.1f} GB of disk in {folder}, which has {free / 1e9:.1f} GB: make room, or "
            "choose another --out"
        )


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


def _sha256(file: Path) -> str:
    with open(file, "rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()
