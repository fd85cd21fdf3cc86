"""Depth maps on disk, as monocular networks or sensors give them.

They lie in `depths` beside `images`: NAME.npy or NAME.png for the image NAME.jpg. What they hold, inverse depth up to
scale and shift or depth up to scale, is an option of the training (`training.depth_prior`).
"""

import os
from pathlib import Path

import numpy as np
from PIL import Image

from a2tg_jax.data.decoding import MAX_PIXELS, MOST_BYTES
from a2tg_jax.data.depths import DepthMap
from a2tg_jax.data.images import on_disk
from a2tg_jax.data.lenses import Lens
from a2tg_jax.host.npz import read_npy
from a2tg_jax.host.regular_files import open_regular
from a2tg_jax.host.remote_files import Unreachable
from a2tg_jax.host.text import shortened

FOLDER = "depths"
"""Folder of depth maps, beside the folder of images."""
SUFFIXES = (".npy", ".png")
DEEPEST = {"L": 255, "I;16": 65535, "I": 65535}
"""Modes of greyscale PNGs and their largest values."""
LARGEST_ERROR = 0.02
"""Largest relative difference of aspect between a depth map and its photograph, beyond two pixels of rounding."""


def find_depths(images: Path, name: str) -> Path | None:
    """Return the depth map of an image, called NAME.npy, NAME.png, NAME.EXT.npy or NAME.EXT.png; None without one.

    Args:
      images: the folder of the full images; depth maps lie in its sibling `depths`.
      name: path of the image below the folder.
    """
    folder = images.with_name(FOLDER)
    own = [f"{stem}{suffix}" for suffix in SUFFIXES for stem in (str(Path(name).with_suffix("")), name)]
    return on_disk(folder, *own)


def depth_map(file: Path | None, lens: Lens, stored: tuple[int, int], size: tuple[int, int]) -> DepthMap | None:
    """Return the depth map of a view, undistorted and resized as its photograph when it is read; None for None.

    Args:
      file: from `find_depths`.
      lens: the photograph's camera.
      stored: (width, height) of the photograph as stored.
      size: (width, height) of the view.
    """
    if file is None:
        return None

    def load() -> np.ndarray:
        values = read_depths(file)
        height, width = values.shape
        if abs(width * stored[1] - height * stored[0]) > max(LARGEST_ERROR * width * stored[1], 2 * max(stored)):
            raise ValueError(f"{file}: is {width}x{height}, of another aspect than its photograph, {_told(stored)}")
        return np.asarray(Image.fromarray(lens.view_plane(values)).resize(size, Image.Resampling.BILINEAR))

    return DepthMap((size[1], size[0]), load)


def read_depths(file: str | os.PathLike[str]) -> np.ndarray:
    """Return the numbers [H, W] float32 of a depth map, an .npy or a greyscale PNG of 8 or 16 bits.

    Raises:
      ValueError: naming the file, if it is damaged or something else.
    """
    try:
        values = read_npy(file) if str(file).endswith(".npy") else _read_png(file)
        values = values.reshape([side for side in values.shape if side != 1]) if values.ndim > 2 else values
    except Unreachable:
        raise
    except Exception as error:  # what a damaged file raises goes from SyntaxError to struct.error
        reason = shortened(str(error) or type(error).__name__)
        raise ValueError(f"{file}: cannot be read as a depth map ({reason}); replace or remove it") from error
    if values.ndim != 2 or not 0 < values.size <= MAX_PIXELS:
        raise ValueError(f"{file}: a depth map must be [H, W]; got {list(values.shape)}")
    return np.ascontiguousarray(values, np.float32)


def _read_png(file: str | os.PathLike[str]) -> np.ndarray:
    with open_regular(file, MOST_BYTES) as opened, Image.open(opened, formats=("PNG",)) as image:
        if image.width * image.height > MAX_PIXELS:
            raise ValueError(f"it has {image.width}x{image.height} pixels")
        if image.mode not in DEEPEST:
            raise ValueError(f"it must be greyscale, of 8 or 16 bits; its mode is {image.mode}")
        values: np.ndarray = np.asarray(image, np.float32) / DEEPEST[image.mode]
        return values


def _told(size: tuple[int, ...]) -> str:
    return "x".join(map(str, size))
