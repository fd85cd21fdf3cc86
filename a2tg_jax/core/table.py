"""A block of numbers for each Gaussian, of one of several sizes, in one padded bucket for each size.

N Gaussians. A block of size (T₁, …) is [T₁, …, C], such as a texture (Tv, Tu) of C = 4 channels, or the spherical
harmonics (K,) of C = 3 colours that a Gaussian has beyond those of all. Blocks of one size share a bucket
[capacity, T₁, …, C], whose rows past the used ones are padding. Programs are compiled for sizes and capacities, so that
only a change of these, on the host, compiles a step again.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from a2tg_jax.core.checks import check_array, check_floats, check_kind, check_mask, check_shape, plain_array, short_repr
from a2tg_jax.core.pytree import partition, pytree, static
from a2tg_jax.parallel.sharded_rows import on_host, placed_like, rows_moved

Size = tuple[int, ...]
KNOWN_SLACK = 1.25
"""Largest number of elements of a known shape, as a multiple of a new one's, for which it is taken."""


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
class Table:
    """Blocks of all Gaussians, by size. A subclass says how a block changes its size, and what padding holds.

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
        """Return blocks of the given sizes [N, D] that hold the C `values` everywhere (host); one of sides 0 takes no
        bytes."""
        places, capacities = plan_places(np.asarray(sizes))
        value = jnp.asarray(values, dtype)
        shapes = zip(capacities, places.bucket_sizes, strict=True)
        return cls.placed(
            [jnp.broadcast_to(value, (capacity, *size, len(values))) for capacity, size in shapes], places
        )

    @classmethod
    def of_blocks(cls, blocks: Sequence[np.ndarray]) -> Self:
        """Return the table of N arrays [T₁, …, C] of one dtype; the inverse of `blocks` (host)."""
        sizes = np.array([block.shape[:-1] for block in blocks], np.int64).reshape(-1, cls.num_sides)
        places, capacities = plan_places(sizes)
        dtype = np.result_type(*blocks) if blocks else np.float32
        shapes = zip(capacities, places.bucket_sizes, strict=True)
        buckets = [cls._padded(capacity, size, dtype) for capacity, size in shapes]
        for block, bucket, row in zip(blocks, np.asarray(places.bucket), np.asarray(places.row), strict=True):
            buckets[bucket][row] = block
        return cls.placed(buckets, places)

    @classmethod
    def placed(cls, buckets: Sequence[Any], places: "Places") -> Self:
        """Return the table of buckets and of the places that were planned for them (host)."""
        return cls(tuple(map(jnp.asarray, buckets)), *places)

    @classmethod
    def _padded(cls, capacity: int, size: Size, dtype: DTypeLike, padding: Sequence[float] | None = None) -> np.ndarray:
        values = np.asarray(cls.padding if padding is None else padding, dtype)
        return np.broadcast_to(values, (capacity, *size, len(values))).copy()

    @property
    def num(self) -> int:
        """Number of Gaussians N."""
        return self.bucket.shape[0]

    @property
    def sizes(self) -> np.ndarray:
        """[N, D] integers, the sides of each block (host)."""
        sides = np.asarray(self.bucket_sizes, np.int64).reshape(-1, self.num_sides)
        return sides[on_host(self.bucket)]

    @property
    def shape(self) -> Shape:
        """Sizes and capacities of the buckets."""
        return Shape(self.bucket_sizes, tuple(map(len, self.buckets)))

    def count_elements(self, num: int) -> int:
        """Return the number of texels or coefficients of the first `num` Gaussians, without padding (host).

        The log calls it every few steps, so it makes no [N, D].
        """
        areas = np.asarray([np.prod(size, dtype=np.int64) for size in self.bucket_sizes], np.int64)
        return int(areas[on_host(self.bucket)[:num]].sum())

    def count_floats(self, num: int) -> int:
        """Return the number of floats of the first `num` Gaussians, without padding (host)."""
        return len(self.padding) * self.count_elements(num)

    def blocks(self) -> list[np.ndarray]:
        """Return the N blocks as NumPy arrays [T₁, …, C], in the order of the Gaussians (host)."""
        buckets = [on_host(bucket) for bucket in self.buckets]
        places = zip(on_host(self.bucket), on_host(self.row), strict=True)
        return [buckets[bucket][row] for bucket, row in places]

    def flat(self) -> np.ndarray:
        """Return the elements [M, C] of all blocks, block after block, each row by row (host)."""
        blocks = [block.reshape(-1, block.shape[-1]) for block in self.blocks()]
        return np.concatenate(blocks) if blocks else np.zeros((0, len(self.padding)), np.float32)

    @classmethod
    def of_flat(cls, sizes: np.ndarray, elements: np.ndarray) -> Self:
        """Return the table of sizes [N, D] and of what `flat` returned, which fits them (host)."""
        pieces = np.split(elements, np.cumsum(sizes.prod(axis=1))[:-1]) if len(sizes) else []
        return cls.of_blocks([piece.reshape(*size, piece.shape[1]) for piece, size in zip(pieces, sizes, strict=True)])

    # Rows

    def gather(self, rows: Array | np.ndarray) -> Self:
        """Return blocks, or moments of them, whose Gaussian i is the former rows[i] of N; traceable. ValueError: there
        are blocks of several sizes."""
        if len(self.buckets) != 1:
            name, num = type(self).__name__.lower(), len(self.buckets)
            raise ValueError(f"{name} of {num} sizes cannot change rows: densify and prune before they grow")
        (bucket,) = self.buckets
        spare = jnp.arange(len(rows), len(bucket), dtype=jnp.int32)
        moved = rows_moved(bucket, jnp.concatenate([jnp.asarray(rows, jnp.int32), spare]))
        return dataclasses.replace(self, buckets=(moved,))

    def clear(self, is_cleared: Array) -> Self:
        """Return moments of blocks with those of the marked Gaussians [N] at zero; traceable."""
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
        old = on_host(self.bucket)[rows], on_host(self.row)[rows]
        moves = _moves_between(old, (np.asarray(places.bucket), np.asarray(places.row)))
        padding = self.padding if padding is None else padding
        return self.placed(_moved(type(self), self.buckets, moves, places.bucket_sizes, capacities, padding), places)

    @classmethod
    def joined(cls, tables: Sequence[Self]) -> Self:
        """Return the blocks of several tables, one after the other (host)."""
        return cls.of_blocks([block for table in tables for block in table.blocks()])

    def nearest_places(self) -> Self:
        """Return the table with int32 buckets and rows, each moved to the nearest one that exists; traced.

        `check_table` refuses such places where it can read them. Traced ones have no values to check.
        """
        bucket = jnp.clip(_as_int32(self.bucket), 0, len(self.buckets) - 1)
        last_rows = jnp.asarray([max(len(blocks) - 1, 0) for blocks in self.buckets], jnp.int32)
        return dataclasses.replace(self, bucket=bucket, row=jnp.clip(_as_int32(self.row), 0, last_rows[bucket]))

    def __repr__(self) -> str:
        return short_repr(self)


def is_table(leaf: object) -> bool:
    """Return whether a node of a pytree is a table, for `is_leaf` of `jax.tree`."""
    return isinstance(leaf, Table)


def _as_int32(index: Array) -> Array:
    """Return integers of any type as int32, clipped to its range."""
    wanted, own = np.iinfo(np.int32), np.iinfo(index.dtype)
    return jnp.clip(index, max(wanted.min, own.min), min(wanted.max, own.max)).astype(jnp.int32)


# Places


class Places(NamedTuple):
    """Place of each block, as the fields of `Table`."""

    bucket: Array
    row: Array
    bucket_sizes: tuple[Size, ...]


def bucket_capacity(count: int) -> int:
    """Return the rows allotted to `count` blocks, rounded up to 1/16 of its power of two so that few shapes occur."""
    if count == 0:
        return 0
    granule: int = max(1, 2 ** (count.bit_length() - 4))
    return -(-count // granule) * granule


def plan_places(
    sizes: np.ndarray, known: Sequence[Shape] = (), like: Array | None = None, room: Shape | None = None
) -> tuple[Places, tuple[int, ...]]:
    """Return the places of blocks of the given sizes [N, D], from 0 to 63, and the capacity of each bucket (host).

    A shape with room for the blocks is taken: `room`, however large it is, or a known one, with a compiled program, of
    at most `KNOWN_SLACK` times the elements. The places are spread over the devices of an array `like`; None: they are
    on one.
    """
    for shape in known:
        check_kind("known", shape, Shape)
    if room is not None:
        check_kind("room", room, Shape)
    # Codes of sizes ascend as the sizes do.
    weights = 64 ** np.arange(sizes.shape[1])[::-1]
    codes, bucket, counts = np.unique(sizes @ weights, return_inverse=True, return_counts=True)
    order = np.argsort(bucket, kind="stable")
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    row = np.empty(len(sizes), np.int32)
    row[order] = np.arange(len(sizes)) - starts
    needed = {
        tuple(int(code // weight % 64) for weight in weights): int(n) for code, n in zip(codes, counts, strict=True)
    }
    # Without Gaussians, one bucket of no blocks keeps the number of sides and the dtype.
    new = Shape(tuple(needed), tuple(map(bucket_capacity, needed.values())))

    def has_room(shape: Shape) -> bool:
        own = dict(zip(*shape, strict=True))
        return all(own.get(size, 0) >= count for size, count in needed.items())

    if not needed:
        shape = Shape(((0,) * sizes.shape[1],), (0,))
    elif room is not None and has_room(room):
        shape = room
    else:
        fitting = [own for own in known if has_room(own) and own.num_elements <= KNOWN_SLACK * new.num_elements]
        shape = min(fitting, key=lambda own: own.num_elements, default=new)
    place = np.asarray([shape.sizes.index(size) for size in needed], np.int32)
    buckets = (place[bucket] if len(place) else bucket).astype(np.int32)
    return Places(placed_like(buckets, like), placed_like(row, like), shape.sizes), shape.capacities


class Resized(NamedTuple):
    """Result of `resize`."""

    table: Any
    """The blocks at their new sizes, a `Table` of the given class."""
    moments: Any
    """Moments as given, their tables rebuilt as the blocks were."""


def resize(
    table: Table,
    sizes: np.ndarray,
    moments: object = None,
    known: Sequence[Shape] = (),
    kept: np.ndarray | None = None,
    room: Shape | None = None,
) -> Resized:
    """Rebuild the buckets at new sizes [N, D] (host). Padding, and what grows from an empty block, is `Table.padding`
    in the table and 0 in moments.

    Moments are any pytree, such as the state of Adam: all tables in it of the same class are rebuilt, other leaves
    stay. Of blocks that are not `kept` [N] they become 0. `known` and `room` are as for `plan_places`.
    """
    places, capacities = plan_places(sizes, known, like=table.bucket, room=room)
    ends = (on_host(table.bucket), on_host(table.row)), (on_host(places.bucket), on_host(places.row))
    moves = kept_moves = _moves_between(*ends)
    if kept is not None:
        check_mask("kept", kept, (table.num,))
        kept_moves = _moves_between(*((bucket[kept], row[kept]) for bucket, row in ends))
    own = type(table)

    def rebuilt(old: Table, moves: list[_Move], padding: Sequence[float]) -> Table:
        targets = _moved(own, old.buckets, moves, places.bucket_sizes, capacities, padding)
        whole = own.placed([placed_like(target, table.bucket) for target in targets], places)
        return partition(whole)[0] if old.bucket is None else whole  # Moments are floats only.

    def rebuilt_moments(leaf: object) -> Any:
        if not isinstance(leaf, own):
            return leaf
        if len(leaf.buckets) != len(table.buckets) or leaf.bucket_sizes != table.bucket_sizes:
            raise ValueError(f"moments must have the buckets of the table; got {leaf}")
        for index, (moment, blocks) in enumerate(zip(leaf.buckets, table.buckets, strict=True)):
            check_shape(f"moments.buckets[{index}]", moment, blocks.shape)
        return rebuilt(leaf, kept_moves, (0.0,) * len(own.padding))

    moments = jax.tree.map(rebuilt_moments, moments, is_leaf=lambda leaf: isinstance(leaf, own))
    return Resized(rebuilt(table, moves, own.padding), moments)


_Move = tuple[int, int, np.ndarray, np.ndarray]
"""Old bucket and new bucket, old rows and new rows of the blocks that go from one to the other."""


def _moves_between(old: tuple[np.ndarray, np.ndarray], new: tuple[np.ndarray, np.ndarray]) -> list[_Move]:
    """Return the moves between (bucket, row) of blocks before and after, one for each pair of buckets; old ones
    ascend."""
    (old_bucket, old_row), (new_bucket, new_row) = old, new
    base = int(new_bucket.max(initial=0)) + 1
    pairs = old_bucket.astype(np.int64) * base + new_bucket
    order = np.argsort(pairs, kind="stable")
    codes, starts = np.unique(pairs[order], return_index=True)
    groups = np.split(order, starts[1:]) if len(codes) else []
    found = zip(codes.tolist(), groups, strict=True)
    return [(code // base, code % base, old_row[group], new_row[group]) for code, group in found]


def _moved(
    kind: type[Table], buckets: Sequence[Any], moves: list[_Move], sizes: Sequence[Size], capacities: Sequence[int],
    padding: Sequence[float],
) -> list[np.ndarray]:  # fmt: skip
    """Return new buckets of given sizes and capacities, with the blocks that moves bring from the old ones."""
    dtype = buckets[0].dtype if buckets else np.float32
    targets = [kind._padded(capacity, size, dtype, padding) for capacity, size in zip(capacities, sizes, strict=True)]
    # Each old bucket is read once, one after the other.
    for old_bucket, own in itertools.groupby(moves, key=lambda move: move[0]):
        if buckets[old_bucket].size:
            source = on_host(buckets[old_bucket])
            for _, new_bucket, old_rows, new_rows in own:
                targets[new_bucket][new_rows] = kind.resized(source[old_rows], sizes[new_bucket])
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
    for index, (bucket, size) in enumerate(zip(table.buckets, table.bucket_sizes, strict=True)):
        check_array(f"{name}.buckets[{index}]", bucket)
        check_floats(f"{name}.buckets[{index}]", bucket, ("capacity", *size, len(table.padding)))
    for field in ("bucket", "row"):
        if not jnp.issubdtype(getattr(table, field).dtype, jnp.integer):
            raise ValueError(f"{name}.{field} must be integers; got {getattr(table, field).dtype}")
    if table.num and not any(len(bucket) for bucket in table.buckets):
        raise ValueError(f"{name} must have a row for each of {table.num} Gaussians; all buckets are empty")
    if not table.num or any(isinstance(leaf, jax.core.Tracer) for leaf in (table.bucket, table.row)):
        return
    places, last = on_host(table.bucket), len(table.buckets) - 1
    if places.min() < 0 or places.max() > last:
        raise ValueError(f"{name}.bucket must be 0 to {last}; got {places.min()} to {places.max()}")
    rows, capacities = on_host(table.row), np.asarray([len(blocks) for blocks in table.buckets])[places]
    outside = np.flatnonzero((rows < 0) | (rows >= capacities))
    if outside.size:
        first = outside[0]
        raise ValueError(
            f"{name}.row must be below the number of blocks in the bucket, {capacities[first]} in bucket "
            f"{places[first]}; got {rows[first]} for Gaussian {first} (of {outside.size} rows out of range)"
        )


def check_places(table: Table, name: str = "textures") -> None:
    """Raise ValueError unless each block has a row of its own; the table must have passed `check_table` (host)."""
    bucket, row = on_host(table.bucket), on_host(table.row)
    capacities = np.asarray([len(blocks) for blocks in table.buckets], np.int64)
    starts = np.cumsum(capacities) - capacities
    if bucket.size and np.bincount(starts[bucket] + row).max() > 1:
        raise ValueError(f"{name} must have a row for each Gaussian; some share one")
