"""Spherical harmonics with a degree per Gaussian, beyond the degree that all Gaussians have.

Band l holds the 2l + 1 coefficients of degree l. All Gaussians have those of `Gaussians.sh`. One of a higher degree has
a block of all bands between in a `core.table.Table`; one without takes no bytes there.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from a2tg_jax.appearance.part import Part
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.numerics import normalize
from a2tg_jax.core.pytree import pytree
from a2tg_jax.core.sh import NUM_BASES, sh_basis
from a2tg_jax.core.table import Places, Size, Table, check_places, check_table
from a2tg_jax.parallel.rows import on_host, placed_like

MAX_DEGREE = 3


@pytree(repr=False)
class Coefficients(Table):
    """Blocks [K, 3] of the coefficients that each Gaussian has beyond those of all; K is 0 without any."""

    owners: tuple[Array, ...] = ()
    """[capacity] int32 Gaussian of each row of each bucket; N for a row of padding."""

    num_sides: ClassVar[int] = 1
    padding: ClassVar[tuple[float, ...]] = (0.0, 0.0, 0.0)

    @classmethod
    def placed(cls, buckets: Sequence[Any], places: Places) -> Self:
        bucket, row, num = on_host(places.bucket), on_host(places.row), places.bucket.shape[0]
        owners = []
        for index, blocks in enumerate(buckets):
            own = np.full(len(blocks), num, np.int32)
            own[row[bucket == index]] = np.flatnonzero(bucket == index)
            owners.append(placed_like(own, places.bucket))
        return cls(tuple(map(jnp.asarray, buckets)), *places, tuple(owners))

    @staticmethod
    def resized(blocks: np.ndarray, size: Size) -> np.ndarray:
        """Return blocks [M, K, 3] with other numbers of coefficients: kept ones stay, new ones are 0 (host)."""
        missing = max(0, size[0] - blocks.shape[1])
        return np.pad(blocks, ((0, 0), (0, missing), (0, 0)))[:, : size[0]]


@pytree
class Bands(Part):
    """View dependence of a degree per Gaussian."""

    coefficients: Coefficients | None = None
    """Coefficients of N Gaussians; None until allocated."""

    def allocate(self, gaussians: Gaussians) -> "Bands":
        degrees = np.full(gaussians.num, gaussians.sh_degree)
        return dataclasses.replace(self, coefficients=empty_bands(degrees, gaussians.sh_degree, gaussians.means.dtype))

    def check(self, gaussians: Gaussians) -> None:
        assert self.coefficients is not None
        check_table(self.coefficients, gaussians.num, "bands.coefficients")
        check_places(self.coefficients, "bands.coefficients")
        possible = {number - NUM_BASES[gaussians.sh_degree] for number in NUM_BASES[gaussians.sh_degree :]}
        if unknown := {size for (size,) in self.coefficients.bucket_sizes} - possible:
            raise ValueError(
                f"bands.coefficients have blocks of {min(unknown)} coefficients, which no degree above "
                f"{gaussians.sh_degree}, the degree of the Gaussians, has"
            )

    def color_sums(self, gaussians: Gaussians, center: Array, degree: Any) -> Array:
        """Return the sums [N, 3] that the bands add to Σ Y_l·sh_l, before 0.5 is added and negatives are cut off.

        Args:
          gaussians: N Gaussians, of which degree and means are read.
          center: [3] camera centre in the world.
          degree: highest degree used; may be traced.
        """
        table, base, means = self.coefficients, gaussians.sh_degree, gaussians.means
        assert table is not None
        total = jnp.zeros(means.shape, jnp.result_type(means, center, *table.buckets))
        for blocks, owners in zip(table.buckets, table.owners, strict=True):
            if not blocks.size:
                continue
            bases = sh_basis(normalize(means[jnp.minimum(owners, table.num - 1)] - center[None, :]))
            colors = jnp.zeros((len(blocks), 3), total.dtype)
            for band in range(base + 1, MAX_DEGREE + 1):
                first, last = NUM_BASES[band - 1], NUM_BASES[band]
                if blocks.shape[1] < last - NUM_BASES[base]:
                    break
                basis = jnp.where(jnp.asarray(degree) >= band, bases[:, first:last], 0.0)
                own = blocks[:, first - NUM_BASES[base] : last - NUM_BASES[base]]
                colors = colors + jnp.sum(basis[:, :, None] * own, axis=1)
            total = total.at[owners].add(colors, mode="drop")
        return total


def floats_of_band(degree: int) -> int:
    """Return the floats of a band of one Gaussian: 9, 15 and 21 for degree 1, 2 and 3."""
    return 3 * (2 * degree + 1)


def sizes_of_degrees(degrees: np.ndarray, base_degree: int) -> np.ndarray:
    """Return the sizes [N, 1] of the blocks of Gaussians of the given degrees.

    Raises:
      ValueError: if a degree is out of range.
    """
    if degrees.size and not base_degree <= degrees.min() <= degrees.max() <= MAX_DEGREE:
        raise ValueError(f"degrees must be in {base_degree}..3; got {degrees.min()}..{degrees.max()}")
    sizes: np.ndarray = np.asarray(NUM_BASES)[degrees] - NUM_BASES[base_degree]
    return sizes[:, None]


def degrees_of_sizes(sizes: np.ndarray, base_degree: int) -> np.ndarray:
    """Return the degrees [N] of Gaussians with blocks of the given sizes [N, 1]."""
    return np.searchsorted(NUM_BASES, sizes[:, 0] + NUM_BASES[base_degree])


def empty_bands(degrees: ArrayLike, base_degree: int, dtype: DTypeLike = jnp.float32) -> Coefficients:
    """Return coefficients of zero for Gaussians of the given degrees [N] (host)."""
    return Coefficients.allocate(sizes_of_degrees(np.asarray(degrees), base_degree), (0.0, 0.0, 0.0), dtype)


def dense_bands(coefficients: Coefficients, base_degree: int) -> np.ndarray:
    """Return all coefficients above the base degree [N, K, 3], zeros above a Gaussian's degree; K is that of degree 3
    (host)."""
    dtype = coefficients.buckets[0].dtype if coefficients.buckets else np.float32
    dense = np.zeros((coefficients.num, NUM_BASES[MAX_DEGREE] - NUM_BASES[base_degree], 3), dtype)
    for blocks, owners in zip(coefficients.buckets, coefficients.owners, strict=True):
        rows = on_host(owners)
        is_used = rows < coefficients.num
        dense[rows[is_used], : blocks.shape[1]] = on_host(blocks)[is_used]
    return dense


def bands_of_dense(dense: np.ndarray, degrees: np.ndarray, base_degree: int) -> Coefficients:
    """Invert `dense_bands`, given the degrees [N]: coefficients above a Gaussian's degree are dropped (host)."""
    dense = np.asarray(dense)
    table = empty_bands(degrees, base_degree, dense.dtype)
    filled = []
    for blocks, owners in zip(table.buckets, table.owners, strict=True):
        rows, values = np.asarray(owners), np.zeros(blocks.shape, dense.dtype)
        is_used = rows < table.num
        values[is_used] = dense[rows[is_used], : blocks.shape[1]]
        filled.append(jnp.asarray(values))
    return dataclasses.replace(table, buckets=tuple(filled))
