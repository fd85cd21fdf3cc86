"""Reading of a scene's photographs with their masks, by one process or by several that divide them.

One process reads all photographs, so that a broken one is found before training. Of several processes each reads its
share, and what has room in its memory. It leaves the others until it draws them.
"""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from a2tg_jax.data.decoding import picture_size, read_pixels
from a2tg_jax.data.depth_files import depth_map
from a2tg_jax.data.depths import DepthMap
from a2tg_jax.data.division import Division
from a2tg_jax.data.images import check_aspect, map_in_threads, num_readers
from a2tg_jax.data.lenses import Lens
from a2tg_jax.data.mask_files import load_mask
from a2tg_jax.data.masks import Mask
from a2tg_jax.data.photo_store import Picture, Shelf
from a2tg_jax.host.remote_files import is_remote


class PhotoFiles(NamedTuple):
    """Files and camera of a photograph, none of which is read yet."""

    name: str
    """Path of the image below the folder of images."""
    file: Path
    downscale: int
    """Factor by which the file's pixels are downscaled."""
    lens_of: Callable[[tuple[int, int]], Lens]
    """Function from the file's (width, height) to the lens."""
    error_message: Callable[[Exception], str]
    """Function from an error of the lens to a message that names the photograph."""
    mask: tuple[Path, int] | None
    """File of the mask, and the factor by which it is downscaled."""
    depths: Path | None
    """File of the depth map."""


class Facts(NamedTuple):
    """Facts about a photograph that only decoding tells."""

    stored: tuple[int, int]
    """(width, height) of the file's pixels."""
    shape: tuple[int, ...]
    """Shape of the view's pixels."""
    is_stored: bool
    """Whether the view's pixels are those of the file, neither undistorted nor downscaled."""
    mask: Mask | None

    def to_json(self) -> list[Any]:
        """Return values that can be written as JSON."""
        return [self.stored, self.shape, self.is_stored, None if self.mask is None else self.mask.to_json()]

    @staticmethod
    def from_json(values: list[Any]) -> "Facts":
        """Return the facts whose `to_json` gave these values."""
        stored, shape, is_stored, mask = values
        return Facts(tuple(stored), tuple(shape), is_stored, None if mask is None else Mask.from_json(mask))


class Reading(NamedTuple):
    """A photograph as its view has it."""

    facts: Facts
    K: np.ndarray
    """[3, 3] intrinsics in pixels of the view."""
    rays: np.ndarray | None
    """Rays of the lens (`Shot.rays`)."""
    picture: Picture
    depth: DepthMap | None


def read_photos(photos: Sequence[PhotoFiles], shelf: Shelf, division: Division | None, place: Path) -> list[Reading]:
    """Return the photographs of a scene.

    Args:
      photos: in an order that is the same in all processes.
      shelf: where their pixels go.
      division: processes that call this together, within `sharing_errors`; None: one.
      place: path of the scene.

    Raises:
      FileNotFoundError, ValueError, OSError: if a photograph or a mask cannot be used. `sharing_errors` raises it in
        every process.
    """
    names: dict[Path, str] = {}
    for photo in photos:
        if names.setdefault(photo.file, photo.name) != photo.name:
            raise ValueError(
                f"{photo.file}: is the only file for {names[photo.file]} and {photo.name}; put both there, or remove "
                "one from the scene"
            )
    threads = num_readers(place)
    if division is None:
        return map_in_threads(lambda photo: _read(photo, shelf), photos, threads)
    read: dict[int, Reading] = {}

    def facts_of(number: int) -> list[Any]:
        read[number] = _read(photos[number], shelf)
        return read[number].facts.to_json()

    told = [f"{photo.name} downscaled by {photo.downscale}" for photo in photos]
    facts = [Facts.from_json(values) for values in division.results(told, facts_of, "photographs", threads)]
    others = [number for number in range(len(photos)) if number not in read]
    fitting = shelf.fitting([math.prod(facts[number].shape) for number in others])

    def of_another(number: int, fits: bool) -> Reading:
        if not fits:
            return _unread(photos[number], shelf, facts[number])
        reading = _read(photos[number], shelf)
        _check_size(photos[number], reading.facts.stored, facts[number].stored)
        return reading

    found = map_in_threads(lambda item: of_another(*item), zip(others, fitting, strict=True), threads)
    read.update(zip(others, found, strict=True))
    return [read[number] for number in range(len(photos))]


def _read(photo: PhotoFiles, shelf: Shelf) -> Reading:
    """Read a photograph, and undistort and downscale it."""
    photograph = read_pixels(photo.file)
    stored = photograph.shape[1], photograph.shape[0]
    lens = photo.lens_of(stored)
    check_aspect(photo.file, stored, lens.size)
    with _named(photo):
        pixels, K = lens.view_pixels(photograph, photo.downscale)
        rays = lens.rays(*pixels.shape[1::-1])
    is_stored, size = pixels is photograph, (pixels.shape[1], pixels.shape[0])
    mask = load_mask(photo.mask, lens, stored, size)
    picture = shelf.keep(pixels, photo.file, None if is_stored else lens.viewing(photo.downscale))
    depth = depth_map(photo.depths, lens, stored, size)
    return Reading(Facts(stored, pixels.shape, is_stored, mask), K, rays, picture, depth)


def _unread(photo: PhotoFiles, shelf: Shelf, facts: Facts) -> Reading:
    """Return a photograph that another process has read. Its own file is read when it is first needed.

    Raises:
      ValueError: if the file is of another size; that of object storage is not looked at.
    """
    if not is_remote(photo.file):
        _check_size(photo, picture_size(photo.file), facts.stored)
    lens = photo.lens_of(facts.stored)
    with _named(photo):
        size, K = lens.view_of(facts.stored, photo.downscale)
        rays = lens.rays(*size)
    picture = shelf.read_later(facts.shape, photo.file, None if facts.is_stored else lens.viewing(photo.downscale))
    return Reading(facts, K, rays, picture, depth_map(photo.depths, lens, facts.stored, size))


def _check_size(photo: PhotoFiles, size: tuple[int, int], stored: tuple[int, int]) -> None:
    """Raise ValueError unless a photograph has the size (width, height) that another process has read."""
    if size != stored:
        raise ValueError(
            f"{photo.file}: is {size[0]}x{size[1]}, but {stored[0]}x{stored[1]} where another process reads it; give "
            "all processes the same photographs"
        )


@contextlib.contextmanager
def _named(photo: PhotoFiles) -> Iterator[None]:
    """Name the photograph in errors of its lens."""
    try:
        yield
    except ValueError as error:
        raise ValueError(photo.error_message(error)) from None
