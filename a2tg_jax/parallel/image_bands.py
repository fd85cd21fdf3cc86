"""Bands of an image: whole rows of tiles, one band for each device, with about as many pairs of splat and tile.

The borders follow from the pairs of each row of tiles, in integers, so that all devices find the same ones. The pixels
of a band then go to the devices that an even cut gives them to, because JAX divides arrays evenly. Mostly that is a few
rows to the neighbours.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.rasterize.tile_pixels import TilePixels, tile_pixels
from a2tg_jax.rasterize.tiles import Rectangles, TileGrid

EMPTY_TILES = 10
"""Rows of tiles without pairs that together cost as much as a mean row. Their cost keeps borders near an even cut in an
image that is mostly empty; in return the fullest band may have a tenth more pairs."""
COST_BITS = 29
"""Bits of the cost of an image."""


class BorderRoom(NamedTuple):
    """Rows of pixels by which a border between two bands may lie off that of an even cut; static."""

    above: int
    below: int

    def wider(self) -> "BorderRoom":
        """Return about twice the room."""
        return BorderRoom(2 * self.above + 1, 2 * self.below + 1)


class Hop(NamedTuple):
    """Pixels that each device sends to the one of another band of its view; all static."""

    bands: int
    """Number of bands to the other one; negative upwards."""
    first: int
    """First of the rows of pixels, in the other one's share of an even cut."""
    rows: int


class ImageBands(NamedTuple):
    """Bands of each view; all static."""

    whole: TileGrid
    """Grid of a view."""
    num: int
    """Number B of bands of a view."""
    room: BorderRoom
    """Room for borders."""

    @staticmethod
    def of(grid: TileGrid, num: int, room: BorderRoom | None = None) -> "ImageBands":
        """Return the bands of a view; without a room, that for any borders."""
        # A border lies at most at the end of the tiles, and in an even cut at most at the end of the devices' rows.
        most = max(grid.rows * grid.tile_size, num * -(-grid.height // num)) if num > 1 else 0
        return ImageBands(grid, num, BorderRoom(*(min(most, own) for own in room or (most, most))))

    @property
    def even_height(self) -> int:
        """Rows of pixels that each device has of an even cut; the last ones may lie below the image."""
        return -(-self.whole.height // self.num)

    @property
    def own(self) -> TileGrid:
        """Grid with room for any of the bands."""
        size = self.whole.tile_size
        rows = -(-(self.even_height + self.room.above + self.room.below) // size)
        return self.whole._replace(height=min(rows * size, self.whole.height))

    def pixels(self, rays: Array | None) -> TilePixels | None:
        """Return the pixels of all tiles, and of so many below the image that any band has its own grid of them; None
        of a pinhole camera."""
        return None if rays is None else tile_pixels(rays, self.whole.tile_size, self.whole.rows + self.own.rows)

    def pairs_of_rows(self, boxes: Rectangles) -> Array:
        """Return the number of pairs in each row of tiles, [rows] int32."""
        end = boxes.y0 + boxes.counts // jnp.maximum(boxes.columns, 1)
        columns = jnp.where(boxes.counts > 0, boxes.columns, 0)
        ends = jnp.zeros(self.whole.rows + 1, jnp.int32).at[boxes.y0].add(columns).at[end].add(-columns)
        return jnp.cumsum(ends)[:-1]

    def borders(self, pairs: Array) -> Array:
        """Return the first row of tiles of each band, and the end of the last one: [B + 1] int32, ascending.

        Args:
          pairs: number of pairs in each row of tiles, [rows] int32.
        """
        rows = self.whole.rows
        if self.num == 1:
            return jnp.asarray([0, rows], jnp.int32)
        pairs = jnp.maximum(pairs, 0)
        bits = 32 - jax.lax.clz(jnp.max(pairs)) + rows.bit_length()
        pairs = pairs >> jnp.maximum(bits - COST_BITS, 0)
        cost = pairs + jnp.sum(pairs) // (rows * EMPTY_TILES) + 1
        ends = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(cost)])
        number = jnp.arange(self.num + 1, dtype=jnp.int32)
        wanted = ends[-1] // self.num * number + ends[-1] % self.num * number // self.num
        after = jnp.searchsorted(ends, wanted, method="compare_all").astype(jnp.int32)
        before = jnp.maximum(after - 1, 0)
        return jnp.where(wanted - ends[before] < ends[after] - wanted, before, after)

    def sums(self, pairs: Array, borders: Array) -> Array:
        """Return the number of pairs in each band, [B] int32, of those in each row of tiles [rows]."""
        ends = jnp.concatenate([jnp.zeros(1, pairs.dtype), jnp.cumsum(pairs)])
        return jnp.diff(ends[borders])

    def even_borders(self) -> Array:
        """Return the borders of bands that are equally high, as `borders` does."""
        height = -(-self.whole.rows // self.num)
        return jnp.minimum(jnp.arange(self.num + 1, dtype=jnp.int32) * height, self.whole.rows)

    def reached(self, boxes: Rectangles, borders: Array) -> Array:
        """Return [B, n] whether the box of each splat reaches each band."""
        end = boxes.y0 + boxes.counts // jnp.maximum(boxes.columns, 1)
        is_reached = (boxes.y0[None] < borders[1:, None]) & (end[None] > borders[:-1, None])
        return is_reached & (boxes.counts > 0)[None]

    def room_for(self, borders: Array) -> Array:
        """Return [2] int32: the room that borders need above, and below."""
        number = jnp.arange(1, self.num, dtype=jnp.int32)
        moved = borders[1:-1] * self.whole.tile_size - number * self.even_height
        return jnp.maximum(jnp.stack([jnp.max(-moved, initial=0), jnp.max(moved, initial=0)]), 0)

    def pixels_of(self, borders: Array, band: Array) -> tuple[Array, Array]:
        """Return the first row of pixels of a band, and the end of its last one, of those in the image."""
        first, end = borders[band] * self.whole.tile_size, borders[band + 1] * self.whole.tile_size
        return first, jnp.minimum(end, self.whole.height)

    def hops(self) -> Iterator[Hop]:
        """Yield what devices send, to others and to themselves, so that each has its rows of an even cut."""
        height = self.even_height
        yield Hop(0, 0, height)
        for number in range(1, self.num):
            below, above = (min(height, room - (number - 1) * height) for room in (self.room.below, self.room.above))
            if below > 0:
                yield Hop(number, 0, below)
            if above > 0:
                yield Hop(-number, height - above, above)

    def to_even(self, image: Array, borders: Array, device: Array, num_views: int, axis: str) -> Array:
        """Return the pixels [C, `even_height`, W] of this device in an even cut, from the bands of all devices.

        Args:
          image: pixels [C, `own.height`, W] from the first row of this device's band.
          borders: of its view.
          device: its index along the axis.
          num_views: number of views, of `num` devices each, one after the other.
          axis: of the mesh, inside `shard_map`.
        """
        band, height = device % self.num, self.even_height
        first, end = self.pixels_of(borders, band)
        even = jnp.zeros((image.shape[0], height, image.shape[2]), image.dtype)
        for hop in self.hops():
            top = (band + hop.bands) * height + hop.first
            rows = top + jnp.arange(hop.rows, dtype=jnp.int32)
            places = rows - first + jnp.where(rows < end, 0, image.shape[1])
            sent = _rows_at(image, places)
            if hop.bands:
                sent = jax.lax.ppermute(sent, axis, list(self._ways(hop.bands, num_views)))
            even = even.at[:, hop.first : hop.first + hop.rows].add(sent)
        return even

    def _ways(self, bands: int, num_views: int) -> Iterator[tuple[int, int]]:
        """Yield each device and the one so many bands below, in the same view."""
        for device in range(self.num * num_views):
            if 0 <= device % self.num + bands < self.num:
                yield device, device + bands


def _rows_at(image: Array, places: Array) -> Array:
    """Return rows [C, n, W] of an image [C, h, W] at ascending places [n]; zeros where a place is outside."""
    rows: Array = image.at[:, places].get(
        mode="fill", fill_value=0, wrap_negative_indices=False, unique_indices=True, indices_are_sorted=True
    )
    return rows
