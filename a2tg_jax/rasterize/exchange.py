"""Compositing on several devices: splats travel to the devices that own the pixels they reach.

N rows of splats are sharded over D devices, N/D each. G views are drawn at once, where G divides D. Each image is cut
into D/G bands of whole rows of tiles, one for each device, with about as many pairs in each (`image_bands`). By one
`all_to_all` every device sends to every other one the splats that reach its band, a fixed number of rows; JAX
transposes it, which brings the gradients back. A splat that reaches two bands travels twice. The pixels then go to the
devices that an even cut of the image gives them to.

The received rows keep the order of the model, so that a band is composited as it is on one device.
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from a2tg_jax.appearance import AppearanceRule
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.geometry import screen_bounds
from a2tg_jax.core.spread_arrays import mesh_of, placed, sharding_of_rows
from a2tg_jax.rasterize.compositor import Composited, composite_arrays
from a2tg_jax.rasterize.image_bands import Bands, BorderRoom
from a2tg_jax.rasterize.kernels.native import composite as native
from a2tg_jax.rasterize.kernels.packing import pack_splats, unpack_splats
from a2tg_jax.rasterize.splats import CompositingSettings, Splats
from a2tg_jax.rasterize.tile_pixels import TilePixels, band_pixels
from a2tg_jax.rasterize.tiles import TileGrid, TileLists, tile_lists, tile_rectangles

AXIS = "rows"
"""Axis of the mesh along which rows of splats, and bands of pixels, lie on devices."""
VIEW_AXIS = "views"
"""Axis of a mesh of the same devices along which the views lie that are drawn at once."""
ROOM_OF_A_BAND = 1.5
"""Room for the pairs of a band, as a multiple of an even share of the capacity."""


@dataclasses.dataclass(frozen=True)
class Exchange:
    """Devices that render together; hashable, so that settings can hold it."""

    mesh: Mesh
    """Devices along the one axis `AXIS`."""
    rows_per_pair: float = 1.0
    """Rows that one device can send to another, as a share of the capacity for pairs."""
    border_room: BorderRoom | None = None
    """Room for the borders between bands; None: for any borders."""
    views_at_once: int = 1
    """Largest number of views that are drawn at once; a divisor of D."""

    @property
    def num(self) -> int:
        """Number D of devices."""
        return self.mesh.size

    def for_batches(self, num_views: int) -> "Exchange":
        """Return the exchange that draws as many views of a batch at once as it can."""
        return dataclasses.replace(self, views_at_once=math.gcd(num_views, self.num))

    def num_at_once(self, num_views: int) -> int:
        """Return how many of some views are drawn at once: a divisor of their number, and of D."""
        return math.gcd(num_views, self.views_at_once)

    @property
    def is_of_processes(self) -> bool:
        """Whether the devices are of several processes."""
        return self.num_processes > 1

    @property
    def num_processes(self) -> int:
        """Number of processes that the devices belong to."""
        return len({device.process_index for device in self.mesh.devices.flat})

    def sharding_of(self, shape: tuple[int, ...], axis: int = 0) -> NamedSharding:
        """Return where the rows of an array lie, along one of its axes."""
        return sharding_of_rows(self.mesh, shape, axis)

    def sharding_of_pictures(self, num_views: int, height: int) -> NamedSharding:
        """Return where the pictures [V, H, ...] of a batch lie: each on the devices that draw its view, which share its
        rows of pixels if their number divides H.

        The g-th of G groups of devices draws the g-th part of the views, one after the other.
        """
        num_groups = self.num_at_once(num_views)
        if num_groups == 1:
            return self.sharding_of((num_views, height), axis=1)
        devices = self.mesh.devices.reshape(num_groups, -1)
        mesh = Mesh(devices, (VIEW_AXIS, AXIS), axis_types=(jax.sharding.AxisType.Auto,) * 2)
        return NamedSharding(mesh, P(VIEW_AXIS, None if height % devices.shape[1] else AXIS))

    def filled_up(self, x: Array, value: float | None = None) -> Array:
        """Return rows followed by so many of a value, or copies of the last one, that D divides their number."""
        num = -x.shape[0] % self.num
        last = x[-1:] if value is None else jnp.full((1, *x.shape[1:]), value, x.dtype)
        return jnp.concatenate([x, jnp.repeat(last, num, axis=0)]) if num else x


def spread(exchange: Exchange | None, tree: Any, axis: int = 0) -> Any:
    """Return arrays with their rows, along an axis, spread over the devices; those that D does not divide are on every
    device.

    Under jit it constrains where results lie; else it moves the arrays. Without an exchange they stay.
    """
    if exchange is None:
        return tree

    def of_leaf(x: Any) -> Any:
        sharding = exchange.sharding_of(jnp.shape(x), axis)
        is_traced = isinstance(x, jax.core.Tracer)
        return jax.lax.with_sharding_constraint(x, sharding) if is_traced else placed(x, sharding)

    return jax.tree.map(of_leaf, tree)


def exchange_of(x: Any) -> Exchange | None:
    """Return the exchange among the devices over which an array is spread; None if it lies on one (host)."""
    mesh = mesh_of(x)
    return None if mesh is None else Exchange(mesh)


def exchange_among(devices: Any) -> Exchange:
    """Return the exchange among devices, at least one."""
    mesh = jax.make_mesh((len(devices),), (AXIS,), axis_types=(jax.sharding.AxisType.Auto,), devices=devices)
    return Exchange(mesh)


def composite_in_bands(
    settings: CompositingSettings, exchange: Exchange, capacity: int, splats: Splats, rule: AppearanceRule,
    cutoff: Array, jacobian: Array, probe: Array, rays: Array | None,
) -> Composited:  # fmt: skip
    """Composite G views, the leading axis of all arrays, as `compositor.composite` does one: each device a band.

    The number of pairs is the capacity that has room for the fullest band and for all that is sent to it.

    Args:
      settings, rule: as for `composite`.
      exchange: the D devices; G divides D.
      capacity: number of pairs of a whole image.
      splats, cutoff, jacobian, probe: as for `composite`, [G, ...].
      rays: [H, W, 2] of the lens that the views share (`Camera.rays`); None of a pinhole.
    """
    num_views = cutoff.shape[0]
    num_bands = exchange.num // num_views
    splats, probe = jax.tree.map(jax.vmap(exchange.filled_up), (splats, probe))
    cutoff = jax.vmap(functools.partial(exchange.filled_up, value=-1.0))(cutoff)
    regions = jax.tree.map(exchange.filled_up, rule.regions)
    share = share_of_a_band(num_bands)
    room = _Room(
        pairs=math.ceil(capacity * share), pairs_share=share,
        rows=min(cutoff.shape[1] // exchange.num, max(1, math.ceil(capacity * exchange.rows_per_pair))),
        rows_share=exchange.rows_per_pair,
    )  # fmt: skip
    bands = Bands.of(settings.grid, num_bands, exchange.border_room)
    on_device = functools.partial(_composite_band, settings, bands, room, rule)
    rows, of_views, everywhere = P(AXIS), P(None, AXIS), P()
    channels, transmittance, num_pairs, overflow = jax.shard_map(
        on_device,
        mesh=exchange.mesh,
        in_specs=(of_views, rows, of_views, of_views, everywhere, everywhere, everywhere),
        out_specs=(P(None, AXIS), P(AXIS), everywhere, everywhere),
        check_vma=False,  # The loops of XLA do not say which devices their carries differ on.
    )(splats, regions, jax.lax.stop_gradient(cutoff), probe, rule.texels, jacobian, bands.pixels(rays))
    height, width = settings.grid.height, settings.grid.width
    channels = channels.reshape(channels.shape[0], num_views, -1, width)[:, :, :height]
    transmittance = transmittance.reshape(num_views, -1, width)[:, :height]
    num_pairs, overflow = (jnp.broadcast_to(x, (num_views,)) for x in (num_pairs, overflow))
    return Composited(jnp.moveaxis(channels, 1, 0), transmittance, num_pairs, overflow)


class Travel(NamedTuple):
    """Need of room for a view that is drawn beside others; int32, traced."""

    rows: Array
    """Largest number of rows that a device sends to another one."""
    above: Array
    """Rows of pixels by which borders move up."""
    below: Array
    """Rows of pixels by which they move down."""
    pairs: Array
    """Largest number of pairs of a band."""


def share_of_a_band(num_bands: int) -> float:
    """Return the share of the capacity for pairs that each of so many bands of a view has."""
    return min(1.0, ROOM_OF_A_BAND / num_bands)


def travel(
    exchange: Exchange, M: Array, cutoff: Array, near_plane: float, grid: TileGrid, rays: Array | None = None
) -> Travel:
    """Return the room that a view needs.

    Args:
      exchange: the D devices.
      M, cutoff, near_plane: of N splats, as for `core.geometry.screen_bounds`.
      grid: tiles of the image.
      rays: of the lens, as for `composite_in_bands`.
    """
    M, cutoff = exchange.filled_up(M), exchange.filled_up(cutoff, -1.0)
    bands = Bands.of(grid, exchange.num // exchange.views_at_once)
    boxes = tile_rectangles(screen_bounds(M, cutoff, near_plane), grid, bands.pixels(rays))
    pairs = bands.pairs_of_rows(boxes)
    borders = bands.borders(pairs)
    reached = bands.reached(boxes, borders).reshape(bands.num, exchange.num, -1)
    above, below = bands.room_for(borders)
    most_rows = jnp.max(jnp.sum(reached, axis=2, dtype=jnp.int32))
    return Travel(most_rows, above, below, jnp.max(bands.sums(pairs, borders)))


class _Room(NamedTuple):
    """Room on each device; static."""

    pairs: int
    """Pairs of a band."""
    pairs_share: float
    """`pairs`, as a share of the capacity."""
    rows: int
    """Rows that a device sends to each other one."""
    rows_share: float
    """`rows`, as a share of the capacity."""


def _composite_band(
    settings: CompositingSettings, bands: Bands, room: _Room, rule: AppearanceRule, splats: Splats,
    regions: TextureRegion | None, cutoff: Array, probe: Array, texels: Array, jacobian: Array,
    pixels: TilePixels | None,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return channels [C, h, W] and transmittance [h, W] of this device's pixels, the capacity needed, the overflow."""
    borders, reached = _cut(settings, bands, jax.lax.stop_gradient(splats.M), cutoff, pixels)
    num_sent = jnp.max(jnp.sum(reached, axis=2, dtype=jnp.int32))
    chosen, chosen_of_views = _chosen_rows(reached, room.rows)
    send = functools.partial(_send, chosen_of_views)

    splats, cutoff, probe = jax.tree.map(lambda x: x.reshape(cutoff.size, *x.shape[2:]), (splats, cutoff, probe))
    packed = send(jnp.concatenate([pack_splats(splats, True), probe], axis=1))
    splats = unpack_splats(packed[:, : -probe.shape[1]], splats, True)
    probe = packed[:, -probe.shape[1] :]
    cutoff = send(cutoff, fill=-1.0)
    regions = None if regions is None else TextureRegion(*(_send(chosen, field) for field in regions))

    index = jax.lax.axis_index(AXIS)
    view, band = index // bands.num, index % bands.num
    top, end = bands.pixels_of(borders[view], band)
    jacobian = jacobian[view]
    if pixels is None:  # Else pixels keep their places in the image plane, from which M leads to them.
        splats, jacobian = splats._replace(M=_shifted(splats.M, top)), _shifted(jacobian[None], top)[0]
    else:
        first, last = (own * bands.own.columns for own in (borders[view, band], borders[view, band + 1]))
        pixels = band_pixels(pixels, first, bands.own.num, jnp.minimum(last - first, bands.own.num))
    # A band that moved too far overflows; until then it must not reach beyond the memory of its grid.
    height = jnp.minimum(end - top, bands.own.height)
    lists = _lists_of_band(settings, bands, room, jax.lax.stop_gradient(splats.M), cutoff, pixels, height)
    own = settings._replace(grid=bands.own, tile_batch=min(settings.tile_batch, bands.own.num))
    channels, transmittance = composite_arrays(own, rule, splats, texels, regions, cutoff, lists, jacobian, probe)
    if bands.num > 1:
        image = jnp.concatenate([channels, transmittance[None]])
        image = bands.to_even(image, borders[view], index, len(borders), AXIS)
        channels, transmittance = image[:-1], image[-1]
    needed = jnp.maximum(lists.num_pairs / room.pairs_share, num_sent / room.rows_share)
    is_moved_too_far = jnp.any(jax.vmap(bands.room_for)(borders) > jnp.asarray(bands.room))
    overflow = lists.overflow | (num_sent > room.rows) | is_moved_too_far
    overflow = jax.lax.pmax(overflow.astype(jnp.int32), AXIS) > 0
    return channels, transmittance, jax.lax.pmax(needed.astype(jnp.float32), AXIS), overflow


def _lists_of_band(
    settings: CompositingSettings, bands: Bands, room: _Room, M: Array, cutoff: Array, pixels: TilePixels | None,
    height: Array,
) -> TileLists:  # fmt: skip
    """Return the splats of each tile of a band of so many rows of pixels, given the pixels of its tiles if they have
    rays of their own."""
    if pixels is not None:
        return tile_lists(M, cutoff, settings.near_plane, bands.own, room.pairs, pixels)
    list_tiles = native.tile_lists if settings.compositor == "native" else tile_lists
    return list_tiles(M, cutoff, settings.near_plane, bands.own, room.pairs, height=height)


def _cut(
    settings: CompositingSettings, bands: Bands, M: Array, cutoff: Array, pixels: TilePixels | None
) -> tuple[Array, Array]:
    """Return the borders [G, D/G + 1] of the bands, the same on all devices, and [G, D/G, n] which bands are reached by
    each of this device's n splats.

    Args:
      settings, bands: static.
      M, cutoff: [G, n, ...] of this device's splats, as for `core.geometry.screen_bounds`.
      pixels: of all tiles, if they have rays of their own.
    """
    boxes = jax.vmap(
        lambda M, cutoff: tile_rectangles(screen_bounds(M, cutoff, settings.near_plane), settings.grid, pixels)
    )(M, cutoff)  # fmt: skip
    num_devices = bands.num * cutoff.shape[0]
    most = jnp.int32((2**31 - 1) // num_devices)
    pairs = jax.lax.psum(jnp.clip(jax.vmap(bands.pairs_of_rows)(boxes), 0, most), AXIS)
    borders = jax.vmap(bands.borders)(pairs)
    return borders, jax.vmap(bands.reached)(boxes, borders)


def _chosen_rows(reached: Array, most: int) -> tuple[Array, Array]:
    """Return the rows that reach each of D bands, up to a number C of them, [D, C]: in [n] rows, and in [G·n] rows.

    Args:
      reached: [G, D/G, n] whether each row reaches each band of its view.
      most: C; places that are left hold n, and G·n.
    """
    num_views, _, num = reached.shape

    def of_band(mask: Array) -> Array:
        return jnp.nonzero(mask, size=most, fill_value=num)[0].astype(jnp.int32)

    chosen: Array = jax.vmap(jax.vmap(of_band))(reached)
    starts = jnp.arange(num_views, dtype=jnp.int32)[:, None, None] * num
    of_views = jnp.where(chosen < num, chosen + starts, num_views * num)
    return chosen.reshape(-1, most), of_views.reshape(-1, most)


def _send(chosen: Array, x: Array, fill: float = 0.0) -> Array:
    """Send the chosen rows [D, C] of an array [n, ...] to each device; return the rows received [D·C, ...]."""
    rows = jnp.take(x, chosen.reshape(-1), axis=0, mode="fill", fill_value=fill)
    received: Array = jax.lax.all_to_all(rows, AXIS, 0, 0, tiled=True)
    return received


def _shifted(M: Array, top: Array) -> Array:
    """Return homographies [N, 3, 3] to pixels counted from row `top`."""
    return M.at[:, 1].add(-top.astype(M.dtype) * M[:, 2])
