"""Masks on disk: 0 (black) excludes a pixel and all else keeps it, as with COLMAP and nerfstudio."""

import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from a2tg_jax.data.assembly import Shot
from a2tg_jax.data.decoding import read_pixels
from a2tg_jax.data.division import Division, divided_masks
from a2tg_jax.data.images import on_disk, resize_pixels
from a2tg_jax.data.lenses import Lens
from a2tg_jax.data.masks import Mask
from a2tg_jax.data.scene import Scene, View
from a2tg_jax.host.regular_files import is_folder

FOLDER = "masks"
"""Folder of masks, beside the folder of images."""
AlphaMeaning = Literal["transparency", "mask"]
"""Meaning of the alpha channel of photographs: transparency over a background, or a mask."""


def find_mask(images: Path, name: str, downscale: int) -> tuple[Path, int] | None:
    """Return the mask of an image and the remaining factor of downscaling; None without a mask.

    Args:
      images: the folder of the full images; masks lie in its sibling `masks`, or `masks_k` for a downscale of k.
      name: path of the image below the folder; its mask is NAME.EXT.png, as in COLMAP, NAME.png, or has the same name.
      downscale: k >= 1.
    """
    return _at_scale(images.with_name(FOLDER), downscale, f"{name}.png", str(Path(name).with_suffix(".png")), name)


def named_mask(path: Path, downscale: int) -> tuple[Path, int]:
    """Read a mask that a scene names, as `find_mask` does.

    Raises:
      FileNotFoundError: if it is missing.
    """
    found = _at_scale(path.parent, downscale, path.name)
    if found is None:
        raise FileNotFoundError(f"{path}: no such mask, but the scene names it; add the mask or remove its mask_path")
    return found


def load_mask(
    found: tuple[Path, int] | None, lens: Lens, stored: tuple[int, int], view_size: tuple[int, int]
) -> Mask | None:
    """Return the mask of a view, undistorted and downscaled as its photograph was; None for None.

    A pixel counts if all its source pixels count.

    Args:
      found: file and factor from `find_mask`.
      lens: the photograph's camera.
      stored: (width, height) of the photograph as stored.
      view_size: (width, height) of the view.

    Raises:
      ValueError: naming the file, if it is no image, or its size is neither the photograph's nor its camera's.
    """
    if found is None:
        return None
    file, still_to_downscale = found
    counts = read_pixels(file)[..., :3].any(axis=-1)
    size = counts.shape[::-1]
    if size not in (stored, lens.size):
        told = "x".join(map(str, size)), "x".join(map(str, stored))
        raise ValueError(f"{file}: is {told[0]}, but its photograph is {told[1]}; a mask must be of the same size")
    planes = np.repeat(np.where(counts, np.uint8(255), np.uint8(0))[..., None], 3, axis=2)
    planes, _ = lens.view_pixels(planes, still_to_downscale)
    return Mask.of(resize_pixels(planes, *view_size)[..., 0] == 255)


def check_masks(shots: Sequence[Shot], source: str, folder: Path | None = None) -> None:
    """Warn of photographs without a mask if others have one, and refuse masks that leave nothing.

    Args:
      shots: all of the scene.
      source: name of the input in messages.
      folder: folder of masks. If it exists but has no mask of any photograph, a warning says so.

    Raises:
      ValueError: naming the photograph.
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
            _check_left(shot.mask, shot.name, source)


def alpha_as_mask(scene: Scene, source: str, division: Division | None = None) -> Scene:
    """Return the scene with the alpha of its photographs as masks. Only opaque pixels count.

    Args:
      scene: the scene.
      source: name of the input in messages.
      division: processes that call this together, and read a share of the photographs each; None: one.

    Raises:
      ValueError: naming a photograph without opaque pixels.
    """
    views = [*scene.train, *scene.test]

    def mask_of(number: int) -> Mask | None:
        view = views[number]
        if not view.has_alpha:
            return view.mask
        is_opaque = view.picture.read()[..., 3] == 255
        mask = Mask.of(is_opaque if view.mask is None else is_opaque & view.mask.read())
        _check_left(mask, view.name, source)
        return mask

    masks = divided_masks([view.name for view in views], mask_of, division)
    masked = [_opaque(view, mask) for view, mask in zip(views, masks, strict=True)]
    return dataclasses.replace(scene, train=tuple(masked[: len(scene.train)]), test=tuple(masked[len(scene.train) :]))


def _opaque(view: View, mask: Mask | None) -> View:
    """Return a view without its alpha, and with a mask."""
    picture, (height, width) = view.picture, view.picture.size
    if view.has_alpha:
        picture = dataclasses.replace(picture, shape=(height, width, 3), read=lambda: view.picture.read()[..., :3])
    return dataclasses.replace(view, picture=picture, mask=mask)


def _at_scale(folder: Path, downscale: int, *names: str) -> tuple[Path, int] | None:
    """Return the file of one of the names in a folder, or in its smaller sibling, and the remaining factor."""
    if downscale > 1 and (found := on_disk(folder.with_name(f"{folder.name}_{downscale}"), *names)) is not None:
        return found, 1
    found = on_disk(folder, *names)
    return None if found is None else (found, downscale)


def _check_left(mask: Mask, name: str, source: str) -> None:
    if mask.num == 0:
        raise ValueError(
            f"{source}: the mask of {name} excludes every pixel; remove the photograph or correct the mask"
        )
