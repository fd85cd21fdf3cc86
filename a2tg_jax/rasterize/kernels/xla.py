"""Compositing by XLA on every device, with array operations only; tests compare `native` and `cuda` with it.

G tiles at a time, P pixels a tile, B splats a block, D channels (colour, then depth, depth² and normal with geometry).
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from a2tg_jax.appearance import Elementwise, elementwise_functions
from a2tg_jax.core import bilinear
from a2tg_jax.core.bilinear import Lookup, TextureRegion
from a2tg_jax.core.numerics import pixel_sum, spread_to_pixels
from a2tg_jax.rasterize import pixel
from a2tg_jax.rasterize.splats import CompositingSettings, Splats
from a2tg_jax.rasterize.tile_pixels import TilePixels
from a2tg_jax.rasterize.tiles import TileLists

BLOCK = 8
"""Number B of splats that are composited at once."""

Totals = tuple[Array, Array, Array]
"""Cotangents of all splats, packed as [N, S], of the texels [T, C], and of the probe [N, 4]."""


Block = tuple[Splats, TextureRegion | None]
"""Splats of a block [..., B], and their texture regions."""
TexelAddends = tuple[Array, Array]
"""Indices of texels [corners, B, P], and addends to their cotangents [corners, B, P, C]."""
BlockCotangents = tuple[Splats, Array | None, TexelAddends | None]
"""Cotangents of a block's splats, of the probe [B, 4], and of the texels."""


class Tiles(NamedTuple):
    """One tile, or G of them."""

    x: Array
    """Horizontal coordinate of its centre, in pixels of the image."""
    y: Array
    """Vertical coordinate of its centre."""
    end: Array
    """End of its list."""
    pixels: TilePixels | None = None
    """Its pixels, if the camera has a ray for each pixel; the centre is then that of the rays."""


def forward(
    settings: CompositingSettings, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists,
) -> tuple[Array, Array]:  # fmt: skip
    """Return channels [tiles, D, P] and transmittance [tiles, P].

    Args:
      settings: static options, with the number G of tiles of a group.
      splats: N splats.
      texels: [T, C] texels of the appearance.
      regions: [N] texture regions of the appearance; None without textures.
      cutoff: [N] squared distance beyond which each splat is invisible; not used here.
      lists: splats of each tile.
    """
    functions = elementwise_functions(settings.kernel.static, settings.kernel.arguments)
    ids, dtype = padded_ids(lists), splats.M.dtype

    def group(index: Array) -> tuple[Array, Array]:
        tiles, start = tiles_of_group(settings, lists, index, dtype)
        add_block = over_tiles(functools.partial(_block, settings, functions, texels), settings.tile_batch)

        def step(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
            at, transmittance, is_live, channels = carry
            rows = gather_splats(splats, regions, block_ids(ids, at))
            added, transmittance, is_live = add_block(rows, at, tiles, transmittance, is_live)
            return at + BLOCK, transmittance, is_live, channels + added

        shape = settings.tile_batch, settings.kernel.num_channels, settings.grid.tile_size**2
        carry = (start, *initial_pixels(settings, lists, tiles), jnp.zeros(shape, dtype))
        _, transmittance, _, channels = jax.lax.while_loop(functools.partial(has_splats_left, tiles.end), step, carry)
        return channels, transmittance

    groups: tuple[Array, Array] = jax.lax.map(group, jnp.arange(settings.num_groups, dtype=jnp.int32))
    return ungrouped(settings, *groups)


def backward(
    settings: CompositingSettings, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists, jacobian: Array, probe: Array, g: Array, suffix_sum: Array,
) -> tuple[Splats, Array, Array]:  # fmt: skip
    """Return the cotangents of splats, texels and probe.

    Args:
      settings, splats, texels, regions, cutoff, lists: as for `forward`.
      jacobian, probe: as for `rasterize.compositor.composite`.
      g: [tiles, D, P] cotangents of the channels.
      suffix_sum: [tiles, P] B of the whole list (`rasterize.pixel.absorb_vjp`).
    """
    widths = [math.prod(leaf.shape[1:]) for leaf in splats]
    packed = jnp.zeros((splats.M.shape[0], sum(widths)), splats.M.dtype)
    totals = packed, jnp.zeros_like(texels), jnp.zeros_like(probe)
    functions = elementwise_functions(settings.kernel.static, settings.kernel.arguments)
    ids = padded_ids(lists)
    g, suffix_sum = (_grouped(settings, of_tiles) for of_tiles in (g, suffix_sum))

    def group(index: Array, totals: Totals) -> Totals:
        tiles, start = tiles_of_group(settings, lists, index, splats.M.dtype)
        pull_back = over_tiles(
            functools.partial(_block_vjp, settings, functions, texels, jacobian), settings.tile_batch
        )

        def step(carry: tuple[Any, ...]) -> tuple[Any, ...]:
            at, *state, totals = carry
            in_block = block_ids(ids, at)
            rows = gather_splats(splats, regions, in_block)
            *state, d_rows = pull_back(rows, at, tiles, *state, g[index])
            return (at + BLOCK, *state, _accumulate(totals, in_block, d_rows))

        carry = (start, *initial_pixels(settings, lists, tiles), suffix_sum[index], totals)
        totals = jax.lax.while_loop(functools.partial(has_splats_left, tiles.end), step, carry)[-1]
        return totals

    packed, d_texels, d_probe = jax.lax.fori_loop(jnp.int32(0), jnp.int32(settings.num_groups), group, totals)
    pieces = jnp.split(packed, np.cumsum(widths)[:-1], axis=1)
    d_splats = Splats(*(piece.reshape(leaf.shape) for piece, leaf in zip(pieces, splats, strict=True)))
    return d_splats, d_texels, d_probe


def ungrouped(settings: CompositingSettings, channels: Array, transmittance: Array) -> tuple[Array, Array]:
    """Return arrays [groups, G, ...] as [tiles, ...], without the tiles that fill up the last group."""
    images = channels, transmittance
    channels, transmittance = (x.reshape(-1, *x.shape[2:])[: settings.grid.num] for x in images)
    return channels, transmittance


def _grouped(settings: CompositingSettings, x: Array) -> Array:
    """Return an array [tiles, ...] as [groups, G, ...], filled up with zeros."""
    missing = settings.num_groups * settings.tile_batch - x.shape[0]
    x = jnp.pad(x, [(0, missing), *[(0, 0)] * (x.ndim - 1)])
    return x.reshape(settings.num_groups, settings.tile_batch, *x.shape[1:])


def initial_pixels(settings: CompositingSettings, lists: TileLists, tiles: Tiles) -> tuple[Array, Array]:
    """Return transmittance 1 [G, P], and the live pixels [G, P]; those that are not shown never are."""
    if tiles.pixels is not None:
        return jnp.ones_like(tiles.pixels.is_seen, tiles.x.dtype), tiles.pixels.is_seen
    x, y = pixels_of_tile(settings.grid.tile_size, tiles.x.dtype)
    height = lists.height_in(settings.grid)
    is_inside = (tiles.x[:, None] + x < settings.grid.width) & (tiles.y[:, None] + y < height)
    return jnp.ones_like(is_inside, tiles.x.dtype), is_inside


def has_splats_left(ends: Array, carry: tuple[Any, ...]) -> Array:
    """Return whether a tile of a group has splats left, and live pixels."""
    at, _, is_live = carry[:3]
    return jnp.any((at < ends) & jnp.any(is_live, axis=1))


def over_tiles(function: Callable[..., Any], num: int) -> Callable[..., Any]:
    """Map a function of one tile over a leading axis of `num` tiles; a single one needs no vmap."""
    if num > 1:
        return jax.vmap(function)
    take, put = (lambda x: x[0]), (lambda x: x[None])
    return lambda *args: jax.tree.map(put, function(*jax.tree.map(take, args)))


def padded_ids(lists: TileLists) -> Array:
    """Return the lists' splats and one block of padding, so that every block can be read whole."""
    return jnp.concatenate([lists.ids, jnp.zeros(BLOCK, lists.ids.dtype)])


def tiles_of_group(
    settings: CompositingSettings, lists: TileLists, index: Array, dtype: DTypeLike
) -> tuple[Tiles, Array]:
    """Return the tiles of a group, and the starts of their lists [G]; tiles past the last one have empty lists."""
    tile = index * settings.tile_batch + jnp.arange(settings.tile_batch, dtype=jnp.int32)
    size = settings.grid.tile_size
    x = (tile % settings.grid.columns).astype(dtype) * size + size / 2
    y = (tile // settings.grid.columns).astype(dtype) * size + size / 2
    is_real = tile < settings.grid.num
    tile = jnp.minimum(tile, settings.grid.num - 1)
    start = lists.starts[tile]
    end = jnp.where(is_real, lists.starts[tile + 1], start)
    if lists.pixels is None:
        return Tiles(x, y, end), start
    own: TilePixels = jax.tree.map(lambda leaf: leaf[tile], lists.pixels)
    own = own._replace(is_seen=own.is_seen & is_real[:, None])
    return Tiles(own.centers[:, 0], own.centers[:, 1], end, own), start


def block_ids(ids: Array, at: Array) -> Array:
    """Return the splats [G, B] of the blocks that start at `at` [G]."""
    if at.shape[0] == 1:
        return jax.lax.dynamic_slice(ids, (at[0],), (BLOCK,))[None]
    return ids[jnp.minimum(at[:, None] + jnp.arange(BLOCK, dtype=jnp.int32)[None, :], ids.shape[0] - 1)]


def gather_splats(splats: Splats, regions: TextureRegion | None, ids: Array) -> Block:
    """Return the splats [G, B, ...] of some ids [G, B], and their texture regions."""
    flat = ids.reshape(-1)
    rows = jax.tree.map(lambda x: x[flat], (splats, regions))
    block: Block = jax.tree.map(lambda x: x.reshape(*ids.shape, *x.shape[1:]), rows)
    return block


def _accumulate(totals: Totals, ids: Array, d_rows: BlockCotangents) -> Totals:
    """Add the cotangents of one block per tile to the totals; those of the splats are packed in one row each."""
    flat = ids.reshape(-1)
    splats, texels, probe = totals
    d_splats, d_probe, d_texels = d_rows
    packed = jnp.concatenate([leaf.reshape(flat.shape[0], -1) for leaf in d_splats], axis=1)
    splats = splats.at[flat].add(packed)
    if d_texels is not None:
        indices, addends = d_texels
        texels = texels.at[indices.reshape(-1)].add(addends.reshape(-1, texels.shape[1]))
    return splats, texels, probe if d_probe is None else probe.at[flat].add(d_probe.reshape(flat.shape[0], -1))


def pixels_of_tile(size: int, dtype: DTypeLike) -> tuple[Array, Array]:
    """Return x and y of a tile's pixel centres, relative to its centre, each [1, P]."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    return jnp.asarray(x.reshape(1, -1), dtype), jnp.asarray(y.reshape(1, -1), dtype)


def numbers_of(tile: Tiles) -> pixel.TileNumbers:
    """Return the centre of a tile, and its frame if pixels have rays of their own."""
    if tile.pixels is None:
        return tile.x, tile.y
    (xx, xy), (yx, yy) = tile.pixels.frames
    return tile.x, tile.y, xx, xy, yx, yy


def pixel_offsets(tile: Tiles, size: int, dtype: DTypeLike) -> tuple[Array, Array]:
    """Return x and y of a tile's pixels, each [1, P], in its frame."""
    if tile.pixels is None:
        return pixels_of_tile(size, dtype)
    x, y = tile.pixels.offsets
    return x[None], y[None]


def split(splats: Splats, has_geometry: bool, num: int | None = None) -> pixel.Splat:
    """Split splats [B, ...] into numbers for `pixel`, each [B], or spread over [B, num] pixels."""

    def put(x: Array) -> Array:
        return x if num is None else spread_to_pixels(x, num=num)

    def several(x: Array) -> Any:
        return tuple(put(x[:, k]) for k in range(x.shape[1]))

    M: Any = tuple(tuple(splats.M[:, i, k] for k in range(3)) for i in range(3))
    normal = several(splats.normals) if has_geometry else None
    numbers = several(splats.numbers)
    return pixel.Splat(M, put(splats.opacities), several(splats.colors), normal, numbers)


def _hits(settings: CompositingSettings, functions: Elementwise, splats: Splats, tile: Tiles) -> pixel.Hit:
    """Return the hits of a tile's pixels with the splats of a block, [B, P] each."""
    x, y = pixel_offsets(tile, settings.grid.tile_size, splats.M.dtype)
    planes = pixel.planes_of(split(splats, False).M, numbers_of(tile))
    planes = jax.tree.map(lambda entry: spread_to_pixels(entry, x.shape[1]), planes)
    return pixel.intersect(planes, x, y, settings.kernel.near_plane, functions.has_low_pass)


def look_up(functions: Elementwise, texels: Array, regions: TextureRegion | None, hit: pixel.Hit) -> Lookup | None:
    """Look up the textures of B splats at P pixels, [B, P] each; None without textures."""
    if regions is None:
        return None
    region = jax.tree.map(lambda x: x[:, None], regions)
    corners = bilinear.corners_of(region, *functions.texel_position(region, hit.u, hit.v))
    read = texels[jnp.stack([corner.texel for corner in corners])]
    sample = bilinear.interpolate(corners, tuple(tuple(jnp.moveaxis(texel, -1, 0)) for texel in read))
    return Lookup(region, bilinear.or_empty(sample, region, functions.empty), corners)


def _show(
    settings: CompositingSettings, functions: Elementwise, splats: Splats, hit: pixel.Hit, values: tuple[Array, ...],
    at: Array, tile: Tiles, rho_probe: Array | None = None,
) -> pixel.Shown:  # fmt: skip
    """Return what a block shows at a tile's pixels, [B, P] each; entries past the end of the list show nothing."""
    shown = pixel.show(
        functions, split(splats, settings.kernel.has_geometry, settings.grid.tile_size**2), hit, values, rho_probe
    )
    in_list = (at + jnp.arange(BLOCK, dtype=jnp.int32) < tile.end)[:, None]
    return pixel.Shown(jnp.where(in_list, shown.alpha, 0.0), shown.channels)


def _block(
    settings: CompositingSettings, functions: Elementwise, texels: Array, rows: Block, at: Array, tile: Tiles,
    transmittance: Array, is_live: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Composite one block of B splats over one tile.

    Args:
      settings: static options.
      functions: those of the appearance.
      texels: [T, C] texels of the appearance.
      rows: splats of the block, and their texture regions.
      at: position of the block in the list; entries past the tile's end are left out.
      tile: the tile.
      transmittance: [P] before the block.
      is_live: [P] pixels that have not stopped.

    Returns:
      Added channels [D, P], and transmittance and live pixels after the block.
    """
    splats, regions = rows
    hit = _hits(settings, functions, splats, tile)
    shown = _show(settings, functions, splats, hit, values_of(look_up(functions, texels, regions, hit)), at, tile)

    def add_splat(carry: tuple[Array, Array], alpha: Array) -> tuple[tuple[Array, Array], Array]:
        weight, transmittance, is_live = pixel.absorb(alpha, *carry)
        return (transmittance, is_live), weight

    (transmittance, is_live), weights = jax.lax.scan(add_splat, (transmittance, is_live), shown.alpha)
    return jnp.stack([sum_rows(channel * weights) for channel in shown.channels]), transmittance, is_live


def sum_rows(x: Array) -> Array:
    """Sum the first axis, a power of two long, by halves: a reduction would not be vectorised over pixels."""
    while x.shape[0] > 1:
        half = x.shape[0] // 2
        x = x[:half] + x[half:]
    return x[0]


def _block_vjp(
    settings: CompositingSettings, functions: Elementwise, texels: Array, jacobian: Array, rows: Block, at: Array,
    tile: Tiles, transmittance: Array, is_live: Array, suffix_sum: Array, g: Array,
) -> tuple[Array, Array, Array, BlockCotangents]:  # fmt: skip
    """Differentiate `_block`: return the state after the block, and the cotangents of its rows.

    `suffix_sum` [P] is g·(channels added by this block and all behind it) + g_T·T_final; g is [D, P].
    """
    splats, regions = rows
    lookup = look_up(functions, texels, regions, _hits(settings, functions, splats, tile))

    def of_floats(splats: Splats, values: tuple[Array, ...], rho_probe: Array | None) -> pixel.Shown:
        hit = _hits(settings, functions, splats, tile)
        return _show(
            settings, functions, splats, hit, pixel.values_at(functions, lookup, hit, values), at, tile, rho_probe
        )

    rho_probe = jnp.zeros((BLOCK, transmittance.shape[0]), transmittance.dtype) if settings.kernel.statistic else None
    shown, pull_back = jax.vjp(of_floats, splats, values_of(lookup), rho_probe)
    g = g[:, None]
    seen: Any = sum(channel * g[k] for k, channel in enumerate(shown.channels))

    def add_splat(carry: pixel.State, splat: tuple[Array, Array]) -> tuple[pixel.State, tuple[Array, Array]]:
        weight, *after, d_alpha = pixel.absorb_vjp(splat[0], carry[0], carry[1], carry[2], splat[1])
        return (after[0], after[1], after[2]), (weight, d_alpha)

    carry, (weights, d_alpha) = jax.lax.scan(add_splat, (transmittance, is_live, suffix_sum), (shown.alpha, seen))
    d_shown = pixel.Shown(d_alpha, tuple(weights * g[k] for k in range(settings.kernel.num_channels)))
    d_splats, d_values, d_rho = pull_back(d_shown)
    d_probe = (
        _statistic(settings, functions, jacobian, splats, tile, d_rho, weights) if settings.kernel.statistic else None
    )
    return *carry, (d_splats, d_probe, _texel_cotangents(lookup, d_values))


def values_of(lookup: Lookup | None) -> tuple[Array, ...]:
    return () if lookup is None else lookup.sample.values


def _texel_cotangents(lookup: Lookup | None, d_values: tuple[Array, ...]) -> TexelAddends | None:
    """Return the addends to the cotangents of the texels, from the cotangents of the values."""
    if lookup is None:
        return None
    per_corner = [jnp.stack([corner.weight * d_value for d_value in d_values], axis=-1) for corner in lookup.corners]
    return jnp.stack([corner.texel for corner in lookup.corners]), jnp.stack(per_corner)


def _statistic(
    settings: CompositingSettings, functions: Elementwise, jacobian: Array, splats: Splats, tile: Tiles, d_rho: Array,
    weights: Array,
) -> Array:  # fmt: skip
    """Return Σ_pixels of the statistic, and the number of pixels composited, [B, 4]."""
    assert settings.kernel.statistic is not None
    x, y = pixel_offsets(tile, settings.grid.tile_size, d_rho.dtype)
    M = jax.tree.map(lambda entry: entry[:, None], split(splats, False).M)
    near_plane, has_low_pass = settings.kernel.near_plane, functions.has_low_pass
    components = pixel.positional_gradient(
        settings.kernel.statistic, M, x, y, numbers_of(tile), d_rho, jacobian, near_plane, has_low_pass
    )
    return jnp.stack([*map(pixel_sum, components), pixel_sum((weights > 0).astype(d_rho.dtype))], axis=1)
