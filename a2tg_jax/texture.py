"""Textures of mixed resolutions as they are stored and trained: padded buckets, and a layout beside them.

`appearance.textured` defines how a texture is shown and where (u, v) lies in it; `core.bilinear` interpolates.

N Gaussians; texture i is [Tv, Tu, 4] = signed RGB residual and alpha factor; u indexes columns (Tu), v rows (Tv).
Textures of one resolution share a bucket [capacity, Tv, Tu, 4], whose rows past the used ones are padding.
`Textures` holds parameters only and is differentiable; `AtlasLayout` holds the bucket and row of each Gaussian.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from a2tg_jax.core.checks import (
    check_array,
    check_floats,
    check_kind,
    check_number,
    check_shape,
    check_unmasked,
    make_plain,
    plain,
    short_repr,
)
from a2tg_jax.core.pytree import pytree
from a2tg_jax.core.spread_arrays import on_host, placed_like

MAX_SIDE = 16
BYTES_PER_TEXEL = 16
NEUTRAL_TEXEL = (0.0, 0.0, 0.0, 1.0)
KNOWN_SLACK = 1.25


@pytree
class Textures:
    """The texels of all Gaussians, bucketed by resolution."""

    buckets: tuple[Array, ...]
    """Bucket b is [capacity_b, Tv_b, Tu_b, 4]."""

    def __post_init__(self) -> None:
        """Convert lists and NumPy's special arrays to plain arrays."""
        if type(self.buckets) in (list, tuple):  # JAX puts other leaves here, such as PartitionSpec.
            buckets = (
                bucket if isinstance(bucket, tuple) else plain(f"textures.buckets[{index}]", bucket)
                for index, bucket in enumerate(self.buckets)
            )
            object.__setattr__(self, "buckets", tuple(buckets))

    def __repr__(self) -> str:
        return short_repr(self)


@pytree
class AtlasLayout:
    """Place of each Gaussian's texture. Integers only: not differentiable, kept apart from `Textures`."""

    bucket: Array
    """[N] int32 bucket of each Gaussian."""
    row: Array
    """[N] int32 row in that bucket."""
    resolutions: tuple[tuple[int, int], ...] = dataclasses.field(metadata={"static": True})
    """(Tv, Tu) of each bucket, ascending."""

    def __post_init__(self) -> None:
        """Convert lists and NumPy's special arrays to plain arrays."""
        make_plain(self, "layout", "bucket", "row", dtype=np.int32)

    @property
    def num(self) -> int:
        """Number of Gaussians N."""
        return self.bucket.shape[0]

    @property
    def sizes(self) -> np.ndarray:
        """[N, 2] integers (Tv, Tu) (host)."""
        sizes: np.ndarray = np.asarray(self.resolutions, np.int64).reshape(-1, 2)[on_host(self.bucket)]
        return sizes

    @property
    def num_texels(self) -> int:
        """Number of texels in use, without padding (host)."""
        return self.count_texels(self.num)

    def count_texels(self, num: int) -> int:
        """Return the number of texels of the first `num` Gaussians (host).

        The log calls it every few steps, so that it makes no [N, 2].
        """
        areas = np.asarray([height * width for height, width in self.resolutions], np.int64)
        return int(areas[on_host(self.bucket)[:num]].sum())

    def __repr__(self) -> str:
        return short_repr(self)


def check_textures(textures: Textures, layout: AtlasLayout, num: int | None = None, name: str = "textures") -> None:
    """Raise ValueError, naming the field, unless textures and layout fit each other and `num` Gaussians, if given.

    Buckets and rows are compared with the textures where they have values, which tracers do not.
    """
    if not isinstance(textures, Textures) or not isinstance(layout, AtlasLayout):
        kinds = f"{type(textures).__name__} and {type(layout).__name__}"
        raise ValueError(f"{name} and layout must be Textures and their AtlasLayout; got {kinds}")
    check_array("layout.bucket", layout.bucket)
    check_array("layout.row", layout.row)
    check_shape("layout.bucket", layout.bucket, ("N",))
    if num is not None and layout.num != num:
        raise ValueError(f"layout is of {layout.num} textures, but there are {num} gaussians")
    check_shape("layout.row", layout.row, (layout.num,))
    if len(textures.buckets) != len(layout.resolutions):
        counts = f"{len(textures.buckets)} buckets, and the layout {len(layout.resolutions)} sizes"
        raise ValueError(f"{name} must have one bucket for each size of the layout; they have {counts}")
    for index, (bucket, size) in enumerate(zip(textures.buckets, layout.resolutions, strict=True)):
        check_array(f"{name}.buckets[{index}]", bucket)
        check_floats(f"{name}.buckets[{index}]", bucket, ("capacity", *size, 4))
    for field in ("bucket", "row"):
        if not jnp.issubdtype(getattr(layout, field).dtype, jnp.integer):
            raise ValueError(f"layout.{field} must be integers; got {getattr(layout, field).dtype}")
    if layout.num and not any(len(bucket) for bucket in textures.buckets):
        raise ValueError(f"{name} must have a row for each of {layout.num} Gaussians; all buckets are empty")
    if layout.num and not any(isinstance(leaf, jax.core.Tracer) for leaf in (layout.bucket, layout.row)):
        _check_ranges(textures, layout)


def _check_ranges(textures: Textures, layout: AtlasLayout) -> None:
    """Raise ValueError unless each bucket exists and each row is within its bucket (host)."""
    bucket, row = on_host(layout.bucket), on_host(layout.row)
    last = len(textures.buckets) - 1
    if bucket.min() < 0 or bucket.max() > last:
        raise ValueError(f"layout.bucket must be 0 to {last}; got {bucket.min()} to {bucket.max()}")
    capacities = np.asarray([len(texels) for texels in textures.buckets])[bucket]
    outside = np.flatnonzero((row < 0) | (row >= capacities))
    if outside.size:
        first = outside[0]
        raise ValueError(
            f"layout.row must be below the number of textures in the bucket, {capacities[first]} in bucket "
            f"{bucket[first]}; got {row[first]} for Gaussian {first} (of {outside.size} rows out of range): "
            "is this the layout of other textures?"
        )


def nearest_places(textures: Textures, layout: AtlasLayout) -> AtlasLayout:
    """Return the layout with int32 buckets and rows, each moved to the nearest one that exists; traced.

    `check_textures` refuses such layouts where it can read them. A traced one has no values to check.
    """
    bucket = jnp.clip(_as_int32(layout.bucket), 0, len(textures.buckets) - 1)
    last_rows = jnp.asarray([max(len(texels) - 1, 0) for texels in textures.buckets], jnp.int32)
    return dataclasses.replace(layout, bucket=bucket, row=jnp.clip(_as_int32(layout.row), 0, last_rows[bucket]))


def _as_int32(index: Array) -> Array:
    """Return integers of any type as int32, clipped to its range."""
    wanted, own = np.iinfo(np.int32), np.iinfo(index.dtype)
    return jnp.clip(index, max(wanted.min, own.min), min(wanted.max, own.max)).astype(jnp.int32)


def check_places(textures: Textures, layout: AtlasLayout) -> None:
    """Raise ValueError unless each texture has a row of its own; they must have passed `check_textures` (host)."""
    bucket, row = np.asarray(layout.bucket), np.asarray(layout.row)
    capacities = np.asarray([len(texels) for texels in textures.buckets], np.int64)
    starts = np.cumsum(capacities) - capacities
    if bucket.size and np.bincount(starts[bucket] + row).max() > 1:
        raise ValueError("layout must give each texture its own row; some share one")


def bucket_capacity(count: int) -> int:
    """Return the rows allotted to `count` textures, rounded up to 1/16 of its power of two so that few shapes occur."""
    if count == 0:
        return 0
    granule: int = max(1, 2 ** (count.bit_length() - 4))
    return -(-count // granule) * granule


class Shape(NamedTuple):
    """Resolutions and capacities of all buckets; programs are compiled for a shape."""

    resolutions: tuple[tuple[int, int], ...]
    """(Tv, Tu) of each bucket, ascending."""
    capacities: tuple[int, ...]
    """Number of rows of each bucket."""

    @property
    def num_texels(self) -> int:
        """Number of texels, padding included."""
        areas = (height * width for height, width in self.resolutions)
        return sum(capacity * area for capacity, area in zip(self.capacities, areas, strict=True))


def shape_of(textures: Textures, layout: AtlasLayout) -> Shape:
    """Return the shape of buckets."""
    return Shape(layout.resolutions, tuple(map(len, textures.buckets)))


def plan_layout(
    sizes: ArrayLike, known: Sequence[Shape] = (), like: Array | None = None, room: Shape | None = None
) -> tuple[AtlasLayout, tuple[int, ...]]:
    """Return the layout for textures of the given sizes, and the capacity of each bucket (host).

    Args:
      sizes: [N, 2] integers (Tv, Tu), each side 1 to 16, or both 0 for an empty texture, which takes no bytes.
      known: shapes with compiled programs. One is taken if the textures fit and it has at most `KNOWN_SLACK` times
        the texels.
      like: array over whose devices the rows of the layout are spread as its own; None: they lie on one.
      room: shape that is taken if the textures fit, however large it is.

    Raises:
      ValueError: if a size is out of range.
    """
    sizes = checked_sizes(sizes)
    for shape in known:
        check_kind("known", shape, Shape)
    if room is not None:
        check_kind("room", room, Shape)
    codes, bucket, counts = np.unique(sizes @ np.array([64, 1]), return_inverse=True, return_counts=True)
    order = np.argsort(bucket, kind="stable")
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    row = np.empty(len(sizes), np.int32)
    row[order] = np.arange(len(sizes)) - starts
    needed = {(int(code) // 64, int(code) % 64): int(count) for code, count in zip(codes, counts, strict=True)}
    shape = _choose_shape(needed, known, room)
    place = np.asarray([shape.resolutions.index(resolution) for resolution in needed], np.int32)
    buckets = (place[bucket] if len(place) else bucket).astype(np.int32)
    return AtlasLayout(placed_like(buckets, like), placed_like(row, like), shape.resolutions), shape.capacities


def checked_sizes(sizes: ArrayLike, name: str = "sizes") -> np.ndarray:
    """Return the sizes of textures as an array (host).

    Raises:
      ValueError: unless they are integers [N, 2], each side 1 to 16, or both 0.
    """
    if isinstance(sizes, Textures | AtlasLayout):
        raise ValueError(f"{name} must be integers [N, 2]; got {type(sizes).__name__}: say layout.sizes")
    check_unmasked(name, sizes)
    sizes = np.asarray(sizes)
    if sizes.ndim != 2 or sizes.shape[1] != 2 or not np.issubdtype(sizes.dtype, np.integer):
        raise ValueError(f"{name} must be integers [N, 2] as (Tv, Tu); got {sizes.dtype} {sizes.shape}")
    is_wrong = ((sizes < 1) | (sizes > MAX_SIDE)).any(axis=1) & (sizes != 0).any(axis=1)
    if is_wrong.any():
        found = sizes[is_wrong]
        raise ValueError(f"texture sides must lie in 1..{MAX_SIDE}, or both be 0; got {found.min()}..{found.max()}")
    return sizes


def _choose_shape(needed: dict[tuple[int, int], int], known: Sequence[Shape], wanted: Shape | None) -> Shape:
    """Return the wanted shape if it has room for the needed textures of each resolution, else the smallest known one
    that has, or a new one."""
    new = Shape(tuple(needed), tuple(map(bucket_capacity, needed.values())))

    def has_room(shape: Shape) -> bool:
        room = dict(zip(*shape, strict=True))
        return all(room.get(resolution, 0) >= count for resolution, count in needed.items())

    if wanted is not None and has_room(wanted):
        return wanted
    fitting = [shape for shape in known if has_room(shape) and shape.num_texels <= KNOWN_SLACK * new.num_texels]
    return min(fitting, key=lambda shape: shape.num_texels, default=new)


def allocate_textures(
    sizes: ArrayLike, *, rgb: float = 0.0, dtype: DTypeLike = jnp.float32
) -> tuple[Textures, AtlasLayout]:
    """Return textures of the given sizes with texels (rgb, rgb, rgb, 1); with rgb = 0 they change nothing.

    Args:
      sizes: [N, 2] integers (Tv, Tu), each side 1 to 16, or both 0 for an empty texture, which takes no bytes.
      rgb: initial RGB residual.
      dtype: dtype of the texels.

    Raises:
      ValueError: if a size is out of range, or the dtype is none of floats.
    """
    check_number("rgb", rgb)
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"dtype must be a dtype of floats; got {dtype}")
    layout, capacities = plan_layout(sizes)
    texel = jnp.asarray([rgb, rgb, rgb, 1.0], dtype)
    shapes = zip(capacities, layout.resolutions, strict=True)
    buckets = tuple(jnp.broadcast_to(texel, (capacity, *resolution, 4)) for capacity, resolution in shapes)
    return Textures(buckets), layout


def textures_from_arrays(arrays: Sequence[ArrayLike]) -> tuple[Textures, AtlasLayout]:
    """Make buckets from N arrays [Tv, Tu, 4] of one float dtype; the inverse of `texture_arrays`.

    Raises:
      ValueError: if an array is not floats [Tv, Tu, 4] with sides of 1 to 16, naming it.
    """
    given = [np.asarray(plain(f"texture {index}", array)) for index, array in enumerate(arrays)]
    for index, array in enumerate(given):
        if array.ndim != 3 or array.shape[2] != 4:
            raise ValueError(f"texture {index} must be [Tv, Tu, 4]; got {array.shape}")
        if not jnp.issubdtype(array.dtype, jnp.floating):
            raise ValueError(f"texture {index} must be floats; got {array.dtype}")
    layout, capacities = plan_layout(np.array([array.shape[:2] for array in given], np.int64).reshape(-1, 2))
    dtype = np.result_type(*given) if given else np.float32
    filled = [
        np.tile(np.asarray(NEUTRAL_TEXEL, dtype), (capacity, *resolution, 1))
        for capacity, resolution in zip(capacities, layout.resolutions, strict=True)
    ]
    for array, bucket, row in zip(given, np.asarray(layout.bucket), np.asarray(layout.row), strict=True):
        filled[bucket][row] = array
    return Textures(tuple(jnp.asarray(bucket) for bucket in filled)), layout


def packed_textures(textures: Textures, layout: AtlasLayout) -> tuple[Textures, AtlasLayout]:
    """Return the same textures, or moments of them, in buckets as large as `plan_layout` makes them (host)."""
    new, capacities = plan_layout(layout.sizes)
    kept = [textures.buckets[layout.resolutions.index(resolution)] for resolution in new.resolutions]
    return Textures(tuple(bucket[:capacity] for bucket, capacity in zip(kept, capacities, strict=True))), new


def first_textures(textures: Textures, layout: AtlasLayout, num: int) -> tuple[Textures, AtlasLayout]:
    """Return the textures of the first `num` Gaussians, in buckets of their own (host)."""
    new, capacities = plan_layout(layout.sizes[:num])
    old_rows = np.asarray(layout.row)[:num]
    buckets = []
    for index, (capacity, resolution) in enumerate(zip(capacities, new.resolutions, strict=True)):
        source = np.asarray(textures.buckets[layout.resolutions.index(resolution)])
        filled = np.tile(np.asarray(NEUTRAL_TEXEL, source.dtype), (capacity, *resolution, 1))
        is_member = np.asarray(new.bucket) == index
        filled[np.asarray(new.row)[is_member]] = source[old_rows[is_member]]
        buckets.append(jnp.asarray(filled))
    return Textures(tuple(buckets)), new


def texture_arrays(textures: Textures, layout: AtlasLayout) -> list[np.ndarray]:
    """Return the N textures as numpy arrays [Tv, Tu, 4], in the order of the Gaussians (host)."""
    check_textures(textures, layout)
    buckets = [np.asarray(bucket) for bucket in textures.buckets]
    places = zip(np.asarray(layout.bucket), np.asarray(layout.row), strict=True)
    return [buckets[bucket][row] for bucket, row in places]
