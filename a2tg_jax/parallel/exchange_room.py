"""Room that several devices need to draw views together, counted on the host.

A device has a fixed number of rows to send to another one, and of rows of pixels by which borders between bands may
move. A step that needs more is not taken, and is repeated with more room.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.appearance import Appearance
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.geometry import screen_bounds
from a2tg_jax.core.numerics import Integer
from a2tg_jax.parallel.exchange import BorderRoom, Exchange, ImageBands, share_of_a_band
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.rasterize.splats import drawn_splats
from a2tg_jax.rasterize.tiles import TileGrid, tile_rectangles


class RoomOfView(NamedTuple):
    """Room that devices need to draw a view together."""

    rows: int  # Rows that a device must be able to send to another one.
    borders: BorderRoom
    pairs: int  # Capacity of which every band's share holds its pairs.


def room_of_view(
    gaussians: Gaussians, camera: Camera, appearance: Appearance, settings: RenderSettings,
    num_live: Integer | None = None,
) -> RoomOfView:  # fmt: skip
    """Return the room that the devices of `settings.exchange` need in a view (host)."""
    assert settings.exchange is not None
    camera = settings.finer(camera)
    needs = jax.jit(_needs, static_argnums=3)(gaussians, camera, appearance, settings, num_live)
    rows, above, below, pairs = map(int, needs)
    share = share_of_a_band(settings.exchange.num // settings.exchange.views_at_once)
    return RoomOfView(rows, BorderRoom(above, below), math.ceil(pairs / share))


def _needs(
    gaussians: Gaussians, camera: Camera, appearance: Appearance, settings: RenderSettings, num_live: Integer | None
) -> tuple[Array, Array, Array, Array]:
    """Return the largest number of rows that a device sends to another one, the rows of pixels by which borders move
    up and down, and the largest number of pairs of a band; int32."""
    exchange, grid = settings.exchange, TileGrid(camera.width, camera.height, settings.tile_size)
    assert exchange is not None
    M, cutoff = drawn_splats(gaussians, camera, appearance, num_live)
    M, cutoff = exchange.filled_up(M), exchange.filled_up(cutoff, -1.0)
    bands = ImageBands.of(grid, exchange.num // exchange.views_at_once)
    boxes = tile_rectangles(screen_bounds(M, cutoff, settings.near_plane), grid, bands.pixels(camera.rays))
    pairs = bands.pairs_of_rows(boxes)
    borders = bands.borders(pairs)
    reached = bands.reached(boxes, borders).reshape(bands.num, exchange.num, -1)
    above, below = bands.room_for(borders)
    most_rows = jnp.max(jnp.sum(reached, axis=2, dtype=jnp.int32))
    return most_rows, above, below, jnp.max(bands.sums(pairs, borders))


def exchange_with_room(
    exchange: Exchange, rooms: Sequence[RoomOfView], growth: float, *, num: int, num_live: int, capacity: int,
    tile_size: int,
) -> Exchange:  # fmt: skip
    """Return the exchange with room for views once all `num` rows, of which `num_live` exist now, are in use (host).

    The room is a multiple of the present rooms of some views; the capacity is the number of pairs of an image.
    """
    rows = -(-num // exchange.num)
    # While Gaussians are added, the existing ones are in the first rows: the share of these is taken for all.
    share = min(1.0, growth * max(1, *(own.rows for own in rooms)) / max(1, min(num_live, rows)))
    above, below = (max(own) for own in zip(*(each.borders for each in rooms), strict=True))
    borders = BorderRoom(*(int(growth * own) + tile_size for own in (above, below)))  # borders move by rows of tiles
    return dataclasses.replace(exchange, rows_per_pair=share * rows / capacity, border_room=borders)


def with_wider_borders(exchange: Exchange, height: int, tile_size: int) -> Exchange:
    """Return the exchange with about twice the room for borders in images of some rows of pixels."""
    assert exchange.border_room is not None
    room = BorderRoom(*(2 * rows + 1 for rows in exchange.border_room))  # + 1: 0 must grow as well
    covers_image = min(room) >= height + tile_size
    return dataclasses.replace(exchange, border_room=None if covers_image else room)
