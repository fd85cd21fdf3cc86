"""Input of the compositors: the splats of a view, projected from Gaussians, and the static options of a pass.

`compositor` and all kernels share these two types.
"""

import dataclasses
import functools
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import Appearance, Arguments, StaticShading, check_shading
from a2tg_jax.appearance.base import colors_in_view, cutoff_of, num_colors_of, numbers_in_view
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.geometry import homographies
from a2tg_jax.core.numerics import Integer
from a2tg_jax.rasterize.pixel import Statistic
from a2tg_jax.rasterize.tiles import TileGrid

Compositor = Literal["cuda", "native", "xla", "autodiff"]
"""CUDA kernels (NVIDIA GPUs), native loops (CPUs), XLA (everywhere), or XLA without a gradient of its own."""
Wanted = Literal["auto", "cuda", "native", "xla", "autodiff"]
"""A compositor, or the first of native loops, CUDA kernels and XLA that runs on the platform that JAX compiles for."""


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
    """[N, K] numbers of the appearance (`Appearance.numbers`)."""


@dataclasses.dataclass(frozen=True)
class KernelSpec:
    """Specification of the passes over one pixel, for which kernels are compiled; hashable."""

    static: StaticShading
    """Appearance without its arrays."""
    num_own_numbers: int
    """Number K of numbers per splat of the appearance."""
    num_columns: int
    """Number C of numbers per texel; 0 without textures."""
    dtype: str
    """Dtype of all computations: "float32" or "float64"."""
    tile_size: int
    """Side of a tile in pixels."""
    near_plane: float
    """Least depth of visible hits."""
    has_geometry: bool
    """Whether depth, squared depth and normals are composited beside the colour."""
    statistic: Statistic | None
    """Statistic that the backward pass computes for densification, if any."""
    num_colors: int = 3
    """Number D of colours of a splat."""
    has_rays: bool = False
    """Whether pixels have rays of their own (`tile_pixels`)."""

    @property
    def arguments(self) -> Arguments:
        """Arguments of the element-wise functions of the appearance."""
        return Arguments(self.num_own_numbers, self.num_columns, self.num_colors, self.dtype)

    @property
    def num_tile_numbers(self) -> int:
        """Number of `rasterize.pixel.TileNumbers`."""
        return 6 if self.has_rays else 2

    @property
    def num_channels(self) -> int:
        """Number of channels: colours, and with geometry depth, depth² and normal."""
        return num_channels(self.has_geometry, self.num_colors)

    @property
    def num_floats(self) -> int:
        """Number S of floats per splat: its numbers, and the squared distance beyond which it is invisible."""
        return num_numbers(self.has_geometry, self.num_colors) + self.num_own_numbers + 1

    def gradient_shapes(self, splats: Splats, texels: Array, probe: Array) -> tuple[tuple[int, ...], ...]:
        """Return the shapes of a kernel's gradients of packed splats, texels and probe; without a statistic [1, 4]."""
        return (len(splats.M), self.num_floats), texels.shape, probe.shape if self.statistic else (1, 4)


class CompositingSettings(NamedTuple):
    """Static options of a compositing pass."""

    kernel: KernelSpec
    """What is computed at each pixel."""
    grid: TileGrid
    """Tiles of the image."""
    compositor: Wanted
    """Native loops, CUDA kernels, or XLA with or without a gradient of its own; "auto": one for the platform."""
    tile_batch: Any
    """Number of tiles that XLA composites at once; 0: all. None: one for the platform, set where that is known."""

    @property
    def num_groups(self) -> int:
        """Number of batches of tiles in the image."""
        num: int = -(-self.grid.num // self.tile_batch)
        return num


def num_channels(has_geometry: bool, num_colors: int) -> int:
    """Return the number of composited channels: colours, and with geometry depth, depth² and normal."""
    return num_colors + 5 if has_geometry else num_colors


def num_numbers(has_geometry: bool, num_colors: int) -> int:
    """Return the numbers per splat: the 9 entries of M, opacity, colours, and with geometry the normal."""
    return 10 + num_colors + (3 if has_geometry else 0)


def project_gaussians(
    gaussians: Gaussians,
    camera: Camera,
    appearance: Appearance,
    near_plane: float,
    sh_degree: Integer,
    num_live: Integer | None = None,
) -> tuple[Splats, Array]:
    """Return the N splats, and the squared distances [N] within which they are visible.

    The distance is not positive if the splat is invisible, and NaN if a visible splat has a number that is not finite.

    Args:
      gaussians: N Gaussians.
      camera: the view.
      appearance: what they show.
      near_plane: least depth of visible splats.
      sh_degree: highest degree of spherical harmonics used; may be traced.
      num_live: number of rows that exist; may be traced.

    Raises:
      ValueError: if the appearance gives opacities, numbers or colours of another shape.
    """
    M, normals = homographies(gaussians, camera)
    opacities, numbers = appearance.peak_opacities(gaussians), numbers_in_view(appearance, gaussians, camera)
    colors = colors_in_view(appearance, gaussians, camera, sh_degree)
    _check_given(appearance, opacities, numbers, colors, gaussians.num)
    # Not >=: a NaN depth counts as drawn, so that it is reported.
    is_drawn = ~(M[:, 2, 2] < near_plane)
    if num_live is not None:
        is_drawn &= jnp.arange(gaussians.num, dtype=jnp.int32) < num_live
    cutoff = jnp.where(is_drawn, jax.lax.stop_gradient(cutoff_of(appearance, opacities)), -1.0)
    is_broken = ~(cutoff <= 0) & ~_are_finite(M, colors, numbers)
    cutoff = jnp.where(is_broken, jnp.nan, cutoff)
    is_shown = (cutoff > 0)[:, None]
    # Invisible rows may hold anything; finite stand-ins keep 0 · inf out of the sums and the gradients.
    M = jnp.where(is_shown[:, None], M, jnp.eye(3, dtype=M.dtype)[None])
    colors, normals, numbers = (jnp.where(is_shown, x, 0.0) for x in (colors, normals, numbers))
    return Splats(M, colors, opacities, normals, numbers), cutoff


def drawn_splats(
    gaussians: Gaussians, camera: Camera, appearance: Appearance, num_live: Integer | None
) -> tuple[Array, Array]:
    """Return homographies [N, 3, 3] and squared distances [N] of visibility, not positive for rows that do not
    exist."""
    M, _ = homographies(gaussians, camera)
    cutoff = cutoff_of(appearance, appearance.peak_opacities(gaussians))
    if num_live is not None:
        cutoff = jnp.where(jnp.arange(gaussians.num, dtype=jnp.int32) < num_live, cutoff, -1.0)
    return M, cutoff


def _check_given(appearance: Appearance, opacities: Array, numbers: Array, colors: Array, num: int) -> None:
    name, num_colors = type(appearance).__name__, num_colors_of(appearance)
    if opacities.shape != (num,) or numbers.shape[:-1] != (num,):
        raise ValueError(
            f"an appearance gives opacities [N] and numbers [N, K] of N = {num} gaussians; {name} "
            f"gave {opacities.shape} and {numbers.shape}"
        )
    if colors.shape != (num, num_colors):
        wanted = f"[N, {num_colors}] of N = {num} gaussians, by its num_colors"
        raise ValueError(f"an appearance gives own_colors {wanted}; {name} gave {colors.shape}")


def kernel_of(
    appearance: Appearance,
    splats: Splats,
    *,
    tile_size: int,
    near_plane: float,
    has_geometry: bool,
    statistic: Statistic | None = None,
    has_rays: bool = False,
) -> tuple[KernelSpec, Array, TextureRegion | None]:
    """Return what is computed at each pixel, and the texels [T, C] and texture regions [N] of N splats.

    Keyword arguments are fields of `KernelSpec`.

    Raises:
      ValueError: if the appearance gives texture regions of another number of splats or a `max_alpha` outside (0, 1),
        or if its element-wise functions return something else than they must.
    """
    (texels, regions), name, num = appearance.atlas(), type(appearance).__name__, splats.opacities.shape[0]
    for field, given in {} if regions is None else regions._asdict().items():
        if given.shape != (num,):
            raise ValueError(
                f"an appearance gives regions.{field} [N] of N = {num} gaussians; {name} gave {given.shape}"
            )
    if not 0 < appearance.alpha_limit < 1:
        raise ValueError(f"max_alpha of an appearance must be in (0, 1); that of {name} is {appearance.alpha_limit}")
    kernel = KernelSpec(
        static=StaticShading.of(appearance),
        num_own_numbers=splats.numbers.shape[1],
        num_columns=0 if regions is None else texels.shape[1],
        dtype=np.dtype(splats.M.dtype).name,
        tile_size=tile_size,
        near_plane=near_plane,
        has_geometry=has_geometry,
        statistic=statistic,
        num_colors=splats.colors.shape[1],
        has_rays=has_rays,
    )
    check_shading(kernel.static, kernel.arguments)
    return kernel, texels, regions


def _are_finite(M: Array, colors: Array, numbers: Array) -> Array:
    """Return whether all numbers of each splat are finite [N]."""
    columns = [*(M[:, i, k] for i in range(3) for k in range(3)), *colors.T, *numbers.T]
    return functools.reduce(jnp.logical_and, map(jnp.isfinite, columns))
