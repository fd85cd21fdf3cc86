"""Textures of mixed resolutions as they are stored and trained: a `core.table.Table` of texels.

`appearance.parts` defines how a texture is shown and where (u, v) is in it; `core.bilinear` interpolates.

N Gaussians; texture i is [Tv, Tu, 4] = signed RGB residual and alpha factor; u indexes columns (Tu), v rows (Tv).
Textures of one resolution share a bucket [capacity, Tv, Tu, 4], whose rows past the used ones are padding.
"""

from collections.abc import Sequence
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike

from a2tg_jax.base.checks import check_floats, check_number, check_unmasked, plain_array
from a2tg_jax.core.pytree import pytree
from a2tg_jax.core.table import Size, Table, check_table

MAX_SIDE = 16
BYTES_PER_TEXEL = 16  # 4 channels of float32
NEUTRAL_TEXEL = (0.0, 0.0, 0.0, 1.0)  # adds no colour, and multiplies alpha by 1


@pytree(repr=False)
class Textures(Table):
    """The textures of all Gaussians, [Tv, Tu, 4] each, bucketed by resolution.

    Examples:
      >>> textures = a2tg.allocate_textures([[1, 1], [4, 2]])  # (Tv, Tu) of two Gaussians
      >>> textures.num_texels, textures.bucket_sizes
      (9, ((1, 1), (4, 2)))
    """

    num_axes: ClassVar[int] = 2
    padding: ClassVar[tuple[float, ...]] = NEUTRAL_TEXEL

    @staticmethod
    def resized(blocks: np.ndarray, size: Size) -> np.ndarray:
        """Return textures [M, Tv, Tu, 4] at another resolution, each texel the nearest old one (host).

        Texel j of a side that grows from T to T' comes from ⌊(j + 1/2)·T/T'⌋, in integers.
        """
        height, width = size
        v = (2 * np.arange(height) + 1) * blocks.shape[1] // (2 * height)
        u = (2 * np.arange(width) + 1) * blocks.shape[2] // (2 * width)
        return blocks[:, v[:, None], u[None, :]]

    @property
    def num_texels(self) -> int:
        """Number of texels in use, without padding (host)."""
        return self.count_elements(self.num)


def check_textures(textures: Textures, num: int | None = None) -> None:
    """Raise ValueError, naming the field, unless a value is `Textures` that fit `num` Gaussians, if given."""
    if not isinstance(textures, Textures):
        raise ValueError(f"textures must be Textures; got {type(textures).__name__}")
    check_table(textures, num)


def checked_sizes(sizes: ArrayLike, name: str = "sizes") -> np.ndarray:
    """Return the sizes of textures as int64 (host). ValueError: they are not integers [N, 2], each side 1 to 16, or
    both 0."""
    if isinstance(sizes, Table):
        raise ValueError(f"{name} must be integers [N, 2]; got {type(sizes).__name__}: pass textures.sizes")
    check_unmasked(name, sizes)
    sizes = np.asarray(sizes)
    if sizes.ndim != 2 or sizes.shape[1] != 2 or not np.issubdtype(sizes.dtype, np.integer):
        raise ValueError(f"{name} must be integers [N, 2] as (Tv, Tu); got {sizes.dtype} {sizes.shape}")
    is_wrong = ((sizes < 1) | (sizes > MAX_SIDE)).any(axis=1) & (sizes != 0).any(axis=1)
    if is_wrong.any():
        wrong = sizes[is_wrong]
        raise ValueError(f"{name}: texture sides must be in 1..{MAX_SIDE}, or both 0; got {wrong.min()}..{wrong.max()}")
    # Unsigned integers would wrap around in differences, and become floats in products with signed ones.
    return sizes.astype(np.int64)


def allocate_textures(sizes: ArrayLike, *, rgb: float = 0.0, dtype: DTypeLike = jnp.float32) -> Textures:
    """Return textures of the given sizes with texels (rgb, rgb, rgb, 1); with rgb = 0 they change nothing.

    Args:
      sizes: [N, 2] integers (Tv, Tu), each side 1 to 16, or both 0 for an empty texture, which takes no bytes.
      rgb: initial RGB residual.
      dtype: dtype of the texels.

    Returns:
      Textures of N Gaussians.

    Raises:
      ValueError: if a size is out of range, or the dtype is not one of floats.

    Examples:
      >>> textures = a2tg.allocate_textures(np.full((gaussians.num, 2), 4))
      >>> a2tg.render_image(gaussians, camera, textures).color.shape
      (36, 48, 3)
    """
    check_number("rgb", rgb)
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"dtype must be a dtype of floats; got {dtype}")
    return Textures.allocate(checked_sizes(sizes), (rgb, rgb, rgb, 1.0), dtype)


def textures_from_arrays(arrays: Sequence[ArrayLike]) -> Textures:
    """Return the textures of N arrays; the inverse of `texture_arrays`.

    Args:
      arrays: N arrays [Tv, Tu, 4] of one float dtype: signed RGB residual and alpha factor in [0, 1].

    Returns:
      Textures of N Gaussians, in the order of the arrays.

    Raises:
      ValueError: if an array is not floats [Tv, Tu, 4] with sides of 1 to 16, naming it.

    Examples:
      >>> arrays = [np.zeros((2, 3, 4), np.float32), np.ones((1, 1, 4), np.float32)]
      >>> textures = a2tg.textures_from_arrays(arrays)
      >>> [array.shape for array in a2tg.texture_arrays(textures)]
      [(2, 3, 4), (1, 1, 4)]
    """
    textures = [np.asarray(plain_array(f"texture {index}", array)) for index, array in enumerate(arrays)]
    for index, array in enumerate(textures):
        check_floats(f"texture {index}", array, ("Tv", "Tu", 4))
    sizes = checked_sizes(np.array([array.shape[:2] for array in textures], int).reshape(-1, 2))
    # Gives the result its dtype and number of channels if there are no textures.
    empty = np.zeros((0, 4), textures[0].dtype if textures else np.float32)
    return Textures.of_flat(sizes, np.concatenate([empty, *(array.reshape(-1, 4) for array in textures)]))


def texture_arrays(textures: Textures) -> list[np.ndarray]:
    """Return the textures as NumPy arrays (host).

    Args:
      textures: textures of N Gaussians.

    Returns:
      N arrays [Tv, Tu, 4], in the order of the Gaussians: RGB residual and alpha factor.

    Raises:
      ValueError: if the argument is of another kind.
    """
    check_textures(textures)
    return textures.blocks()
