"""Photographs and masks on disk: files by name, and threads that read them."""

import os
import unicodedata
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePath, PureWindowsPath
from typing import TypeVar

from a2tg_jax.base.regular_files import is_regular, names_in
from a2tg_jax.base.text import counted, first_names, shortened
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.data.decoding import PictureError

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".heic", ".heif", ".avif")
"""Suffixes of photographs, in lower or upper case."""
LONGEST_NAME = 1000
"""Largest number of letters in an image's path below its folder."""
MOST_READERS = 8

Result = TypeVar("Result")


def find_image(folder: Path, name: str) -> Path | None:
    """Return the file of an image, whose name is a path below a folder, perhaps without suffix; None if there is none.

    Raises:
      ValueError: if the name leads out of the folder.
    """
    name = inside(folder, name)
    # NeRF's Blender scenes leave out the suffix .png.
    suffixes = ["", ".png", *(each for suffix in PHOTO_SUFFIXES for each in (suffix, suffix.upper()))]
    return next(filter(is_regular, (folder / (name + suffix) for suffix in suffixes)), None) or on_disk(folder, name)


def inside(folder: Path, name: str) -> str:
    """Return the path below a folder of a file that the scene names, with "/" between its parts.

    A backslash separates parts as "/" does, unless a file has that very name. An absolute path in the folder becomes a
    relative one.

    Raises:
      ValueError: naming both, if it leads out of the folder, by ".." or as an absolute path, or is no name. Links may
        lead anywhere.
    """
    if len(name) > LONGEST_NAME:
        raise ValueError(f"{folder}: {shortened(name)} is too long a name ({len(name)} letters); shorten it")
    # On Linux and macOS a backslash may also be a letter of a name.
    is_file = "\0" not in name and "\\" in name and is_regular(folder / name)
    path = Path(name if is_file else name.replace("\\", "/"))
    if path.is_absolute():
        roots = os.path.abspath(folder), os.path.realpath(folder)  # The scene may have been written through a link.
        path = next((path.relative_to(root) for root in roots if path.is_relative_to(root)), path)
    # On Windows /x has a root and C:x a drive, but neither is absolute.
    if PureWindowsPath(str(path)).root or path.drive or os.pardir in path.parts or "\0" in name:
        raise ValueError(
            f"{folder}: {shortened(name)} leads out of the scene's folder, and nothing outside is read; "
            "move it there, or put a link there to where it is, and name that"
        )
    return path.as_posix()


def on_disk(folder: Path, *names: str) -> Path | None:
    """Return the first file of some paths below a folder that exists; None if there is none.

    If none exists, return the first that differs from a file in capitals alone, unless it does from several.
    """
    for name in names:
        if is_regular(folder / name):
            return folder / name
    for name in names:
        places = [folder]
        for part in Path(name).parts:
            # Several may fit: folders may differ in capitals as well.
            entries = [place / entry for place in places for entry in names_in(place)]
            places = [entry for entry in entries if _letters(entry.name) == _letters(part)]
        if len(places) == 1 and is_regular(places[0]):
            return places[0]
    return None


def _letters(name: str) -> str:
    """Return a name without capitals. macOS writes accents as separate letters, which are joined."""
    return unicodedata.normalize("NFC", name.casefold())


def is_photo(file: PurePath) -> bool:
    """Return whether a file is a photograph by its name."""
    # macOS puts ._0.jpg, which is no picture, next to 0.jpg on disks of other systems.
    return file.suffix.lower() in PHOTO_SUFFIXES and file.name[0] != "."


def is_hidden(name: PurePath) -> bool:
    """Return whether a path below a folder is in a hidden folder, or in one such as @eaDir, Synology's thumbnails."""
    return any(part[0] in ".@" for part in name.parts[:-1])


def files_below(folder: Path) -> Iterator[Path]:
    """Yield the files in a folder and below it, also where links to folders lead, each folder once."""
    seen = set()
    for place, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        if real in seen:  # A link may lead to a folder above it.
            folders.clear()
            continue
        seen.add(real)
        folders.sort()
        for name in names:
            file = Path(place, name)
            if file.is_file():
                yield file


def warn_of_unposed(folder: Path, names: Iterable[str], is_deep: bool = True) -> None:
    """Warn of photographs in a folder (`is_deep`: and its subfolders) that are not among some names.

    The names are paths below it, whose suffixes and capitals may differ.
    """
    if not folder.is_dir():
        return
    posed = {_letters(PurePath(name).with_suffix("").as_posix()) for name in names}
    others = []
    for file in files_below(folder) if is_deep else folder.iterdir():
        name = file.relative_to(folder)
        if is_photo(name) and not is_hidden(name) and _letters(name.with_suffix("").as_posix()) not in posed:
            others.append(name.as_posix())
    others.sort()
    if others:
        left_out = f"{counted(len(others), 'photograph')} without a pose, such as {shortened(others[0])}"
        warn(f"{folder}: {left_out}: not used")


def map_in_threads(function: Callable[..., Result], *iterables: Iterable[object]) -> list[Result]:
    """Return list(map(function, *iterables)), run in threads, as decoding of pictures releases Python's lock.

    Raises:
      PictureError: naming all pictures that cannot be used, with the reason of the first.
    """

    def attempt(*arguments: object) -> Result | PictureError:
        try:
            return function(*arguments)
        except PictureError as error:
            return error

    results: list[Result] = []
    errors: list[PictureError] = []
    with ThreadPoolExecutor(max_workers=min(MOST_READERS, os.cpu_count() or 1)) as pool:
        for result in pool.map(attempt, *iterables):
            if isinstance(result, PictureError):
                errors.append(result)
            else:
                results.append(result)
    if not errors:
        return results
    path, text = errors[0].args
    # Several calls may read one picture.
    others = list(dict.fromkeys(str(error.args[0]) for error in errors if error.args[0] != path))
    if others:
        text = f"{text}. {len(others)} more cannot be used: {first_names(others)}"
    raise PictureError(path, text) from errors[0]
