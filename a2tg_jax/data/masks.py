"""Masks: pixels of a photograph that count.

In files 0 (black, or transparent) excludes a pixel and all else keeps it, as with COLMAP and nerfstudio.
"""

import dataclasses
import zlib
from pathlib import Path
from typing import Literal

import numpy as np

from a2tg_jax.data.decoding import read_pixels
from a2tg_jax.data.image_files import SmallerCopies, on_disk
from a2tg_jax.data.lenses import Lens, resize_pixels

FOLDER = "masks"
"""Folder of masks, beside the folder of images."""
AlphaMeaning = Literal["transparency", "mask"]
"""Meaning of the alpha channel of photographs: transparency over a background, or a mask."""


@dataclasses.dataclass(frozen=True)
class Mask:
    """[H, W] bool, True where a pixel counts, as compressed bits. All masks of a scene take less than one
    photograph."""

    shape: tuple[int, int]
    """(H, W)."""
    num: int
    """Number of pixels that count."""
    data: bytes = dataclasses.field(repr=False)

    @staticmethod
    def of(counts: "np.ndarray | Mask") -> "Mask":
        """Return the mask of an array [H, W]; a mask is returned unchanged.

        Raises:
          ValueError: unless it is bool, [H, W].
        """
        if isinstance(counts, Mask):
            return counts
        wanted = "a mask must be an array bool [H, W], True where pixels count"
        if not hasattr(counts, "dtype"):
            raise ValueError(f"{wanted}; got {type(counts).__name__}")
        if counts.ndim != 2 or counts.dtype != bool:
            raise ValueError(f"{wanted}; got {counts.dtype} {[*counts.shape]}")
        height, width = counts.shape
        return Mask((height, width), int(counts.sum()), zlib.compress(np.packbits(counts).tobytes(), 1))

    @property
    def is_full(self) -> bool:
        """Whether all pixels count."""
        return self.num == self.shape[0] * self.shape[1]

    def read(self) -> np.ndarray:
        """Return [H, W] bool."""
        bits = np.frombuffer(zlib.decompress(self.data), np.uint8)
        return np.unpackbits(bits, count=self.shape[0] * self.shape[1]).view(bool).reshape(self.shape)


def check_left(mask: Mask, name: str, source: str) -> None:
    """Raise ValueError, naming the photograph, if its mask leaves nothing."""
    if mask.num == 0:
        raise ValueError(
            f"{source}: the mask of {name} excludes every pixel; remove the photograph or correct the mask"
        )


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
    """Return the file of a mask (folder and path of the full one) and the remaining factor of downscaling; None without
    one. `is_named`: the scene names it, so that a missing one is an error.
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


def _counts(pixels: np.ndarray) -> np.ndarray:
    """Return [H, W] whether pixels of a mask file count: all that are not black, or not transparent in a file whose
    alpha channel is the mask. A file with a mask in both excludes what either does."""
    is_lit = np.asarray(pixels[..., :3].any(axis=-1))
    if pixels.shape[2] == 3 or (pixels[..., 3] == pixels[0, 0, 3]).all():
        return is_lit
    is_opaque = pixels[..., 3].astype(bool)
    lit = pixels[is_opaque & is_lit]
    # Colours hold a mask too if there are two of them, one black: not in a cut-out photograph, nor where all are black.
    has_both = 0 < len(lit) < is_opaque.sum() and (lit[:, :3] == lit[0, :3]).all()
    return is_opaque & is_lit if has_both else is_opaque
