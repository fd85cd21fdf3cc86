"""Lists of the splats that touch each tile, in depth order, at a fixed capacity.

A pair is one splat in one tile. Pairs are emitted splat by splat in depth order, and those whose outline misses the
tile are dropped. One stable sort by tile makes the lists here; `kernels.native` makes the same ones by counting. Tiles
of P = tile_size² pixels are numbered row by row.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.geometry import Outline, ScreenBounds, screen_bounds
from a2tg_jax.rasterize.tile_pixels import TilePixels, covered_tiles


class TileGrid(NamedTuple):
    """Tiles that cover an image of width × height pixels; all static."""

    width: int
    height: int
    tile_size: int

    @property
    def columns(self) -> int:
        return -(-self.width // self.tile_size)

    @property
    def rows(self) -> int:
        return -(-self.height // self.tile_size)

    @property
    def num(self) -> int:
        return self.columns * self.rows


class TileLists(NamedTuple):
    """Splats of each tile, front to back."""

    ids: Array  # [capacity] splat indices, tile after tile
    starts: Array  # [tiles + 1] start of each tile's list in `ids`
    num_pairs: Array  # number of pairs before the outline test, as a float; the capacity must hold it
    overflow: Array  # whether the pairs did not fit; the lists are then empty
    pixels: TilePixels | None = None  # pixels of the tiles, if the camera has a ray for each pixel


class Rectangles(NamedTuple):
    """Tiles x0 <= x < x0 + columns, y0 <= y < y0 + counts/columns of each splat, and their number."""

    x0: Array
    y0: Array
    columns: Array
    counts: Array


def tile_rectangles(bounds: ScreenBounds, grid: TileGrid, pixels: TilePixels | None = None) -> Rectangles:
    """Return the tiles that each splat's box covers, or may cover if pixels have rays of their own."""
    if pixels is None:
        x0, columns = _tile_span(bounds.left, bounds.right, grid.width, grid.tile_size)
        y0, rows = _tile_span(bounds.top, bounds.bottom, grid.height, grid.tile_size)
    else:
        reach = jnp.max(bounds.outline.radius, initial=0.0)
        low = (bounds.left, bounds.top)
        high = (bounds.right, bounds.bottom)
        (x0, columns), (y0, rows) = covered_tiles(pixels, grid.columns, reach, low, high)
    # Without rows there are no columns either: counts may be divided by them.
    columns = jnp.where(rows > 0, columns, jnp.int32(0))
    return Rectangles(x0, y0, columns, columns * rows)


def _tile_span(low: Array, high: Array, size: int, tile_size: int) -> tuple[Array, Array]:
    """Return the first tile along an axis with a pixel centre in [low, high], and the number of such tiles."""
    nothing = jnp.int32(0)
    last_pixel = jnp.int32(size - 1)
    side = jnp.int32(tile_size)
    # Pixel k has its centre at k + ½. Clipped as floats, for the conversion of larger ones is not defined.
    edges = jnp.ceil(low - 0.5), jnp.floor(high - 0.5)
    first, last = (jnp.clip(edge, -1.0, 1e6).astype(jnp.int32) for edge in edges)
    first = jnp.maximum(first, nothing)
    last = jnp.minimum(last, last_pixel)
    # Not //, which is slower for the sake of negative numbers; only `last` can be one, -1, less than `first`.
    begin = jax.lax.div(first, side)
    end = jax.lax.div(last, side) + 1
    return begin, jnp.where(last < first, nothing, end - begin)


def total_pairs(counts: Array) -> Array:
    """Return the sum of counts [N] as a float32, which cannot wrap, to a few units in the last place."""
    # Blocks are summed as integers first, so that no small count is lost in a large sum.
    blocks = jnp.pad(counts, (0, -counts.shape[0] % 256)).reshape(-1, 256)
    return jnp.sum(jnp.sum(blocks, axis=1, dtype=jnp.int32).astype(jnp.float32))


def outline_touches(outline: Outline, left: Array, right: Array, top: Array, bottom: Array) -> Array:
    """Return whether an outline reaches a box, given the box's edges; element-wise."""

    def box_from(x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        return left - x, right - x, top - y, bottom - y

    from_left, from_right, from_top, from_bottom = box_from(outline.ellipse_x, outline.ellipse_y)
    xx = outline.xx
    xy = outline.xy
    yy = outline.yy
    # The nearest point of the box in the ellipse's metric is on one of the two sides that face the centre.
    x_side = _clip(0.0, from_left, from_right)
    y_side = _clip(0.0, from_top, from_bottom)
    y_on_side = _clip(xy / xx * x_side, from_top, from_bottom)
    x_on_side = _clip(xy / yy * y_side, from_left, from_right)

    def squared_distance(x: Array, y: Array) -> Array:
        return yy * x * x - 2 * xy * x * y + xx * y * y

    # In the ellipse's metric, points at distance 1 have yy·x² − 2·xy·x·y + xx·y² = xx·yy − xy².
    nearest = jnp.minimum(squared_distance(x_side, y_on_side), squared_distance(x_on_side, y_side))
    is_in_ellipse = nearest <= (xx * yy - xy * xy)
    from_left, from_right, from_top, from_bottom = box_from(outline.mean_x, outline.mean_y)
    nearest = _clip(0.0, from_left, from_right) ** 2 + _clip(0.0, from_top, from_bottom) ** 2
    return is_in_ellipse | (nearest <= outline.radius**2) | outline.is_clipped


def _clip(x: Array | float, low: Array, high: Array) -> Array:
    """Return a number moved between two others: two instructions in native loops, where jnp.clip takes twelve."""
    x = jnp.where(x > low, x, low)
    return jnp.where(x < high, x, high)


def tile_edges(x0: Array, y0: Array, tile_size: int) -> tuple[Array, Array, Array, Array]:
    """Return the left, right, top and bottom edge of the pixel centres of the tile with first pixel (x0, y0)."""
    left = x0 + 0.5
    top = y0 + 0.5
    return left, left + (tile_size - 1), top, top + (tile_size - 1)


def tile_lists(
    M: Array, cutoff: Array, near_plane: float, grid: TileGrid, capacity: int, pixels: TilePixels | None = None
) -> TileLists:
    """List the splats that touch each tile, ordered by depth, ties by index.

    Args:
      M, cutoff, near_plane: of N splats, as for `core.geometry.screen_bounds`.
      grid: tiles of the image.
      capacity: number of pairs that fit, before the outline test.
      pixels: pixels of the tiles, if the camera has a ray for each pixel.
    """
    bounds = screen_bounds(M, cutoff, near_plane)
    depths = M[:, 2, 2]
    order = jnp.argsort(depths, stable=True)
    unordered = tile_rectangles(bounds, grid, pixels)
    # Summed before they are ordered: a GPU would otherwise sum and gather in one slow kernel.
    total = total_pairs(unordered.counts)
    rectangles = jax.tree.map(lambda x: x[order], unordered)
    # The total is known to a relative error of about 2⁻²⁰.
    overflow = total + jnp.floor(total * 2.0**-20) > capacity
    # Empty lists, not incomplete ones, so that an overflow makes an image that is plainly wrong.
    counts = jnp.where(overflow, 0, rectangles.counts)
    ends = jnp.cumsum(counts)
    num = depths.shape[0]
    # One place for each pair: splat `rank` in depth order has the places from ends − counts on, and pair number `local`
    # of its rectangle is in its column local mod columns. Places that are left, up to the capacity, are not kept.
    rank = jnp.repeat(jnp.arange(num, dtype=jnp.int32), counts, total_repeat_length=capacity)
    position = jnp.arange(capacity, dtype=jnp.int32)
    local = position - (ends - counts)[rank]
    columns = jnp.maximum(rectangles.columns[rank], 1)
    x = rectangles.x0[rank] + local % columns
    y = rectangles.y0[rank] + local // columns
    ids = order[rank].astype(jnp.int32)
    dtype = bounds.left.dtype
    per_pair = jax.tree.map(lambda leaf: leaf[ids], bounds.outline)
    if pixels is None:
        tile_x = (x * grid.tile_size).astype(dtype)
        tile_y = (y * grid.tile_size).astype(dtype)
        is_touched = outline_touches(per_pair, *tile_edges(tile_x, tile_y, grid.tile_size))
    else:
        # Places that are left over may be in no tile.
        tile = jnp.minimum(y * grid.columns + x, grid.num - 1)
        left, top, right, bottom = pixels.boxes[tile].T
        # The radius of the low-pass filter is in pixels of the image; the boxes are in the image plane.
        outline = per_pair._replace(radius=per_pair.radius * pixels.magnifications[tile])
        is_touched = outline_touches(outline, left, right, top, bottom)
    # Pairs that are not kept sort behind all tiles.
    is_kept = (position < ends[-1]) & is_touched
    tile = jnp.where(is_kept, y * grid.columns + x, grid.num)
    ids, starts = _sort_by_tile(tile, rank, order, grid.num)
    return TileLists(ids, starts, total, overflow, pixels)


def _sort_by_tile(tile: Array, rank: Array, order: Array, num_tiles: int) -> tuple[Array, Array]:
    """Return splat indices sorted by tile, then by depth rank, and the start of each tile's list.

    If both fit 32 bits they are packed into one key: sorting keys is several times faster than sorting pairs.
    """
    num = order.shape[0]
    rank_bits = max(1, (num - 1).bit_length())
    if num_tiles.bit_length() + rank_bits <= 32:
        key = jnp.sort(tile.astype(jnp.uint32) << rank_bits | rank.astype(jnp.uint32))
        sorted_tile = (key >> rank_bits).astype(jnp.int32)
        sorted_rank = key & ((1 << rank_bits) - 1)
        ids = order[sorted_rank].astype(jnp.int32)
    else:
        tile_type = jnp.uint16 if num_tiles < 2**16 else jnp.uint32
        sorted_tile, sorted_rank = jax.lax.sort((tile.astype(tile_type), rank), num_keys=1, is_stable=True)
        ids = order[sorted_rank].astype(jnp.int32)
        sorted_tile = sorted_tile.astype(jnp.int32)
    starts = jnp.searchsorted(sorted_tile, jnp.arange(num_tiles + 1, dtype=jnp.int32), method="scan_unrolled")
    return ids, starts.astype(jnp.int32)
