"""What compositors are given: the splats of a view, and the static choices of a pass.

It stands below the kernels, so that `compositor` and all of them speak of the same two types.
"""

from typing import Literal, NamedTuple

from jax import Array

from a2tg_jax.pixel import Statistic
from a2tg_jax.tiles import TileGrid

Compositor = Literal["native", "pallas", "xla"]
"""Native loops (CPUs), Pallas kernels (GPUs) or XLA (everywhere)."""


class Splats(NamedTuple):
    """What the compositor needs of N splats; each differentiable."""

    M: Array
    """[N, 3, 3] homographies from (u, v, 1) to pixels."""
    colors: Array
    """[N, 3] of their spherical harmonics."""
    opacities: Array
    """[N] peak opacities."""
    normals: Array
    """[N, 3] in the world, facing the camera."""
    numbers: Array
    """[N, K] what else the appearance rule knows of them."""


class CompositingSettings(NamedTuple):
    """The static choices of a compositing pass."""

    grid: TileGrid
    """The tiles of the image."""
    near_plane: float
    """Hits nearer than this do not show."""
    has_geometry: bool
    """Depth, squared depth and normals are composited beside the colour."""
    statistic: Statistic | None
    """What densification asks of the backward pass, if anything."""
    compositor: Compositor
    """Native loops, Pallas kernels, or XLA."""
    tile_batch: int
    """Tiles composited at once by XLA; 1 with the others."""

    @property
    def num_channels(self) -> int:
        """D: colour, and with geometry depth, depth² and normal."""
        return 8 if self.has_geometry else 3

    @property
    def num_groups(self) -> int:
        """Batches of tiles in the image."""
        return -(-self.grid.num // self.tile_batch)
