"""Finding and resizing photographs. Pixels are uint8, [H, W, 3] or, with straight alpha, [H, W, 4]."""

import os
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path, PurePath, PureWindowsPath
from typing import TypeVar

import numpy as np
from PIL import Image

from a2tg_jax.host.regular_files import is_regular, names_in
from a2tg_jax.host.remote_files import is_remote
from a2tg_jax.host.text import counted, shortened

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".heic", ".heif", ".avif")
"""Suffixes of photographs; capital letters do as well."""
LONGEST_NAME = 1000
"""Largest number of letters in an image's path below its folder."""
MAX_ASPECT_ERROR = 0.01
"""Largest relative difference of aspect between an image and its camera, beyond one pixel of rounding."""
MOST_READERS = 8
"""Largest number of threads that read photographs."""

Item = TypeVar("Item")
Result = TypeVar("Result")


def locate_image(folder: Path, name: str) -> Path:
    """Return the file of one image.

    Args:
      folder: the folder of images.
      name: path of the image below the folder; the suffix may be missing.

    Raises:
      FileNotFoundError: naming the image, if it is not there.
      ValueError: if the name leads out of the folder.
    """
    name = inside(folder, name)
    for candidate in (folder / name, folder / f"{name}.png", *_with_suffixes(folder, name)):
        if is_regular(candidate):
            return candidate
    if (found := on_disk(folder, name)) is not None:
        return found
    raise FileNotFoundError(
        f"{folder / name}: no such image, but the scene has a camera for it; "
        f"put the image there, or remove its frame from the file that names it"
    )


def find_image(folder: Path, name: str) -> Path | None:
    """Return the file that `locate_image` returns, or None if it is not there."""
    with suppress(FileNotFoundError):
        return locate_image(folder, name)
    return None


def named_image(folder: Path, name: str) -> Path | None:
    """Return the image of a name, with or without its suffix, or None."""
    own = [folder / name] if Path(name).suffix.lower() in PHOTO_SUFFIXES else []
    found = next((file for file in (*own, *_with_suffixes(folder, name)) if name and is_regular(file)), None)
    return found or (on_disk(folder, name) if own else None)


def _with_suffixes(folder: Path, name: str) -> Iterator[Path]:
    for suffix in PHOTO_SUFFIXES:
        yield folder / f"{name}{suffix}"
        yield folder / f"{name}{suffix.upper()}"


def inside(folder: Path, name: str) -> str:
    """Return the path below a folder of what a file of the scene names, with "/" between its parts.

    A backslash separates parts as "/" does, unless a file has the very name. An absolute path in the folder becomes a
    relative one.

    Raises:
      ValueError: naming both, if it leads out of the folder, by ".." or as an absolute path, or is no name. Links may
        lead anywhere.
    """
    if len(name) > LONGEST_NAME:
        raise ValueError(f"{folder}: {shortened(name)} is too long a name ({len(name)} letters); shorten it")
    is_file = "\0" not in name and "\\" in name and is_regular(folder / name)
    path = Path(name if is_file else name.replace("\\", "/"))
    if path.is_absolute() and not is_remote(folder):
        roots = os.path.abspath(folder), os.path.realpath(folder)
        path = next((path.relative_to(root) for root in roots if path.is_relative_to(root)), path)
    if PureWindowsPath(str(path)).root or path.drive or os.pardir in path.parts or "\0" in name:
        raise ValueError(
            f"{folder}: {shortened(name)} leads out of the scene's folder, and nothing outside is read; "
            "move it there, or put a link there to where it is, and name that"
        )
    return path.as_posix()


def on_disk(folder: Path, *names: str) -> Path | None:
    """Return the first file of some paths below a folder that exists; None without one.

    If none exists, return the first that differs from a file in capitals alone, unless it does from several.
    """
    files = [folder / name for name in names if is_regular(folder / name)]
    for name in () if files else names:
        found = [folder]
        for part in Path(name).parts:
            found = [each / own for each in found for own in names_in(each) if _letters(own) == _letters(part)]
        files += [found[0]] if len(found) == 1 and is_regular(found[0]) else []
    return files[0] if files else None


def _letters(name: str) -> str:
    """Return a name without capitals. macOS writes accents as letters of their own, which are joined."""
    return unicodedata.normalize("NFC", name.casefold())


def warn_of_unposed(folder: Path, names: Iterable[str], is_deep: bool = True) -> None:
    """Warn of photographs in a folder of this machine that are not among some names.

    Args:
      folder: the folder of photographs.
      names: paths below it of photographs with a pose; suffixes and capitals may differ.
      is_deep: whether folders in it hold photographs, too.
    """
    if is_remote(folder) or not folder.is_dir():
        return
    own = {_letters(PurePath(name).with_suffix("").as_posix()) for name in names}
    files = (file.relative_to(folder) for file in (folder.rglob("*") if is_deep else folder.iterdir()))
    photos = (file for file in files if file.suffix.lower() in PHOTO_SUFFIXES)
    others = sorted(file.as_posix() for file in photos if _letters(file.with_suffix("").as_posix()) not in own)
    if others:
        told = f"{counted(len(others), 'photograph')} without a pose, such as {shortened(others[0])}"
        warnings.warn(f"{folder}: {told}: not used", stacklevel=3)


def resize_pixels(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the image at a smaller size, each new pixel a weighted mean around its area (weighted with alpha too).

    Pillow's box filter uses whole pixels only, which shifts details at fractional ratios.
    """
    if pixels.shape[:2] == (height, width):
        return pixels
    return np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.HAMMING))


def downscaled_size(width: int, height: int, downscale: int) -> tuple[int, int]:
    """Return (width, height) divided by the factor, rounded, at least 1."""
    return max(1, round(width / downscale)), max(1, round(height / downscale))


def check_aspect(path: Path, stored: tuple[int, int], camera: tuple[int, int]) -> None:
    """Raise ValueError if the image's aspect differs from that of the camera; both are (width, height).

    Raises:
      ValueError: naming the file and both sizes.
    """
    (image_width, image_height), (width, height) = stored, camera
    ratio = (image_width * height) / (image_height * width)
    if abs(ratio - 1) > max(MAX_ASPECT_ERROR, 1 / min(image_width, image_height)):
        is_turned = (image_height, image_width) == camera
        advice = "write it turned as EXIF says (magick mogrify -auto-orient FILE), or " if is_turned else ""
        raise ValueError(
            f"{path}: is {image_width}x{image_height}, but its camera is {width}x{height}, of another aspect; "
            f"{advice}use the image that the camera was estimated from"
        )


def scaled_intrinsics(K: np.ndarray, old: tuple[int, int], new: tuple[int, int]) -> np.ndarray:
    """Return K [3, 3] for an image of the size `new` instead of `old`, both (width, height); pixel edges stay edges."""
    scaled: np.ndarray = np.diag([new[0] / old[0], new[1] / old[1], 1.0]) @ K
    return scaled


def num_readers(place: Path | None = None) -> int:
    """Return the number of threads that read photographs of a place; None: of this machine. Those that wait for a
    store take no core."""
    return MOST_READERS if place is not None and is_remote(place) else min(MOST_READERS, os.cpu_count() or 1)


def map_in_threads(
    function: Callable[[Item], Result], items: Iterable[Item], num_threads: int | None = None
) -> list[Result]:
    """Return [function(item) for item in items], in several threads; decoding and resizing release Python's lock.

    Args:
      function: called in any of the threads.
      items: its arguments.
      num_threads: number of threads; None: `num_readers` of this machine.
    """
    with ThreadPoolExecutor(max_workers=num_threads or num_readers()) as pool:
        return list(pool.map(function, items))
