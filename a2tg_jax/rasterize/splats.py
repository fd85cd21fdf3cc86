"""Input of the compositors: the splats of a view, projected from Gaussians, and the static settings of a pass.

Kernels take splats and texture regions packed in plain arrays.
"""

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
from a2tg_jax.core.numerics import Integer, factor_to, first_rows
from a2tg_jax.rasterize.pixel import Statistic
from a2tg_jax.rasterize.tiles import TileGrid, TileLists

Compositor = Literal["cuda", "native", "xla", "autodiff"]
"""CUDA kernels (NVIDIA GPUs), native loops (CPUs), XLA (everywhere), or XLA code that JAX differentiates."""
CompositorChoice = Literal["auto", "cuda", "native", "xla", "autodiff"]
"""A compositor, or the first of native loops, CUDA kernels and XLA that runs on the platform that JAX compiles for."""


LARGEST_DEPTH = 1e18
"""Largest depth of a homography; products of larger ones and their gradients would overflow float32."""
LARGEST_AXIS = 1e12
"""Largest entry of its first two columns, for the same reason."""


class Splats(NamedTuple):
    """N splats for the compositor; all fields are differentiable."""

    M: Array  # [N, 3, 3] homographies from (u, v, 1) to pixels
    colors: Array  # [N, D] own colours, or other features
    opacities: Array  # [N] peak opacities
    normals: Array  # [N, 3] normals in the world, facing the camera
    numbers: Array  # [N, K] numbers of the appearance (`Appearance.numbers`)


class PassSettings(NamedTuple):
    """Static settings of a compositing pass; hashable."""

    static: StaticShading  # the appearance without its arrays
    num_own_numbers: int  # K, numbers per splat of the appearance
    num_values: int  # C, numbers per texel; 0 without textures
    num_colors: int  # D, colours of a splat
    dtype: str  # of all computations: "float32" or "float64"
    grid: TileGrid
    near_plane: float  # least depth of visible hits
    has_geometry: bool  # whether depth, squared depth and normals are composited as well
    statistic: Statistic | None = None  # computed by the backward pass for densification
    only_colors: bool = False  # whether the backward pass is for the colours alone; all other gradients are then zero
    has_rays: bool = False  # whether pixels have rays of their own (`tile_pixels`)
    compositor: CompositorChoice = "auto"
    tile_batch: int | None = None
    """Number of tiles that XLA composites at once; 0: all. None: one for the platform, set where that is known."""

    @property
    def kernel_settings(self) -> "PassSettings":
        """The settings that kernels are compiled for: all but the size of the image and what runs them."""
        return self._replace(grid=TileGrid(0, 0, self.grid.tile_size), compositor="auto", tile_batch=None)

    @property
    def arguments(self) -> Arguments:
        """Arguments of the element-wise functions of the appearance."""
        return Arguments(self.num_own_numbers, self.num_values, self.num_colors, self.dtype)

    @property
    def num_pixels(self) -> int:
        """Number P of pixels of a tile."""
        return self.grid.tile_size**2

    @property
    def num_channels(self) -> int:
        """Number of composited channels: colours, and with geometry depth, depth² and normal."""
        return self.num_colors + 5 * self.has_geometry

    @property
    def num_floats(self) -> int:
        """Number S of floats per splat: M, opacity, colours, normal with geometry, own numbers, and the cutoff."""
        return 10 + self.num_colors + 3 * self.has_geometry + self.num_own_numbers + 1

    def gradient_shapes(self, num: int, texels: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
        """Return the shapes of a kernel's gradients of `num` packed splats, of texels of a shape, and of the probe;
        without a statistic [1, 4]."""
        return (num, self.num_floats), texels, (num if self.statistic else 1, 4)


class PassInputs(NamedTuple):
    """Arrays of a compositing pass over N splats."""

    splats: Splats
    texels: Array  # [T, C] texels of the appearance
    regions: TextureRegion | None  # [N] places of the splats' textures among them; None without textures
    cutoff: Array  # [N] squared distance beyond which each splat is invisible; XLA does not use it
    lists: TileLists


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
    `sh_degree`, the highest degree of spherical harmonics used, and `num_live`, the number of rows that exist, may be
    traced.

    Raises:
      ValueError: if the appearance gives opacities, numbers or colours of another shape.
    """
    M, normals = appearance.homographies(gaussians, camera)
    opacities = appearance.peak_opacities(gaussians)
    numbers = numbers_in_view(appearance, gaussians, camera, sh_degree)
    colors = colors_in_view(appearance, gaussians, camera, sh_degree)
    name = type(appearance).__name__
    num = gaussians.num
    num_colors = num_colors_of(appearance)
    if opacities.shape != (num,) or numbers.shape[:-1] != (num,):
        raise ValueError(
            f"an appearance gives opacities [N] and numbers [N, K] of N = {num} gaussians; {name} "
            f"gave {opacities.shape} and {numbers.shape}"
        )
    if colors.shape != (num, num_colors):
        wanted = f"[N, {num_colors}] of N = {num} gaussians, by its num_colors"
        raise ValueError(f"an appearance gives own_colors {wanted}; {name} gave {colors.shape}")
    # Not >=: a NaN depth counts as drawn, so that it is reported.
    is_drawn = ~(M[:, 2, 2] < near_plane)
    if num_live is not None:
        is_drawn &= first_rows(num, num_live)
    # A factor on a whole homography moves a splat nearer and changes nothing else; one on two columns makes it smaller.
    nearer = factor_to(LARGEST_DEPTH, [M[:, 2, 2]])
    smaller = nearer * factor_to(LARGEST_AXIS, [M[:, i, k] for i in range(3) for k in range(2)])
    M = M * jnp.stack([smaller, smaller, nearer], axis=1)[:, None, :]
    # A bound, not part of the image: what lies beyond is invisible anyway.
    cutoff = jnp.where(is_drawn, jax.lax.stop_gradient(cutoff_of(appearance, opacities)), -1.0)
    # Not finite and not invisible: NaN marks it, which `views.render_traced` carries into the image. Column by column,
    # for XLA does not fuse reductions along a short axis.
    columns = [*(M[:, i, k] for i in range(3) for k in range(3)), *colors.T, *numbers.T]
    is_broken = ~(cutoff <= 0) & ~functools.reduce(jnp.logical_and, map(jnp.isfinite, columns))
    cutoff = jnp.where(is_broken, jnp.nan, cutoff)
    is_shown = (cutoff > 0)[:, None]
    # Invisible rows may not be finite; stand-ins keep 0 · inf out of the sums and the gradients.
    M = jnp.where(is_shown[:, None], M, jnp.eye(3, dtype=M.dtype)[None])
    colors, normals, numbers = (jnp.where(is_shown, x, 0.0) for x in (colors, normals, numbers))
    return Splats(M, colors, opacities, normals, numbers), cutoff


def drawn_splats(
    gaussians: Gaussians, camera: Camera, appearance: Appearance, num_live: Integer | None
) -> tuple[Array, Array]:
    """Return homographies [N, 3, 3] and squared distances [N] of visibility, −1 for rows that do not exist."""
    M, _ = appearance.homographies(gaussians, camera)
    cutoff = cutoff_of(appearance, appearance.peak_opacities(gaussians))
    if num_live is not None:
        cutoff = jnp.where(first_rows(gaussians.num, num_live), cutoff, -1.0)
    return M, cutoff


def settings_of_pass(
    appearance: Appearance, splats: Splats, grid: TileGrid, near_plane: float, *, has_geometry: bool, **more: Any
) -> tuple[PassSettings, Array, TextureRegion | None]:
    """Return the settings of a pass, and the texels [T, C] and texture regions [N] of N splats.

    Further arguments are fields of `PassSettings`.

    Raises:
      ValueError: if the appearance gives texture regions of another number of splats or a `max_alpha` outside (0, 1),
        or if its element-wise functions return something else than they must.
    """
    texels, regions = appearance.atlas()
    name = type(appearance).__name__
    num = splats.opacities.shape[0]
    for field, numbers in () if regions is None else regions._asdict().items():
        if numbers.shape != (num,):
            raise ValueError(
                f"an appearance gives regions.{field} [N] of N = {num} gaussians; {name} gave {numbers.shape}"
            )
    if not 0 < appearance.alpha_limit < 1:
        raise ValueError(f"max_alpha of an appearance must be in (0, 1); in {name} it is {appearance.alpha_limit}")
    settings = PassSettings(
        static=StaticShading.of(appearance),
        num_own_numbers=splats.numbers.shape[1],
        num_values=0 if regions is None else texels.shape[1],
        num_colors=splats.colors.shape[1],
        dtype=np.dtype(splats.M.dtype).name,
        grid=grid,
        near_plane=near_plane,
        has_geometry=has_geometry,
        **more,
    )
    check_shading(settings.static, settings.arguments)
    return settings, texels, regions


def pack_inputs(settings: PassSettings, inputs: PassInputs) -> tuple[Array, ...]:
    """Pack what kernels read: ids, starts, splats with the cutoff, regions, texels, and (columns, width, height).

    Kernels follow these indices without checking them. Ids and starts are clamped here, and regions by the compositor
    (`bilinear.within_texels`), so that no list and no region, whatever it holds, makes them read or write elsewhere.
    Rays of pixels are packed by `native.composite`.
    """
    splats, texels, regions, cutoff, lists = inputs
    dtype = splats.M.dtype
    num = splats.M.shape[0]
    capacity = lists.ids.shape[0]
    # One row per splat, in the order of `rasterize.pixel.Splat`.
    columns = [splats.M.reshape(-1, 9), splats.opacities[:, None], splats.colors]
    columns += [splats.normals] if settings.has_geometry else []
    packed = jnp.concatenate([*columns, splats.numbers, cutoff[:, None]], axis=1).astype(dtype)
    size = jnp.asarray([settings.grid.columns, settings.grid.width, settings.grid.height], jnp.int32)
    # Threads divide the tiles by their starts, which must ascend. Without splats no id is valid: all lists are empty.
    starts = jax.lax.cummax(jnp.clip(lists.starts, 0, capacity if num else 0))
    ids = jnp.clip(lists.ids, 0, max(num - 1, 0))
    # int32 [N, 3], or [1, 0] without textures.
    places = jnp.zeros((1, 0), jnp.int32) if regions is None else jnp.stack(regions, axis=1).astype(jnp.int32)
    return ids, starts, packed, places, texels.astype(dtype), size


def unpack_gradients(
    settings: PassSettings, gradients: Sequence[Array], inputs: PassInputs, probe: Array
) -> tuple[Splats, Array, Array]:
    """Unpack a kernel's gradients, of `PassSettings.gradient_shapes`, as gradients of splats, texels and probe."""
    packed, d_texels, d_probe = gradients
    splats = inputs.splats
    normal = 10 + settings.num_colors
    first = normal + 3 * settings.has_geometry
    d_splats = Splats(
        M=packed[:, :9].reshape(-1, 3, 3).astype(splats.M.dtype),
        opacities=packed[:, 9].astype(splats.opacities.dtype),
        colors=packed[:, 10:normal].astype(splats.colors.dtype),
        normals=packed[:, normal:first].astype(splats.normals.dtype)
        if settings.has_geometry
        else jnp.zeros_like(splats.normals),
        numbers=packed[:, first : first + settings.num_own_numbers].astype(splats.numbers.dtype),
    )
    d_probe = d_probe.astype(probe.dtype) if settings.statistic else jnp.zeros_like(probe)
    return d_splats, d_texels.astype(inputs.texels.dtype), d_probe
