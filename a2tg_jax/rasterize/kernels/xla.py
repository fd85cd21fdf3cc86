"""Compositing by XLA, on every device: what the kernels beside it do, said with array operations only.

G tiles at a time, P pixels a tile, B splats a block, D channels (colour, then depth and normal where asked for). Tests
compare `native` and `pallas` with it.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import StaticRule, elementwise_rule
from a2tg_jax.core import bilinear
from a2tg_jax.core.bilinear import Lookup, TextureRegion
from a2tg_jax.core.numerics import pixel_sum, spread
from a2tg_jax.rasterize import pixel
from a2tg_jax.rasterize.splats import CompositingSettings, Splats, shading_arguments
from a2tg_jax.rasterize.tiles import TileLists

BLOCK = 8


class Tiles(NamedTuple):
    """One tile, or G of them."""

    x: Array
    """Its centre, in pixels of the image."""
    y: Array
    """Its centre's other coordinate."""
    end: Array
    """Where its list ends."""


def forward(
    settings: CompositingSettings, static: StaticRule, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists,
) -> tuple[Array, Array]:  # fmt: skip
    """Channels [groups, G, D, P] and transmittance [groups, G, P], G tiles a group.

    Args:
      settings: static choices.
      static: the appearance rule, without its arrays.
      splats: N splats.
      texels: [T, C] of the rule.
      regions: [N] each, of the rule; None without textures.
      cutoff: [N] squared distance beyond which each splat need not be looked at; not used here.
      lists: the splats of each tile.
    """
    rule = elementwise_rule(static, shading_arguments(texels, regions, splats.numbers, splats.colors))
    ids, dtype = padded_ids(lists), splats.M.dtype

    def group(index):
        tiles, start = tiles_of_group(settings, lists, index, dtype)
        add_block = over_tiles(functools.partial(_block, settings, rule, texels), settings.tile_batch)

        def step(carry):
            at, transmittance, is_live, channels = carry
            rows = gather_rows(splats, regions, block_ids(ids, at))
            added, transmittance, is_live = add_block(rows, at, tiles, transmittance, is_live)
            return at + BLOCK, transmittance, is_live, channels + added

        shape = settings.tile_batch, settings.num_channels, settings.grid.tile_size**2
        carry = (start, *initial_state(settings, tiles), jnp.zeros(shape, dtype))
        _, transmittance, _, channels = jax.lax.while_loop(functools.partial(is_unfinished, tiles.end), step, carry)
        return channels, transmittance

    return jax.lax.map(group, jnp.arange(settings.num_groups, dtype=jnp.int32))


def backward(
    settings: CompositingSettings, static: StaticRule, splats: Splats, texels: Array, regions: TextureRegion | None,
    cutoff: Array, lists: TileLists, jacobian: Array, probe: Array, g: Array, suffix_sum: Array,
) -> tuple[Splats, Array, Array]:  # fmt: skip
    """The cotangents of splats, texels and probe.

    Args:
      settings, static, splats, texels, regions, cutoff, lists: as for `forward`.
      jacobian, probe: as for `rasterize.compositor.composite`.
      g: [groups, G, D, P] cotangents of the channels.
      suffix_sum: [groups, G, P] what they make of the whole list (`rasterize.pixel.absorb_vjp`).
    """
    widths = [math.prod(leaf.shape[1:]) for leaf in splats]
    packed = jnp.zeros((splats.M.shape[0], sum(widths)), splats.M.dtype)
    totals = packed, jnp.zeros_like(texels), jnp.zeros_like(probe)
    rule = elementwise_rule(static, shading_arguments(texels, regions, splats.numbers, splats.colors))
    ids = padded_ids(lists)

    def group(index, totals):
        tiles, start = tiles_of_group(settings, lists, index, splats.M.dtype)
        pull_back = over_tiles(functools.partial(_block_vjp, settings, rule, texels, jacobian), settings.tile_batch)

        def step(carry):
            at, *state, totals = carry
            in_block = block_ids(ids, at)
            rows = gather_rows(splats, regions, in_block)
            *state, d_rows = pull_back(rows, at, tiles, *state, g[index])
            return (at + BLOCK, *state, _accumulate(totals, in_block, d_rows))

        carry = (start, *initial_state(settings, tiles), suffix_sum[index], totals)
        return jax.lax.while_loop(functools.partial(is_unfinished, tiles.end), step, carry)[-1]

    packed, d_texels, d_probe = jax.lax.fori_loop(jnp.int32(0), jnp.int32(settings.num_groups), group, totals)
    pieces = jnp.split(packed, np.cumsum(widths)[:-1], axis=1)
    d_splats = Splats(*(piece.reshape(leaf.shape) for piece, leaf in zip(pieces, splats, strict=True)))
    return d_splats, d_texels, d_probe


def initial_state(settings: CompositingSettings, tiles: Tiles) -> tuple[Array, Array]:
    """Full transmittance [G, P], and which pixels are live: those of the border tiles outside the image never are."""
    x, y = pixels_of_tile(settings.grid.tile_size, tiles.x.dtype)
    is_inside = (tiles.x[:, None] + x < settings.grid.width) & (tiles.y[:, None] + y < settings.grid.height)
    return jnp.ones_like(is_inside, tiles.x.dtype), is_inside


def is_unfinished(ends: Array, carry) -> Array:
    """Whether some tile of a group has splats left, and pixels that they may reach."""
    at, _, is_live = carry[:3]
    return jnp.any((at < ends) & jnp.any(is_live, axis=1))


def over_tiles(function, num: int):
    """`function` of one tile applied to a leading axis of `num` tiles; a single one needs no vmap."""
    if num > 1:
        return jax.vmap(function)
    take, put = (lambda x: x[0]), (lambda x: x[None])
    return lambda *args: jax.tree.map(put, function(*jax.tree.map(take, args)))


def padded_ids(lists: TileLists) -> Array:
    """The lists' splats, and a block more, so that every block can be read whole."""
    return jnp.concatenate([lists.ids, jnp.zeros(BLOCK, lists.ids.dtype)])


def tiles_of_group(settings: CompositingSettings, lists: TileLists, index: Array, dtype) -> tuple[Tiles, Array]:
    """The tiles of a group, and [G] where their lists begin; tiles past the last one have empty lists."""
    tile = index * settings.tile_batch + jnp.arange(settings.tile_batch, dtype=jnp.int32)
    size = settings.grid.tile_size
    x = (tile % settings.grid.columns).astype(dtype) * size + size / 2
    y = (tile // settings.grid.columns).astype(dtype) * size + size / 2
    is_real = tile < settings.grid.num
    tile = jnp.minimum(tile, settings.grid.num - 1)
    start = lists.starts[tile]
    return Tiles(x, y, jnp.where(is_real, lists.starts[tile + 1], start)), start


def block_ids(ids: Array, at: Array) -> Array:
    """[G, B] splats of the blocks that start at `at` [G]."""
    if at.shape[0] == 1:
        return jax.lax.dynamic_slice(ids, (at[0],), (BLOCK,))[None]
    return ids[jnp.minimum(at[:, None] + jnp.arange(BLOCK, dtype=jnp.int32)[None, :], ids.shape[0] - 1)]


def gather_rows(splats: Splats, regions: TextureRegion | None, ids: Array):
    """The splats [G, B, ...] of some ids [G, B], and their texture regions."""
    flat = ids.reshape(-1)
    rows = jax.tree.map(lambda x: x[flat], (splats, regions))
    return jax.tree.map(lambda x: x.reshape(*ids.shape, *x.shape[1:]), rows)


def _accumulate(totals, ids: Array, d_rows):
    """Adds the cotangents of one block a tile to the totals; those of the splats are packed in one row each."""
    flat = ids.reshape(-1)
    splats, texels, probe = totals
    d_splats, d_probe, d_texels = d_rows
    packed = jnp.concatenate([leaf.reshape(flat.shape[0], -1) for leaf in d_splats], axis=1)
    splats = splats.at[flat].add(packed)
    if d_texels is not None:
        indices, addends = d_texels
        texels = texels.at[indices.reshape(-1)].add(addends.reshape(-1, texels.shape[1]))
    return splats, texels, probe if d_probe is None else probe.at[flat].add(d_probe.reshape(flat.shape[0], -1))


def pixels_of_tile(size: int, dtype) -> tuple[Array, Array]:
    """x and y of a tile's pixel centres from its centre, each [1, P]."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    return jnp.asarray(x.reshape(1, -1), dtype), jnp.asarray(y.reshape(1, -1), dtype)


def split(splats: Splats, has_geometry: bool, num: int | None = None) -> pixel.Splat:
    """Splats [B, ...] as the numbers that `pixel` wants, each [B], or spread over [B, num] pixels."""
    put = (lambda x: x) if num is None else functools.partial(spread, num=num)
    several = lambda x: tuple(put(x[:, k]) for k in range(x.shape[1]))  # noqa: E731
    M = tuple(tuple(splats.M[:, i, k] for k in range(3)) for i in range(3))
    normal = several(splats.normals) if has_geometry else None
    numbers = several(splats.numbers)
    return pixel.Splat(M, put(splats.opacities), several(splats.colors), normal, numbers)  # type: ignore[arg-type]


def _hits(settings: CompositingSettings, rule, splats: Splats, tile: Tiles) -> pixel.Hit:
    """Where the rays of a tile's pixels meet the splats of a block; each [B, P]."""
    x, y = pixels_of_tile(settings.grid.tile_size, splats.M.dtype)
    planes = pixel.planes_of(split(splats, False).M, tile.x, tile.y)
    planes = jax.tree.map(lambda entry: spread(entry, x.shape[1]), planes)
    return pixel.intersect(planes, x, y, settings.near_plane, rule.has_low_pass)


def look_up(rule, texels: Array, regions: TextureRegion | None, hit: pixel.Hit) -> Lookup | None:
    """What is read of the textures of B splats at P pixels, [B, P] each; None where the rule has no textures."""
    if regions is None:
        return None
    region = jax.tree.map(lambda x: x[:, None], regions)
    corners = bilinear.corners_of(region, *rule.texel_position(region, hit.u, hit.v))
    read = texels[jnp.stack([corner.texel for corner in corners])]
    sample = bilinear.interpolate(corners, tuple(tuple(jnp.moveaxis(texel, -1, 0)) for texel in read))
    return Lookup(region, bilinear.or_empty(sample, region, rule.empty), corners)


def _show(settings: CompositingSettings, rule, splats: Splats, hit: pixel.Hit, values, at, tile: Tiles, rho_probe=None):
    """`pixel.Shown` of a block at a tile's pixels, each [B, P]; entries past the end of the list show nothing."""
    shown = pixel.show(rule, split(splats, settings.has_geometry, settings.grid.tile_size**2), hit, values, rho_probe)
    in_list = (at + jnp.arange(BLOCK, dtype=jnp.int32) < tile.end)[:, None]
    return pixel.Shown(jnp.where(in_list, shown.alpha, 0.0), shown.channels)


def _block(settings: CompositingSettings, rule, texels: Array, rows, at, tile: Tiles, transmittance, is_live):
    """Composites one block of B splats over one tile.

    Args:
      rows: the block's splats, and their texture regions.
      at: position of the block in the list; entries past the tile's end are left out.
      transmittance: [P] before the block.
      is_live: [P] pixels that have not stopped.

    Returns:
      Channels added [D, P], and transmittance and live pixels after the block.
    """
    splats, regions = rows
    hit = _hits(settings, rule, splats, tile)
    shown = _show(settings, rule, splats, hit, values_of(look_up(rule, texels, regions, hit)), at, tile)

    def add_splat(carry, alpha):
        weight, transmittance, is_live = pixel.absorb(alpha, *carry)
        return (transmittance, is_live), weight

    (transmittance, is_live), weights = jax.lax.scan(add_splat, (transmittance, is_live), shown.alpha)
    return jnp.stack([sum_rows(channel * weights) for channel in shown.channels]), transmittance, is_live


def sum_rows(x: Array) -> Array:
    """Sum over the first axis, a power of two long, by halves: a reduction would not be vectorised over pixels."""
    while x.shape[0] > 1:
        half = x.shape[0] // 2
        x = x[:half] + x[half:]
    return x[0]


def _block_vjp(
    settings: CompositingSettings, rule, texels: Array, jacobian, rows, at, tile: Tiles, transmittance, is_live,
    suffix_sum, g,
):  # fmt: skip
    """One block of the backward pass over one tile: the state after it, and the cotangents of its rows.

    `suffix_sum` [P] is g·(what this block and all behind it add) + g_T·T_final; g is [D, P].
    """
    splats, regions = rows
    lookup = look_up(rule, texels, regions, _hits(settings, rule, splats, tile))

    def of_floats(splats, values, rho_probe):
        hit = _hits(settings, rule, splats, tile)
        return _show(settings, rule, splats, hit, pixel.values_at(rule, lookup, hit, values), at, tile, rho_probe)

    rho_probe = jnp.zeros((BLOCK, transmittance.shape[0]), transmittance.dtype) if settings.statistic else None
    shown, pull_back = jax.vjp(of_floats, splats, values_of(lookup), rho_probe)
    g = g[:, None]
    seen = sum(channel * g[k] for k, channel in enumerate(shown.channels))

    def add_splat(carry, splat):
        weight, *carry, d_alpha = pixel.absorb_vjp(splat[0], *carry, splat[1])
        return tuple(carry), (weight, d_alpha)

    carry, (weights, d_alpha) = jax.lax.scan(add_splat, (transmittance, is_live, suffix_sum), (shown.alpha, seen))
    d_shown = pixel.Shown(d_alpha, tuple(weights * g[k] for k in range(settings.num_channels)))
    d_splats, d_values, d_rho = pull_back(d_shown)
    d_probe = _statistic(settings, rule, jacobian, splats, tile, d_rho, weights) if settings.statistic else None
    return *carry, (d_splats, d_probe, _texel_cotangents(lookup, d_values))


def values_of(lookup: Lookup | None) -> tuple[Array, ...]:
    return () if lookup is None else lookup.sample.values


def _texel_cotangents(lookup: Lookup | None, d_values: tuple[Array, ...]) -> tuple[Array, Array] | None:
    """Indices of texels [corners, B, P], and what is added to their cotangents [corners, B, P, C]."""
    if lookup is None:
        return None
    per_corner = [jnp.stack([corner.weight * d_value for d_value in d_values], axis=-1) for corner in lookup.corners]
    return jnp.stack([corner.texel for corner in lookup.corners]), jnp.stack(per_corner)


def _statistic(
    settings: CompositingSettings, rule, jacobian, splats: Splats, tile: Tiles, d_rho: Array, weights: Array
) -> Array:
    """[B, 4]: Σ_pixels of the statistic, and the pixels composited."""
    assert settings.statistic is not None
    x, y = pixels_of_tile(settings.grid.tile_size, d_rho.dtype)
    M = jax.tree.map(lambda entry: entry[:, None], split(splats, False).M)
    at_pixel = M, x, y, tile.x, tile.y, d_rho, jacobian
    components = pixel.positional_gradient(settings.statistic, *at_pixel, settings.near_plane, rule.has_low_pass)
    return jnp.stack([*map(pixel_sum, components), pixel_sum((weights > 0).astype(d_rho.dtype))], axis=1)
