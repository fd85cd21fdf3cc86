"""Depth maps of photographs, as monocular networks or sensors give them: read when a training needs them.

They are in `depths` beside `images`: NAME.npy or NAME.png for the image NAME.jpg. What they hold, inverse depth up to
scale and shift or depth up to scale, is an option of the training (`training.depth_prior`).
"""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from a2tg_jax.data.decoding import MAX_PIXELS, read_grey
from a2tg_jax.data.image_files import on_disk
from a2tg_jax.data.lenses import Lens
from a2tg_jax.host.npz import read_npy
from a2tg_jax.host.remote_files import Unreachable
from a2tg_jax.host.text import shortened

FOLDER = "depths"
"""Folder of depth maps, beside the folder of images."""
SUFFIXES = (".npy", ".png")
LARGEST_ERROR = 0.02
"""Largest relative difference of aspect between a depth map and its photograph, beyond two pixels of rounding."""


@dataclasses.dataclass(frozen=True, eq=False)
class DepthMap:
    """A depth map of a view, left where it is until it is read."""

    shape: tuple[int, int]
    """(H, W)."""
    load: Callable[[], np.ndarray] = dataclasses.field(repr=False)

    @staticmethod
    def of(values: "np.ndarray | DepthMap") -> "DepthMap":
        """Return the map of an array [H, W] of floats, NaN where unknown; a map is returned unchanged.

        Raises:
          ValueError: if it is no such array.
        """
        if isinstance(values, DepthMap):
            return values
        wanted = "a depth map must be an array of floats [H, W]"
        if not hasattr(values, "dtype"):
            raise ValueError(f"{wanted}; got {type(values).__name__}")
        if values.ndim != 2 or not np.issubdtype(values.dtype, np.floating):
            raise ValueError(f"{wanted}; got {values.dtype} {list(values.shape)}")
        height, width = values.shape
        return DepthMap((height, width), lambda: values)

    def __deepcopy__(self, memo: object) -> "DepthMap":
        """Return the map itself, which nothing changes."""
        return self

    def __reduce__(self) -> Any:
        """Pickle the numbers that `read` returns."""
        return DepthMap.of, (self.read(),)

    def read(self) -> np.ndarray:
        """Return [H, W] float32, NaN where unknown, its largest magnitude 1 (scales are unknown anyway)."""
        values = np.array(self.load(), np.float32)
        values[~np.isfinite(values)] = np.nan
        largest = np.nanmax(np.abs(values), initial=0.0)
        return values / largest if largest > 0 else values


def find_depths(images: Path, name: str) -> Path | None:
    """Return the depth map of an image below a folder: NAME.npy, NAME.png, NAME.EXT.npy or NAME.EXT.png in the sibling
    folder `depths`; None without one.
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
            raise ValueError(
                f"{file}: is {width}x{height}, of another aspect than its photograph, {stored[0]}x{stored[1]}"
            )
        return np.asarray(Image.fromarray(lens.view_plane(values)).resize(size, Image.Resampling.BILINEAR))

    return DepthMap((size[1], size[0]), load)


def read_depths(file: str | os.PathLike[str]) -> np.ndarray:
    """Return the numbers [H, W] float32 of a depth map, an .npy or a greyscale PNG, whose largest value is 1."""
    if str(file).endswith(".npy"):
        try:
            values = read_npy(file)
        except Unreachable:
            raise
        except Exception as error:  # what a damaged file raises goes from SyntaxError to struct.error
            reason = shortened(str(error) or type(error).__name__)
            raise ValueError(f"{file}: cannot be read as a depth map ({reason}); replace or remove it") from error
        values = values.reshape([side for side in values.shape if side != 1]) if values.ndim > 2 else values
    else:
        levels, largest = read_grey(file)
        values = levels.astype(np.float32) / largest
    if values.ndim != 2 or not 0 < values.size <= MAX_PIXELS:
        raise ValueError(f"{file}: a depth map must be [H, W]; got {list(values.shape)}")
    return np.ascontiguousarray(values, np.float32)
