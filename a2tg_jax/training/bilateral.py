"""Bilateral grids: an affine map of colours per photograph that varies with position and luminance.

They follow what an affine map cannot: vignettes, local tone mapping, curves of a camera's processing. A grid has an
affine map [3, 4] at each of its nodes; a pixel's map is interpolated trilinearly at its place in the image and the
luminance of the render (Chen et al., 2007; Wang et al., 2024, Bilateral Guided Radiance Field Processing).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.core.checks import check_number
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.training.corrections import FadingCorrection

LUMINANCE = (0.299, 0.587, 0.114)
"""Weights of red, green and blue (BT.601)."""
LARGEST_GRID = 64
"""Largest number of nodes of a grid along each of its axes."""


@pytree
class BilateralGrid(FadingCorrection):
    """An affine map of colours per view, position and luminance, [L, Gy, Gx, 3, 4]; see `sliced`.

    Each node is on average over the views the identity. Cameras look at one subject, so that a change which all views
    share, even one that varies over the picture, would shift the model.
    """

    size: tuple[int, int, int] = static(default=(4, 4, 4))
    """Numbers (Gx, Gy, L) of nodes along x, along y, and of luminances, each up to 64."""
    rate: float = 5e-3
    """Adam's learning rate of the grids."""
    final_factor: float = 0.1
    """Factor of the rate at the end of a stage; a system's later stages keep the rate of the first one's end."""
    smoothness: float = 10.0
    """Weight of the total variation of the grids in the loss."""

    name = "bilateral_grid"
    bytes_per_pixel = 89  # as XLA reports for the gradient of `sliced`

    def check_options(self) -> None:
        super().check_options()
        if not all(1 <= number <= LARGEST_GRID for number in self.size):
            raise ValueError(f"size must be numbers in 1..{LARGEST_GRID}; got {self.size}")
        check_number("smoothness", self.smoothness, least=0)

    @property
    def neutral(self) -> np.ndarray:
        columns, rows, levels = self.size
        return np.tile(np.eye(3, 4), (levels, rows, columns, 1, 1))

    def color(self, row: Array, color: Array) -> Array:
        return sliced(row, color)

    def penalty(self, row: Array) -> Array:
        return self.smoothness * total_variation(row)

    def project(self, rows: Array) -> Array:
        return rows - jnp.mean(rows, axis=0, keepdims=True) + jnp.asarray(self.neutral, rows.dtype)[None]


def sliced(grid: Array, color: Array) -> Array:
    """Return the colours [H, W, 3] after each pixel's own affine map from the grid.

    The first and last nodes lie at the edges of the image, and at the luminances 0 and 1.

    Args:
      grid: [L, Gy, Gx, 3, 4].
      color: [H, W, 3].
    """
    levels, rows, columns = grid.shape[:3]
    height, width = color.shape[:2]
    along_y, along_x = (_hats(num, side, grid.dtype) for num, side in ((rows, height), (columns, width)))
    luminance = jnp.clip(color @ jnp.asarray(LUMINANCE, color.dtype), 0, 1) * (levels - 1)

    @jax.checkpoint
    def add(total: Array, level: tuple[Array, Array]) -> tuple[Array, None]:
        nodes, number = level
        maps = jnp.einsum("hr,wc,rcij->hwij", along_y, along_x, nodes, precision=jax.lax.Precision.HIGHEST)
        mapped = jnp.sum(maps[..., :3] * color[..., None, :], axis=-1) + maps[..., 3]
        weight = jnp.maximum(1 - jnp.abs(luminance - number), 0)
        return total + weight[..., None] * mapped, None

    result: Array = jax.lax.scan(add, jnp.zeros_like(color), (grid, jnp.arange(levels, dtype=color.dtype)))[0]
    return result


def total_variation(grid: Array) -> Array:
    """Return the mean squared difference of neighbouring nodes [L, Gy, Gx, ...], summed over the three axes."""
    steps = [jnp.diff(grid, axis=axis) for axis in range(3) if grid.shape[axis] > 1]
    return sum((jnp.mean(step * step) for step in steps), jnp.zeros((), grid.dtype))


def _hats(num: int, side: int, dtype: jnp.dtype) -> Array:
    """Return the weights [side, num] of nodes for linear interpolation at pixel centres."""
    places = (jnp.arange(side, dtype=dtype) + 0.5) / side * (num - 1)
    return jnp.maximum(1 - jnp.abs(places[:, None] - jnp.arange(num, dtype=dtype)[None]), 0)
