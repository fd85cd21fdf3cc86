"""How splats reach the pixels that need them: compositing on several devices.

N rows of splats are sharded over D devices, N/D each. G views are drawn at once, where G divides D. Each image is cut
into D/G bands of whole rows of tiles, one for each device, with about as many pairs in each (`ImageBands`). By one
`all_to_all` every device sends to every other one the splats that reach its band, a fixed number of rows; JAX
transposes it, which brings the gradients back. A splat that reaches two bands travels twice. The pixels then move to
the devices that have them in an even cut of the image, because JAX divides arrays evenly; usually only a few rows go to
neighbours.

The received rows keep the order of the model, so that a band is composited as on one device.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P

from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.geometry import screen_bounds
from a2tg_jax.parallel.sharded_rows import everywhere, mesh_of, placed, sharding_of_rows
from a2tg_jax.rasterize.compositor import Composited, composite, list_tiles
from a2tg_jax.rasterize.splats import PassSettings, Splats, pack_splats, unpack_splats
from a2tg_jax.rasterize.tile_pixels import TilePixels, band_pixels, tile_pixels
from a2tg_jax.rasterize.tiles import Rectangles, TileGrid, tile_rectangles

T = TypeVar("T")

EMPTY_TILES = 10
"""Rows of tiles without pairs that together cost as much as a mean row. Their cost keeps borders near an even cut in an
image that is mostly empty; in return the fullest band may have a tenth more pairs."""
COST_BITS = 29
"""Bits of the cost of an image."""


class BorderRoom(NamedTuple):
    """Rows of pixels by which a border between two bands may differ from the border of an even cut; static."""

    above: int
    below: int


class Hop(NamedTuple):
    """Pixels that each device sends to the one of another band of its view; all static."""

    bands: int  # Number of bands to the other one; negative upwards.
    first: int  # First of the rows of pixels, in the other one's share of an even cut.
    rows: int


class ImageBands(NamedTuple):
    """Bands of each view; all static."""

    whole: TileGrid  # Of a view.
    num: int  # Number B of bands of a view.
    room: BorderRoom

    @staticmethod
    def of(grid: TileGrid, num: int, room: BorderRoom | None = None) -> "ImageBands":
        """Return the bands of a view, with room for any borders by default."""
        # A border is at most at the end of the tiles, and in an even cut at most at the end of the devices' rows.
        most = max(grid.rows * grid.tile_size, num * -(-grid.height // num)) if num > 1 else 0
        return ImageBands(grid, num, BorderRoom(*(min(most, own) for own in room or (most, most))))

    @property
    def even_height(self) -> int:
        """Rows of pixels that each device has of an even cut; the last ones may be below the image."""
        return -(-self.whole.height // self.num)

    @property
    def own(self) -> TileGrid:
        """Grid with room for any of the bands."""
        size = self.whole.tile_size
        rows = -(-(self.even_height + self.room.above + self.room.below) // size)
        return self.whole._replace(height=min(rows * size, self.whole.height))

    def pixels(self, rays: Array | None) -> TilePixels | None:
        """Return the pixels of all tiles, and of enough below the image for the grid of any band; None for a pinhole
        camera."""
        return None if rays is None else tile_pixels(rays, self.whole.tile_size, self.whole.rows + self.own.rows)

    def pairs_of_rows(self, boxes: Rectangles) -> Array:
        """Return the number of pairs in each row of tiles, [rows] int32."""
        # Counts are columns times rows of tiles.
        end = boxes.y0 + boxes.counts // jnp.maximum(boxes.columns, 1)
        columns = jnp.where(boxes.counts > 0, boxes.columns, 0)
        # Each box adds its columns at its first row and takes them away after its last: the running sum is the count.
        ends = jnp.zeros(self.whole.rows + 1, jnp.int32).at[boxes.y0].add(columns).at[end].add(-columns)
        return jnp.cumsum(ends)[:-1]

    def borders(self, pairs: Array) -> Array:
        """Return the first row of tiles of each band, and the end of the last one: [B + 1] int32, ascending, given the
        number of pairs in each row of tiles [rows]."""
        rows = self.whole.rows
        if self.num == 1:
            return jnp.asarray([0, rows], jnp.int32)
        # Integers only, so that all devices find the same. Counts are shifted so that their sum has COST_BITS bits.
        pairs = jnp.maximum(pairs, 0)
        bits = 32 - jax.lax.clz(jnp.max(pairs)) + rows.bit_length()
        pairs = pairs >> jnp.maximum(bits - COST_BITS, 0)
        cost = pairs + jnp.sum(pairs) // (rows * EMPTY_TILES) + 1
        ends = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(cost)])
        number = jnp.arange(self.num + 1, dtype=jnp.int32)
        wanted = ends[-1] // self.num * number + ends[-1] % self.num * number // self.num  # Without overflow.
        after = jnp.searchsorted(ends, wanted, method="compare_all").astype(jnp.int32)
        before = jnp.maximum(after - 1, 0)
        return jnp.where(wanted - ends[before] < ends[after] - wanted, before, after)

    def sums(self, pairs: Array, borders: Array) -> Array:
        """Return the number of pairs in each band, [B] int32, of those in each row of tiles [rows]."""
        ends = jnp.concatenate([jnp.zeros(1, pairs.dtype), jnp.cumsum(pairs)])
        return jnp.diff(ends[borders])

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
        yield Hop(0, 0, height)  # To itself.
        # A border that moves by more than the height of a share uncovers rows of bands further away.
        for number in range(1, self.num):
            below, above = (min(height, room - (number - 1) * height) for room in (self.room.below, self.room.above))
            if below > 0:
                yield Hop(number, 0, below)
            if above > 0:
                yield Hop(-number, height - above, above)

    def to_even(self, image: Array, borders: Array, device: Array, num_views: int, axis: str) -> Array:
        """Return the pixels [C, `even_height`, W] of this device in an even cut, from the bands of all devices.

        The image [C, `own.height`, W] begins with the first row of this device's band, in the borders of its
        view. Devices of several views follow each other along the axis, inside `shard_map`.
        """
        band, height = device % self.num, self.even_height
        first, end = self.pixels_of(borders, band)
        even = jnp.zeros((image.shape[0], height, image.shape[2]), image.dtype)
        for hop in self.hops():
            top = (band + hop.bands) * height + hop.first
            rows = top + jnp.arange(hop.rows, dtype=jnp.int32)
            # Rows of others are read outside the image, where there are zeros.
            places = rows - first + jnp.where(rows < end, 0, image.shape[1])
            sent: Array = image.at[:, places].get(
                mode="fill", fill_value=0, wrap_negative_indices=False, unique_indices=True, indices_are_sorted=True
            )
            if hop.bands:
                own = [d for d in range(self.num * num_views) if 0 <= d % self.num + hop.bands < self.num]
                sent = jax.lax.ppermute(sent, axis, [(d, d + hop.bands) for d in own])
            even = even.at[:, hop.first : hop.first + hop.rows].add(sent)
        return even


AXIS = "rows"
"""Axis of the mesh along which rows of splats, and bands of pixels, are spread over devices."""
ROOM_OF_A_BAND = 1.5
"""Room for the pairs of a band, as a multiple of an even share of the capacity."""


@dataclasses.dataclass(frozen=True)
class Exchange:
    """Devices that render together; hashable, so that settings can hold it."""

    mesh: Mesh  # Devices along the one axis `AXIS`.
    rows_per_pair: float = 1.0  # Rows that one device can send to another, as a share of the capacity for pairs.
    border_room: BorderRoom | None = None  # For the borders between bands; None: for any borders.
    views_at_once: int = 1  # Number of views that are drawn at once (`value_and_grad_of_views`); a divisor of D.

    @property
    def num(self) -> int:
        """Number D of devices."""
        return self.mesh.size

    def for_batches(self, num_views: int) -> "Exchange":
        """Return the exchange that draws as many views of a batch at once as it can."""
        return dataclasses.replace(self, views_at_once=math.gcd(num_views, self.num))

    def filled_up(self, x: Array, value: float | None = None) -> Array:
        """Return rows, filled up to a multiple of D with a value or copies of the last row."""
        num = -x.shape[0] % self.num
        last = x[-1:] if value is None else jnp.full((1, *x.shape[1:]), value, x.dtype)
        return jnp.concatenate([x, jnp.repeat(last, num, axis=0)]) if num else x


def exchange_of(x: object) -> Exchange | None:
    """Return the exchange among the devices over which an array is spread; None if it is on one (host)."""
    mesh = mesh_of(x)
    return None if mesh is None else Exchange(mesh)


def exchange_among(devices: Sequence[jax.Device]) -> Exchange:
    """Return the exchange among devices, at least one."""
    mesh = jax.make_mesh((len(devices),), (AXIS,), axis_types=(jax.sharding.AxisType.Auto,), devices=devices)
    return Exchange(mesh)


def composite_on_devices(
    settings: PassSettings, exchange: Exchange, capacity: int, splats: Splats, texels: Array,
    regions: TextureRegion | None, cutoff: Array, jacobian: Array, probe: Array, rays: Array | None,
) -> Composited:  # fmt: skip
    """Composite a view as `compositor.composite` does on one device, with its arguments: each device a band.

    The capacity is the number of pairs of a whole image; the result's number of pairs is the capacity with room for the
    fullest band and for all that is sent to it. `value_and_grad_of_views` calls this for each view that is drawn at
    once. The rays [H, W, 2] of the lens are `Camera.rays`.
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
    settings: PassSettings, exchange: Exchange, capacity: int, texels: Array,
    regions: TextureRegion | None, rays: Array | None, splats: Splats, cutoff: Array, jacobian: Array, probe: Array,
) -> Composited:  # fmt: skip
    """Composite G views, the leading axis of splats, cutoff, jacobian and probe, which share the rays of a lens."""
    num_views = cutoff.shape[0]
    num_bands = exchange.num // num_views
    splats, probe = jax.tree.map(jax.vmap(exchange.filled_up), (splats, probe))
    cutoff = jax.vmap(functools.partial(exchange.filled_up, value=-1.0))(cutoff)
    regions = jax.tree.map(exchange.filled_up, regions)
    bands = ImageBands.of(settings.grid, num_bands, exchange.border_room)
    on_device = functools.partial(_composite_band, settings, exchange, capacity, bands)
    rows, of_views, whole = P(AXIS), P(None, AXIS), P()
    channels, transmittance, num_pairs, overflow = jax.shard_map(
        on_device,
        mesh=exchange.mesh,
        in_specs=(of_views, rows, of_views, of_views, whole, whole, whole),
        out_specs=(of_views, rows, whole, whole),
        check_vma=False,  # The loops of XLA do not say which devices their carries differ on.
    )(splats, regions, jax.lax.stop_gradient(cutoff), probe, texels, jacobian, bands.pixels(rays))
    height, width = settings.grid.height, settings.grid.width
    channels = channels.reshape(channels.shape[0], num_views, -1, width)[:, :, :height]
    transmittance = transmittance.reshape(num_views, -1, width)[:, :height]
    num_pairs, overflow = (jnp.broadcast_to(x, (num_views,)) for x in (num_pairs, overflow))
    return Composited(jnp.moveaxis(channels, 1, 0), transmittance, num_pairs, overflow)


def share_of_a_band(num_bands: int) -> float:
    """Return the share of the capacity for pairs that each band of a view has."""
    return min(1.0, ROOM_OF_A_BAND / num_bands)


def _composite_band(
    settings: PassSettings, exchange: Exchange, capacity: int, bands: ImageBands, splats: Splats,
    regions: TextureRegion | None, cutoff: Array, probe: Array, texels: Array, jacobian: Array,
    pixels: TilePixels | None,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return channels [C, h, W] and transmittance [h, W] of this device's pixels, the capacity needed, the overflow."""
    pairs_share, (num_views, num) = share_of_a_band(bands.num), cutoff.shape
    most_pairs = math.ceil(capacity * pairs_share)
    most_sent = min(num, max(1, math.ceil(capacity * exchange.rows_per_pair)))
    # Borders of bands [G, D/G + 1], the same on all devices, and which bands are reached by each of its n splats.
    boxes = jax.vmap(
        lambda M, cutoff: tile_rectangles(screen_bounds(M, cutoff, settings.near_plane), settings.grid, pixels)
    )(jax.lax.stop_gradient(splats.M), cutoff)
    most = jnp.int32((2**31 - 1) // exchange.num)  # No sum over devices overflows.
    pairs = jax.lax.psum(jnp.clip(jax.vmap(bands.pairs_of_rows)(boxes), 0, most), AXIS)
    borders = jax.vmap(bands.borders)(pairs)
    reached = jax.vmap(bands.reached)(boxes, borders)
    num_sent = jnp.max(jnp.sum(reached, axis=2, dtype=jnp.int32))
    # The rows that reach each of D bands, [D, most_sent], among [n] and among [G·n] rows; n and G·n stand for none.
    rows_of = functools.partial(jnp.nonzero, size=most_sent, fill_value=num)
    chosen: Array = jax.vmap(jax.vmap(lambda mask: rows_of(mask)[0].astype(jnp.int32)))(reached)
    starts = jnp.arange(num_views, dtype=jnp.int32)[:, None, None] * num
    of_views = jnp.where(chosen < num, chosen + starts, num_views * num).reshape(-1, most_sent)
    send, chosen = functools.partial(_send, of_views), chosen.reshape(-1, most_sent)

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
    M = jax.lax.stop_gradient(splats.M)
    lists = list_tiles(own.compositor, M, cutoff, own.near_plane, own.grid, most_pairs, pixels, height)
    channels, transmittance = composite(own, splats, texels, regions, cutoff, lists, jacobian, probe)
    if bands.num > 1:
        image = jnp.concatenate([channels, transmittance[None]])
        image = bands.to_even(image, borders[view], index, len(borders), AXIS)
        channels, transmittance = image[:-1], image[-1]
    # As a capacity of a whole image, of which bands and messages have fixed shares.
    needed = jnp.maximum(lists.num_pairs / pairs_share, num_sent / exchange.rows_per_pair)
    is_moved_too_far = jnp.any(jax.vmap(bands.room_for)(borders) > jnp.asarray(bands.room))
    overflow = lists.overflow | (num_sent > most_sent) | is_moved_too_far
    overflow = jax.lax.pmax(overflow.astype(jnp.int32), AXIS) > 0
    return channels, transmittance, jax.lax.pmax(needed.astype(jnp.float32), AXIS), overflow


def _send(chosen: Array, x: Array, fill: float = 0.0) -> Array:
    """Send the chosen rows [D, C] of an array [n, ...] to each device; return the rows received [D·C, ...]."""
    rows = jnp.take(x, chosen.reshape(-1), axis=0, mode="fill", fill_value=fill)
    return jax.lax.all_to_all(rows, AXIS, 0, 0, tiled=True)


def _shifted(M: Array, top: Array) -> Array:
    """Return homographies [N, 3, 3] to pixels counted from row `top`."""
    # y − top = (M₁ − top·M₂)·p / (M₂·p) with p = (u, v, 1).
    return M.at[:, 1].add(-top.astype(M.dtype) * M[:, 2])


# Several views that devices draw at once: a function of one view under `jax.vmap`. Where the views meet, in
# `composite_on_devices`, each of them gets all of them (`of_all_views`), and takes its own from the result
# (`of_own_view`). Derivatives are taken around the `jax.vmap`, since views that share their devices are drawn, and
# differentiated, together.

VIEWS_AXIS = "views_at_once"
"""Axis of `jax.vmap` along which the views are that are drawn at once."""


def value_and_grad_of_views(
    loss: Callable[..., tuple[Array, object]], num_views: int, axes: object
) -> Callable[..., Any]:
    """Return `jax.value_and_grad(loss, (0, 1, 2, 3), has_aux=True)` for G views at once.

    Results have a leading axis [G, ...], except the gradient in `appearance`, a mean over the views. The loss is a
    function of (gaussians, appearance, rows, probe, view), which returns a scalar and any auxiliary value. `rows` and
    `view`, mapped along `axes`, are of each view; the others are shared.
    """

    def of_views(gaussians: Any, appearance: object, rows: object, probe: object, views: object) -> tuple[Array, Any]:
        # Views share only the appearance, so the gradient of the sum keeps all others apart.
        of_each = jax.vmap(loss, in_axes=(0, None, 0, 0, axes), axis_name=VIEWS_AXIS)
        values, aux = of_each(gaussians, appearance, rows, probe, views)
        return jnp.sum(values), (values, aux)

    def differentiated(gaussians: object, appearance: object, rows: object, probe: object, views: object) -> Any:
        # Each view has its own copy, since events need the gradient of each view.
        copy = lambda x: jnp.broadcast_to(x, (num_views, *x.shape))  # noqa: E731
        gaussians, probe = jax.tree.map(copy, (gaussians, probe))
        with_gradients = jax.value_and_grad(of_views, argnums=(0, 1, 2, 3), has_aux=True)
        (_, found), (of_gaussians, sums, *others) = with_gradients(gaussians, appearance, rows, probe, views)
        return found, (of_gaussians, jax.tree.map(lambda x: x / num_views, sums), *others)

    return differentiated


def map_views(function: Callable[[Any], tuple[Any, Any]], views: object, num_at_once: int) -> tuple[Any, Any]:
    """Return what `jax.lax.map` does, of a function of G views [G, ...] at a time, where G divides V.

    Each of the G groups of devices draws V/G views, one after the other, and needs only their photographs
    (`sharding_of_batch`).
    The function returns results of the views, which come back as [V, ...], and results that they share, [V/G, ...].
    """
    # Group g draws the g-th part of the views, a view a round: `lax.map` goes along the rounds.
    rounds = jax.tree.map(lambda x: x.reshape(num_at_once, -1, *x.shape[1:]).swapaxes(0, 1), views)
    of_views, shared = jax.lax.map(function, rounds)
    of_views = jax.tree.map(lambda x: x.swapaxes(0, 1).reshape(-1, *x.shape[2:]), of_views)
    return of_views, shared


def of_all_views(tree: T) -> T:
    """Return the arrays [G, ...] of all views that are drawn at once."""
    return jax.tree.map(lambda x: jax.lax.all_gather(x, VIEWS_AXIS), tree)


def of_own_view(views: T) -> T:
    """Return this view's part of arrays [G, ...] of all views."""
    return _own(views, jax.lax.axis_index(VIEWS_AXIS))


@jax.custom_batching.custom_vmap
def _own(views: T, index: Array) -> T:
    return jax.tree.map(lambda x: x[index], views)


@_own.def_vmap
def _all(size: int, is_batched: object, views: object, index: Array) -> tuple[Any, Any]:
    # Indexing would be a gather, for which XLA may bring all views to every device.
    return views, jax.tree.map(lambda _: True, views)


# Photographs of the training views on the devices that draw them (host)

GROUP_AXIS = "views"
"""Axis of a mesh of the same devices along which their groups are."""
PICTURES = ("images", "alphas", "masks", "depths")
"""Fields of a batch [V, H, ...] that devices share. Each device has the others whole."""


def sharding_of_batch(exchange: Exchange, num_views: int, height: int) -> NamedSharding:
    """Return where the pictures [V, H, ...] of a batch are: each on the group of devices that draws its view, which
    share its rows of pixels if their number divides H. The g-th of G groups draws the g-th part of the views."""
    num_groups = exchange.views_at_once
    if num_groups == 1:
        return sharding_of_rows(exchange.mesh, (num_views, height), axis=1)
    devices = exchange.mesh.devices.reshape(num_groups, -1)
    mesh = Mesh(devices, (GROUP_AXIS, AXIS), axis_types=(jax.sharding.AxisType.Auto,) * 2)
    return NamedSharding(mesh, P(GROUP_AXIS, None if height % devices.shape[1] else AXIS))


def are_drawn_here(exchange: Exchange | None, num_views: int, height: int) -> list[bool]:
    """Return whether this process's devices draw at least a part of each view of a batch."""
    if exchange is None:
        return [True] * num_views
    sharding = sharding_of_batch(exchange, num_views, height)
    parts = sharding.addressable_devices_indices_map((num_views, height)).values()
    drawn = {view for part in parts if part is not None for view in range(num_views)[part[0]]}
    return [view in drawn for view in range(num_views)]


def on_devices(exchange: Exchange, photographs: Any, *, is_batch: bool) -> Any:
    """Return `training.batches.Photographs` of V views with their pictures spread over the devices that draw them, for
    a batch, or otherwise over all devices; the rest is on every device, and the rays of a lens stay where they are."""
    placed_fields = {}
    for name, field in photographs._asdict().items():
        if name in PICTURES and field is not None:
            shape = field.shape[:2]
            own = sharding_of_batch(exchange, *shape) if is_batch else sharding_of_rows(exchange.mesh, shape, axis=1)
            placed_fields[name] = placed(field, own)
        elif name != "rays":
            placed_fields[name] = everywhere(exchange.mesh, field)
    return photographs._replace(**placed_fields)
