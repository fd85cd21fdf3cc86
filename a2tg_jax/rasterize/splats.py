"""Input of the compositors: the splats of a view, projected from Gaussians, and the static options of a pass.

`compositor` and all kernels share these two types.
"""

import functools
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import AppearanceRule, Arguments, StaticRule, check_shading
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.geometry import homographies
from a2tg_jax.rasterize.pixel import Statistic
from a2tg_jax.rasterize.tiles import TileGrid

Compositor = Literal["cuda", "native", "xla", "autodiff"]
"""CUDA kernels (NVIDIA GPUs), native loops (CPUs), XLA (everywhere), or XLA without a gradient of its own."""
Wanted = Literal["auto", "cuda", "native", "xla", "autodiff"]
"""A compositor, or the first of native loops, CUDA kernels and XLA that runs here."""


class Splats(NamedTuple):
    """N splats for the compositor; all fields are differentiable."""

    M: Array
    """[N, 3, 3] homographies from (u, v, 1) to pixels."""
    colors: Array
    """[N, D] own colours, or other features."""
    opacities: Array
    """[N] peak opacities."""
    normals: Array
    """[N, 3] normals in the world, facing the camera."""
    numbers: Array
    """[N, K] numbers of the appearance rule (`AppearanceRule.numbers`)."""


class CompositingSettings(NamedTuple):
    """Static options of a compositing pass."""

    grid: TileGrid
    """Tiles of the image."""
    near_plane: float
    """Least depth of visible hits."""
    has_geometry: bool
    """Whether depth, squared depth and normals are composited beside the colour."""
    statistic: Statistic | None
    """Statistic that densification reads from the backward pass, if any."""
    compositor: Compositor
    """Native loops, CUDA kernels, or XLA with or without a gradient of its own."""
    tile_batch: int
    """Number of tiles that XLA composites at once; 1 with native loops and CUDA kernels."""

    num_colors: int = 3
    """Number D of colours of a splat."""
    has_rays: bool = False
    """Whether pixels have rays of their own (`tile_pixels`)."""

    @property
    def num_channels(self) -> int:
        """Number of channels: colours, and with geometry depth, depth² and normal."""
        return num_channels(self.has_geometry, self.num_colors)

    @property
    def num_groups(self) -> int:
        """Number of batches of tiles in the image."""
        return -(-self.grid.num // self.tile_batch)


def num_channels(has_geometry: bool, num_colors: int) -> int:
    """Return the number of composited channels: colours, and with geometry depth, depth² and normal."""
    return num_colors + 5 if has_geometry else num_colors


def project_gaussians(
    gaussians: Gaussians, camera: Camera, rule: AppearanceRule, near_plane: float, sh_degree: Any, num_live: Any = None
) -> tuple[Splats, Array]:
    """Return the N splats, and the squared distances [N] within which they are visible.

    The distance is not positive if the splat is invisible, and NaN if a visible splat has a number that is not finite.

    Args:
      gaussians: N Gaussians.
      camera: the view.
      rule: appearance rule.
      near_plane: least depth of visible splats.
      sh_degree: highest degree of spherical harmonics used; may be traced.
      num_live: number of rows that exist; may be traced.

    Raises:
      ValueError: if the rule gives opacities, numbers or colours of another shape, or a `max_alpha` outside (0, 1),
        or if its element-wise functions return something else than they must.
    """
    M, normals = homographies(gaussians, camera)
    opacities, numbers = rule.opacities(gaussians), rule.numbers(gaussians, camera)
    colors = rule.own_colors(gaussians, camera, sh_degree)
    _check_rule(rule, opacities, numbers, colors, gaussians.num)
    # Not >=: a NaN depth counts as drawn, so that it is reported.
    is_drawn = ~(M[:, 2, 2] < near_plane)
    if num_live is not None:
        is_drawn &= jnp.arange(gaussians.num, dtype=jnp.int32) < num_live
    cutoff = jnp.where(is_drawn, jax.lax.stop_gradient(rule.cutoff(opacities)), -1.0)
    is_broken = ~(cutoff <= 0) & ~_are_finite(M, colors, numbers)
    cutoff = jnp.where(is_broken, jnp.nan, cutoff)
    is_shown = (cutoff > 0)[:, None]
    # Invisible rows may hold anything; finite stand-ins keep 0 · inf out of the sums and the gradients.
    M = jnp.where(is_shown[:, None], M, jnp.eye(3, dtype=M.dtype)[None])
    colors, normals, numbers = (jnp.where(is_shown, x, 0.0) for x in (colors, normals, numbers))
    return Splats(M, colors, opacities, normals, numbers), cutoff


def _check_rule(rule: AppearanceRule, opacities: Array, numbers: Array, colors: Array, num: int) -> None:
    name = type(rule).__name__
    if opacities.shape != (num,) or numbers.shape[:-1] != (num,):
        raise ValueError(
            f"a rule gives opacities [N] and numbers [N, K] of N = {num} gaussians; {name} "
            f"gave {opacities.shape} and {numbers.shape}"
        )
    if colors.shape != (num, rule.num_colors):
        wanted = f"[N, {rule.num_colors}] of N = {num} gaussians, by its num_colors"
        raise ValueError(f"a rule gives own_colors {wanted}; {name} gave {colors.shape}")
    places = {} if rule.regions is None else rule.regions._asdict()
    for field, numbers_of_textures in places.items():
        if numbers_of_textures.shape != (num,):
            given = numbers_of_textures.shape
            raise ValueError(f"a rule gives regions.{field} [N] of N = {num} gaussians; {name} gave {given}")
    if not 0 < rule.max_alpha < 1:
        raise ValueError(f"max_alpha of a rule must lie in (0, 1); that of {name} is {rule.max_alpha}")
    check_shading(StaticRule.of(rule), shading_arguments(rule.texels, rule.regions, numbers, colors))


def shading_arguments(texels: Array, regions: TextureRegion | None, numbers: Array, colors: Array) -> Arguments:
    """Return what the element-wise functions of a rule are called with, from the arrays of its splats."""
    num_values = 0 if regions is None else texels.shape[1]
    return Arguments(numbers.shape[1], num_values, colors.shape[1], np.dtype(colors.dtype).name)


def _are_finite(M: Array, colors: Array, numbers: Array) -> Array:
    """Return whether all numbers of each splat are finite [N]."""
    columns = [*(M[:, i, k] for i in range(3) for k in range(3)), *colors.T, *numbers.T]
    return functools.reduce(jnp.logical_and, map(jnp.isfinite, columns))
