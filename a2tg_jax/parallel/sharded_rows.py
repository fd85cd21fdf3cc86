"""Placement of arrays: rows spread over the devices of a mesh, or everything on every device.

An array has its mesh in its sharding. A `Mesh | None` says where new arrays go; None is one device, where all arrays
stay unchanged. On the host, arrays are read by `on_host` and written by `placed_like`, one at a time, so that a
change takes a share of the memory of each device. All processes make the same calls.
"""

import functools
import warnings
import zlib
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P
from jax.typing import ArrayLike, DTypeLike

T = TypeVar("T")


@jax.tree_util.register_pytree_with_keys_class
class Shared:
    """Node of a pytree around arrays without rows, such as weights of a network, which every device has whole.

    `core.pytree.shared` marks fields that are in one; `core.table.map_rows` leaves it unchanged.
    """

    def __init__(self, tree: Any):
        """Args:
        tree: arrays, or any pytree of them.
        """
        self.tree = tree

    def tree_flatten_with_keys(self) -> tuple[tuple[tuple[str, Any]], None]:
        """Return the content under an empty key: paths in errors and files name the field only."""
        return (("", self.tree),), None

    @classmethod
    def tree_unflatten(cls, _: None, children: Sequence[Any]) -> "Shared":
        """Return the node around its only child."""
        return cls(*children)


def is_shared(node: object) -> bool:
    """Return whether a node of a pytree is shared by all rows, for `is_leaf` of `jax.tree`."""
    return isinstance(node, Shared)


LARGEST_PART = 2**28
"""Largest number of bytes read at a time. Each device holds them besides the array, for all processes."""


def mesh_of(x: object) -> Mesh | None:
    """Return the mesh of the devices that share an array; None for an array on one device, of NumPy, or traced."""
    sharding = None if isinstance(x, jax.core.Tracer) else getattr(x, "sharding", None)
    mesh = sharding.mesh if isinstance(sharding, NamedSharding) else None
    return mesh if isinstance(mesh, Mesh) and mesh.size > 1 else None


def num_processes(mesh: Mesh | None) -> int:
    """Return the number of processes that the devices belong to."""
    return 1 if mesh is None else len({device.process_index for device in mesh.devices.flat})


def sharding_of_rows(mesh: Mesh, shape: tuple[int, ...], axis: int = 0) -> NamedSharding:
    """Return where the rows of an array are, along one of its axes; every device has all if D does not divide them."""
    # JAX divides arrays evenly only; any other array is whole on each device.
    is_divided = len(shape) > axis and shape[axis] >= mesh.size and shape[axis] % mesh.size == 0
    return NamedSharding(mesh, P(*[None] * axis, mesh.axis_names[0]) if is_divided else P())


def spread(mesh: Mesh | None, tree: T, axis: int = 0) -> T:
    """Return arrays with their rows, along an axis, spread over the devices, or on every device if D does not divide
    them, or if they are `Shared`. Under jit it constrains where results are. ValueError: arrays that are not spread yet
    differ between processes."""
    if mesh is None:
        return tree
    own = [x for x in jax.tree.leaves(tree) if not isinstance(x, jax.core.Tracer) and _is_own(x)]
    if own and num_processes(mesh) > 1:
        digest = 0
        for x in map(np.asarray, own):
            values: Any = np.ascontiguousarray(x).view(np.uint8)
            # With the shape, which is not in the bytes.
            digest = zlib.crc32(values, zlib.crc32(repr(x.shape).encode(), digest))
        if len(np.unique(multihost_utils.process_allgather(np.asarray(digest, np.uint32)))) > 1:
            raise ValueError("the processes differ after a change of the model: train on machines that are alike")

    def at(sharding: NamedSharding, x: Any) -> Any:
        is_traced = isinstance(x, jax.core.Tracer)
        return jax.lax.with_sharding_constraint(x, sharding) if is_traced else placed(x, sharding)

    def of_leaf(x: Any) -> Any:
        if is_shared(x):
            return jax.tree.map(functools.partial(at, NamedSharding(mesh, P())), x)
        return at(sharding_of_rows(mesh, jnp.shape(x), axis), x)

    return jax.tree.map(of_leaf, tree, is_leaf=is_shared)


def everywhere(mesh: Mesh | None, tree: T) -> T:
    """Return arrays that every device has whole (host)."""
    return tree if mesh is None else jax.tree.map(lambda x: placed(x, NamedSharding(mesh, P())), tree)


def placed(x: ArrayLike, sharding: NamedSharding) -> Array:
    """Return an array whose parts are where a sharding says; other processes place theirs of an equal one."""
    if isinstance(x, jax.Array) and x.sharding.is_equivalent_to(sharding, x.ndim):
        return x
    if sharding.is_fully_addressable:
        return jax.device_put(x, sharding)
    # `device_put` cannot reach the devices of other processes; each fills its own parts.
    return jax.make_array_from_callback(jnp.shape(x), sharding, on_host(x).__getitem__)


def on_host(x: Any) -> np.ndarray:
    """Return the values of an array."""
    if _is_own(x):
        return np.asarray(x)
    if x.is_fully_replicated:
        return np.asarray(x.addressable_data(0))
    mesh = mesh_of(x)
    if mesh is None or not x.sharding.is_equivalent_to(sharding_of_rows(mesh, x.shape), x.ndim):
        whole = x if x.is_fully_addressable else multihost_utils.process_allgather(x, tiled=True)
        return np.asarray(whole)
    # Every process reads its own parts, one piece at a time, and all exchange them: no device ever holds the whole.
    starts: dict[int, list[int]] = {}  # Of each process, the first rows of the parts on its devices.
    for device, index in x.sharding.devices_indices_map(x.shape).items():
        starts.setdefault(device.process_index, []).append(index[0].start or 0)
    firsts = zip(*(sorted(own) for _, own in sorted(starts.items())), strict=True)
    found, shards = np.empty(x.shape, x.dtype), sorted(x.addressable_shards, key=lambda one: one.index[0].start or 0)
    num_rows = max(1, LARGEST_PART * len(x) // max(1, x.nbytes * len(starts)))
    for shard, rows in zip(shards, firsts, strict=True):
        for first in range(0, len(shard.data), num_rows):
            # JAX caches what is read of an array as long as the array exists, so a copy is read.
            part = np.asarray(jnp.array(shard.data[first : first + num_rows], copy=True))
            parts = part[None] if x.is_fully_addressable else multihost_utils.process_allgather(part)
            for row, values in zip(rows, parts, strict=True):
                found[row + first : row + first + len(values)] = values
    return found


def _is_own(x: object) -> bool:
    """Return whether an array is of this process alone, in one part."""
    return mesh_of(x) is None and getattr(x, "is_fully_addressable", True)


def placed_like(new: Any, old: Any) -> Array:
    """Return values of the host, their rows spread over the devices of another array, whose shape may differ, or on its
    device if it is committed to one. ValueError: several processes have different values."""
    mesh, new = mesh_of(old), np.asarray(new)
    new = new.astype(jax.dtypes.canonicalize_dtype(new.dtype), copy=False)
    if mesh is not None:
        return spread(mesh, new)
    is_fixed = _is_held(old) and old.committed and len(old.devices()) == 1
    # Compiles nothing, unlike `jnp.asarray`.
    return jax.device_put(new, next(iter(old.devices())) if is_fixed else None)


def _is_held(x: object) -> bool:
    """Return whether a value is an array of JAX with numbers, not traced."""
    return isinstance(x, jax.Array) and not isinstance(x, jax.core.Tracer)


def zeros_beside(old: object, shape: Sequence[int], dtype: DTypeLike) -> Array:
    """Return zeros, their rows spread over the devices of another array."""
    mesh = mesh_of(old)
    return jnp.zeros(shape, dtype, device=None if mesh is None else sharding_of_rows(mesh, tuple(shape)))


def rows_moved(x: Array, rows: Array | np.ndarray) -> Array:
    """Return the array whose row i is the former row rows[i].

    It is traceable. Outside jit, rows of JAX's arrays move on the host, where nothing is compiled for their number.
    """
    if not _is_held(x) or isinstance(rows, jax.core.Tracer):
        return x[rows]
    return placed_like(on_host(x)[np.asarray(rows)], x)


def rows_joined(parts: Sequence[Array]) -> Array:
    """Return the rows of several arrays, one after the other, on the devices of the first, as in `rows_moved`."""
    if not all(map(_is_held, parts)):
        return jnp.concatenate(parts)
    return placed_like(np.concatenate([on_host(part) for part in parts]), parts[0])


def rows_replaced(x: Array, rows: np.ndarray, new: ArrayLike) -> Array:
    """Return the array with other values at some rows (host)."""
    found = np.array(on_host(x))
    found[rows] = new
    return placed_like(found, x)


def readable(tree: T) -> T:
    """Return arrays that this process can read: those that are also on other processes' devices are read (host)."""
    return jax.tree.map(lambda x: x if not isinstance(x, jax.Array) or x.is_fully_addressable else on_host(x), tree)


def warn_of_uneven_rows(num: int, num_devices: int) -> None:
    """Warn if the rows of a checkpoint cannot be spread evenly over the devices, which costs memory."""
    if num % num_devices:
        fitting = [number for number in range(1, num_devices) if num % number == 0]
        warnings.warn(
            f"the checkpoint has {num:,} rows, which {num_devices} devices cannot share evenly: each holds all of "
            f"them until the stage ends; {' or '.join(map(str, fitting))} could share them",
            stacklevel=2,
        )


def asked_by_any(mesh: Mesh | None, is_asked: bool) -> bool:
    """Return whether `is_asked` holds in any process (host)."""
    if num_processes(mesh) == 1:
        return is_asked
    return bool(np.any(multihost_utils.process_allgather(np.asarray(is_asked))))


def of_first(mesh: Mesh | None, tree: T) -> T:
    """Return the first process's NumPy arrays in all processes, which have arrays of the same shapes."""
    if num_processes(mesh) == 1:
        return tree

    def of_leaf(x: Any) -> np.ndarray:
        x = np.ascontiguousarray(x)
        sent = multihost_utils.broadcast_one_to_all(x.reshape(-1).view(np.uint8))  # As bytes: JAX may round numbers.
        return np.asarray(sent, np.uint8).view(x.dtype).reshape(x.shape)

    return jax.tree.map(of_leaf, tree)


# Inside shard_map: results of foreign functions, which JAX assumes to be the same on all devices


def _axes(tree: object) -> frozenset[str]:
    """Return the axes of a mesh along which an array of a pytree varies."""
    types = [getattr(jax.typeof(leaf), "manual_axis_type", None) for leaf in jax.tree.leaves(tree)]
    return frozenset().union(*(type_.varying for type_ in types if type_ is not None))


def vary_with(inputs: object, results: T) -> T:
    """Mark the results as varying along every axis of the mesh along which an input varies."""
    axes = _axes(inputs)

    def vary(result: Array) -> Array:
        missing = tuple(sorted(axes - _axes(result)))
        return lax.pcast(result, missing, to="varying") if missing else result

    return jax.tree.map(vary, results)


def cotangent_of(primal: object, cotangent: T) -> T:
    """Sum a cotangent over the devices that share its primal value, leaf by leaf."""

    def total(value: object, cotangent: object) -> Any:
        # A value that devices share was broadcast to them; the transpose of that is a sum.
        shared = tuple(sorted(_axes(cotangent) - _axes(value)))
        return lax.psum(cotangent, shared) if shared else cotangent

    return jax.tree.map(total, primal, cotangent)
