"""Arrays on the devices of an exchange and back (host): in one process, or in several that make the same calls."""

from typing import Any

import jax
import numpy as np
from jax import Array
from jax.experimental import multihost_utils
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P

from a2tg_jax.core import spread_arrays
from a2tg_jax.core.spread_arrays import on_host, placed
from a2tg_jax.rasterize.exchange import Exchange


def spread_pixels(exchange: Exchange, pictures: Array) -> Array:
    """Return pictures [V, H, ...] with their rows of pixels spread over the devices, if D divides H (host)."""
    return placed(pictures, exchange.sharding_of(pictures.shape, axis=1))


def spread_views(exchange: Exchange, pictures: Array) -> Array:
    """Return pictures [V, H, ...] of a batch on the devices that draw them (host). Only those views are read that
    `are_drawn_here`."""
    return placed(pictures, exchange.sharding_of_pictures(*pictures.shape[:2]))


def are_drawn_here(exchange: Exchange | None, num_views: int, height: int) -> list[bool]:
    """Return whether this process's devices draw at least a part of each view of a batch."""
    if exchange is None:
        return [True] * num_views
    sharding = exchange.sharding_of_pictures(num_views, height)
    parts = sharding.addressable_devices_indices_map((num_views, height)).values()
    drawn = {view for part in parts if part is not None for view in range(num_views)[part[0]]}
    return [view in drawn for view in range(num_views)]


def everywhere(exchange: Exchange, x: Array) -> Array:
    """Return an array that every device has whole (host)."""
    return placed(x, NamedSharding(exchange.mesh, P()))


def gathered(exchange: Exchange | None, tree: Any) -> Any:
    """Return arrays on the first of this process's devices; without an exchange they stay (host).

    If the devices are of several processes, all of these must call it.
    """
    return tree if exchange is None else jax.device_put(readable(tree), exchange.mesh.local_mesh.devices.flat[0])


def readable(tree: Any) -> Any:
    """Return arrays that this process can read: those that lie on other processes' devices too are gathered (host).

    All processes must call it.
    """

    def of_leaf(x: Any) -> Any:
        return x if not isinstance(x, jax.Array) or x.is_fully_addressable else on_host(x)

    return jax.tree.map(of_leaf, tree)


def asked_by_any(exchange: Exchange | None, is_asked: bool) -> bool:
    """Return whether any of the processes asks for something (host); all of them call it."""
    if exchange is None or not exchange.is_of_processes:
        return is_asked
    return bool(np.any(multihost_utils.process_allgather(np.asarray(is_asked))))


def of_first(exchange: Exchange | None, tree: Any) -> Any:
    """Return the first process's arrays in all processes, on the host; all of them call it with arrays of the same
    shapes. With one process they stay."""
    if exchange is None or not exchange.is_of_processes:
        return tree

    def of_leaf(x: Any) -> np.ndarray:
        x = np.ascontiguousarray(x)
        told = multihost_utils.broadcast_one_to_all(x.reshape(-1).view(np.uint8))  # As bytes: JAX may round numbers.
        same: np.ndarray = np.asarray(told, np.uint8).view(x.dtype).reshape(x.shape)
        return same

    return jax.tree.map(of_leaf, tree)


def check_same(exchange: Exchange | None, tree: Any, what: str) -> None:
    """Raise ValueError unless all processes have the same arrays (host); all of them call it."""
    if exchange is not None and exchange.is_of_processes:
        spread_arrays.check_same(tree, what)
