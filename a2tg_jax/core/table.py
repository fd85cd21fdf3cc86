"""A block of numbers for each Gaussian, of one of several sizes, in one padded bucket for each size.

N Gaussians. A block of size (T₁, …) is [T₁, …, C], such as a texture (Tv, Tu) of C = 4 channels, or the spherical
harmonics (K,) of C = 3 colours that a Gaussian has beyond the common ones. Blocks of one size share a bucket
[capacity, T₁, …, C], whose rows past the used ones are padding. Programs are compiled for sizes and capacities, so that
only a change of these, on the host, compiles a step again.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from a2tg_jax.base.checks import check_array, check_floats, check_kind, check_mask, check_shape, plain_array, short_repr
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.core.pytree import is_shared, partition, pytree, static

T = TypeVar("T")
Size = tuple[int, ...]
Group = tuple[np.ndarray, np.ndarray]
"""Indices [n] of Gaussians, and their blocks [n, T₁, …, C], all of one size."""
KNOWN_SLACK = 1.25
"""A known shape is reused if it has at most this many times the elements of the smallest shape."""


class Shape(NamedTuple):
    """Sizes and capacities of all buckets; programs are compiled for a shape."""

    sizes: tuple[Size, ...]
    """Size of the blocks of each bucket, ascending."""
    capacities: tuple[int, ...]
    """Number of rows of each bucket."""

    @property
    def num_elements(self) -> int:
        """Number of texels, or of coefficients, padding included."""
        return sum(capacity * int(np.prod(size)) for capacity, size in zip(self.capacities, self.sizes, strict=True))


@pytree
class Table(NamedFields):
    """Blocks of all Gaussians, by size. A subclass defines how blocks are resized and what padding contains.

    Its floats are differentiable; `partition` keeps its integers from `jax.grad`.
    """

    buckets: tuple[Array, ...]
    """Bucket b is [capacity_b, *size_b, C]."""
    bucket: Array
    """[N] int32 bucket of each Gaussian."""
    row: Array
    """[N] int32 row in that bucket."""
    bucket_sizes: tuple[Size, ...] = static()
    """Size of the blocks of each bucket, ascending."""

    num_sides: ClassVar[int]
    """Number D of sides of a block."""
    padding: ClassVar[tuple[float, ...]]
    """C numbers of padding, and of what grows from an empty block."""

    def __post_init__(self) -> None:
        """Convert lists and NumPy's special arrays to plain arrays."""
        name = type(self).__name__.lower()
        if type(self.buckets) in (list, tuple):
            buckets = (plain_array(f"{name}.buckets[{index}]", bucket) for index, bucket in enumerate(self.buckets))
            object.__setattr__(self, "buckets", tuple(buckets))
        for field in ("bucket", "row"):
            object.__setattr__(self, field, plain_array(f"{name}.{field}", getattr(self, field), np.int32))

    @staticmethod
    def resized(blocks: np.ndarray, size: Size) -> np.ndarray:
        """Return blocks [M, …, C] of one size at another size (host)."""
        raise NotImplementedError

    @classmethod
    def allocate(cls, sizes: ArrayLike, values: Sequence[float], dtype: DTypeLike = jnp.float32) -> Self:
        """Return blocks of the given sizes [N, D] that hold the C `values` everywhere (host); one with sides of 0
        takes no bytes."""
        places, capacities = plan_places(np.asarray(sizes))
        shapes = zip(capacities, places.bucket_sizes, strict=True)
        return cls.placed([cls._padded(capacity, size, dtype, values) for capacity, size in shapes], places)

    @classmethod
    def placed(cls, buckets: Sequence[Any], places: "Places") -> Self:
        """Return the table of buckets and of the places that were planned for them (host)."""
        # It compiles nothing, unlike `jnp.asarray`.
        return cls(tuple(map(jax.device_put, buckets)), *places)

    @classmethod
    def _padded(cls, capacity: int, size: Size, dtype: DTypeLike, padding: Sequence[float] | None = None) -> np.ndarray:
        values = np.asarray(cls.padding if padding is None else padding, dtype)
        # A copy, because views of broadcasting are read-only.
        return np.broadcast_to(values, (capacity, *size, len(values))).copy()

    @classmethod
    def of_groups(cls, groups: Iterable[Group]) -> Self:
        """Return the table of groups that together have each of N Gaussians once; the inverse of `groups` (host)."""
        groups = [group for group in groups if len(group[0])]
        sizes = np.zeros((sum(len(ids) for ids, _ in groups), cls.num_sides), np.int64)
        for ids, blocks in groups:
            sizes[ids] = blocks.shape[1:-1]
        places, capacities = plan_places(sizes)
        dtype = np.result_type(*(blocks for _, blocks in groups)) if groups else np.float32
        shapes = zip(capacities, places.bucket_sizes, strict=True)
        buckets = [cls._padded(capacity, size, dtype) for capacity, size in shapes]
        rows = np.asarray(places.row)
        for ids, blocks in groups:
            buckets[int(places.bucket[ids[0]])][rows[ids]] = blocks
        return cls.placed(buckets, places)

    def groups(self) -> list[Group]:
        """Return a group for each bucket, its Gaussians ascending (host)."""
        bucket, row = _indices(self)
        groups = []
        for index, blocks in enumerate(self.buckets):
            ids = np.flatnonzero(bucket == index)
            groups.append((ids, np.asarray(blocks)[row[ids]]))
        return groups

    def blocks(self) -> list[np.ndarray]:
        """Return the N blocks as NumPy arrays [T₁, …, C], in the order of the Gaussians (host)."""
        block_of: dict[int, np.ndarray] = {}
        for ids, blocks in self.groups():
            block_of.update(zip(ids.tolist(), blocks, strict=True))
        return [block_of[index] for index in range(self.num)]

    @classmethod
    def of_flat(cls, sizes: np.ndarray, elements: np.ndarray) -> Self:
        """Return the table of sizes [N, D] and of what `flat` returned, which fits them (host)."""
        places, _ = plan_places(sizes)
        ends = np.cumsum(sizes.prod(axis=1))
        groups = []
        for index, size in enumerate(places.bucket_sizes):
            ids = np.flatnonzero(np.asarray(places.bucket) == index)
            # A block ends where the running sum of areas does.
            rows = ends[ids, None] + np.arange(-math.prod(size), 0)
            groups.append((ids, elements[rows].reshape(len(ids), *size, elements.shape[1])))
        return cls.of_groups(groups)

    def flat(self) -> np.ndarray:
        """Return the elements [M, C] of all blocks, block after block, each row by row (host)."""
        ends = np.cumsum(self.sizes.prod(axis=1))
        dtype = self.buckets[0].dtype if self.buckets else np.float32
        elements = np.zeros((ends[-1] if self.num else 0, len(self.padding)), dtype)
        for ids, blocks in self.groups():
            area = math.prod(blocks.shape[1:-1])
            elements[ends[ids, None] + np.arange(-area, 0)] = blocks.reshape(len(ids), area, len(self.padding))
        return elements

    @classmethod
    def joined(cls, tables: Sequence[Self]) -> Self:
        """Return the blocks of several tables, one after the other (host)."""
        groups: list[Group] = []
        start = 0
        for table in tables:
            groups += [(ids + start, blocks) for ids, blocks in table.groups()]
            start += table.num
        return cls.of_groups(groups)

    @property
    def num(self) -> int:
        """Number of Gaussians N."""
        return self.bucket.shape[0]

    @property
    def sizes(self) -> np.ndarray:
        """[N, D] integers, the sides of each block (host)."""
        sides = np.asarray(self.bucket_sizes, np.int64).reshape(-1, self.num_sides)
        return sides[np.asarray(self.bucket)]

    @property
    def shape(self) -> Shape:
        """Sizes and capacities of the buckets."""
        return Shape(self.bucket_sizes, tuple(map(len, self.buckets)))

    def count_elements(self, num: int) -> int:
        """Return the number of texels or coefficients of the first `num` Gaussians, without padding (host).

        The log calls it every few steps, so it makes no [N, D].
        """
        areas = np.asarray([np.prod(size, dtype=np.int64) for size in self.bucket_sizes], np.int64)
        return int(areas[np.asarray(self.bucket)[:num]].sum())

    def count_floats(self, num: int) -> int:
        """Return the number of floats of the first `num` Gaussians, without padding (host)."""
        return len(self.padding) * self.count_elements(num)

    # Rows

    def gather(self, rows: Array | np.ndarray) -> Self:
        """Return blocks, or moments of them, whose Gaussian i is the former rows[i] of N; traceable. ValueError: there
        are blocks of several sizes."""
        if len(self.buckets) != 1:
            name = type(self).__name__.lower()
            num = len(self.buckets)
            raise ValueError(f"{name} of {num} sizes cannot change rows: densify and prune before they grow")
        # With one bucket, row i is Gaussian i's (`plan_places`); padding follows and stays.
        (bucket,) = self.buckets
        spare = jnp.arange(len(rows), len(bucket), dtype=jnp.int32)
        moved = rows_moved(bucket, jnp.concatenate([jnp.asarray(rows, jnp.int32), spare]))
        return dataclasses.replace(self, buckets=(moved,))

    def clear(self, is_cleared: Array) -> Self:
        """Return moments of blocks, zero for the marked Gaussians [N]; traceable."""
        cleared = []
        for index, bucket in enumerate(self.buckets):
            # Gaussians of other buckets point beyond the end, where they are dropped.
            rows = jnp.where(self.bucket == index, self.row, bucket.shape[0])
            marks = jnp.zeros(bucket.shape[0], bool).at[rows].set(is_cleared, mode="drop")
            cleared.append(jnp.where(marks.reshape(-1, *[1] * (bucket.ndim - 1)), jnp.zeros_like(bucket), bucket))
        return dataclasses.replace(self, buckets=tuple(cleared))

    def take(self, rows: np.ndarray, padding: Sequence[float] | None = None) -> Self:
        """Return the blocks of the Gaussians `rows` [M], which may repeat, in buckets as small as they need (host).
        Padding is `padding` of the class, or C given numbers, such as zeros for moments."""
        places, capacities = plan_places(self.sizes[rows])
        bucket, row = _indices(self)
        old_and_new = ((bucket[rows], row[rows]), _indices(places))
        padding = padding or self.padding
        buckets = _moved(type(self), self.buckets, old_and_new, places.bucket_sizes, capacities, padding)
        return self.placed(buckets, places)

    def nearest_places(self) -> Self:
        """Return the table with int32 buckets and rows, each moved to the nearest one that exists; traced.

        `check_table` refuses places that do not exist, but cannot check traced ones, which have no values.
        """

        def clipped(index: Array, last: Any) -> Array:
            # First to the range of int32: larger integers of other dtypes would wrap around.
            given = np.iinfo(index.dtype)
            int32 = np.iinfo(np.int32)
            index = jnp.clip(index, max(int32.min, given.min), min(int32.max, given.max)).astype(jnp.int32)
            return jnp.clip(index, 0, last)

        bucket = clipped(self.bucket, len(self.buckets) - 1)
        last_rows = jnp.asarray([max(len(blocks) - 1, 0) for blocks in self.buckets], jnp.int32)
        return dataclasses.replace(self, bucket=bucket, row=clipped(self.row, last_rows[bucket]))

    def __repr__(self) -> str:
        return short_repr(self)


def is_table(leaf: object) -> bool:
    """Return whether a node of a pytree is a table, for `is_leaf` of `jax.tree`."""
    return isinstance(leaf, Table)


def is_whole(node: object) -> bool:
    """Return whether a node of a pytree is a table or shared by all Gaussians, for `is_leaf` of `jax.tree`: no array in
    it has a row for each Gaussian."""
    return is_table(node) or is_shared(node)


def map_rows(of_array: Callable[..., Any], of_table: Callable[..., Any], *trees: T) -> T:
    """Return the first tree with its rows changed: each array with a row for each Gaussian by `of_array`, each table by
    `of_table`. Both also get the arrays or tables of the other trees. What all Gaussians share (`core.pytree.shared`)
    stays as in the first tree."""

    def mapped(*nodes: Any) -> Any:
        if is_shared(nodes[0]):
            return nodes[0]
        return of_table(*nodes) if is_table(nodes[0]) else of_array(*nodes)

    return jax.tree.map(mapped, *trees, is_leaf=is_whole)


def rows_moved(x: Array, rows: Array | np.ndarray) -> Array:
    """Return the array whose row i is the former row rows[i].

    It is traceable. Outside jit, rows of JAX's arrays move on the host, where nothing is compiled for their number.
    """
    if not is_held(x) or isinstance(rows, jax.core.Tracer):
        return x[rows]
    device = x.sharding if x.committed else None
    return jax.device_put(np.asarray(x)[np.asarray(rows)], device)


def is_held(x: object) -> bool:
    """Return whether a value is an array of JAX with numbers, not traced."""
    return isinstance(x, jax.Array) and not isinstance(x, jax.core.Tracer)


# Places

_Indices = tuple[np.ndarray, np.ndarray]
"""Buckets and rows of blocks."""


class Places(NamedTuple):
    """Place of each block, as the fields of `Table`."""

    bucket: Array
    row: Array
    bucket_sizes: tuple[Size, ...]


def _indices(places: Table | Places) -> _Indices:
    return np.asarray(places.bucket), np.asarray(places.row)


def bucket_capacity(count: int) -> int:
    """Return the rows allotted to `count` blocks, rounded up to 1/16 of its power of two so that few shapes occur."""
    if count == 0:
        return 0
    # At most an eighth is spare: counts of b bits are at least 2^(b−1), and rounded up to 2^(b−4).
    granule: int = max(1, 2 ** (count.bit_length() - 4))
    return -(-count // granule) * granule


def plan_places(
    sizes: np.ndarray, known: Sequence[Shape] = (), room: Shape | None = None
) -> tuple[Places, tuple[int, ...]]:
    """Return the places of blocks of the given sizes [N, D], from 0 to 63, and the capacity of each bucket (host).

    If `room`, of any size, has space for the blocks, it is used; otherwise the smallest known shape that has, with at
    most `KNOWN_SLACK` times the elements needed, because its programs are compiled; otherwise the smallest shape.
    """
    for shape in known:
        check_kind("known", shape, Shape)
    if room is not None:
        check_kind("room", room, Shape)
    # Codes of sizes ascend as the sizes do.
    weights = 64 ** np.arange(sizes.shape[1])[::-1]
    codes, bucket, counts = np.unique(sizes @ weights, return_inverse=True, return_counts=True)
    # Stable: rows of a bucket are in the order of the Gaussians, so that equal sizes lead to equal places.
    order = np.argsort(bucket, kind="stable")
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    row = np.empty(len(sizes), np.int32)
    row[order] = np.arange(len(sizes)) - starts
    sides = map(tuple, (codes[:, None] // weights % 64).tolist())
    needed: dict[Size, int] = dict(zip(sides, counts.tolist(), strict=True))
    smallest = Shape(tuple(needed), tuple(map(bucket_capacity, needed.values())))

    def has_room(shape: Shape) -> bool:
        rows = dict(zip(*shape, strict=True))
        return all(rows.get(size, 0) >= count for size, count in needed.items())

    if not needed:
        # Without Gaussians, one bucket of no blocks keeps the number of sides and the dtype.
        shape = Shape(((0,) * sizes.shape[1],), (0,))
    elif room is not None and has_room(room):
        shape = room
    else:
        most = KNOWN_SLACK * smallest.num_elements
        fitting = [shape for shape in known if has_room(shape) and shape.num_elements <= most]
        shape = min(fitting, key=lambda shape: shape.num_elements, default=smallest)
    place = np.asarray([shape.sizes.index(size) for size in needed], np.int32)
    return Places(jax.device_put(place[bucket]), jax.device_put(row), shape.sizes), shape.capacities


def resize(
    table: Table,
    sizes: np.ndarray,
    moments: object = None,
    known: Sequence[Shape] = (),
    kept: np.ndarray | None = None,
    room: Shape | None = None,
) -> tuple[Any, Any]:
    """Return the table with its buckets rebuilt at new sizes [N, D] (host), and the moments likewise.

    Padding, and what grows from an empty block, is `Table.padding` in the table and 0 in moments.

    Moments are any pytree, such as the state of Adam: all tables in it of the same class are rebuilt, other leaves
    stay. They become 0 for blocks that are not `kept` [N]. `known` and `room` are as for `plan_places`.
    """
    places, capacities = plan_places(sizes, known, room)
    old_and_new = [_indices(table), _indices(places)]
    kept_old_and_new = old_and_new
    if kept is not None:
        check_mask("kept", kept, (table.num,))
        kept_old_and_new = [(bucket[kept], row[kept]) for bucket, row in old_and_new]
    kind = type(table)

    def rebuilt(old: Table, old_and_new: list[_Indices], padding: Sequence[float]) -> Table:
        targets = _moved(kind, old.buckets, old_and_new, places.bucket_sizes, capacities, padding)
        whole = kind.placed(targets, places)
        return partition(whole)[0] if old.bucket is None else whole  # Moments are floats only.

    def rebuilt_moments(leaf: object) -> Any:
        if not isinstance(leaf, kind):
            return leaf
        if len(leaf.buckets) != len(table.buckets) or leaf.bucket_sizes != table.bucket_sizes:
            raise ValueError(f"moments must have the buckets of the table; got {leaf}")
        for index, (moment, blocks) in enumerate(zip(leaf.buckets, table.buckets, strict=True)):
            check_shape(f"moments.buckets[{index}]", moment, blocks.shape)
        return rebuilt(leaf, kept_old_and_new, (0.0,) * len(kind.padding))

    moments = jax.tree.map(rebuilt_moments, moments, is_leaf=lambda leaf: isinstance(leaf, kind))
    return rebuilt(table, old_and_new, kind.padding), moments


def _moved(
    kind: type[Table], buckets: Sequence[Any], old_and_new: Sequence[_Indices], sizes: Sequence[Size],
    capacities: Sequence[int], padding: Sequence[float],
) -> list[np.ndarray]:  # fmt: skip
    """Return new buckets of given sizes and capacities, with blocks moved from old to new (bucket, row)."""
    dtype = buckets[0].dtype if buckets else np.float32
    targets = [kind._padded(capacity, size, dtype, padding) for capacity, size in zip(capacities, sizes, strict=True)]
    (old_bucket, old_row), (new_bucket, new_row) = old_and_new
    for index, bucket in enumerate(buckets):
        from_here = np.flatnonzero(old_bucket == index)
        # Blocks with a side of 0 have nothing to move.
        if not bucket.size or not len(from_here):
            continue
        source = np.asarray(bucket)  # Each old bucket is read once, one after the other.
        for target in np.unique(new_bucket[from_here]).tolist():
            ids = from_here[new_bucket[from_here] == target]
            targets[target][new_row[ids]] = kind.resized(source[old_row[ids]], sizes[target])
    return targets


# Checks


def check_table(table: Table, num: int | None = None, name: str = "textures") -> None:
    """Raise ValueError, naming the field, unless the fields fit each other and `num` Gaussians, if given.

    Buckets and rows are compared with the capacities where they have values, which tracers do not.
    """
    check_array(f"{name}.bucket", table.bucket)
    check_array(f"{name}.row", table.row)
    check_shape(f"{name}.bucket", table.bucket, ("N",))
    if num is not None and table.num != num:
        raise ValueError(f"{name} are of {table.num} Gaussians, but there are {num} gaussians")
    check_shape(f"{name}.row", table.row, (table.num,))
    if len(table.buckets) != len(table.bucket_sizes):
        counts = f"{len(table.buckets)} buckets and {len(table.bucket_sizes)} sizes"
        raise ValueError(f"{name} must have one bucket for each of bucket_sizes; they have {counts}")
    for number, (bucket, size) in enumerate(zip(table.buckets, table.bucket_sizes, strict=True)):
        check_array(f"{name}.buckets[{number}]", bucket)
        check_floats(f"{name}.buckets[{number}]", bucket, ("capacity", *size, len(table.padding)))
    for field, index in (("bucket", table.bucket), ("row", table.row)):
        if not jnp.issubdtype(index.dtype, jnp.integer):
            raise ValueError(f"{name}.{field} must be integers; got {index.dtype}")
    if table.num and not any(len(bucket) for bucket in table.buckets):
        raise ValueError(f"{name} must have a row for each of {table.num} Gaussians; all buckets are empty")
    if not table.num or any(isinstance(leaf, jax.core.Tracer) for leaf in (table.bucket, table.row)):
        return
    places = np.asarray(table.bucket)
    last = len(table.buckets) - 1
    if places.min() < 0 or places.max() > last:
        raise ValueError(f"{name}.bucket must be 0 to {last}; got {places.min()} to {places.max()}")
    rows = np.asarray(table.row)
    capacities = np.asarray([len(blocks) for blocks in table.buckets])[places]
    outside = np.flatnonzero((rows < 0) | (rows >= capacities))
    if outside.size:
        first = outside[0]
        raise ValueError(
            f"{name}.row must be below the number of blocks in the bucket, {capacities[first]} in bucket "
            f"{places[first]}; got {rows[first]} for Gaussian {first} (of {outside.size} rows out of range)"
        )


def check_places(table: Table, name: str = "textures") -> None:
    """Raise ValueError unless each block has its own row; the table must have passed `check_table` (host)."""
    bucket, row = _indices(table)
    capacities = np.asarray([len(blocks) for blocks in table.buckets], np.int64)
    # With the rows of all buckets numbered through, equal numbers are shared rows.
    starts = np.cumsum(capacities) - capacities
    if bucket.size and np.bincount(starts[bucket] + row).max() > 1:
        raise ValueError(f"{name} must have a row for each Gaussian; some share one")
