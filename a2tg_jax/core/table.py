"""A block of numbers for each Gaussian, of one of several sizes, in one padded bucket for each size.

N Gaussians. A block of size (T₁, …) is [T₁, …, C], such as a texture (Tv, Tu) of C = 4 channels, or the spherical
harmonics (K,) of C = 3 colours that a Gaussian has beyond the common ones. Blocks of one size share a bucket
[capacity, T₁, …, C], whose rows past the used ones are padding. The place of a block is its bucket and its row in it.
Sizes and capacities are the layout of the buckets. Programs are compiled for it, so that only a change of the layout,
on the host, compiles a step again.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from a2tg_jax.base.checks import check_array, check_floats, check_kind, check_mask, check_shape, plain_array, short_repr
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.core.numerics import where_rows
from a2tg_jax.core.pytree import is_shared, partition, pytree, static

T = TypeVar("T")
Size = tuple[int, ...]
Group = tuple[np.ndarray, np.ndarray]
"""Indices [n] of Gaussians, and their blocks [n, T₁, …, C], all of one size."""
KNOWN_SLACK = 1.25
"""A known layout is reused if it has at most this many times the elements of the smallest one."""


def bucket_capacity(count: int) -> int:
    """Return the rows allotted to `count` blocks, rounded up to 1/16 of its power of two so that few layouts occur."""
    if count == 0:
        return 0
    # At most an eighth is spare: counts of b bits are at least 2^(b−1), and rounded up to 2^(b−4).
    granule: int = max(1, 2 ** (count.bit_length() - 4))
    return -(-count // granule) * granule


class Layout(NamedTuple):
    """Sizes and capacities of all buckets."""

    sizes: tuple[Size, ...]
    """Size of the blocks of each bucket, ascending."""
    capacities: tuple[int, ...]
    """Number of rows of each bucket."""

    @staticmethod
    def of(counts: Mapping[Size, int]) -> "Layout":
        """Return the smallest layout for numbers of blocks by size, ascending."""
        return Layout(tuple(counts), tuple(map(bucket_capacity, counts.values())))

    @property
    def num_elements(self) -> int:
        """Number of texels, or of coefficients, padding included."""
        return sum(math.prod(size) * capacity for size, capacity in zip(*self, strict=True))

    def has_room(self, counts: Mapping[Size, int]) -> bool:
        """Return whether numbers of blocks by size fit."""
        rows = dict(zip(*self, strict=True))
        return all(rows.get(size, 0) >= count for size, count in counts.items())


class Places(NamedTuple):
    """Place of each block."""

    bucket: Array
    row: Array
    layout: Layout


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

    num_axes: ClassVar[int]
    """Number D of axes of a block, channels excluded."""
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
        """Return blocks of the given sizes [N, D] that hold the C `values` everywhere (host); one of size 0 takes no
        bytes."""
        places = plan_places(np.asarray(sizes))
        return cls.placed(_filled(places.layout, values, dtype), places)

    @classmethod
    def placed(cls, buckets: Sequence[np.ndarray], places: Places) -> Self:
        """Return the table of buckets and of the places that were planned for them (host)."""
        # It compiles nothing, unlike `jnp.asarray`.
        return cls(tuple(map(jax.device_put, buckets)), places.bucket, places.row, places.layout.sizes)

    @classmethod
    def of_groups(cls, groups: Iterable[Group]) -> Self:
        """Return the table of groups that together have each of N Gaussians once; the inverse of `groups` (host)."""
        groups = [group for group in groups if len(group[0])]
        sizes = np.zeros((sum(len(ids) for ids, _ in groups), cls.num_axes), np.int64)
        for ids, blocks in groups:
            sizes[ids] = blocks.shape[1:-1]
        places = plan_places(sizes)
        dtype = np.result_type(*(blocks for _, blocks in groups)) if groups else np.float32
        buckets = _filled(places.layout, cls.padding, dtype)
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
        empty = cls.allocate(sizes, cls.padding, elements.dtype)
        return cls.of_groups((ids, elements[rows].reshape(blocks.shape)) for ids, blocks, rows in empty._flat_groups())

    def flat(self) -> np.ndarray:
        """Return the elements [M, C] of all blocks, block after block, each row by row (host)."""
        elements = np.zeros((self.count_elements(self.num), len(self.padding)), self.dtype)
        for _, blocks, rows in self._flat_groups():
            elements[rows] = blocks.reshape(*rows.shape, len(self.padding))
        return elements

    def _flat_groups(self) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield each group, and the rows [n, T₁·…] of its elements in `flat`."""
        ends = np.cumsum(self.sizes.prod(axis=1))
        for ids, blocks in self.groups():
            # A block ends where the running sum of its elements and those before does.
            yield ids, blocks, ends[ids, None] + np.arange(-math.prod(blocks.shape[1:-1]), 0)

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
        """[N, D] integers, the size of each block (host)."""
        sizes = np.asarray(self.bucket_sizes, np.int64).reshape(-1, self.num_axes)
        return sizes[np.asarray(self.bucket)]

    @property
    def layout(self) -> Layout:
        """Sizes and capacities of the buckets."""
        return Layout(self.bucket_sizes, tuple(map(len, self.buckets)))

    @property
    def dtype(self) -> DTypeLike:
        """Dtype of the blocks."""
        return self.buckets[0].dtype if self.buckets else np.float32

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
            cleared.append(where_rows(marks, jnp.zeros_like(bucket), bucket))
        return dataclasses.replace(self, buckets=tuple(cleared))

    def take(self, rows: np.ndarray, padding: Sequence[float] | None = None) -> Self:
        """Return the blocks of the Gaussians `rows` [M], which may repeat, in buckets as small as they need (host).
        Padding is `padding` of the class, or C given numbers, such as zeros for moments."""
        bucket, row = _indices(self)
        ids = np.arange(len(rows))
        return _rebuilt(self, (bucket[rows], row[rows]), ids, plan_places(self.sizes[rows]), padding or self.padding)

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

TableT = TypeVar("TableT", bound=Table)
_Indices = tuple[np.ndarray, np.ndarray]
"""Buckets and rows of blocks."""


def _indices(table: Table) -> _Indices:
    return np.asarray(table.bucket), np.asarray(table.row)


def plan_places(sizes: np.ndarray, known: Sequence[Layout] = (), room: Layout | None = None) -> Places:
    """Return the places of blocks of the given sizes [N, D], from 0 to 63, in a layout of `choose_layout` (host)."""
    # Codes of sizes ascend as the sizes do.
    weights = 64 ** np.arange(sizes.shape[1])[::-1]
    codes, group, counts = np.unique(sizes @ weights, return_inverse=True, return_counts=True)
    distinct = map(tuple, (codes[:, None] // weights % 64).tolist())
    needed: dict[Size, int] = dict(zip(distinct, counts.tolist(), strict=True))
    # Without Gaussians, one bucket of no blocks keeps the number of axes and the dtype.
    layout = choose_layout(needed, known, room) if needed else Layout(((0,) * sizes.shape[1],), (0,))
    bucket = np.asarray([layout.sizes.index(size) for size in needed], np.int32)
    # Stable: rows of a bucket are in the order of the Gaussians, so that equal sizes lead to equal places.
    order = np.argsort(group, kind="stable")
    row = np.empty(len(sizes), np.int32)
    row[order] = np.arange(len(sizes)) - np.repeat(np.cumsum(counts) - counts, counts)
    return Places(jax.device_put(bucket[group]), jax.device_put(row), layout)


def choose_layout(needed: Mapping[Size, int], known: Sequence[Layout] = (), room: Layout | None = None) -> Layout:
    """Return a layout for numbers of blocks by size, ascending.

    It is `room`, however large, if that has space; otherwise the smallest known one that has, with at most
    `KNOWN_SLACK` times the elements needed, because its programs are compiled; otherwise the smallest possible one.
    """
    for layout in known:
        check_kind("known", layout, Layout)
    if room is not None:
        check_kind("room", room, Layout)
        if room.has_room(needed):
            return room
    smallest = Layout.of(needed)
    most = KNOWN_SLACK * smallest.num_elements
    fitting = [layout for layout in known if layout.has_room(needed) and layout.num_elements <= most]
    return min(fitting, key=lambda layout: layout.num_elements, default=smallest)


def resize(
    table: Table,
    sizes: np.ndarray,
    moments: object = None,
    known: Sequence[Layout] = (),
    kept: np.ndarray | None = None,
    room: Layout | None = None,
) -> tuple[Any, Any]:
    """Return the table with its buckets rebuilt at new sizes [N, D] (host), and the moments likewise.

    Padding, and what grows from an empty block, is `Table.padding` in the table and 0 in moments.

    Moments are any pytree, such as the state of Adam: all tables in it of the same class are rebuilt, other leaves
    stay. They become 0 for blocks that are not `kept` [N]. `known` and `room` are as for `choose_layout`.
    """
    places = plan_places(sizes, known, room)
    bucket, row = _indices(table)
    ids = np.arange(table.num)
    kept_ids = ids
    if kept is not None:
        check_mask("kept", kept, (table.num,))
        kept_ids = np.flatnonzero(kept)
    kind = type(table)

    def rebuilt_moments(leaf: object) -> Any:
        if not isinstance(leaf, kind):
            return leaf
        if len(leaf.buckets) != len(table.buckets) or leaf.bucket_sizes != table.bucket_sizes:
            raise ValueError(f"moments must have the buckets of the table; got {leaf}")
        for index, (moment, blocks) in enumerate(zip(leaf.buckets, table.buckets, strict=True)):
            check_shape(f"moments.buckets[{index}]", moment, blocks.shape)
        rebuilt = _rebuilt(leaf, (bucket[kept_ids], row[kept_ids]), kept_ids, places, (0.0,) * len(kind.padding))
        return partition(rebuilt)[0] if leaf.bucket is None else rebuilt  # Moments are floats only.

    moments = jax.tree.map(rebuilt_moments, moments, is_leaf=lambda leaf: isinstance(leaf, kind))
    return _rebuilt(table, (bucket, row), ids, places, kind.padding), moments


def _rebuilt(old: TableT, sources: _Indices, ids: np.ndarray, places: Places, padding: Sequence[float]) -> TableT:
    """Return a table in which the Gaussians `ids` [n] have the old table's blocks at (bucket, row) [n], resized; other
    Gaussians have padding."""
    buckets = _filled(places.layout, padding, old.dtype)
    old_bucket, old_row = sources
    new_bucket = np.asarray(places.bucket)[ids]
    new_row = np.asarray(places.row)[ids]
    for index, bucket in enumerate(old.buckets):
        from_here = np.flatnonzero(old_bucket == index)
        # Blocks with an axis of 0 have nothing to move.
        if not bucket.size or not len(from_here):
            continue
        source = np.asarray(bucket)  # Each old bucket is read once, one after the other.
        for target in np.unique(new_bucket[from_here]).tolist():
            moved = from_here[new_bucket[from_here] == target]
            buckets[target][new_row[moved]] = old.resized(source[old_row[moved]], places.layout.sizes[target])
    return old.placed(buckets, places)


def _filled(layout: Layout, values: Sequence[float], dtype: DTypeLike) -> list[np.ndarray]:
    """Return buckets whose blocks hold C values everywhere."""
    buckets = zip(*layout, strict=True)
    return [np.full((capacity, *size, len(values)), values, dtype) for size, capacity in buckets]


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
