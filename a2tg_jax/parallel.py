"""One scene on several devices, of one process or of several: the only module that divides arrays.

The step is written for one device. On a mesh of D devices, each draws V/D whole views of a batch of V. Floats of the
training state (parameters, Adam's moments, statistics) are divided by rows where D divides their number; integers, such
as the places of textures, are whole on each device. XLA moves the rest: all parameters to each device before it draws,
and the gradients of all views to the device that has the row, which sums them in the order of a single device.

A mesh of None is one device, on which these functions return what they are given; `everywhere` puts it there.
"""

import zlib
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec as P

T = TypeVar("T")
AXIS = "devices"
"""The only axis of a mesh."""


def mesh_of(devices: Sequence[jax.Device] | None) -> Mesh | None:
    """Return the mesh of two or more devices, or None for JAX's default device. ValueError: there is one or none."""
    if devices is None:
        return None
    if len(devices) < 2:
        raise ValueError(f"devices must be two or more; got {len(devices)}: for one use jax.default_device(device)")
    return jax.make_mesh((len(devices),), (AXIS,), axis_types=(AxisType.Auto,), devices=devices)


# Inside the step


def in_views(mesh: Mesh | None, function: Callable[[Any, Any], T]) -> Callable[[Any, Any], T]:
    """Return a function of (arrays that all views share, arrays [V, ...] of the views), which returns arrays [V, ...],
    so that each device calls it with its own views."""
    if mesh is None:
        return function
    # Not left to XLA, which cannot divide the call of a kernel. check_vma=False, because the loops of `xla` do not
    # declare which devices their carries differ on.
    return jax.shard_map(function, mesh=mesh, in_specs=(P(), P(AXIS)), out_specs=P(AXIS), check_vma=False)


def _sharding_of_rows(mesh: Mesh, x: Any, axis: int = 0) -> NamedSharding | None:
    """Return how the devices divide the rows of an array, along an axis; None if they cannot, or do not."""
    shape = jnp.shape(x)
    is_float = jnp.issubdtype(jnp.result_type(x), jnp.floating)
    if not is_float or len(shape) <= axis or shape[axis] % mesh.size or not shape[axis]:
        return None
    return NamedSharding(mesh, P(*[None] * axis, AXIS))


def with_rows_divided(mesh: Mesh | None, state: T) -> T:
    """Return the training state with its floats divided by rows, or whole where D does not divide these; traced."""
    if mesh is None:
        return state

    def constrained(x: Any) -> Any:
        return jax.lax.with_sharding_constraint(x, _sharding_of_rows(mesh, x) or NamedSharding(mesh, P()))

    return jax.tree.map(constrained, state)


def with_rows_of_views_divided(mesh: Mesh | None, gradients: T) -> T:
    """Return arrays [V, N, ...] of views with their rows, instead of the views, divided among the devices; traced."""
    if mesh is None:
        return gradients

    def constrained(x: Any) -> Any:
        # XLA sums what D does not divide where it is.
        sharding = _sharding_of_rows(mesh, x, axis=1)
        return x if sharding is None else jax.lax.with_sharding_constraint(x, sharding)

    return jax.tree.map(constrained, gradients)


# Between steps. All processes make the same calls.


def whole(tree: T) -> T:
    """Return copies of arrays as NumPy's, whole in each process."""

    def read(x: Any) -> np.ndarray:
        is_here = not isinstance(x, jax.Array) or x.is_fully_addressable or x.is_fully_replicated
        return np.array(x if is_here else multihost_utils.process_allgather(x, tiled=True))

    return jax.tree.map(read, tree)


def divided(mesh: Mesh | None, state: T) -> T:
    """Return a whole state, divided among the devices as `with_rows_divided` does. Processes get the first one's
    numbers. ValueError: they differ in shapes."""
    if mesh is None:
        return state
    state = _of_first_process(mesh, state)
    return jax.tree.map(lambda x: _put(x, _sharding_of_rows(mesh, x) or NamedSharding(mesh, P())), state)


def _of_first_process(mesh: Mesh, tree: T) -> T:
    """Return the first process's arrays in all processes: GPUs may round a sum differently each time."""
    if num_processes(mesh) == 1:
        return tree
    tree = whole(tree)
    shapes = repr([(x.shape, x.dtype) for x in jax.tree.leaves(tree)])
    digests = multihost_utils.process_allgather(np.asarray(zlib.crc32(shapes.encode()), np.uint32))
    if len(np.unique(digests)) > 1:
        raise ValueError("the processes differ after a change of the model: train on machines that are alike")
    of_first: T = multihost_utils.broadcast_one_to_all(tree)
    return of_first


def everywhere(mesh: Mesh | None, tree: T) -> T:
    """Return arrays that each device has whole, given the same in all processes."""
    return jax.device_put(tree) if mesh is None else jax.tree.map(lambda x: _put(x, NamedSharding(mesh, P())), tree)


def of_views(mesh: Mesh | None, batch: T) -> T:
    """Return arrays [V, ...] of a batch on the devices that draw the views, given the `views_here` of each process."""
    if mesh is None:
        return batch
    sharding = NamedSharding(mesh, P(AXIS))
    return jax.tree.map(lambda x: jax.make_array_from_process_local_data(sharding, np.asarray(x)), batch)


def views_here(mesh: Mesh | None, num_views: int) -> list[int]:
    """Return the places in a batch of V views that this process draws."""
    if mesh is None:
        return list(range(num_views))
    parts = NamedSharding(mesh, P(AXIS)).addressable_devices_indices_map((num_views,)).values()
    return sorted(view for (part,) in parts for view in range(num_views)[part])  # type: ignore[misc]


def _put(x: Any, sharding: NamedSharding) -> jax.Array:
    if sharding.is_fully_addressable:
        return jax.device_put(x, sharding)
    # `device_put` would compare the numbers of all processes.
    return jax.make_array_from_callback(jnp.shape(x), sharding, np.asarray(x).__getitem__)


# Several processes


def num_processes(mesh: Mesh | None) -> int:
    """Return the number of processes that the devices belong to."""
    return 1 if mesh is None else len({device.process_index for device in mesh.devices.flat})


def any_process(mesh: Mesh | None, is_here: bool) -> bool:
    """Return whether `is_here` holds in any process."""
    if num_processes(mesh) == 1:
        return is_here
    return bool(np.any(multihost_utils.process_allgather(np.asarray(is_here))))


def broadcast(data: bytes) -> bytes:
    """Return the first process's bytes in every process; all call it together."""
    # All must give arrays of one shape: the length comes first, as two integers that JAX does not round.
    length = multihost_utils.broadcast_one_to_all(np.asarray(divmod(len(data), 2**31), np.int32))
    size = int(length[0]) * 2**31 + int(length[1])
    padded = np.frombuffer(data.ljust(size, b"\0")[:size], np.uint8)
    return bytes(np.asarray(multihost_utils.broadcast_one_to_all(padded), np.uint8)) if size else b""


def leave() -> None:
    """End the common work; each process continues alone."""
    if jax.distributed.is_initialized():
        multihost_utils.sync_global_devices("leave")
        jax.distributed.shutdown()
