"""Benchmark data sets: where their authors, or mirrors, offer them, and their download.

A download continues where it stopped, is checked against a checksum, and unpacked within one folder.
"""

import http.client
import shutil
import tarfile
import time
import urllib.error
import urllib.request
import zipfile
import zlib
from pathlib import Path
from typing import Any, NamedTuple

from a2tg_jax.base.regular_files import sha256_of
from a2tg_jax.host.progress_bars import new_bar, progress_over

CHUNK_BYTES = 1 << 20
TIMEOUT_SECONDS = 60
ATTEMPTS = 5
"""Number of times a connection may break before it is an error."""
PAUSE_SECONDS = 2.0
"""Pause before the second attempt; each further one is twice as long."""
LEFT_OUT = "__MACOSX"
"""Folder of a system's own files in archives, which is not unpacked."""
GRESEARCH = "https://storage.googleapis.com/gresearch/refraw360"


class Archive(NamedTuple):
    """A file to download and unpack."""

    url: str
    folder: str
    """Folder, below the folder of all scenes, in which it is unpacked."""
    num_bytes: int | None = None
    """Size, if known before the download."""
    sha256: str | None = None
    content: str = ""
    """Short description."""


BENCHMARK_SETS = {
    "mipnerf360": Archive(
        f"{GRESEARCH}/360_v2.zip", "360_v2", 12_500_000_000,
        content="Mip-NeRF 360: bicycle, bonsai, counter, garden, kitchen, room, stump",
    ),
    "mipnerf360-extra": Archive(
        f"{GRESEARCH}/360_extra_scenes.zip", "360_v2", content="Mip-NeRF 360: flowers, treehill"
    ),
    "tandt-db": Archive(
        "https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/datasets/input/tandt_db.zip", ".", 690_000_000,
        content="3DGS's Tanks and Temples (train, truck) and Deep Blending (drjohnson, playroom)",
    ),
    "nerf-synthetic": Archive(
        "https://github.com/yxlao/nerfmirror/releases/download/20220618/nerf_synthetic.zip", ".",
        sha256="f01fd1b4ab045b0d453917346f26f898657bb5bec4834b95fdad1f361826e45e",
        content="NeRF's eight synthetic objects: chair, drums, ficus, hotdog, lego, materials, mic, ship",
    ),
    "dtu": Archive(
        "https://huggingface.co/datasets/dylanebert/2DGS/resolve/main/dtu.tar.gz", "dtu",
        content="15 scans of DTU, prepared for 2DGS, without the measured points",
    ),
}  # fmt: skip
"""Data sets of `a2tg download` by name: what they hold, and where their authors, or mirrors, offer them."""


def fetch(archive: Archive, scenes: Path, *, progress: bool = True) -> bool:
    """Download and unpack an archive, unless that was done before.

    Args:
      archive: what to fetch.
      scenes: folder for all scenes; archives are in `archives` below it until they are unpacked.
      progress: show progress bars.

    Returns:
      Whether there was anything to do.

    Raises:
      OSError: if the address cannot be read or the disk has no room; the next call continues with the bytes so far.
      FileExistsError: if another file has the name of one in the archive, and was not left by an earlier call.
      ValueError: if the checksum differs, the archive is damaged, or it would write outside its folder.
    """
    file = scenes / "archives" / archive.url.partition("?")[0].rpartition("/")[2]
    done = file.with_name(f"{file.name}.unpacked")
    begun = file.with_name(f"{file.name}.unpacking")
    if done.is_file():
        return False
    file.parent.mkdir(parents=True, exist_ok=True)
    if not file.is_file():
        _download(archive, file, progress)
    if archive.sha256 is not None and sha256_of(file) != archive.sha256:
        file.unlink()
        raise ValueError(f"{archive.url}: its SHA-256 is not {archive.sha256}; the file was deleted, call again")
    try:
        _unpack(file, scenes / archive.folder, begun, progress)
    except (zipfile.BadZipFile, tarfile.TarError, EOFError, zlib.error) as error:
        file.unlink()
        raise ValueError(f"{file} is damaged, and was deleted: call again to fetch it ({error})") from error
    # In this order: after a kill in between, nothing is fetched or replaced again.
    done.touch()
    begun.unlink()
    file.unlink()
    return True


def _download(archive: Archive, file: Path, progress: bool) -> None:
    """Download a file, from where an earlier attempt stopped, and continue when the connection breaks."""
    partial = file.with_name(f"{file.name}.partial")
    # The ETag of the version that the partial file is from.
    version = partial.with_name(f"{partial.name}.etag")
    if archive.num_bytes is not None:  # The archive and what is unpacked from it are on the disk at once.
        _check_room(file.parent, 2 * archive.num_bytes - _size(partial), archive.url)
    total = None
    for attempt in range(ATTEMPTS):
        if attempt:
            time.sleep(PAUSE_SECONDS * 2 ** (attempt - 1))
        try:
            total = _receive(archive.url, partial, version, progress)
        except urllib.error.HTTPError as error:  # The server has answered: no other attempt.
            raise OSError(f"{archive.url}: {error}") from error
        except (urllib.error.URLError, ConnectionError, TimeoutError, http.client.HTTPException) as error:
            # If the first attempt finds no server, the address or the network is wrong: waiting would not help.
            if attempt == ATTEMPTS - 1 or (attempt == 0 and isinstance(error, urllib.error.URLError)):
                raise OSError(f"{archive.url}: the connection broke ({error}); call again to continue") from error
            continue
        if total is None or _size(partial) >= total:
            break
    if total is not None and _size(partial) > total:
        partial.unlink()
        raise OSError(f"{archive.url}: has more bytes on disk than on the server; they were deleted, call again")
    if total is not None and _size(partial) < total:
        raise OSError(f"{archive.url}: {_size(partial):,} of {total:,} bytes came; call again to continue")
    partial.replace(file)
    version.unlink(missing_ok=True)


def _receive(url: str, partial: Path, version: Path, progress: bool) -> int | None:
    """Receive the missing part of a file. Return its size if the server reports it."""
    have = _size(partial)
    request = urllib.request.Request(url)
    if have:
        request.add_header("Range", f"bytes={have}-")
        if version.is_file():
            request.add_header("If-Range", version.read_text(encoding="ascii"))
    try:
        with urllib.request.urlopen(request, timeout=TIMEOUT_SECONDS) as response:
            # Servers that ignore Range, or have another version (If-Range), send the whole file with status 200.
            start = have if response.status == http.HTTPStatus.PARTIAL_CONTENT else 0
            length = response.headers.get("Content-Length")
            total = None if length is None else int(length) + start
            _check_room(partial.parent, int(length or 0), url)
            etag = response.headers.get("ETag") or "W/"
            if etag.startswith("W/") or not etag.isascii():  # Parts may be joined by strong ETags only.
                version.unlink(missing_ok=True)
            else:
                version.write_text(etag, encoding="ascii")
            name = partial.name.removesuffix(".partial")
            bar = new_bar(desc=name, initial=start, total=total, unit="B", unit_scale=True, disable=not progress)
            with open(partial, "ab" if start else "wb") as opened, bar:
                for chunk in iter(lambda: response.read(CHUNK_BYTES), b""):
                    opened.write(chunk)
                    bar.update(len(chunk))
            return total
    except urllib.error.HTTPError as error:
        if error.code != http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            raise
        # No bytes are left to come: the server says how many there are.
        with error:  # It holds the connection.
            return int(error.headers.get("Content-Range", f"*/{have}").rpartition("/")[2])


def _unpack(file: Path, folder: Path, begun: Path, progress: bool) -> None:
    """Unpack a zip or tar archive, none of whose members may lead outside the folder, as links and devices may.

    `begun` is a file that is made before the first member; if it is there, files of other sizes are replaced.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tarfile.open(file) if tarfile.is_tarfile(file) else zipfile.ZipFile(file) as opened:
        members = [member for member in _members(opened) if LEFT_OUT not in Path(member.name).parts]
        for member in members:
            target = folder / member.name
            if member.is_special:
                raise ValueError(
                    f"{file}: the member {member.name!r} is a link or a device, which may lead outside {folder}"
                )
            # resolve also follows links that are in the folder already.
            if not target.resolve().is_relative_to(folder.resolve()):
                raise ValueError(f"{file}: the member {member.name!r} would be written outside {folder}")
            is_other = not member.is_folder and target.exists() and _size(target) != member.num_bytes
            if is_other and not begun.is_file():
                raise FileExistsError(
                    f"{target}: exists already and differs from the one in {file.name}; move it away, or choose "
                    "another folder"
                )
        _check_room(folder, sum(member.num_bytes for member in members if not member.is_folder), str(file))
        begun.touch()
        for member in progress_over(members, "unpacking", "file", is_shown=progress):
            opened.extract(member.entry, folder)


class _Member(NamedTuple):
    """Member of an archive."""

    entry: Any  # As tarfile or zipfile has it.
    name: str
    num_bytes: int
    is_folder: bool
    is_special: bool  # Neither a file nor a folder.


def _members(opened: tarfile.TarFile | zipfile.ZipFile) -> list[_Member]:
    members = []
    if isinstance(opened, zipfile.ZipFile):
        for info in opened.infolist():
            members.append(_Member(info, info.filename, info.file_size, info.is_dir(), is_special=False))
        return members
    if hasattr(tarfile, "data_filter"):  # Pythons before 3.11.4 have no filters.
        opened.extraction_filter = tarfile.data_filter
    for entry in opened.getmembers():
        is_special = not entry.isfile() and not entry.isdir()
        members.append(_Member(entry, entry.name, entry.size, entry.isdir(), is_special))
    return members


def _check_room(folder: Path, num_bytes: int, what: str) -> None:
    free = shutil.disk_usage(folder).free
    if num_bytes > free:
        raise OSError(
            f"{what} needs {num_bytes / 1e9:.1f} GB of disk in {folder}, which has {free / 1e9:.1f} GB: make room, or "
            "choose another folder"
        )


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0
