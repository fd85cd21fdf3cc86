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

from a2tg_jax.appearance import elementwise_functions
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.rasterize import pixel
from a2tg_jax.rasterize.kernels import xla
from a2tg_jax.rasterize.kernels.xla import BLOCK
from a2tg_jax.rasterize.splats import CompositingSettings, Splats
from a2tg_jax.rasterize.tiles import TileLists


def composite_tiles(
    settings: CompositingSettings, splats: Splats, texels: Array, regions: TextureRegion | None,
    lists: TileLists,
) -> tuple[Array, Array]:  # fmt: skip
    """Return channels [tiles, D, P] and transmittance [tiles, P], given the same arguments as `xla.forward`."""
    functions = elementwise_functions(settings.kernel.static, settings.kernel.arguments)
    ids, dtype = xla.padded_ids(lists), splats.M.dtype
    # No list is longer than this; blocks behind the end of all lists of a group are skipped.
    num_blocks = -(-min(lists.ids.shape[0], splats.M.shape[0]) // BLOCK)

    def group(index: Array) -> tuple[Array, Array]:
        tiles, start = xla.tiles_of_group(settings, lists, index, dtype)
        add_block = xla.over_tiles(functools.partial(_block, settings, functions, texels), settings.tile_batch)

        def add(carry: Any) -> Any:
            at, transmittance, is_live, channels = carry
            rows = xla.gather_splats(splats, regions, xla.block_ids(ids, at))
            added, transmittance, is_live = add_block(rows, at, tiles, transmittance, is_live)
            return at + BLOCK, transmittance, is_live, channels + added

        def step(carry: Any, _: None) -> tuple[Any, None]:
            return jax.lax.cond(xla.has_splats_left(tiles.end, carry), add, lambda carry: carry, carry), None

        shape = settings.tile_batch, settings.kernel.num_channels, settings.grid.tile_size**2
        carry = (start, *xla.initial_pixels(settings, lists, tiles), jnp.zeros(shape, dtype))
        (_, transmittance, _, channels), _ = jax.lax.scan(jax.checkpoint(step), carry, length=num_blocks)
        return channels, transmittance

    groups: tuple[Array, Array] = jax.lax.map(jax.checkpoint(group), jnp.arange(settings.num_groups, dtype=jnp.int32))
    return xla.ungrouped(settings, *groups)


def _block(
    settings: CompositingSettings, functions: Any, texels: Array, rows: Any, at: Array, tile: Any, transmittance: Array,
    is_live: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Composite one block of B splats over one tile; arguments and results are those of `xla._block`."""
    splats, regions = rows
    x, y = xla.pixel_offsets(tile, settings.grid.tile_size, splats.M.dtype)

    def spread(tree: Any) -> Any:
        return jax.tree.map(lambda entry: jnp.broadcast_to(entry[:, None], (BLOCK, x.shape[1])), tree)

    splat = xla.split(splats, settings.kernel.has_geometry)
    planes, splat = spread(pixel.planes_of(splat.M, xla.numbers_of(tile))), spread(splat)
    in_list = (at + jnp.arange(BLOCK, dtype=jnp.int32) < tile.end)[:, None]

    def show(planes: pixel.Planes) -> pixel.Shown:
        hit = pixel.intersect(planes, x, y, settings.kernel.near_plane, functions.has_low_pass)
        lookup = xla.look_up(functions, texels, regions, hit)
        return pixel.show(functions, splat, hit, xla.values_of(lookup))

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
