"""Reading of a scene's photographs with their masks, by one process or by several that divide them.

One process reads all photographs, so that a broken one is found before training. Of several processes each reads its
share, and what has room in its memory. It leaves the others until it draws them.
"""

import contextlib
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from a2tg_jax.data.assembly import Shot
from a2tg_jax.data.decoding import picture_size, read_pixels
from a2tg_jax.data.depths import depth_map
from a2tg_jax.data.division import Division, divided
from a2tg_jax.data.image_files import map_in_threads
from a2tg_jax.data.lenses import Lens, LensUse
from a2tg_jax.data.masks import Mask, check_left, load_mask
from a2tg_jax.data.photo_store import Picture, Shelf
from a2tg_jax.host.regular_files import is_folder
from a2tg_jax.host.remote_files import is_remote

MAX_ASPECT_ERROR = 0.01
"""Largest relative difference of aspect between an image and its camera, beyond one pixel of rounding."""


class Options(NamedTuple):
    """Options of `load_scene` for the readers of all formats."""

    downscale: int
    test_every: int
    lens: LensUse
    shelf: Shelf
    """Where pixels go."""
    division: Division | None
    """Processes that load the scene together, within `sharing_errors`; None: one."""


class Photo(NamedTuple):
    """Files and camera of a photograph that is not read yet."""

    name: str
    """Path of the image below the folder of images."""
    viewmat: np.ndarray
    """[4, 4] float64 world to camera (OpenCV), in the original world."""
    file: Path
    downscale: int
    """Factor by which the file's pixels are downscaled."""
    lens_of: Callable[[tuple[int, int]], Lens]
    """Function from the file's (width, height) to the lens."""
    what: str
    """Name of the photograph in errors of its lens."""
    mask: tuple[Path, int] | None
    """File of the mask, and the factor by which it is downscaled."""
    depths: Path | None
    """File of the depth map."""
    panorama: int | None = None
    """Number of the panorama that it was cut from."""

    def processing(self, lens: Lens) -> Callable[[np.ndarray], np.ndarray]:
        """Return the function from the file's pixels to the view's."""
        return lambda pixels: lens.view_pixels(pixels, self.downscale)[0]


class Facts(NamedTuple):
    """Facts about a photograph that are known once it is decoded."""

    stored: tuple[int, int]
    """(width, height) of the file's pixels."""
    shape: tuple[int, ...]
    """Shape of the view's pixels."""
    is_stored: bool
    """Whether the view has the pixels of the file, neither undistorted nor downscaled."""
    mask: Mask | None


def read_photos(photos: Sequence[Photo], options: Options, place: Path) -> list[Shot]:
    """Return the photographs of a scene at a place, given in an order that is the same in all processes."""
    names: dict[Path, str] = {}
    for photo in photos:
        if names.setdefault(photo.file, photo.name) != photo.name:
            raise ValueError(
                f"{photo.file}: is the only file for {names[photo.file]} and {photo.name}; put both there, or remove "
                "one from the scene"
            )
    shelf, read = options.shelf, dict[int, Shot]()

    def facts_of(number: int) -> Facts:
        facts, read[number] = _read(photos[number], shelf)
        return facts

    told = [f"{photo.name} downscaled by {photo.downscale}" for photo in photos]
    facts = divided(options.division, told, facts_of, "photographs", place)
    # All of them are read here if there is one process.
    others = [number for number in range(len(photos)) if number not in read]
    fitting = shelf.fitting([math.prod(facts[number].shape) for number in others])

    def of_another(number: int, fits: bool) -> Shot:
        if not fits:
            return _unread(photos[number], shelf, facts[number])
        found, shot = _read(photos[number], shelf)
        _check_size(photos[number], found.stored, facts[number].stored)
        return shot

    found = map_in_threads(of_another, others, fitting, place=place)
    read.update(zip(others, found, strict=True))
    return [read[number] for number in range(len(photos))]


def _read(photo: Photo, shelf: Shelf) -> tuple[Facts, Shot]:
    """Read a photograph, and undistort and downscale it."""
    photograph = read_pixels(photo.file)
    stored = photograph.shape[1], photograph.shape[0]
    lens = photo.lens_of(stored)
    _check_aspect(photo.file, stored, lens.size)
    with _named(photo):
        pixels, K = lens.view_pixels(photograph, photo.downscale)
        rays = lens.rays(*pixels.shape[1::-1])
    is_stored, size = pixels is photograph, (pixels.shape[1], pixels.shape[0])
    mask = load_mask(photo.mask, lens, stored, size)
    picture = shelf.keep(pixels, photo.file, None if is_stored else photo.processing(lens))
    return Facts(stored, pixels.shape, is_stored, mask), _shot(photo, lens, stored, K, rays, picture, mask)


def _unread(photo: Photo, shelf: Shelf, facts: Facts) -> Shot:
    """Return a photograph that another process has read. Its own file is read when it is first needed."""
    if not is_remote(photo.file):
        _check_size(photo, picture_size(photo.file), facts.stored)
    lens = photo.lens_of(facts.stored)
    with _named(photo):
        size, K = lens.view_of(facts.stored, photo.downscale)
        rays = lens.rays(*size)
    picture = shelf.read_later(facts.shape, photo.file, None if facts.is_stored else photo.processing(lens))
    return _shot(photo, lens, facts.stored, K, rays, picture, facts.mask)


def _shot(
    photo: Photo, lens: Lens, stored: tuple[int, int], K: np.ndarray, rays: np.ndarray | None, picture: Picture,
    mask: Mask | None,
) -> Shot:  # fmt: skip
    depth = depth_map(photo.depths, lens, stored, picture.size[::-1])
    return Shot(photo.name, photo.viewmat, K, picture, mask, rays, depth, photo.panorama)


def _check_size(photo: Photo, size: tuple[int, int], stored: tuple[int, int]) -> None:
    """Raise ValueError unless a photograph has the size (width, height) that another process has read."""
    if size != stored:
        raise ValueError(
            f"{photo.file}: is {size[0]}x{size[1]}, but {stored[0]}x{stored[1]} where another process reads it; give "
            "all processes the same photographs"
        )


def _check_aspect(path: Path, stored: tuple[int, int], camera: tuple[int, int]) -> None:
    """Raise ValueError if the image's aspect differs from the camera's; both are (width, height)."""
    (image_width, image_height), (width, height) = stored, camera
    ratio = (image_width * height) / (image_height * width)
    if abs(ratio - 1) > max(MAX_ASPECT_ERROR, 1 / min(image_width, image_height)):
        is_turned = (image_height, image_width) == camera
        advice = "write it turned as EXIF says (magick mogrify -auto-orient FILE), or " if is_turned else ""
        raise ValueError(
            f"{path}: is {image_width}x{image_height}, but its camera is {width}x{height}, of another aspect; "
            f"{advice}use the image that the camera was estimated from"
        )


@contextlib.contextmanager
def _named(photo: Photo) -> Iterator[None]:
    """Name the photograph in errors of its lens."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{photo.what}: its camera model {error}") from None


def check_masks(shots: Sequence[Shot], source: str, folder: Path | None = None) -> None:
    """Warn of photographs without a mask if others have one, or if the folder of masks has none of any photograph.

    Raise ValueError, naming the photograph, if its mask leaves nothing.
    """
    lacking = [shot.name for shot in shots if shot.mask is None]
    if len(lacking) == len(shots):
        if folder is not None and is_folder(folder):
            message = f"{folder}: holds no mask of a photograph of the scene, called NAME.jpg.png or NAME.png: not used"
            warnings.warn(message, stacklevel=3)
        return
    if lacking:
        message = f"{source}: {len(lacking)} of {len(shots)} photographs have no mask, such as {lacking[0]}"
        warnings.warn(f"{message}: all of their pixels count", stacklevel=3)
    for shot in shots:
        if shot.mask is not None:
            check_left(shot.mask, shot.name, source)
