"""Compositing on several devices: splats travel to the devices that own the pixels they reach.

N rows of splats are sharded over D devices, N/D each. The image is cut into D bands of whole rows of tiles, one for
each device. By one `all_to_all` every device sends to every other one the splats that reach its band, a fixed number
of rows; JAX transposes it, which brings the gradients back. A splat that reaches two bands travels twice.

The received rows keep the order of the model, so that a band is composited as it is on one device.
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from a2tg_jax.appearance import AppearanceRule
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.geometry import screen_bounds
from a2tg_jax.rasterize.compositor import Composited, composite_arrays
from a2tg_jax.rasterize.kernels.native import composite as native
from a2tg_jax.rasterize.kernels.packing import pack_splats, unpack_splats
from a2tg_jax.rasterize.splats import CompositingSettings, Splats
from a2tg_jax.rasterize.tiles import TileGrid, tile_lists, tile_rectangles

AXIS = "rows"
"""Axis of the mesh along which rows of splats, and bands of pixels, lie on devices."""
ROOM_OF_A_BAND = 2.0
"""Room for the pairs of a band, as a multiple of an even share of the capacity."""


@dataclasses.dataclass(frozen=True)
class Exchange:
    """Devices that render together; hashable, so that settings can hold it."""

    mesh: Mesh
    """Devices along the one axis `AXIS`."""
    rows_per_pair: float = 1.0
    """Rows that one device can send to another, as a share of the capacity for pairs (`plan_exchange`)."""

    @property
    def num(self) -> int:
        """Number D of devices."""
        return self.mesh.size

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
        is_divided = len(shape) > axis and shape[axis] >= self.num and shape[axis] % self.num == 0
        return NamedSharding(self.mesh, P(*[None] * axis, AXIS) if is_divided else P())

    def filled_up(self, x: Array, value: float | None = None) -> Array:
        """Return rows followed by so many of a value, or copies of the last one, that D divides their number."""
        num = -x.shape[0] % self.num
        last = x[-1:] if value is None else jnp.full((1, *x.shape[1:]), value, x.dtype)
        return jnp.concatenate([x, jnp.repeat(last, num, axis=0)]) if num else x


def spread(exchange: Exchange | None, tree: Any) -> Any:
    """Return arrays with their rows spread over the devices; those that D does not divide are on every device.

    Under jit it constrains where results lie; else it moves the arrays. Without an exchange they stay.
    """
    if exchange is None:
        return tree

    def of_leaf(x: Any) -> Any:
        sharding = exchange.sharding_of(jnp.shape(x))
        is_traced = isinstance(x, jax.core.Tracer)
        return jax.lax.with_sharding_constraint(x, sharding) if is_traced else placed(x, sharding)

    return jax.tree.map(of_leaf, tree)


def placed(x: Any, sharding: NamedSharding) -> Array:
    """Return an array whose parts lie where a sharding says; other processes place theirs of an equal one."""
    if sharding.is_fully_addressable:
        array: Array = jax.device_put(x, sharding)
        return array
    return jax.make_array_from_callback(jnp.shape(x), sharding, np.asarray(x).__getitem__)


def exchange_among(devices: Any) -> Exchange:
    """Return the exchange among devices, at least one."""
    mesh = jax.make_mesh((len(devices),), (AXIS,), axis_types=(jax.sharding.AxisType.Auto,), devices=devices)
    return Exchange(mesh)


@dataclasses.dataclass(frozen=True)
class Bands:
    """Bands of an image; all static."""

    whole: TileGrid
    own: TileGrid
    """Grid of one band."""
    num: int

    @staticmethod
    def of(grid: TileGrid, num: int) -> "Bands":
        rows = -(-grid.rows // num)
        return Bands(grid, TileGrid(grid.width, rows * grid.tile_size, grid.tile_size), num)

    def reached(self, M: Array, cutoff: Array, near_plane: float) -> Array:
        """Return [D, n] whether each splat's box reaches each band."""
        boxes = tile_rectangles(screen_bounds(M, cutoff, near_plane), self.whole)
        first = boxes.y0
        end = first + boxes.counts // jnp.maximum(boxes.columns, 1)
        starts = jnp.arange(self.num, dtype=jnp.int32)[:, None] * self.own.rows
        return (boxes.counts > 0) & (first < starts + self.own.rows) & (end > starts)


def composite_in_bands(
    settings: CompositingSettings, exchange: Exchange, capacity: int, splats: Splats, rule: AppearanceRule,
    cutoff: Array, jacobian: Array, probe: Array,
) -> Composited:  # fmt: skip
    """Composite as `compositor.composite` does, each device a band of the image.

    The number of pairs is the capacity that has room for the fullest band and for all that is sent to it.

    Args:
      settings, splats, rule, cutoff, jacobian, probe: as for `composite`.
      exchange: the devices.
      capacity: number of pairs of the whole image.
    """
    devices = exchange.num
    own = splats, rule.regions, probe
    (splats, regions, probe), cutoff = jax.tree.map(exchange.filled_up, own), exchange.filled_up(cutoff, -1.0)
    num_rows = cutoff.shape[0]
    share = min(1.0, ROOM_OF_A_BAND / devices)
    room = _Room(
        pairs=math.ceil(capacity * share), pairs_share=share,
        rows=min(num_rows // devices, max(1, math.ceil(capacity * exchange.rows_per_pair))),
        rows_share=exchange.rows_per_pair,
    )  # fmt: skip
    on_device = functools.partial(_composite_band, settings, Bands.of(settings.grid, devices), room, rule)
    rows, everywhere = P(AXIS), P()
    channels, transmittance, num_pairs, overflow = jax.shard_map(
        on_device,
        mesh=exchange.mesh,
        in_specs=(rows, rows, rows, rows, everywhere, everywhere),
        out_specs=(P(None, AXIS), P(AXIS), everywhere, everywhere),
        check_vma=False,  # The loops of XLA do not say which devices their carries differ on.
    )(splats, regions, jax.lax.stop_gradient(cutoff), probe, rule.texels, jacobian)
    height = settings.grid.height
    return Composited(channels[:, :height], transmittance[:height], num_pairs, overflow)


def rows_to_send(exchange: Exchange, M: Array, cutoff: Array, near_plane: float, grid: TileGrid) -> Array:
    """Return the largest number of rows that a device sends to another one for a view.

    Args:
      exchange: the D devices.
      M, cutoff, near_plane: of N splats, as for `core.geometry.screen_bounds`.
      grid: tiles of the image.
    """
    num = exchange.num
    M, cutoff = exchange.filled_up(M), exchange.filled_up(cutoff, -1.0)
    reached = Bands.of(grid, num).reached(M, cutoff, near_plane)
    return jnp.max(jnp.sum(reached.reshape(num, num, -1), axis=2, dtype=jnp.int32))


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
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return channels [D, h, W] and transmittance [h, W] of this device's band, the capacity needed, the overflow."""
    reached = bands.reached(jax.lax.stop_gradient(splats.M), cutoff, settings.near_plane)
    num_sent = jnp.max(jnp.sum(reached, axis=1, dtype=jnp.int32))
    nothing = cutoff.shape[0]
    chosen = jax.vmap(lambda mask: jnp.nonzero(mask, size=room.rows, fill_value=nothing)[0])(reached)
    send = functools.partial(_send, chosen.astype(jnp.int32))

    packed = send(jnp.concatenate([pack_splats(splats, True), probe], axis=1))
    splats = unpack_splats(packed[:, : -probe.shape[1]], splats, True)
    probe = packed[:, -probe.shape[1] :]
    cutoff = send(cutoff, fill=-1.0)
    regions = None if regions is None else TextureRegion(*(send(field) for field in regions))

    top = jax.lax.axis_index(AXIS) * bands.own.height
    M, jacobian = _shifted(splats.M, top), _shifted(jacobian[None], top)[0]
    splats = splats._replace(M=M)
    list_tiles = native.tile_lists if settings.compositor == "native" else tile_lists
    lists = list_tiles(jax.lax.stop_gradient(M), cutoff, settings.near_plane, bands.own, room.pairs)
    own = settings._replace(grid=bands.own, tile_batch=min(settings.tile_batch, bands.own.num))
    channels, transmittance = composite_arrays(own, rule, splats, texels, regions, cutoff, lists, jacobian, probe)
    is_sent = num_sent <= room.rows
    needed = jnp.maximum(lists.num_pairs / room.pairs_share, num_sent / room.rows_share)
    overflow = jax.lax.pmax((lists.overflow | ~is_sent).astype(jnp.int32), AXIS) > 0
    return channels, transmittance, jax.lax.pmax(needed.astype(jnp.float32), AXIS), overflow


def _send(chosen: Array, x: Array, fill: float = 0.0) -> Array:
    """Send the chosen rows [D, C] of an array [n, ...] to each device; return the rows received [D·C, ...]."""
    rows = jnp.take(x, chosen.reshape(-1), axis=0, mode="fill", fill_value=fill)
    received: Array = jax.lax.all_to_all(rows, AXIS, 0, 0, tiled=True)
    return received


def _shifted(M: Array, top: Array) -> Array:
    """Return homographies [N, 3, 3] to pixels counted from row `top`."""
    return M.at[:, 1].add(-top.astype(M.dtype) * M[:, 2])
