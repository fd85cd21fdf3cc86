"""Finding and resizing photographs. Pixels are uint8, [H, W, 3] or, with straight alpha, [H, W, 4]."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import numpy as np
from PIL import Image

from a2tg_jax.host.regular_files import is_regular
from a2tg_jax.host.remote_files import is_remote
from a2tg_jax.host.text import shortened

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
    check_inside(folder, name)
    for candidate in (folder / name, folder / f"{name}.png", *_with_suffixes(folder, name)):
        if is_regular(candidate):
            return candidate
    raise FileNotFoundError(
        f"{folder / name}: no such image, but the scene has a camera for it; "
        f"put the image there or remove the camera from the model"
    )


def named_image(folder: Path, name: str) -> Path | None:
    """Return the image of a name, with or without its suffix, or None."""
    own = [folder / name] if Path(name).suffix.lower() in PHOTO_SUFFIXES else []
    return next((file for file in (*own, *_with_suffixes(folder, name)) if name and is_regular(file)), None)


def _with_suffixes(folder: Path, name: str) -> Iterator[Path]:
    for suffix in PHOTO_SUFFIXES:
        yield folder / f"{name}{suffix}"
        yield folder / f"{name}{suffix.upper()}"


def check_inside(folder: Path, name: str) -> None:
    """Refuse a name in a file of the scene that leads out of the scene's folder. Links may lead anywhere.

    Raises:
      ValueError: naming both, if it is absolute, climbs by "..", or is no name.
    """
    if os.path.isabs(name) or os.pardir in Path(name).parts or "\0" in name:
        raise ValueError(
            f"{folder}: {shortened(name)} leads out of the scene's folder, and nothing outside is read; "
            "move it there, or put a link there to where it is, and name that"
        )
    if len(name) > LONGEST_NAME:
        raise ValueError(f"{folder}: {shortened(name)} is too long a name ({len(name)} letters); shorten it")


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
        raise ValueError(
            f"{path}: is {image_width}x{image_height}, but its camera is {width}x{height}, of another aspect; "
            f"use the image that the camera was estimated from"
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
