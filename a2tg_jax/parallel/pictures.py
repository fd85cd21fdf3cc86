"""Photographs of the training views on the devices that draw them (host)."""

from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from a2tg_jax.parallel.exchange import AXIS, Exchange
from a2tg_jax.parallel.rows import everywhere, placed, sharding_of_rows

VIEW_AXIS = "views"
"""Axis of a mesh of the same devices along which the views are that are drawn at once."""
PICTURES = ("images", "alphas", "masks", "depths")
"""Fields of a batch [V, H, ...] of which each device needs those that it draws. It has the others whole."""


def sharding_of_batch(exchange: Exchange, num_views: int, height: int) -> NamedSharding:
    """Return where the pictures [V, H, ...] of a batch are: each on the devices that draw its view, which share its
    rows of pixels if their number divides H.

    The g-th of G groups of devices draws the g-th part of the views, one after the other.
    """
    num_groups = exchange.views_at_once
    if num_groups == 1:
        return sharding_of_rows(exchange.mesh, (num_views, height), axis=1)
    devices = exchange.mesh.devices.reshape(num_groups, -1)
    mesh = Mesh(devices, (VIEW_AXIS, AXIS), axis_types=(jax.sharding.AxisType.Auto,) * 2)
    return NamedSharding(mesh, P(VIEW_AXIS, None if height % devices.shape[1] else AXIS))


def are_drawn_here(exchange: Exchange | None, num_views: int, height: int) -> list[bool]:
    """Return whether this process's devices draw at least a part of each view of a batch."""
    if exchange is None:
        return [True] * num_views
    sharding = sharding_of_batch(exchange, num_views, height)
    parts = sharding.addressable_devices_indices_map((num_views, height)).values()
    drawn = {view for part in parts if part is not None for view in range(num_views)[part[0]]}
    return [view in drawn for view in range(num_views)]


def on_devices(exchange: Exchange, photographs: Any, *, is_batch: bool) -> Any:
    """Return `training.batches.Photographs` with their pictures spread over the devices, the rest on every device.

    Args:
      exchange: the D devices.
      photographs: V views. The rays of their lens stay where they are.
      is_batch: whether they are a batch, of which other processes' devices may draw a part (`are_drawn_here`).
        Otherwise all devices share each picture's rows of pixels, if D divides them.
    """
    placed_fields = {}
    for name, field in photographs._asdict().items():
        if name in PICTURES and field is not None:
            shape = field.shape[:2]
            own = sharding_of_batch(exchange, *shape) if is_batch else sharding_of_rows(exchange.mesh, shape, axis=1)
            placed_fields[name] = placed(field, own)
        elif name != "rays":
            placed_fields[name] = everywhere(exchange.mesh, field)
    return photographs._replace(**placed_fields)
