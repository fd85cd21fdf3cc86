"""Compositing by XLA in plain array code, which JAX differentiates in any mode and to any order.

The other compositors bring their own gradient, so that JAX can differentiate them once, in reverse mode. This one is
slower and takes more memory: a gradient keeps the state of the pixels of one tile before each block of its splats.

G tiles at a time, P pixels a tile, B splats a block, D channels, as in `xla`.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.appearance import StaticRule, elementwise_rule
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.rasterize import pixel
from a2tg_jax.rasterize.kernels import xla
from a2tg_jax.rasterize.kernels.xla import BLOCK
from a2tg_jax.rasterize.splats import CompositingSettings, Splats, shading_arguments
from a2tg_jax.rasterize.tiles import TileLists


def composite_tiles(
    settings: CompositingSettings, static: StaticRule, splats: Splats, texels: Array, regions: TextureRegion | None,
    lists: TileLists,
) -> tuple[Array, Array]:  # fmt: skip
    """Return channels [groups, G, D, P] and transmittance [groups, G, P]; arguments are those of `xla.forward`."""
    rule = elementwise_rule(static, shading_arguments(texels, regions, splats.numbers, splats.colors))
    ids, dtype = xla.padded_ids(lists), splats.M.dtype
    # No list is longer than this; blocks behind the end of all lists of a group are skipped.
    num_blocks = -(-min(lists.ids.shape[0], splats.M.shape[0]) // BLOCK)

    def group(index: Array) -> tuple[Array, Array]:
        tiles, start = xla.tiles_of_group(settings, lists, index, dtype)
        add_block = xla.over_tiles(functools.partial(_block, settings, rule, texels), settings.tile_batch)

        def add(carry: Any) -> Any:
            at, transmittance, is_live, channels = carry
            rows = xla.gather_rows(splats, regions, xla.block_ids(ids, at))
            added, transmittance, is_live = add_block(rows, at, tiles, transmittance, is_live)
            return at + BLOCK, transmittance, is_live, channels + added

        def step(carry: Any, _: None) -> tuple[Any, None]:
            return jax.lax.cond(xla.is_unfinished(tiles.end, carry), add, lambda carry: carry, carry), None

        shape = settings.tile_batch, settings.num_channels, settings.grid.tile_size**2
        carry = (start, *xla.initial_state(settings, lists, tiles), jnp.zeros(shape, dtype))
        (_, transmittance, _, channels), _ = jax.lax.scan(jax.checkpoint(step), carry, length=num_blocks)
        return channels, transmittance

    tiles: tuple[Array, Array] = jax.lax.map(jax.checkpoint(group), jnp.arange(settings.num_groups, dtype=jnp.int32))
    return tiles


def _block(
    settings: CompositingSettings, rule: Any, texels: Array, rows: Any, at: Array, tile: Any, transmittance: Array,
    is_live: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Composite one block of B splats over one tile; arguments and results are those of `xla._block`."""
    splats, regions = rows
    x, y = xla.pixels_of(tile, settings.grid.tile_size, splats.M.dtype)

    def spread(tree: Any) -> Any:
        return jax.tree.map(lambda entry: jnp.broadcast_to(entry[:, None], (BLOCK, x.shape[1])), tree)

    splat = xla.split(splats, settings.has_geometry)
    planes, splat = spread(pixel.planes_of(splat.M, xla.numbers_of(tile))), spread(splat)
    in_list = (at + jnp.arange(BLOCK, dtype=jnp.int32) < tile.end)[:, None]

    def show(planes: pixel.Planes) -> pixel.Shown:
        hit = pixel.intersect(planes, x, y, settings.near_plane, rule.has_low_pass)
        lookup = xla.look_up(rule, texels, regions, hit)
        return pixel.show(rule, splat, hit, xla.values_of(lookup))

    is_shown = in_list & ~(jax.lax.stop_gradient(show(planes).alpha) == 0)
    # Far away from what is shown, derivatives may overflow. A plane that faces the camera keeps them out of the sums.
    shown = show(jax.tree.map(lambda entry, facing: jnp.where(is_shown, entry, facing), planes, _FACING))
    alphas = jnp.where(is_shown, shown.alpha, 0.0)

    def add_splat(carry: tuple[Array, Array], alpha: Array) -> tuple[tuple[Array, Array], Array]:
        weight, transmittance, is_live = pixel.absorb(alpha, *carry)
        return (transmittance, is_live), weight

    (transmittance, is_live), weights = jax.lax.scan(add_splat, (transmittance, is_live), alphas)
    return jnp.stack([xla.sum_rows(channel * weights) for channel in shown.channels]), transmittance, is_live


_FACING: Any = pixel.Planes((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0, 0.0, 0.0, 1.0)  # type: ignore[arg-type]
"""Planes of a splat at depth 1 that each ray hits at its centre."""
