"""Masks on disk: 0 (black, or transparent) excludes a pixel and all else keeps it, as with COLMAP and nerfstudio."""

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
from a2tg_jax.data.smaller_copies import SmallerCopies
from a2tg_jax.host.regular_files import is_folder

FOLDER = "masks"
"""Folder of masks, beside the folder of images."""
AlphaMeaning = Literal["transparency", "mask"]
"""Meaning of the alpha channel of photographs: transparency over a background, or a mask."""


def find_mask(images: Path, name: str, downscale: int) -> tuple[Path, str] | None:
    """Return the folder of an image's mask and the mask's path below it; None without a mask.

    Args:
      images: the folder of the full images; masks are in its sibling `masks`, or only in `masks_k` for a downscale k.
      name: path of the image below the folder; its mask is NAME.EXT.png, as in COLMAP, NAME.png, or has the same name.
      downscale: k >= 1.
    """
    folder = images.with_name(FOLDER)
    names = f"{name}.png", str(Path(name).with_suffix(".png")), name
    for place in (folder, folder.with_name(f"{folder.name}_{downscale}")) if downscale > 1 else (folder,):
        if (found := on_disk(place, *names)) is not None:
            return folder, found.relative_to(place).as_posix()
    return None


def mask_to_read(
    mask: tuple[Path, str] | None, copies: SmallerCopies, *, is_named: bool = False
) -> tuple[Path, int] | None:
    """Return the file of a mask and the remaining factor of downscaling; None without one.

    Args:
      mask: folder of the full mask, and path below it.
      copies: smaller copies of the scene's files.
      is_named: whether the scene names the mask.

    Raises:
      FileNotFoundError: if a mask that the scene names is missing.
    """
    if mask is None:
        return None
    folder, still_to_downscale = copies.of(mask[0])
    if (found := on_disk(folder, mask[1])) is not None:
        return found, still_to_downscale
    if is_named:
        path = mask[0] / mask[1]
        raise FileNotFoundError(f"{path}: no such mask, but the scene names it; add the mask or remove its mask_path")
    return None


def load_mask(
    found: tuple[Path, int] | None, lens: Lens, stored: tuple[int, int], view_size: tuple[int, int]
) -> Mask | None:
    """Return the mask of a view, undistorted and downscaled as its photograph was; None for None.

    A pixel counts if all its source pixels count.

    Args:
      found: file and factor from `mask_to_read`.
      lens: the photograph's camera.
      stored: (width, height) of the photograph as stored.
      view_size: (width, height) of the view.

    Raises:
      ValueError: naming the file, if it is no image, or its size is neither the photograph's nor its camera's.
    """
    if found is None:
        return None
    file, still_to_downscale = found
    counts = _counts(read_pixels(file))
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


def _counts(pixels: np.ndarray) -> np.ndarray:
    """Return [H, W] whether pixels of a mask file count: those that are not black, or not transparent in a file whose
    alpha channel is the mask. A file with a mask in both excludes what either does."""
    is_lit = np.asarray(pixels[..., :3].any(axis=-1))
    if pixels.shape[2] == 3 or (pixels[..., 3] == pixels[0, 0, 3]).all():
        return is_lit
    is_opaque = pixels[..., 3].astype(bool)
    lit = pixels[is_opaque & is_lit]
    # Colours hold a mask too if there are two of them, one black: not in a cut-out photograph, nor where all are black.
    has_both = 0 < len(lit) < is_opaque.sum() and (lit[:, :3] == lit[0, :3]).all()
    return is_opaque & is_lit if has_both else is_opaque


def _check_left(mask: Mask, name: str, source: str) -> None:
    if mask.num == 0:
        raise ValueError(
            f"{source}: the mask of {name} excludes every pixel; remove the photograph or correct the mask"
        )
