"""Front-to-back compositing of tiles, given any appearance rule, with an exact gradient in constant memory.

G tiles at a time, P pixels a tile, B splats a block, D channels (colour, then depth and normal where asked for).

The backward pass walks front to back too. With T the transmittance before a block, dC what the block adds to the
channels and g the cotangent, everything behind it is linear in the transmittance T' it leaves, so

    ∂L/∂T' = (g·C_final + g_T·T_final − g·C_so_far) / T'

is "the light behind" and the block's own vjp, with cotangents g for dC and ∂L/∂T' for T', is exact. Nothing is stored
per pixel and splat, and T' never falls below the transmittance at which compositing stops.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import AppearanceRule, add_at
from a2tg_jax.numerics import pixel_sum, spread
from a2tg_jax.tiles import TileGrid, TileLists

BLOCK = 8
MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4


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


class Compositing(NamedTuple):
    """The static choices of a compositing pass."""

    grid: TileGrid
    near_plane: float
    has_geometry: bool
    """Depth, squared depth and normals are composited beside the colour."""
    has_statistic: bool
    """The backward pass also yields the absolute positional gradient."""
    tile_batch: int
    """Tiles composited at once: 1 is a sequential loop (CPU), more are vectorised (GPU)."""

    @property
    def num_channels(self) -> int:
        return 8 if self.has_geometry else 3

    @property
    def num_groups(self) -> int:
        return -(-self.grid.num // self.tile_batch)


class _Tile(NamedTuple):
    """One tile: its centre in pixels, and the span of its list."""

    x: Array
    y: Array
    end: Array


def composite(how: Compositing, splats: Splats, rule: AppearanceRule, lists: TileLists, jacobian: Array, tap: Array):
    """Channels [D, H, W] and final transmittance [H, W]; D is red, green, blue(, depth, depth², normal x, y, z).

    Args:
      how: static choices.
      splats: N splats.
      rule: what they show.
      lists: the splats of each tile.
      jacobian: [3, 3] ∂M[:, 2]/∂μ = K·Rc, used by the statistic alone.
      tap: [N, 4] zeros. Its gradient is not of the image: columns 0 to 2 are Σ_pixels |∂L/∂μ| per component, through
        the Gaussian factor only, column 3 the number of pixels in which the splat was composited.
    """
    channels, transmittance = _composite_tiles(how, splats, rule.params, rule, lists, jacobian, tap)
    return _assemble(channels, how.grid), _assemble(transmittance, how.grid)


def _assemble(tiles: Array, grid: TileGrid) -> Array:
    """[groups, G, ..., P] tiles as one image [..., H, W]."""
    tiles = tiles.reshape(-1, *tiles.shape[2:])[: grid.num]
    inner = tiles.shape[1:-1]
    blocks = tiles.reshape(grid.rows, grid.columns, *inner, grid.tile_size, grid.tile_size)
    image = jnp.moveaxis(blocks, (0, 1), (-4, -2))
    size = grid.tile_size
    return image.reshape(*inner, grid.rows * size, grid.columns * size)[..., : grid.height, : grid.width]


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _composite_tiles(how, splats, params, rule, lists, jacobian, tap):
    return _forward(how, splats, params, rule, lists)


def _composite_tiles_fwd(how, splats, params, rule, lists, jacobian, tap):
    channels, transmittance = _forward(how, splats, params, rule, lists)
    return (channels, transmittance), (splats, params, rule, lists, jacobian, tap, channels, transmittance)


def _composite_tiles_bwd(how, residuals, cotangents):
    splats, params, rule, lists, jacobian, tap, channels, transmittance = residuals
    g_channels, g_transmittance = cotangents
    behind = jnp.sum(g_channels * channels, axis=2) + g_transmittance * transmittance
    widths = [leaf.size // leaf.shape[0] for leaf in splats]
    packed = jnp.zeros((splats.M.shape[0], sum(widths)), splats.M.dtype)
    totals = packed, *jax.tree.map(jnp.zeros_like, (params, tap))
    ids = _padded_ids(lists)

    def group(index, totals):
        tiles, start = _tiles_of_group(how, lists, index, splats.M.dtype)
        g = g_channels[index]
        pull_back = _over_tiles(functools.partial(_block_vjp, how, rule, jacobian), how.tile_batch)

        def step(carry):
            at, light, is_live, behind, totals = carry
            block_ids = _block_ids(ids, at)
            rows = _gather(splats, params, rule, block_ids)
            light, is_live, behind, d_rows = pull_back(rows, at, tiles, light, is_live, behind, g)
            return at + BLOCK, light, is_live, behind, _accumulate(rule, totals, block_ids, d_rows)

        carry = (start, *_initial_light(how, tiles), behind[index], totals)
        return jax.lax.while_loop(functools.partial(_is_unfinished, tiles.end), step, carry)[-1]

    packed, d_params, d_tap = jax.lax.fori_loop(jnp.int32(0), jnp.int32(how.num_groups), group, totals)
    pieces = jnp.split(packed, np.cumsum(widths)[:-1], axis=1)
    d_splats = Splats(*(piece.reshape(leaf.shape) for piece, leaf in zip(pieces, splats, strict=True)))
    return d_splats, d_params, None, None, None, d_tap


_composite_tiles.defvjp(_composite_tiles_fwd, _composite_tiles_bwd)


def _forward(how: Compositing, splats: Splats, params, rule, lists: TileLists) -> tuple[Array, Array]:
    """Channels [groups, G, D, P] and transmittance [groups, G, P]."""
    ids = _padded_ids(lists)
    dtype = splats.M.dtype

    def group(index):
        tiles, start = _tiles_of_group(how, lists, index, dtype)
        add_block = _over_tiles(functools.partial(_block, how, rule), how.tile_batch)

        def step(carry):
            at, light, is_live, channels = carry
            rows = _gather(splats, params, rule, _block_ids(ids, at))
            added, light, is_live, _ = add_block(rows, at, tiles, light, is_live)
            return at + BLOCK, light, is_live, channels + added

        pixels = how.grid.tile_size**2
        carry = (start, *_initial_light(how, tiles), jnp.zeros((how.tile_batch, how.num_channels, pixels), dtype))
        _, light, _, channels = jax.lax.while_loop(functools.partial(_is_unfinished, tiles.end), step, carry)
        return channels, light

    return jax.lax.map(group, jnp.arange(how.num_groups, dtype=jnp.int32))


def _initial_light(how: Compositing, tiles: _Tile) -> tuple[Array, Array]:
    """Full transmittance [G, P], and which pixels are live: those of the border tiles outside the image never are."""
    x, y = _pixels_of_tile(how.grid.tile_size, tiles.x.dtype)
    is_inside = (tiles.x[:, None] + x < how.grid.width) & (tiles.y[:, None] + y < how.grid.height)
    return jnp.ones_like(is_inside, tiles.x.dtype), is_inside


def _is_unfinished(ends: Array, carry) -> Array:
    at, _, is_live = carry[:3]
    return jnp.any((at < ends) & jnp.any(is_live, axis=1))


def _over_tiles(function, num: int):
    """`function` of one tile applied to a leading axis of `num` tiles; a single one without vmap, which would turn
    the rule's branches into selections."""
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


def _gather(splats: Splats, params, rule, ids: Array):
    flat = ids.reshape(-1)
    rows = jax.tree.map(lambda x: x[flat], splats), rule.rows(params, flat)
    return jax.tree.map(lambda x: x.reshape(*ids.shape, *x.shape[1:]), rows)


def _accumulate(rule, totals, ids: Array, d_rows):
    """Adds the cotangents of one block a tile to the totals; those of the splats are packed in one row each."""
    flat = ids.reshape(-1)
    d_splats, d_appearance, d_tap = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), d_rows)
    splats, params, tap = totals
    packed = jnp.concatenate([leaf.reshape(leaf.shape[0], -1) for leaf in d_splats], axis=1)
    splats = add_at(splats, flat, packed)
    return splats, rule.add_rows(params, flat, d_appearance), tap if d_tap is None else add_at(tap, flat, d_tap)


class _Hit(NamedTuple):
    """Where the rays of a tile's pixels meet the splats of a block; each [B, P]."""

    u: Array
    v: Array
    rho: Array
    depth: Array


def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _intersect(axes, mean, pixels, near_plane: float) -> _Hit:
    """The hit of each pixel's ray, or the low-pass filter where that is nearer (2DGS, equations 10 and 11).

    With rows M₀, M₁, M₂ the point is (p₀, p₁)/p₂, p = [M₁×M₂ | M₂×M₀ | M₀×M₁]·(x, y, 1), and its depth det(M)/p₂.

    Args:
      axes: three pairs, the first two columns of M's rows, each [B], relative to the tile's centre.
      mean: M's last column, three arrays [B]; or [B, P], as if each pixel had a splat of its own.
      pixels: (x, y), each [1, P], relative to the tile's centre.
      near_plane: smaller depths are no hit.
    """
    x, y = pixels
    per_pixel = functools.partial(_per_pixel, num=x.shape[1])
    if mean[0].ndim == 2:
        axes = tuple((row[0][:, None], row[1][:, None]) for row in axes)
    rows = [(*axes[i], mean[i]) for i in range(3)]
    planes = _cross(rows[1], rows[2]), _cross(rows[2], rows[0]), _cross(rows[0], rows[1])
    p0, p1, p2 = (per_pixel(planes[0][i]) * x + per_pixel(planes[1][i]) * y + per_pixel(planes[2][i]) for i in range(3))
    determinant = per_pixel(rows[2][0] * planes[2][0] + rows[2][1] * planes[2][1] + rows[2][2] * planes[2][2])

    # Far out on a nearly parallel plane u² would overflow, and 1/p₂² for the tiniest splats: there the divisor is
    # held, with a finite gradient.
    far, tiny = float(np.cbrt(np.finfo(p2.dtype).max)), float(np.sqrt(np.finfo(p2.dtype).tiny))
    least = jnp.maximum(jnp.maximum(jnp.abs(p0), jnp.abs(p1)), jnp.abs(determinant)) / far
    least = jnp.maximum(least, tiny)
    is_far = jnp.abs(p2) <= least
    is_parallel = p2 == 0
    held = jax.lax.stop_gradient(jnp.where(p2 < 0, -1.0, 1.0) * least)
    inverse = 1 / jnp.where(is_far, held, p2)
    depth = determinant * inverse
    is_hit = ~is_parallel & (depth >= near_plane)
    u, v = jnp.where(is_hit, p0 * inverse, 0.0), jnp.where(is_hit, p1 * inverse, 0.0)

    dx, dy = x - per_pixel(mean[0] / mean[2]), y - per_pixel(mean[1] / mean[2])
    rho_ray, rho_screen = u * u + v * v, 2 * (dx * dx + dy * dy)
    is_ray = is_hit & (rho_ray <= rho_screen)
    return _Hit(u, v, jnp.where(is_ray, rho_ray, rho_screen), jnp.where(is_ray, depth, per_pixel(mean[2])))


def _per_pixel(x: Array, num: int) -> Array:
    """x [B] spread over the pixels; [B, P] as it is, and [B, 1] of what has no pixel's own value."""
    if x.ndim == 1:
        return spread(x, num)
    return jnp.broadcast_to(x, (x.shape[0], num))


def _relative_to_tile(M: Array, tile: _Tile):
    """The entries of M [B, 3, 3] with pixels counted from the tile's centre: axes and mean, each entry [B]."""
    last = M[:, 2]
    shifted = (M[:, 0] - tile.x * last, M[:, 1] - tile.y * last, last)
    return tuple((row[:, 0], row[:, 1]) for row in shifted), tuple(row[:, 2] for row in shifted)


def _pixels_of_tile(size: int, dtype) -> tuple[Array, Array]:
    """x and y of a tile's pixel centres from its centre, each [1, P]."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    return jnp.asarray(x.reshape(1, -1), dtype), jnp.asarray(y.reshape(1, -1), dtype)


def _block(how: Compositing, rule, rows, at, tile: _Tile, light, is_live, log_tap=None):
    """Composites one block of B splats over one tile.

    Args:
      rows: the block's splats and appearance rows.
      at: position of the block in the list; entries past the tile's end are left out.
      light: [P] transmittance before the block; is_live: [P] pixels that have not stopped.
      log_tap: [B, P] zeros added to the exponent of the falloff, to read the gradient there; or None.

    Returns:
      Channels added [D, P], transmittance and live pixels after the block, and weights [B, P].
    """
    splats, appearance = rows
    pixels = _pixels_of_tile(how.grid.tile_size, splats.M.dtype)
    axes, mean = _relative_to_tile(splats.M, tile)
    hit = _intersect(axes, mean, pixels, how.near_plane)
    residual, factor = rule.sample(appearance, hit.u, hit.v)
    per_pixel = functools.partial(spread, num=light.shape[0])
    a = per_pixel(splats.opacities) * rule.falloff(hit.rho)
    a = a if factor is None else a * factor
    a = a if log_tap is None else a * jnp.exp(log_tap)
    in_list = (at + jnp.arange(BLOCK, dtype=jnp.int32) < tile.end)[:, None]
    alpha = jnp.where((a >= MIN_ALPHA) & in_list, jnp.where(a < MAX_ALPHA, a, MAX_ALPHA), 0.0)
    weights, light, is_live = _weights(alpha, light, is_live)
    channels = [per_pixel(splats.colors[:, k]) for k in range(3)]
    if residual is not None:
        channels = [base + extra for base, extra in zip(channels, residual, strict=True)]
    if how.has_geometry:
        channels += [hit.depth, hit.depth * hit.depth, *(per_pixel(splats.normals[:, k]) for k in range(3))]
    added = jnp.stack([_sum_rows(channel * weights) for channel in channels])
    return added, light, is_live, weights


def _sum_rows(x: Array) -> Array:
    """Sum over the first axis, a power of two long, by halves: a reduction would not be vectorised over pixels."""
    while x.shape[0] > 1:
        half = x.shape[0] // 2
        x = x[:half] + x[half:]
    return x[0]


def _weights(alpha: Array, light: Array, is_live: Array) -> tuple[Array, Array, Array]:
    """Weights α·T [B, P] front to back; a pixel stops before the splat that would leave less than 10⁻⁴."""

    def add_splat(carry, alpha):
        light, is_live = carry
        after = light * (1 - alpha)
        is_live = is_live & (after >= MIN_TRANSMITTANCE)
        return (jnp.where(is_live, after, light), is_live), jnp.where(is_live, alpha * light, 0.0)

    (light, is_live), weights = jax.lax.scan(add_splat, (light, is_live), alpha)
    return weights, light, is_live


def _block_vjp(how: Compositing, rule, jacobian, rows, at, tile, light, is_live, behind, g):
    """One block of the backward pass over one tile: the state after it, and the cotangents of its rows.

    `behind` [P] is g·(what this block and all behind it add) + g_T·T_final.
    """

    def block(rows, log_tap):
        added, light_after, live_after, weights = _block(how, rule, rows, at, tile, light, is_live, log_tap)
        return (added, light_after), (live_after, weights)

    floats, rebuild = _split_floats(rows)
    log_tap = jnp.zeros((BLOCK, light.shape[0]), light.dtype) if how.has_statistic else None
    (added, after), pull_back, (live_after, weights) = jax.vjp(
        lambda floats, log_tap: block(rebuild(floats), log_tap), floats, log_tap, has_aux=True
    )
    behind = behind - jnp.sum(g * added, axis=0)
    d_floats, d_log = pull_back((g, behind / after))
    d_splats, d_appearance = rebuild(d_floats)
    d_tap = _statistic(how, jacobian, rows[0].M, tile, d_log, weights) if how.has_statistic else None
    return after, live_after, behind, (d_splats, d_appearance, d_tap)


def _split_floats(tree: Any):
    """The float leaves of a pytree, and the function that puts (other) floats back among its integers."""
    leaves, structure = jax.tree.flatten(tree)
    is_float = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves]

    def rebuild(floats):
        remaining = iter(floats)
        merged = [next(remaining) if flag else leaf for flag, leaf in zip(is_float, leaves, strict=True)]
        return jax.tree.unflatten(structure, merged)

    return [leaf for leaf, flag in zip(leaves, is_float, strict=True) if flag], rebuild


def _statistic(how: Compositing, jacobian, M, tile: _Tile, d_log: Array, weights: Array) -> Array:
    """[B, 4]: Σ_pixels |∂L/∂μ| per world component, through the Gaussian factor only, and the pixels composited.

    d_log [B, P] is ∂L/∂(log of the Gaussian factor) = ∂L/∂(−ρ/2).
    """
    axes, mean = _relative_to_tile(M, tile)
    mean = tuple(jnp.broadcast_to(entry[:, None], d_log.shape) for entry in mean)
    pixels = _pixels_of_tile(how.grid.tile_size, M.dtype)
    _, pull_back = jax.vjp(lambda mean: _intersect(axes, mean, pixels, how.near_plane).rho, mean)
    (d_mean,) = pull_back(-0.5 * d_log)
    shifted = (jacobian[0] - tile.x * jacobian[2], jacobian[1] - tile.y * jacobian[2], jacobian[2])
    per_pixel = [sum(d_mean[i] * shifted[i][axis] for i in range(3)) for axis in range(3)]
    sums = [pixel_sum(jnp.abs(component)) for component in per_pixel]
    return jnp.stack([*sums, pixel_sum((weights > 0).astype(M.dtype))], axis=1)
