"""Input of the compositors: the splats of a view, projected from Gaussians, and the static options of a pass.

`compositor` and all kernels share these two types. Kernels take splats and texture regions packed in plain arrays.
"""

import dataclasses
import functools
from collections.abc import Sequence
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
from a2tg_jax.core.numerics import Integer
from a2tg_jax.rasterize.pixel import Statistic
from a2tg_jax.rasterize.tiles import TileGrid, TileLists

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

    def gradient_shapes(self, inputs: "PassInputs") -> tuple[tuple[int, ...], ...]:
        """Return the shapes of a kernel's gradients of packed splats, texels and probe; without a statistic [1, 4]."""
        num = len(inputs.cutoff)
        return (num, self.num_floats), inputs.texels.shape, (num if self.statistic else 1, 4)


class PassInputs(NamedTuple):
    """Arrays of a compositing pass."""

    splats: Splats
    """N splats."""
    texels: Array
    """[T, C] texels of the appearance."""
    regions: TextureRegion | None
    """[N] places of the splats' textures among them; None without textures."""
    cutoff: Array
    """[N] squared distance beyond which each splat is invisible; XLA has no use for it."""
    lists: TileLists
    """Splats of each tile."""


class CompositingSettings(NamedTuple):
    """Static options of a compositing pass: a kernel, and what may change without compiling another one."""

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
        return -(-self.grid.num // self.tile_batch)


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
    M, normals = appearance.homographies(gaussians, camera)
    opacities, numbers = appearance.peak_opacities(gaussians), numbers_in_view(appearance, gaussians, camera)
    colors = colors_in_view(appearance, gaussians, camera, sh_degree)
    _check_given(appearance, opacities, numbers, colors, gaussians.num)
    # Not >=: a NaN depth counts as drawn, so that it is reported.
    is_drawn = ~(M[:, 2, 2] < near_plane)
    if num_live is not None:
        is_drawn &= jnp.arange(gaussians.num, dtype=jnp.int32) < num_live
    # A bound, not part of the image: what lies beyond is invisible anyway.
    cutoff = jnp.where(is_drawn, jax.lax.stop_gradient(cutoff_of(appearance, opacities)), -1.0)
    # Not finite and not invisible: NaN marks it, which `views.render_traced` carries into the image.
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
    M, _ = appearance.homographies(gaussians, camera)
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


def settings_of_pass(
    appearance: Appearance, splats: Splats, grid: TileGrid, near_plane: float, *, has_geometry: bool,
    statistic: Statistic | None = None, has_rays: bool = False, compositor: Wanted = "auto",
    tile_batch: int | None = None,
) -> tuple[CompositingSettings, Array, TextureRegion | None]:  # fmt: skip
    """Return the static options of a pass, and the texels [T, C] and texture regions [N] of N splats.

    Further arguments are fields of `CompositingSettings` and of `KernelSpec`.

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
        tile_size=grid.tile_size,
        near_plane=near_plane,
        has_geometry=has_geometry,
        statistic=statistic,
        num_colors=splats.colors.shape[1],
        has_rays=has_rays,
    )
    check_shading(kernel.static, kernel.arguments)
    return CompositingSettings(kernel, grid, compositor, tile_batch), texels, regions


def _are_finite(M: Array, colors: Array, numbers: Array) -> Array:
    """Return whether all numbers of each splat are finite [N]."""
    columns = [*(M[:, i, k] for i in range(3) for k in range(3)), *colors.T, *numbers.T]
    return functools.reduce(jnp.logical_and, map(jnp.isfinite, columns))


def pack_inputs(settings: CompositingSettings, inputs: PassInputs) -> tuple[Array, ...]:
    """Pack what kernels read: ids, starts, splats with the cutoff, regions, texels, and (columns, width, height).

    Kernels follow these indices without checking them. Ids and starts are clamped here, and regions by the compositor
    (`bilinear.within_texels`), so that no list and no region, whatever it holds, makes them read or write elsewhere.
    Rays of pixels are packed apart (`native.composite`).
    """
    splats, texels, regions, cutoff, lists = inputs
    num, capacity = splats.M.shape[0], lists.ids.shape[0]
    packed = pack_splats(splats, settings.kernel.has_geometry, cutoff).astype(splats.M.dtype)
    size = jnp.asarray([settings.grid.columns, settings.grid.width, lists.height_in(settings.grid)], jnp.int32)
    # Threads divide the tiles by their starts, which must ascend. Without splats no id is valid: all lists are empty.
    starts = jax.lax.cummax(jnp.clip(lists.starts, 0, capacity if num else 0))
    ids = jnp.clip(lists.ids, 0, max(num - 1, 0))
    return ids, starts, packed, pack_regions(regions), texels.astype(splats.M.dtype), size


def pack_splats(splats: Splats, has_geometry: bool, *more: Array) -> Array:
    """Pack splats as [N, S], one per row in the order of `rasterize.pixel.Splat`, followed by further columns [N]."""
    columns = [splats.M.reshape(-1, 9), splats.opacities[:, None], splats.colors]
    columns += [splats.normals] if has_geometry else []
    return jnp.concatenate([*columns, splats.numbers, *(column[:, None] for column in more)], axis=1)


def unpack_splats(packed: Array, like: Splats, has_geometry: bool) -> Splats:
    """Unpack cotangents [N, S] as those of splats."""
    num_colors = like.colors.shape[1]
    normal, first = 10 + num_colors, num_numbers(has_geometry, num_colors)
    return Splats(
        M=packed[:, :9].reshape(-1, 3, 3).astype(like.M.dtype),
        opacities=packed[:, 9].astype(like.opacities.dtype),
        colors=packed[:, 10:normal].astype(like.colors.dtype),
        normals=packed[:, normal:first].astype(like.normals.dtype) if has_geometry else jnp.zeros_like(like.normals),
        numbers=packed[:, first : first + like.numbers.shape[1]].astype(like.numbers.dtype),
    )


def split_image(image: Array) -> tuple[Array, Array]:
    """Split a kernel's image [tiles, D + 1, P] into channels [tiles, D, P] and transmittance [tiles, P]."""
    return image[:, :-1], image[:, -1]


def unpack_gradients(
    settings: CompositingSettings, found: Sequence[Array], inputs: PassInputs, probe: Array
) -> tuple[Splats, Array, Array]:
    """Unpack a kernel's gradients, of `KernelSpec.gradient_shapes`, as those of splats, texels and probe."""
    packed, d_texels, d_probe = found
    d_splats = unpack_splats(packed, inputs.splats, settings.kernel.has_geometry)
    d_probe = d_probe.astype(probe.dtype) if settings.kernel.statistic else jnp.zeros_like(probe)
    return d_splats, d_texels.astype(inputs.texels.dtype), d_probe


def pack_regions(regions: TextureRegion | None) -> Array:
    """Pack the `TextureRegion` of every splat as int32 [N, 3]; without textures [1, 0]."""
    if regions is None:
        return jnp.zeros((1, 0), jnp.int32)
    return jnp.stack(regions, axis=1).astype(jnp.int32)
