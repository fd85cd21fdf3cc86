"""Front-to-back compositing of tiles, given any appearance, with an exact gradient in constant memory.

`pixel` defines one pixel. A module of `kernels` computes all: `native` on CPUs, `cuda` on NVIDIA GPUs, or `xla`. Each
has a `forward` and a `backward` with the same arguments and results, and JAX chooses among them when it compiles for a
platform (`kernels.by_platform`). `autodiff` has no gradient of its own.

The backward pass walks front to back too (`rasterize.pixel.absorb_vjp`), so that nothing is stored per pixel and splat.
"""

import functools
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.bilinear import TextureRegion, within_texels
from a2tg_jax.parallel.sharded_rows import cotangent_of
from a2tg_jax.rasterize import tiles
from a2tg_jax.rasterize.kernels import autodiff, xla
from a2tg_jax.rasterize.kernels.by_platform import by_platform
from a2tg_jax.rasterize.kernels.choice import choose, instead_of
from a2tg_jax.rasterize.kernels.native import composite as native
from a2tg_jax.rasterize.reverse_only import ADVICE, reverse_only
from a2tg_jax.rasterize.splats import CompositingSettings, Splats, Wanted
from a2tg_jax.rasterize.tile_pixels import TilePixels
from a2tg_jax.rasterize.tiles import TileGrid, TileLists

TILES_ON_ACCELERATORS = 4096
"""Number of tiles that XLA composites at once if the settings do not say it; 1 on CPUs."""


class Composited(NamedTuple):
    """Image of a view without its background."""

    channels: Array
    """[D, H, W]; D is red, green, blue(, depth, depth², normal x, y, z)."""
    transmittance: Array
    """[H, W] of what is behind all splats."""
    num_pairs: Array
    """Number of pairs, the least capacity."""
    overflow: Array
    """Whether the capacity was too small."""


def composite(
    settings: CompositingSettings, splats: Splats, texels: Array, regions: TextureRegion | None, cutoff: Array,
    lists: TileLists, jacobian: Array, probe: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Return channels [D, H, W] and final transmittance [H, W]; D is red, green, blue(, depth, depth², normal x, y, z).

    Args:
      settings: static options.
      splats: N splats.
      texels: [T, C] texels of the appearance, differentiated.
      regions: [N] places of the textures among them; None without textures.
      cutoff: [N] squared distance beyond which each splat is invisible.
      lists: splats of each tile.
      jacobian: [3, 3] ∂M[:, 2]/∂μ = K·Rc, used only by the statistic.
      probe: [N, 4] zeros. Its gradient is not of the image: columns 0 to 2 are the statistic, Σ_pixels of
        `rasterize.pixel.positional_gradient`, column 3 the number of pixels in which the splat was composited.
    """
    regions = None if regions is None else within_texels(regions, texels.shape[0])
    if settings.compositor == "autodiff":
        if settings.kernel.statistic:
            raise ValueError("the statistic of densification needs another compositor than 'autodiff'")
        channels, transmittance = _autodiff(settings, splats, texels, regions, lists)
    else:
        splats, texels, probe = reverse_only(settings.compositor, (splats, texels, probe))
        arrays = splats, texels, regions, cutoff, lists, jacobian, probe
        channels, transmittance = _composite_tiles(settings, *arrays)
    return _assemble(channels, settings.grid), _assemble(transmittance, settings.grid)


def list_tiles(
    settings: CompositingSettings, M: Array, cutoff: Array, capacity: int, pixels: TilePixels | None = None,
    height: Array | None = None,
) -> TileLists:  # fmt: skip
    """List the splats that touch each tile of a pass, as `tiles.tile_lists` does, by native loops where they run.

    If the tiles have pixels with rays, XLA lists the splats, and the height is not used.
    """
    grid, near_plane = settings.grid, settings.kernel.near_plane
    if pixels is not None:
        return tiles.tile_lists(M, cutoff, near_plane, grid, capacity, pixels)
    integers = [jax.ShapeDtypeStruct((num,), jnp.int32) for num in (capacity, grid.num + 1)]
    results = (*integers, jax.ShapeDtypeStruct((), jnp.float32), jax.ShapeDtypeStruct((), jnp.bool_))
    static = settings.compositor, near_plane, grid, capacity
    ids, starts, num_pairs, overflow = by_platform(_lists_on, static, results, M, cutoff, height)
    return TileLists(ids, starts, num_pairs, overflow, height=height)


def _lists_on(platform: str, compositor: Wanted, near_plane: float, grid: TileGrid, capacity: int) -> Any:
    def lists(M: Array, cutoff: Array, height: Array | None) -> tuple[Array, ...]:
        is_native = choose(compositor, platform) == "native"
        tile_lists: Any = native.tile_lists if is_native else tiles.tile_lists
        return tuple(tile_lists(M, cutoff, near_plane, grid, capacity, height=height)[:4])

    return lists


def _autodiff(settings: CompositingSettings, *arrays: Any) -> tuple[Array, Array]:
    def on(platform: str) -> Any:
        return functools.partial(autodiff.composite_tiles, _batched_on(platform, settings))

    # JAX differentiates the code itself, which it must therefore trace for all platforms.
    per_platform = {"cpu": on("cpu")} if settings.tile_batch is None else {}
    shown: tuple[Array, Array] = jax.lax.platform_dependent(*arrays, default=on("other"), **per_platform)
    return shown


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _composite_tiles(
    settings: CompositingSettings, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists, jacobian: Array, probe: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Return channels [tiles, D, P] and transmittance [tiles, P], P pixels a tile."""
    return _forward(settings, splats, texels, regions, cutoff, lists)


def _forward(settings: CompositingSettings, *arrays: Any) -> tuple[Array, Array]:
    splats: Splats = arrays[0]
    tiles, pixels = settings.grid.num, settings.grid.tile_size**2
    shapes = (tiles, settings.kernel.num_channels, pixels), (tiles, pixels)
    results = [jax.ShapeDtypeStruct(shape, splats.M.dtype) for shape in shapes]
    channels, transmittance = _by_platform("forward", settings, results, *arrays)
    return channels, transmittance


def _composite_tiles_fwd(
    settings: CompositingSettings, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists, jacobian: Array, probe: Array,
) -> tuple[tuple[Array, Array], tuple[Any, ...]]:  # fmt: skip
    shown = _forward(settings, splats, texels, regions, cutoff, lists)
    return shown, (splats, texels, regions, cutoff, lists, jacobian, probe, *shown)


def _composite_tiles_bwd(
    settings: CompositingSettings, residuals: tuple[Any, ...], cotangents: tuple[Array, Array]
) -> tuple[Splats, Array, None, None, None, None, Array]:
    *arrays, channels, transmittance = residuals
    g, g_transmittance = cotangents
    suffix_sum = jnp.sum(g * channels, axis=1) + g_transmittance * transmittance
    differentiated = arrays[0], arrays[1], arrays[-1]
    results = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), differentiated)
    found = _by_platform("backward", settings, results, *arrays, g, suffix_sum)
    d_splats, d_texels, d_probe = cotangent_of(differentiated, found)
    return d_splats, d_texels, None, None, None, None, d_probe


_composite_tiles.defvjp(_composite_tiles_fwd, _composite_tiles_bwd)


def _by_platform(
    which: Literal["forward", "backward"],
    settings: CompositingSettings,
    results: Any,
    *arrays: Any,
) -> Any:
    advice = ADVICE.format(compositor=settings.compositor)
    return by_platform(_pass_on, (which, settings), results, *arrays, advice=advice)


def _pass_on(platform: str, which: str, settings: CompositingSettings) -> Any:
    def run(splats: Splats, texels: Array, regions: TextureRegion | None, *arrays: Any) -> Any:
        compositor = choose(settings.compositor, platform)
        kernels: Any = native if compositor == "native" else xla
        if compositor == "cuda":  # Not imported by programs on CPUs.
            from a2tg_jax.rasterize.kernels.cuda import composite as cuda

            kernels = cuda
        spec = settings.kernel
        if kernels is not xla and (reason := kernels.refusal(spec)):
            instead_of(settings.compositor, type(spec.static.appearance), reason)
            kernels = xla
        return getattr(kernels, which)(_batched_on(platform, settings), splats, texels, regions, *arrays)

    return run


def _batched_on(platform: str, settings: CompositingSettings) -> CompositingSettings:
    """Return the settings with the number of tiles that XLA composites at once on a platform."""
    num = settings.tile_batch
    if num is None:
        num = 1 if platform == "cpu" else TILES_ON_ACCELERATORS
    return settings._replace(tile_batch=min(num or settings.grid.num, settings.grid.num))


def _assemble(tiles: Array, grid: TileGrid) -> Array:
    """Assemble tiles [tiles, ..., P] into one image [..., H, W]."""
    inner = tiles.shape[1:-1]
    blocks = tiles.reshape(grid.rows, grid.columns, *inner, grid.tile_size, grid.tile_size)
    image = jnp.moveaxis(blocks, (0, 1), (-4, -2))
    size = grid.tile_size
    return image.reshape(*inner, grid.rows * size, grid.columns * size)[..., : grid.height, : grid.width]
