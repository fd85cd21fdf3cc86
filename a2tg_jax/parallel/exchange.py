"""How splats reach the pixels that need them: compositing on several devices.

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
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.geometry import screen_bounds
from a2tg_jax.parallel.image_bands import BorderRoom, ImageBands
from a2tg_jax.parallel.rows import mesh_of
from a2tg_jax.parallel.views_at_once import of_all_views, of_own_view
from a2tg_jax.rasterize.compositor import Composited, composite, list_tiles
from a2tg_jax.rasterize.kernels.packing import pack_splats, unpack_splats
from a2tg_jax.rasterize.splats import CompositingSettings, Splats
from a2tg_jax.rasterize.tile_pixels import TilePixels, band_pixels
from a2tg_jax.rasterize.tiles import tile_rectangles

AXIS = "rows"
"""Axis of the mesh along which rows of splats, and bands of pixels, are spread over devices."""
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
    """Number of views that are drawn at once (`views_at_once`); a divisor of D."""

    @property
    def num(self) -> int:
        """Number D of devices."""
        return self.mesh.size

    def for_batches(self, num_views: int) -> "Exchange":
        """Return the exchange that draws as many views of a batch at once as it can."""
        return dataclasses.replace(self, views_at_once=math.gcd(num_views, self.num))

    def filled_up(self, x: Array, value: float | None = None) -> Array:
        """Return rows followed by so many of a value, or copies of the last one, that D divides their number."""
        num = -x.shape[0] % self.num
        last = x[-1:] if value is None else jnp.full((1, *x.shape[1:]), value, x.dtype)
        return jnp.concatenate([x, jnp.repeat(last, num, axis=0)]) if num else x


def exchange_of(x: Any) -> Exchange | None:
    """Return the exchange among the devices over which an array is spread; None if it is on one (host)."""
    mesh = mesh_of(x)
    return None if mesh is None else Exchange(mesh)


def exchange_among(devices: Any) -> Exchange:
    """Return the exchange among devices, at least one."""
    mesh = jax.make_mesh((len(devices),), (AXIS,), axis_types=(jax.sharding.AxisType.Auto,), devices=devices)
    return Exchange(mesh)


def composite_on_devices(
    settings: CompositingSettings, exchange: Exchange, capacity: int, splats: Splats, texels: Array,
    regions: TextureRegion | None, cutoff: Array, jacobian: Array, probe: Array, rays: Array | None,
) -> Composited:  # fmt: skip
    """Composite a view as `compositor.composite` does on one device: each device a band.

    The number of pairs is the capacity that has room for the fullest band and for all that is sent to it.

    Args:
      settings, splats, texels, regions, cutoff, jacobian, probe: as for `composite`.
      exchange: the D devices. If they draw several views at once, this is called for each of them under
        `views_at_once.value_and_grad_of_views`.
      capacity: number of pairs of a whole image.
      rays: [H, W, 2] of the lens (`Camera.rays`); None of a pinhole.
    """
    draw = functools.partial(_composite_views, settings, exchange, capacity, texels, regions, rays)
    arrays = splats, cutoff, jacobian, probe
    own: Composited
    if exchange.views_at_once > 1:
        own = of_own_view(draw(*of_all_views(arrays)))
    else:
        own = jax.tree.map(lambda x: x[0], draw(*jax.tree.map(lambda x: x[None], arrays)))
    return own


def _composite_views(
    settings: CompositingSettings, exchange: Exchange, capacity: int, texels: Array,
    regions: TextureRegion | None, rays: Array | None, splats: Splats, cutoff: Array, jacobian: Array, probe: Array,
) -> Composited:  # fmt: skip
    """Composite G views, the leading axis of splats, cutoff, jacobian and probe, which share the rays of a lens."""
    num_views = cutoff.shape[0]
    num_bands = exchange.num // num_views
    splats, probe = jax.tree.map(jax.vmap(exchange.filled_up), (splats, probe))
    cutoff = jax.vmap(functools.partial(exchange.filled_up, value=-1.0))(cutoff)
    regions = jax.tree.map(exchange.filled_up, regions)
    share = share_of_a_band(num_bands)
    room = _Room(
        pairs=math.ceil(capacity * share), pairs_share=share,
        rows=min(cutoff.shape[1] // exchange.num, max(1, math.ceil(capacity * exchange.rows_per_pair))),
        rows_share=exchange.rows_per_pair,
    )  # fmt: skip
    bands = ImageBands.of(settings.grid, num_bands, exchange.border_room)
    on_device = functools.partial(_composite_band, settings, bands, room)
    rows, of_views, everywhere = P(AXIS), P(None, AXIS), P()
    channels, transmittance, num_pairs, overflow = jax.shard_map(
        on_device,
        mesh=exchange.mesh,
        in_specs=(of_views, rows, of_views, of_views, everywhere, everywhere, everywhere),
        out_specs=(P(None, AXIS), P(AXIS), everywhere, everywhere),
        check_vma=False,  # The loops of XLA do not say which devices their carries differ on.
    )(splats, regions, jax.lax.stop_gradient(cutoff), probe, texels, jacobian, bands.pixels(rays))
    height, width = settings.grid.height, settings.grid.width
    channels = channels.reshape(channels.shape[0], num_views, -1, width)[:, :, :height]
    transmittance = transmittance.reshape(num_views, -1, width)[:, :height]
    num_pairs, overflow = (jnp.broadcast_to(x, (num_views,)) for x in (num_pairs, overflow))
    return Composited(jnp.moveaxis(channels, 1, 0), transmittance, num_pairs, overflow)


def share_of_a_band(num_bands: int) -> float:
    """Return the share of the capacity for pairs that each of so many bands of a view has."""
    return min(1.0, ROOM_OF_A_BAND / num_bands)


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
    settings: CompositingSettings, bands: ImageBands, room: _Room, splats: Splats,
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
    own = settings._replace(grid=bands.own)
    lists = list_tiles(own, jax.lax.stop_gradient(splats.M), cutoff, room.pairs, pixels, height)
    channels, transmittance = composite(own, splats, texels, regions, cutoff, lists, jacobian, probe)
    if bands.num > 1:
        image = jnp.concatenate([channels, transmittance[None]])
        image = bands.to_even(image, borders[view], index, len(borders), AXIS)
        channels, transmittance = image[:-1], image[-1]
    needed = jnp.maximum(lists.num_pairs / room.pairs_share, num_sent / room.rows_share)
    is_moved_too_far = jnp.any(jax.vmap(bands.room_for)(borders) > jnp.asarray(bands.room))
    overflow = lists.overflow | (num_sent > room.rows) | is_moved_too_far
    overflow = jax.lax.pmax(overflow.astype(jnp.int32), AXIS) > 0
    return channels, transmittance, jax.lax.pmax(needed.astype(jnp.float32), AXIS), overflow


def _cut(
    settings: CompositingSettings, bands: ImageBands, M: Array, cutoff: Array, pixels: TilePixels | None
) -> tuple[Array, Array]:
    """Return the borders [G, D/G + 1] of the bands, the same on all devices, and [G, D/G, n] which bands are reached by
    each of this device's n splats.

    Args:
      settings, bands: static.
      M, cutoff: [G, n, ...] of this device's splats, as for `core.geometry.screen_bounds`.
      pixels: of all tiles, if they have rays of their own.
    """
    boxes = jax.vmap(
        lambda M, cutoff: tile_rectangles(screen_bounds(M, cutoff, settings.kernel.near_plane), settings.grid, pixels)
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
