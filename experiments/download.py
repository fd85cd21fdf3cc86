"""Fetch the data sets of the paper: Mip-NeRF 360 (12 GB), Tanks and Temples and Deep Blending (0.7 GB).

    python experiments/download.py SCENES

Archives are downloaded to SCENES/archives and unpacked into 360_v2, tandt and db, as grids/scales.toml names them. An
interrupted download continues. Existing data sets are left alone.
"""

import argparse
import shutil
import sys
import urllib.error
import urllib.request
import zipfile
from collections.abc import Mapping
from pathlib import Path

from lab.interrupts import interruptible

ARCHIVES = {
    "https://storage.googleapis.com/gresearch/refraw360/360_v2.zip": "360_v2",
    "https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/datasets/input/tandt_db.zip": ".",
}
"""Folder below SCENES in which each archive is unpacked, by address."""
CHUNK_BYTES = 1 << 20
TIMEOUT_SECONDS = 60


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, help="folder for the scenes")
    try:
        fetch_all(parser.parse_args().scenes, ARCHIVES)
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")


def fetch_all(scenes: Path, archives: Mapping[str, str]) -> None:
    """Download and unpack the archives that are missing.

    Args:
      scenes: folder for the scenes.
      archives: folder below it by address.

    Raises:
      OSError: if an address cannot be read; the downloaded part stays, and the next call continues.
      ValueError: if an archive would write outside its folder.
    """
    for url, name in archives.items():
        archive = scenes / "archives" / url.rpartition("/")[2]
        done = archive.with_suffix(".unpacked")
        if done.is_file():
            continue
        download(url, archive)
        try:
            unpack(archive, scenes / name)
        except zipfile.BadZipFile as error:
            archive.unlink()
            raise ValueError(f"{archive} is damaged, and was deleted: call again to fetch it anew ({error})") from error
        done.touch()
        archive.unlink()


def download(url: str, path: Path) -> None:
    """Download a file, from where an earlier attempt stopped."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    if path.is_file():
        return
    have = partial.stat().st_size if partial.is_file() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"} if have else {})
    try:
        with urllib.request.urlopen(request, timeout=TIMEOUT_SECONDS) as response:
            is_rest = response.status == 206
            total = int(response.headers.get("Content-Length", 0)) + (have if is_rest else 0)
            print(f"{url}: {total / 1e9:.2f} GB" + (f", from {have / 1e9:.2f} GB on" if is_rest else ""), flush=True)
            with open(partial, "ab" if is_rest else "wb") as file:
                shutil.copyfileobj(response, file, CHUNK_BYTES)
    except urllib.error.HTTPError as error:
        if error.code != 416:
            raise OSError(f"{url}: {error}") from error
        # No bytes are left to come: the server says how many there are.
        total = int(error.headers.get("Content-Range", f"*/{have}").rpartition("/")[2])
        error.close()
    if total and partial.stat().st_size > total:
        partial.unlink()
        raise OSError(f"{url}: more bytes were there than it has; they were deleted, call again")
    if total and partial.stat().st_size != total:
        raise OSError(f"{url}: {partial.stat().st_size} of {total} bytes came; call again to go on")
    partial.replace(path)


def unpack(archive: Path, folder: Path) -> None:
    """Unpack a zip archive.

    Raises:
      ValueError: if a member's name leads outside the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(archive) as opened:
        for name in opened.namelist():
            if not (folder / name).resolve().is_relative_to(folder.resolve()):
                raise ValueError(f"{archive}: the member {name!r} would be written outside {folder}")
        opened.extractall(folder)


if __name__ == "__main__":
    with interruptible():
        main()
