"""Arrays whose rows are spread over the devices of a mesh: read and written on the host, one at a time (host).

A change on the host then takes a share of the memory of each device, and one array on the host. Arrays on one device
and NumPy arrays are read and written as usual. If the devices belong to several processes, all of them must make the
same calls.
"""

import zlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jax.typing import DTypeLike

LARGEST_PART = 2**28
"""Largest number of bytes read at a time. Each device holds them beside the array, for all processes."""


def mesh_of(x: Any) -> Mesh | None:
    """Return the mesh of the devices that share an array; None for an array on one device, of NumPy, or traced."""
    sharding = None if isinstance(x, jax.core.Tracer) else getattr(x, "sharding", None)
    mesh = sharding.mesh if isinstance(sharding, NamedSharding) else None
    return mesh if isinstance(mesh, Mesh) and mesh.size > 1 else None


def sharding_of_rows(mesh: Mesh, shape: tuple[int, ...], axis: int = 0) -> NamedSharding:
    """Return where the rows of an array lie, along one of its axes; every device has all if D does not divide them."""
    is_divided = len(shape) > axis and shape[axis] >= mesh.size and shape[axis] % mesh.size == 0
    return NamedSharding(mesh, P(*[None] * axis, mesh.axis_names[0]) if is_divided else P())


def on_host(x: Any) -> np.ndarray:
    """Return the values of an array."""
    if mesh_of(x) is None:
        return np.asarray(x)
    if x.is_fully_replicated:
        return np.asarray(x.addressable_data(0))
    if not x.sharding.is_equivalent_to(sharding_of_rows(x.sharding.mesh, x.shape), x.ndim):
        whole = x if x.is_fully_addressable else multihost_utils.process_allgather(x, tiled=True)
        return np.asarray(whole)
    found, starts = np.empty(x.shape, x.dtype), _starts_of_processes(x)
    own = sorted(x.addressable_shards, key=_start_of)
    num_rows = max(1, LARGEST_PART * len(x) // max(1, x.nbytes * len(starts)))
    for shard, rows in zip(own, zip(*starts, strict=True), strict=True):
        for first in range(0, len(shard.data), num_rows):
            # JAX keeps what was read of an array as long as the array lives, so a copy is read.
            part = np.asarray(jnp.array(shard.data[first : first + num_rows], copy=True))
            parts = part[None] if x.is_fully_addressable else multihost_utils.process_allgather(part)
            for row, values in zip(rows, parts, strict=True):
                found[row + first : row + first + len(values)] = values
    return found


def _start_of(shard: Any) -> int:
    start: int = shard.index[0].start or 0
    return start


def _starts_of_processes(x: Array) -> list[list[int]]:
    """Return, for each process, the first rows of the parts of an array that lie on its devices, ascending."""
    starts: dict[int, list[int]] = {}
    places: Any = x.sharding.devices_indices_map(x.shape)
    for device, index in places.items():
        starts.setdefault(device.process_index, []).append(index[0].start or 0)
    return [sorted(own) for _, own in sorted(starts.items())]


def placed(x: Any, sharding: NamedSharding) -> Array:
    """Return an array whose parts lie where a sharding says; other processes place theirs of an equal one."""
    if isinstance(x, jax.Array) and x.sharding.is_equivalent_to(sharding, x.ndim):
        return x
    if sharding.is_fully_addressable:
        array: Array = jax.device_put(x, sharding)
        return array
    return jax.make_array_from_callback(jnp.shape(x), sharding, on_host(x).__getitem__)


def placed_like(new: Any, old: Any) -> Array:
    """Return values of the host, their rows spread over the devices of another array, whose shape may differ.

    Raises:
      ValueError: if several processes have different values.
    """
    mesh = mesh_of(old)
    if mesh is None:
        return jnp.asarray(new)
    new = np.asarray(new)
    new = new.astype(jax.dtypes.canonicalize_dtype(new.dtype), copy=False)
    sharding = sharding_of_rows(mesh, new.shape)
    if not sharding.is_fully_addressable:
        check_same(new, "a change of the model")
    return placed(new, sharding)


def zeros_beside(old: Any, shape: Sequence[int], dtype: DTypeLike) -> Array:
    """Return zeros, their rows spread over the devices of another array."""
    mesh = mesh_of(old)
    return jnp.zeros(shape, dtype, device=None if mesh is None else sharding_of_rows(mesh, tuple(shape)))


def rows_moved(x: Array, rows: Any) -> Array:
    """Return the array whose row i is the former row rows[i].

    It is traceable. Outside jit, rows that are spread over devices move on the host.
    """
    if mesh_of(x) is None:
        moved: Array = x[rows]
        return moved
    return placed_like(on_host(x)[np.asarray(rows)], x)


def check_same(tree: Any, what: str) -> None:
    """Raise ValueError unless all processes have the same arrays."""
    digest = 0
    for leaf in map(np.asarray, jax.tree.leaves(tree)):
        values: Any = np.ascontiguousarray(leaf).view(np.uint8)
        digest = zlib.crc32(values, zlib.crc32(repr(leaf.shape).encode(), digest))
    if len(np.unique(multihost_utils.process_allgather(np.asarray(digest, np.uint32)))) > 1:
        raise ValueError(f"the processes differ after {what}: train on machines that are alike")
