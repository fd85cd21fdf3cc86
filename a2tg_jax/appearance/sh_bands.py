"""Spherical harmonics with a degree per Gaussian, stored and trained as one padded table for each band.

Band l holds the 2l + 1 coefficients of degree l. All Gaussians have those of `Gaussians.sh`; one of a higher degree
owns a row in the table of every band between. A Gaussian without a row in a table takes no bytes there. `Bands` holds
parameters only and is differentiable; `BandLayout` holds the owners of the rows.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from a2tg_jax.core.checks import check_shape, short_repr
from a2tg_jax.core.numerics import normalize
from a2tg_jax.core.pytree import pytree
from a2tg_jax.core.sh import NUM_BASES, sh_basis
from a2tg_jax.core.spread_arrays import on_host, placed_like
from a2tg_jax.texture import bucket_capacity

MAX_DEGREE = 3


@pytree
class Bands:
    """Coefficients beyond those that all Gaussians have."""

    tables: tuple[Array, ...]
    """Tables [capacity, 2l + 1, 3] of the bands above the Gaussians' own degree; rows without an owner are 0."""

    def __repr__(self) -> str:
        return short_repr(self)


@pytree
class BandLayout:
    """Owners of the rows of the tables. Integers only: not differentiable, kept apart from `Bands`."""

    owners: tuple[Array, ...]
    """[capacity] int32 owner of each row of each table, ascending; N for a row without an owner."""
    num: int = dataclasses.field(metadata={"static": True})
    """Number of Gaussians N."""

    @property
    def base_degree(self) -> int:
        """Degree that all Gaussians have."""
        return MAX_DEGREE - len(self.owners)

    @property
    def degrees(self) -> np.ndarray:
        """[N] degree of each Gaussian (host)."""
        degrees = np.full(self.num, self.base_degree)
        for owners in self.owners:
            degrees[_owned(owners, self.num)] += 1
        return degrees

    def count_floats(self, num: int) -> int:
        """Return the floats of the first `num` Gaussians beyond those that all have (host)."""
        rows = [int(np.count_nonzero(on_host(owners) < num)) for owners in self.owners]
        return sum(count * floats_of_band(degree) for count, degree in zip(rows, self.bands, strict=True))

    @property
    def bands(self) -> range:
        """Degree of each table."""
        return range(self.base_degree + 1, MAX_DEGREE + 1)

    def __repr__(self) -> str:
        return short_repr(self)


def floats_of_band(degree: int) -> int:
    """Return the floats of a band of one Gaussian: 9, 15 and 21 for degree 1, 2 and 3."""
    return 3 * (2 * degree + 1)


def allocate_bands(degrees: ArrayLike, base_degree: int, dtype: DTypeLike = jnp.float32) -> tuple[Bands, BandLayout]:
    """Return tables of zeros for Gaussians of the given degrees (host).

    Args:
      degrees: [N] integers, `base_degree` to 3.
      base_degree: degree of `Gaussians.sh`.
      dtype: dtype of the coefficients.

    Raises:
      ValueError: if a degree is out of range.
    """
    degrees = np.asarray(degrees)
    owners = _owners(degrees, base_degree)
    bands = enumerate(owners, base_degree + 1)
    tables = tuple(jnp.zeros((len(own), 2 * degree + 1, 3), dtype) for degree, own in bands)
    return Bands(tables), BandLayout(tuple(map(jnp.asarray, owners)), len(degrees))


def _owners(degrees: np.ndarray, base_degree: int, room: Sequence[int] = ()) -> list[np.ndarray]:
    """Return the owners of the rows of each table, which has `room` rows if they suffice, for Gaussians of the given
    degrees."""
    if degrees.size and not base_degree <= degrees.min() <= degrees.max() <= MAX_DEGREE:
        raise ValueError(f"degrees must lie in {base_degree}..3; got {degrees.min()}..{degrees.max()}")
    found = []
    wanted = room or [0] * (MAX_DEGREE - base_degree)
    for degree, capacity in zip(range(base_degree + 1, MAX_DEGREE + 1), wanted, strict=True):
        rows = np.flatnonzero(degrees >= degree)
        capacity = capacity if capacity >= len(rows) else bucket_capacity(len(rows))
        owners = np.full(capacity, len(degrees), np.int32)
        owners[: len(rows)] = rows
        found.append(owners)
    return found


def reallocate_bands(
    bands: Bands, layout: BandLayout, degrees: np.ndarray, moments: Any = None, room: Sequence[int] = ()
) -> tuple[Bands, BandLayout, Any]:
    """Return tables for other degrees (host): kept coefficients stay unchanged, new ones are 0.

    Args:
      bands: present coefficients.
      layout: owners of the coefficients.
      degrees: [N] integers, the layout's base degree to 3.
      moments: any pytree; all `Bands` in it are rebuilt as well, other leaves stay unchanged.
      room: number of rows of each table, unless it needs more; empty: as many as it needs, rounded up.
    """
    check_shape("degrees", degrees, (layout.num,))

    def rebuilt(old: Bands) -> tuple[Bands, BandLayout]:
        return _packed(_dense_tables(old, layout), degrees, layout.base_degree, like=layout.owners, room=room)

    def is_bands(node: Any) -> bool:
        return isinstance(node, Bands)

    moments = jax.tree.map(lambda leaf: rebuilt(leaf)[0] if is_bands(leaf) else leaf, moments, is_leaf=is_bands)
    return *rebuilt(bands), moments


def gather_bands(bands: Bands, layout: BandLayout, rows: Array) -> Bands:
    """Return coefficients whose Gaussian i has those of the former Gaussian rows[i]; traceable.

    Each row keeps its degree: coefficients above it are dropped, and those that the former Gaussian lacked are 0.
    """
    tables, rows = [], jnp.asarray(rows)
    for table, owners in zip(bands.tables, layout.owners, strict=True):
        places = jnp.full(layout.num + 1, table.shape[0], jnp.int32)
        places = places.at[owners].set(jnp.arange(table.shape[0], dtype=jnp.int32)).at[layout.num].set(table.shape[0])
        padded_rows = jnp.concatenate([rows, jnp.full((1,), layout.num, rows.dtype)])
        padded = jnp.concatenate([table, jnp.zeros_like(table, shape=(1, *table.shape[1:]))])
        tables.append(padded[places[padded_rows[owners]]])
    return Bands(tuple(tables))


def clear_bands(bands: Bands, layout: BandLayout, is_cleared: Array) -> Bands:
    """Return moments of coefficients with those of the marked Gaussians [N] at zero; traceable."""
    marks = jnp.concatenate([is_cleared, jnp.zeros((1,), bool)])
    cleared = [
        jnp.where(marks[owners].reshape(-1, 1, 1), jnp.zeros_like(table), table)
        for table, owners in zip(bands.tables, layout.owners, strict=True)
    ]
    return Bands(tuple(cleared))


def first_bands(bands: Bands, layout: BandLayout, num: int) -> tuple[Bands, BandLayout]:
    """Return the coefficients of the first `num` Gaussians, in tables of their own (host)."""
    dense = [table[:num] for table in _dense_tables(bands, layout)]
    return _packed(dense, layout.degrees[:num], layout.base_degree)


def take_bands(bands: Bands, layout: BandLayout, rows: np.ndarray) -> tuple[Bands, BandLayout]:
    """Return the coefficients of the Gaussians `rows`, which may repeat, with their degrees (host)."""
    dense = [table[rows] for table in _dense_tables(bands, layout)]
    return _packed(dense, layout.degrees[rows], layout.base_degree)


def join_bands(parts: Sequence[tuple[Bands, BandLayout]]) -> tuple[Bands, BandLayout]:
    """Return the coefficients of several sets of Gaussians, one after the other (host).

    Raises:
      ValueError: if their base degrees differ.
    """
    bases = sorted({layout.base_degree for _, layout in parts})
    if len(bases) > 1:
        raise ValueError(f"bands must begin above one degree; got {bases}")
    dense = [np.concatenate(tables) for tables in zip(*(_dense_tables(*part) for part in parts), strict=True)]
    return _packed(dense, np.concatenate([layout.degrees for _, layout in parts]), bases[0])


def band_colors(bands: Bands, layout: BandLayout, means: Array, center: Array, degree: Any) -> Array:
    """Return the sums [N, 3] that the bands add to Σ Y_l·sh_l, before 0.5 is added and negatives are cut off.

    Args:
      bands: coefficients.
      layout: owners of the coefficients.
      means: [N, 3] positions in the world.
      center: [3] camera centre in the world.
      degree: highest degree used; may be traced.
    """
    total = jnp.zeros(means.shape, jnp.result_type(means, center, *bands.tables))
    for table, owners, band in zip(bands.tables, layout.owners, layout.bands, strict=True):
        if not table.shape[0]:
            continue
        directions = normalize(means[jnp.minimum(owners, layout.num - 1)] - center[None, :])
        basis = sh_basis(directions)[:, NUM_BASES[band - 1] : NUM_BASES[band]]
        basis = jnp.where(jnp.asarray(degree) >= band, basis, 0.0)
        total = total.at[owners].add(jnp.sum(basis[:, :, None] * table, axis=1), mode="drop")
    return total


def dense_sh(sh: np.ndarray, bands: Bands, layout: BandLayout) -> np.ndarray:
    """Return all coefficients [N, K, 3], zeros above a Gaussian's degree; K is that of the highest degree (host)."""
    highest = int(layout.degrees.max(initial=layout.base_degree))
    own = np.asarray(sh)
    return np.concatenate([own, *_dense_tables(bands, layout)], axis=1, dtype=own.dtype)[:, : NUM_BASES[highest]]


def split_sh(dense: np.ndarray, degrees: np.ndarray, base_degree: int) -> tuple[Bands, BandLayout]:
    """Invert `dense_sh`, given the degrees: coefficients above a Gaussian's degree are dropped (host)."""
    bands = range(base_degree + 1, MAX_DEGREE + 1)
    dense = np.asarray(dense)
    return _packed([dense[:, NUM_BASES[band - 1] : NUM_BASES[band]] for band in bands], degrees, base_degree)


def _dense_tables(bands: Bands, layout: BandLayout) -> Iterator[np.ndarray]:
    """Yield each band as [N, 2l + 1, 3], zeros for Gaussians without it (host)."""
    for table, owners in zip(bands.tables, layout.owners, strict=True):
        rows = _owned(owners, layout.num)
        dense = np.zeros((layout.num, *table.shape[1:]), table.dtype)
        dense[rows] = on_host(table)[: len(rows)]
        yield dense


def _packed(
    dense: Iterable[np.ndarray], degrees: ArrayLike, base_degree: int, like: Sequence[Array] | None = None,
    room: Sequence[int] = (),
) -> tuple[Bands, BandLayout]:  # fmt: skip
    """Pack dense tables, one after the other, for Gaussians of these degrees; tables of bands without owners may lack
    columns. `like` are arrays over whose devices the rows are spread as their own; None: they lie on one."""
    degrees = np.asarray(degrees)
    tables, placed_owners = [], []
    owners = _owners(degrees, base_degree, room)
    bands = range(base_degree + 1, MAX_DEGREE + 1)
    former: Sequence[Array | None] = like or [None] * len(owners)
    for values, own, degree, old in zip(dense, owners, bands, former, strict=True):
        rows = _owned(own, len(degrees))
        filled = np.zeros((len(own), 2 * degree + 1, 3), values.dtype)
        if len(rows):
            filled[: len(rows)] = values[rows]
        tables.append(placed_like(filled, old))
        placed_owners.append(placed_like(own, old))
    return Bands(tuple(tables)), BandLayout(tuple(placed_owners), len(degrees))


def _owned(owners: Array | np.ndarray, num: int) -> np.ndarray:
    """Return the owners of the used rows, in the order of the rows."""
    found = on_host(owners)
    return found[found < num]
