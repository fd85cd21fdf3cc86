"""Front-to-back compositing of tiles, given any appearance rule, with an exact gradient in constant memory.

G tiles at a time, P pixels a tile, B splats a block, D channels (colour, then depth and normal where asked for).
What happens at one pixel is `pixel`'s; here it is done for all of them, by XLA, by `kernels.native` on CPUs, or by
`kernels.pallas` on GPUs.

The backward pass walks front to back too (`pixel.absorb_vjp`), so that nothing is stored per pixel and splat.
"""

import functools
import math
from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax import bilinear, pixel
from a2tg_jax.appearance import AppearanceRule, StaticRule
from a2tg_jax.bilinear import Image
from a2tg_jax.kernels.choice import Compositor
from a2tg_jax.kernels.manual_axes import cotangent_of
from a2tg_jax.numerics import pixel_sum, spread
from a2tg_jax.tiles import TileGrid, TileLists

BLOCK = 8


class Splats(NamedTuple):
    """What the compositor needs of N splats; each differentiable."""

    M: Array
    """[N, 3, 3] homographies from (u, v, 1) to pixels."""
    colors: Array
    """[N, 3]."""
    opacities: Array
    """[N]."""
    normals: Array
    """[N, 3] in the world, facing the camera."""
    numbers: Array
    """[N, K] what else the appearance rule knows of them."""


class Compositing(NamedTuple):
    """The static choices of a compositing pass."""

    grid: TileGrid
    near_plane: float
    has_geometry: bool
    """Depth, squared depth and normals are composited beside the colour."""
    statistic: pixel.Statistic | None
    """What densification asks of the backward pass, if anything."""
    compositor: Compositor
    """Native loops, Pallas kernels, or XLA."""
    tile_batch: int
    """Tiles composited at once by XLA; 1 with the others."""

    @property
    def num_channels(self) -> int:
        return 8 if self.has_geometry else 3

    @property
    def num_groups(self) -> int:
        return -(-self.grid.num // self.tile_batch)


class _Tile(NamedTuple):
    """One tile: its centre in pixels, and the end of its list."""

    x: Array
    y: Array
    end: Array


def composite(
    how: Compositing, splats: Splats, rule: AppearanceRule, cutoff: Array, lists: TileLists, jacobian: Array, tap: Array
) -> tuple[Array, Array]:
    """Channels [D, H, W] and final transmittance [H, W]; D is red, green, blue(, depth, depth², normal x, y, z).

    Args:
      how: static choices.
      splats: N splats.
      rule: what they show. Its table is differentiated; of its other arrays none is read but the images.
      cutoff: [N] squared distance beyond which each splat need not be looked at.
      lists: the splats of each tile.
      jacobian: [3, 3] ∂M[:, 2]/∂μ = K·Rc, used by the statistic alone.
      tap: [N, 4] zeros. Its gradient is not of the image: columns 0 to 2 are the statistic, Σ_pixels of
        `pixel.positional_gradient`, column 3 the number of pixels in which the splat was composited.
    """
    arrays = splats, rule.table, rule.images, cutoff, lists, jacobian, tap
    channels, transmittance = _composite_tiles(how, StaticRule.of(rule), *arrays)
    return _assemble(channels, how.grid), _assemble(transmittance, how.grid)


def _assemble(tiles: Array, grid: TileGrid) -> Array:
    """[groups, G, ..., P] tiles as one image [..., H, W]."""
    tiles = tiles.reshape(-1, *tiles.shape[2:])[: grid.num]
    inner = tiles.shape[1:-1]
    blocks = tiles.reshape(grid.rows, grid.columns, *inner, grid.tile_size, grid.tile_size)
    image = jnp.moveaxis(blocks, (0, 1), (-4, -2))
    size = grid.tile_size
    return image.reshape(*inner, grid.rows * size, grid.columns * size)[..., : grid.height, : grid.width]


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _composite_tiles(how, rule, splats, table, images, cutoff, lists, jacobian, tap):
    return _forward(how, rule, splats, table, images, cutoff, lists)


def _composite_tiles_fwd(how, rule, splats, table, images, cutoff, lists, jacobian, tap):
    seen = _forward(how, rule, splats, table, images, cutoff, lists)
    return seen, (splats, table, images, cutoff, lists, jacobian, tap, *seen)


def _composite_tiles_bwd(how, rule, residuals, cotangents):
    *arrays, channels, transmittance = residuals
    g, g_transmittance = cotangents
    behind = jnp.sum(g * channels, axis=2) + g_transmittance * transmittance
    backward = _backward if how.compositor == "xla" else _accelerated(how).backward
    cotangents = backward(how, rule, *arrays, g, behind)
    d_splats, d_table, d_tap = cotangent_of((arrays[0], arrays[1], arrays[-1]), cotangents)
    return d_splats, d_table, None, None, None, None, d_tap


_composite_tiles.defvjp(_composite_tiles_fwd, _composite_tiles_bwd)


def _accelerated(how: Compositing) -> ModuleType:
    """The module with the kernels, imported where they are used: Pallas adds to JAX's settings when it is."""
    if how.compositor == "native":
        from a2tg_jax.kernels import native

        return native
    from a2tg_jax.kernels import pallas

    return pallas


def _forward(
    how: Compositing, static: StaticRule, splats: Splats, table: Array, images: Image | None, cutoff, lists: TileLists
) -> tuple[Array, Array]:
    """Channels [groups, G, D, P] and transmittance [groups, G, P]."""
    if how.compositor != "xla":
        return _accelerated(how).forward(how, static, splats, table, images, cutoff, lists)
    rule, ids, dtype = static.rule, _padded_ids(lists), splats.M.dtype

    def group(index):
        tiles, start = _tiles_of_group(how, lists, index, dtype)
        add_block = _over_tiles(functools.partial(_block, how, rule, table), how.tile_batch)

        def step(carry):
            at, light, is_live, channels = carry
            added, light, is_live = add_block(_gather(splats, images, _block_ids(ids, at)), at, tiles, light, is_live)
            return at + BLOCK, light, is_live, channels + added

        pixels = how.grid.tile_size**2
        carry = (start, *_initial_light(how, tiles), jnp.zeros((how.tile_batch, how.num_channels, pixels), dtype))
        _, light, _, channels = jax.lax.while_loop(functools.partial(_is_unfinished, tiles.end), step, carry)
        return channels, light

    return jax.lax.map(group, jnp.arange(how.num_groups, dtype=jnp.int32))


def _backward(
    how: Compositing, static: StaticRule, splats: Splats, table: Array, images: Image | None, cutoff, lists: TileLists,
    jacobian, tap, g, behind,
):  # fmt: skip
    """The cotangents of splats, table and tap, given those of the channels, g [groups, G, D, P], and what they
    make of the whole list, `behind` [groups, G, P]."""
    widths = [math.prod(leaf.shape[1:]) for leaf in splats]
    packed = jnp.zeros((splats.M.shape[0], sum(widths)), splats.M.dtype)
    totals = packed, jnp.zeros_like(table), jnp.zeros_like(tap)
    rule, ids = static.rule, _padded_ids(lists)

    def group(index, totals):
        tiles, start = _tiles_of_group(how, lists, index, splats.M.dtype)
        pull_back = _over_tiles(functools.partial(_block_vjp, how, rule, table, jacobian), how.tile_batch)

        def step(carry):
            at, light, is_live, behind, totals = carry
            block_ids = _block_ids(ids, at)
            rows = _gather(splats, images, block_ids)
            light, is_live, behind, d_rows = pull_back(rows, at, tiles, light, is_live, behind, g[index])
            return at + BLOCK, light, is_live, behind, _accumulate(totals, block_ids, d_rows)

        carry = (start, *_initial_light(how, tiles), behind[index], totals)
        return jax.lax.while_loop(functools.partial(_is_unfinished, tiles.end), step, carry)[-1]

    packed, d_table, d_tap = jax.lax.fori_loop(jnp.int32(0), jnp.int32(how.num_groups), group, totals)
    pieces = jnp.split(packed, np.cumsum(widths)[:-1], axis=1)
    d_splats = Splats(*(piece.reshape(leaf.shape) for piece, leaf in zip(pieces, splats, strict=True)))
    return d_splats, d_table, d_tap


def _initial_light(how: Compositing, tiles: _Tile) -> tuple[Array, Array]:
    """Full transmittance [G, P], and which pixels are live: those of the border tiles outside the image never are."""
    x, y = _pixels_of_tile(how.grid.tile_size, tiles.x.dtype)
    is_inside = (tiles.x[:, None] + x < how.grid.width) & (tiles.y[:, None] + y < how.grid.height)
    return jnp.ones_like(is_inside, tiles.x.dtype), is_inside


def _is_unfinished(ends: Array, carry) -> Array:
    at, _, is_live = carry[:3]
    return jnp.any((at < ends) & jnp.any(is_live, axis=1))


def _over_tiles(function, num: int):
    """`function` of one tile applied to a leading axis of `num` tiles; a single one needs no vmap."""
    if num > 1:
        return jax.vmap(function)
    take, put = (lambda x: x[0]), (lambda x: x[None])
    return lambda *args: jax.tree.map(put, function(*jax.tree.map(take, args)))


def _padded_ids(lists: TileLists) -> Array:
    return jnp.concatenate([lists.ids, jnp.zeros(BLOCK, lists.ids.dtype)])


def _tiles_of_group(how: Compositing, lists: TileLists, index: Array, dtype) -> tuple[_Tile, Array]:
    tile = index * how.tile_batch + jnp.arange(how.tile_batch, dtype=jnp.int32)
    size = how.grid.tile_size
    x = (tile % how.grid.columns).astype(dtype) * size + size / 2
    y = (tile // how.grid.columns).astype(dtype) * size + size / 2
    is_real = tile < how.grid.num
    tile = jnp.minimum(tile, how.grid.num - 1)
    start = lists.starts[tile]
    return _Tile(x, y, jnp.where(is_real, lists.starts[tile + 1], start)), start


def _block_ids(ids: Array, at: Array) -> Array:
    """[G, B] splats of the blocks that start at `at` [G]."""
    if at.shape[0] == 1:
        return jax.lax.dynamic_slice(ids, (at[0],), (BLOCK,))[None]
    return ids[jnp.minimum(at[:, None] + jnp.arange(BLOCK, dtype=jnp.int32)[None, :], ids.shape[0] - 1)]


def _gather(splats: Splats, images: Image | None, ids: Array):
    """The splats [G, B, ...] of some ids [G, B], and their images."""
    flat = ids.reshape(-1)
    rows = jax.tree.map(lambda x: x[flat], (splats, images))
    return jax.tree.map(lambda x: x.reshape(*ids.shape, *x.shape[1:]), rows)


def _accumulate(totals, ids: Array, d_rows):
    """Adds the cotangents of one block a tile to the totals; those of the splats are packed in one row each."""
    flat = ids.reshape(-1)
    splats, table, tap = totals
    d_splats, d_tap, d_texels = d_rows
    packed = jnp.concatenate([leaf.reshape(flat.shape[0], -1) for leaf in d_splats], axis=1)
    splats = splats.at[flat].add(packed)
    if d_texels is not None:
        entries, addends = d_texels
        table = table.at[entries.reshape(-1)].add(addends.reshape(-1, table.shape[1]))
    return splats, table, tap if d_tap is None else tap.at[flat].add(d_tap.reshape(flat.shape[0], -1))


def _pixels_of_tile(size: int, dtype) -> tuple[Array, Array]:
    """x and y of a tile's pixel centres from its centre, each [1, P]."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    return jnp.asarray(x.reshape(1, -1), dtype), jnp.asarray(y.reshape(1, -1), dtype)


def _split(splats: Splats, has_geometry: bool, num: int | None = None) -> pixel.Splat:
    """Splats [B, ...] as the numbers that `pixel` wants, each [B], or spread over [B, num] pixels."""
    put = (lambda x: x) if num is None else functools.partial(spread, num=num)
    several = lambda x: tuple(put(x[:, k]) for k in range(x.shape[1]))  # noqa: E731
    M = tuple(tuple(splats.M[:, i, k] for k in range(3)) for i in range(3))
    normal = several(splats.normals) if has_geometry else None
    numbers = several(splats.numbers)
    return pixel.Splat(M, put(splats.opacities), several(splats.colors), normal, numbers)  # type: ignore[arg-type]


def _hits(how: Compositing, rule, splats: Splats, tile: _Tile) -> pixel.Hit:
    """Where the rays of a tile's pixels meet the splats of a block; each [B, P]."""
    x, y = _pixels_of_tile(how.grid.tile_size, splats.M.dtype)
    planes = pixel.planes_of(_split(splats, False).M, tile.x, tile.y)
    planes = jax.tree.map(lambda entry: spread(entry, x.shape[1]), planes)
    return pixel.intersect(planes, x, y, how.near_plane, rule.has_low_pass)


class _Read(NamedTuple):
    """What is read of the images of B splats at P pixels."""

    image: Image
    """[B, 1] each."""
    taps: tuple[bilinear.Tap, ...]
    """[B, P] each."""
    sample: bilinear.Sample
    """[B, P] each."""


def _read(rule, table: Array, images: Image | None, hit: pixel.Hit) -> _Read | None:
    """None where the rule has no images."""
    if images is None:
        return None
    image = jax.tree.map(lambda x: x[:, None], images)
    taps = bilinear.taps(image, *rule.texel(image, hit.u, hit.v))
    texels = table[jnp.stack([tap.entry for tap in taps])]
    sample = bilinear.interpolate(taps, tuple(tuple(jnp.moveaxis(texel, -1, 0)) for texel in texels))
    return _Read(image, taps, sample)


def _show(how: Compositing, rule, splats: Splats, hit: pixel.Hit, values, at, tile: _Tile, rho_tap=None):
    """`pixel.Shown` of a block at a tile's pixels, each [B, P]; entries past the end of the list show nothing."""
    shown = pixel.show(rule, _split(splats, how.has_geometry, how.grid.tile_size**2), hit, values, rho_tap)
    in_list = (at + jnp.arange(BLOCK, dtype=jnp.int32) < tile.end)[:, None]
    return pixel.Shown(jnp.where(in_list, shown.alpha, 0.0), shown.channels)


def _block(how: Compositing, rule, table: Array, rows, at, tile: _Tile, light, is_live):
    """Composites one block of B splats over one tile.

    Args:
      rows: the block's splats, and their images.
      at: position of the block in the list; entries past the tile's end are left out.
      light: [P] transmittance before the block; is_live: [P] pixels that have not stopped.

    Returns:
      Channels added [D, P], and transmittance and live pixels after the block.
    """
    splats, images = rows
    hit = _hits(how, rule, splats, tile)
    shown = _show(how, rule, splats, hit, _values(_read(rule, table, images, hit)), at, tile)

    def add_splat(carry, alpha):
        weight, light, is_live = pixel.absorb(alpha, *carry)
        return (light, is_live), weight

    (light, is_live), weights = jax.lax.scan(add_splat, (light, is_live), shown.alpha)
    return jnp.stack([_sum_rows(channel * weights) for channel in shown.channels]), light, is_live


def _sum_rows(x: Array) -> Array:
    """Sum over the first axis, a power of two long, by halves: a reduction would not be vectorised over pixels."""
    while x.shape[0] > 1:
        half = x.shape[0] // 2
        x = x[:half] + x[half:]
    return x[0]


def _block_vjp(how: Compositing, rule, table: Array, jacobian, rows, at, tile, light, is_live, behind, g):
    """One block of the backward pass over one tile: the state after it, and the cotangents of its rows.

    `behind` [P] is g·(what this block and all behind it add) + g_T·T_final; g is [D, P].
    """
    splats, images = rows
    read = _read(rule, table, images, _hits(how, rule, splats, tile))
    image, sample = (None, None) if read is None else (read.image, read.sample)

    def of_floats(splats, values, rho_tap):
        hit = _hits(how, rule, splats, tile)
        return _show(how, rule, splats, hit, pixel.values_at(rule, image, sample, hit, values), at, tile, rho_tap)

    rho_tap = jnp.zeros((BLOCK, light.shape[0]), light.dtype) if how.statistic else None
    shown, pull_back = jax.vjp(of_floats, splats, _values(read), rho_tap)
    g = g[:, None]
    seen = sum(channel * g[k] for k, channel in enumerate(shown.channels))

    def add_splat(carry, splat):
        weight, *carry, d_alpha = pixel.absorb_vjp(splat[0], *carry, splat[1])
        return tuple(carry), (weight, d_alpha)

    carry, (weights, d_alpha) = jax.lax.scan(add_splat, (light, is_live, behind), (shown.alpha, seen))
    d_shown = pixel.Shown(d_alpha, tuple(weights * g[k] for k in range(how.num_channels)))
    d_splats, d_values, d_rho = pull_back(d_shown)
    d_tap = _statistic(how, rule, jacobian, splats, tile, d_rho, weights) if how.statistic else None
    return *carry, (d_splats, d_tap, _d_texels(read, d_values))


def _values(read: _Read | None) -> tuple[Array, ...]:
    return () if read is None else read.sample.values


def _d_texels(read: _Read | None, d_values: tuple[Array, ...]) -> tuple[Array, Array] | None:
    """Entries of the table [taps, B, P], and what is added to their cotangents [taps, B, P, C]."""
    if read is None:
        return None
    per_tap = [jnp.stack([tap.weight * d_value for d_value in d_values], axis=-1) for tap in read.taps]
    return jnp.stack([tap.entry for tap in read.taps]), jnp.stack(per_tap)


def _statistic(how: Compositing, rule, jacobian, splats: Splats, tile: _Tile, d_rho: Array, weights: Array) -> Array:
    """[B, 4]: Σ_pixels of the statistic, and the pixels composited."""
    assert how.statistic is not None
    x, y = _pixels_of_tile(how.grid.tile_size, d_rho.dtype)
    M = jax.tree.map(lambda entry: entry[:, None], _split(splats, False).M)
    at_pixel = M, x, y, tile.x, tile.y, d_rho, jacobian
    components = pixel.positional_gradient(how.statistic, *at_pixel, how.near_plane, rule.has_low_pass)
    return jnp.stack([*map(pixel_sum, components), pixel_sum((weights > 0).astype(d_rho.dtype))], axis=1)
