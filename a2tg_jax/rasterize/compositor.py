"""Front-to-back compositing of tiles, given any appearance rule, with an exact gradient in constant memory.

`pixel` defines one pixel. A module of `kernels` computes all: `native` on CPUs, `cuda` on NVIDIA GPUs, or `xla`.
Each has a `forward` and a `backward` with the same arguments and results. `autodiff` has no gradient of its own.

The backward pass walks front to back too (`rasterize.pixel.absorb_vjp`), so that nothing is stored per pixel and splat.
"""

import functools
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.appearance import AppearanceRule, StaticRule
from a2tg_jax.core.bilinear import TextureRegion, within_texels
from a2tg_jax.rasterize.kernels import autodiff
from a2tg_jax.rasterize.kernels.manual_axes import cotangent_of
from a2tg_jax.rasterize.reverse_only import once, reverse_only
from a2tg_jax.rasterize.splats import CompositingSettings, Compositor, Splats
from a2tg_jax.rasterize.tiles import TileGrid, TileLists


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
    settings: CompositingSettings, splats: Splats, rule: AppearanceRule, cutoff: Array, lists: TileLists,
    jacobian: Array, probe: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Return channels [D, H, W] and final transmittance [H, W]; D is red, green, blue(, depth, depth², normal x, y, z).

    Args:
      settings: static options.
      splats: N splats.
      rule: appearance rule. Its texels are differentiated; its other arrays are not read, except the regions.
      cutoff: [N] squared distance beyond which each splat is invisible.
      lists: splats of each tile.
      jacobian: [3, 3] ∂M[:, 2]/∂μ = K·Rc, used only by the statistic.
      probe: [N, 4] zeros. Its gradient is not of the image: columns 0 to 2 are the statistic, Σ_pixels of
        `rasterize.pixel.positional_gradient`, column 3 the number of pixels in which the splat was composited.
    """
    return composite_arrays(settings, rule, splats, rule.texels, rule.regions, cutoff, lists, jacobian, probe)


def composite_arrays(
    settings: CompositingSettings, rule: AppearanceRule, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists, jacobian: Array, probe: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Return what `composite` does, with texels and regions in place of the rule's own."""
    static = StaticRule.of(rule)
    regions = None if regions is None else within_texels(regions, texels.shape[0])
    if settings.compositor == "autodiff":
        if settings.statistic:
            raise ValueError("the statistic of densification needs another compositor than 'autodiff'")
        channels, transmittance = autodiff.composite_tiles(settings, static, splats, texels, regions, lists)
    else:
        splats, texels, probe = reverse_only(settings.compositor, (splats, texels, probe))
        arrays = splats, texels, regions, cutoff, lists, jacobian, probe
        channels, transmittance = _composite_tiles(settings, static, *arrays)
    return _assemble(channels, settings.grid), _assemble(transmittance, settings.grid)


def refusal(settings: CompositingSettings, rule: AppearanceRule, splats: Splats) -> str | None:
    """Return why the compositor of the settings cannot run a rule; None if it can."""
    reason: str | None = _kernels(settings.compositor).refusal(settings, rule, splats)
    return reason


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _composite_tiles(
    settings: CompositingSettings, rule: StaticRule, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists, jacobian: Array, probe: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Return channels [groups, G, D, P] and transmittance [groups, G, P], G tiles a group, P pixels a tile."""
    return _forward(settings, rule, splats, texels, regions, cutoff, lists)


def _forward(settings: CompositingSettings, rule: StaticRule, *arrays: Any) -> tuple[Array, Array]:
    forward = functools.partial(_kernels(settings.compositor).forward, settings, rule)
    shown: tuple[Array, Array] = once(settings.compositor, forward, *arrays)
    return shown


def _composite_tiles_fwd(
    settings: CompositingSettings, rule: StaticRule, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists, jacobian: Array, probe: Array,
) -> tuple[tuple[Array, Array], tuple[Any, ...]]:  # fmt: skip
    shown = _forward(settings, rule, splats, texels, regions, cutoff, lists)
    return shown, (splats, texels, regions, cutoff, lists, jacobian, probe, *shown)


def _composite_tiles_bwd(
    settings: CompositingSettings, rule: StaticRule, residuals: tuple[Any, ...], cotangents: tuple[Array, Array]
) -> tuple[Splats, Array, None, None, None, None, Array]:
    *arrays, channels, transmittance = residuals
    g, g_transmittance = cotangents
    suffix_sum = jnp.sum(g * channels, axis=2) + g_transmittance * transmittance
    backward = functools.partial(_kernels(settings.compositor).backward, settings, rule)
    found = once(settings.compositor, backward, *arrays, g, suffix_sum)
    d_splats, d_texels, d_probe = cotangent_of((arrays[0], arrays[1], arrays[-1]), found)
    return d_splats, d_texels, None, None, None, None, d_probe


_composite_tiles.defvjp(_composite_tiles_fwd, _composite_tiles_bwd)


def _kernels(compositor: Compositor) -> ModuleType:
    """Return the compositing module, imported on first use."""
    if compositor == "native":
        from a2tg_jax.rasterize.kernels.native import composite as native

        return native
    if compositor == "cuda":
        from a2tg_jax.rasterize.kernels.cuda import composite as cuda

        return cuda
    from a2tg_jax.rasterize.kernels import xla

    return xla


def _assemble(tiles: Array, grid: TileGrid) -> Array:
    """Assemble tiles [groups, G, ..., P] into one image [..., H, W]."""
    tiles = tiles.reshape(-1, *tiles.shape[2:])[: grid.num]
    inner = tiles.shape[1:-1]
    blocks = tiles.reshape(grid.rows, grid.columns, *inner, grid.tile_size, grid.tile_size)
    image = jnp.moveaxis(blocks, (0, 1), (-4, -2))
    size = grid.tile_size
    return image.reshape(*inner, grid.rows * size, grid.columns * size)[..., : grid.height, : grid.width]
