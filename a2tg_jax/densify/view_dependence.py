"""Adaptive spherical harmonics: a degree per Gaussian, raised where the gradient is large, lowered where it is idle.

The image is linear in the coefficients. So the gradient of a coefficient that a Gaussian does not have yet is known: Σ
over views of ∂L/∂colour · Y(direction). Residuals that many views share add up in it, others cancel.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.sh_bands import MAX_DEGREE, BandLayout, Bands, floats_of_band, reallocate_bands
from a2tg_jax.core.budget import BYTES_PER_FLOAT, MOST_ROOM, bytes_of, event_budget, within_budget
from a2tg_jax.core.numerics import normalize
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.core.sh import NUM_BASES, sh_basis
from a2tg_jax.core.spread_arrays import on_host, zeros_beside
from a2tg_jax.events import Change, Due, HostEvent, Seen, iterations_at
from a2tg_jax.model import Model


@pytree
class ViewDependence:
    """Sums over views of the gradient at all 16 coefficients of each Gaussian, whether it has them or not."""

    total: Array
    """[N, 16, 3]."""
    views: Array
    """[] int32, views so far."""

    @staticmethod
    def init(num: int, dtype: Any = jnp.float32, like: Array | None = None) -> "ViewDependence":
        """Return empty sums for `num` Gaussians, whose rows are spread as those of an array `like` (None: on one
        device)."""
        return ViewDependence(zeros_beside(like, (num, 16, 3), dtype), zeros_beside(like, (), jnp.int32))

    def observe(self, means: Array, centers: Array, colors: Array) -> "ViewDependence":
        """Add V views.

        Args:
          means: [N, 3] of the Gaussians.
          centers: [V, 3] of the cameras.
          colors: [V, N, 3] gradients by the colour of each Gaussian.
        """
        total = self.total
        for center, color in zip(centers, colors, strict=True):
            basis = sh_basis(normalize(means - center[None, :]))
            total = total + basis[:, :, None] * color[:, None, :]
        return ViewDependence(total, self.views + len(colors))

    def strengths(self) -> np.ndarray:
        """Return [N, 3] norm of the average gradient at the coefficients of degree 1, 2 and 3 (host)."""
        total, views = on_host(self.total), max(1, int(self.views))
        return np.stack([np.linalg.norm(total[:, band] / views, axis=(1, 2)) for band in BAND_SLICES], axis=1)


BAND_SLICES = tuple(slice(NUM_BASES[degree - 1], NUM_BASES[degree]) for degree in (1, 2, 3))


@pytree
class AdaptDegrees(HostEvent):
    """Event that lowers idle degrees and raises others by one where the gradient per byte is largest, within a budget.

    It needs `appearance.Banded`.
    """

    budget_mb: float = 0.0
    """Largest reported memory in MB (10^6 bytes)."""
    at: tuple[float, ...] = static(default=(0.05, 0.1))
    """Fractions of the stage at which degrees change. Each time spends an equal part of the remaining budget."""
    highest: int = static(default=MAX_DEGREE)
    """Highest degree."""
    idle: float = 0.0
    """Smallest change of a colour by a band (root mean square over all directions); bands below it are removed."""

    observes = True
    reads_whole = False

    def iterations(self, num_iterations: int) -> tuple[int, ...]:
        return iterations_at(self.at, num_iterations, of=self)

    def num_programs(self, num_iterations: int) -> int:
        return 0  # Tables have room, unless degrees may take more than half of the budget.

    def most_bytes(self, num_bytes: float, num: int, num_iterations: int) -> float:
        return max(num_bytes, bytes_of(self.budget_mb))

    def with_room(
        self, model: Model, moments: AdamState, num_bytes: float, num_iterations: int
    ) -> tuple[Model, AdamState]:
        if model.bands is None:
            return model, moments
        bands, layout = model.bands
        budget = bytes_of(self.budget_mb)
        left = budget - model.num_bytes + BYTES_PER_FLOAT * layout.count_floats(model.num)
        highest = min(self.highest, layout.base_degree + len(self.iterations(num_iterations)))
        room = most_rows(left, layout.base_degree, highest, model.num)
        floats = sum(rows * floats_of_band(band) for rows, band in zip(room, layout.bands, strict=True))
        if BYTES_PER_FLOAT * floats > MOST_ROOM * budget:
            return model, moments
        bands, layout, moments = reallocate_bands(bands, layout, layout.degrees, moments, room)
        return model.with_bands(bands, layout), moments

    def init(self, model: Model) -> ViewDependence:
        return ViewDependence.init(model.gaussians.num, model.gaussians.means.dtype, model.gaussians.means)

    def observe(self, state: ViewDependence, model: Model, seen: Seen) -> ViewDependence:
        centers = jax.vmap(lambda camera: camera.center)(seen.cameras)
        return state.observe(model.gaussians.means, centers, seen.colors)

    def apply(self, due: Due, model: Model, moments: AdamState, state: ViewDependence) -> Change:
        if model.bands is None:
            raise ValueError(f"{type(model.appearance).__name__} has no degrees that could rise; Banded has")
        (bands, layout), num = model.bands, model.num
        degrees = without_idle(bands, layout, self.idle)
        used = model.num_bytes - saved_bytes(layout, degrees, num)
        budget = event_budget(bytes_of(self.budget_mb), used, due.index, due.count)
        degrees[:num] = raised(degrees[:num], state.strengths()[:num], budget, self.highest)
        room = [len(owners) for owners in layout.owners]
        bands, layout, moments = reallocate_bands(bands, layout, degrees, moments, room)
        model = model.with_bands(bands, layout)
        return Change(model, moments, self.init(model))


def most_rows(num_bytes: float, base_degree: int, highest: int, num: int) -> list[int]:
    """Return the largest number of rows that the table of each band above `base_degree` can need within some bytes.

    A row of a band comes with one of each band below it. Bands above `highest` need none.
    """
    rows, cost = [], 0
    for degree in range(base_degree + 1, MAX_DEGREE + 1):
        cost += BYTES_PER_FLOAT * floats_of_band(degree)
        rows.append(min(num, max(0, int(num_bytes // cost))) if degree <= highest else 0)
    return rows


def without_idle(bands: Bands, layout: BandLayout, idle: float) -> np.ndarray:
    """Return [N] degrees, one less if the highest band changes the colour by less than `idle` (host).

    Spherical harmonics are orthonormal. So the mean square of a band, over all directions and three channels, is the
    sum of its squared coefficients divided by 12π.
    """
    degrees = layout.degrees
    highest = degrees.copy()
    for band, table, owners in zip(layout.bands, bands.tables, layout.owners, strict=True):
        rows = on_host(owners)[on_host(owners) < layout.num]
        energy = np.square(on_host(table)[: len(rows)]).sum(axis=(1, 2)) / (12 * np.pi)
        is_idle = (energy < idle**2) & (degrees[rows] == band)
        highest[rows[is_idle]] -= 1
    return highest


def saved_bytes(layout: BandLayout, degrees: np.ndarray, num: int) -> int:
    """Return the bytes that the first `num` Gaussians save at lower degrees (host)."""
    floats = np.asarray([3 * NUM_BASES[degree] for degree in range(MAX_DEGREE + 1)])
    return BYTES_PER_FLOAT * int((floats[layout.degrees[:num]] - floats[degrees[:num]]).sum())


def raised(degrees: np.ndarray, strengths: np.ndarray, budget: float, highest: int = MAX_DEGREE) -> np.ndarray:
    """Return [N] degrees, raised by one in descending order of gradient per added byte within a budget (host).

    Args:
      degrees: [N] 0 to 3.
      strengths: [N, 3] of the bands of degree 1, 2 and 3.
      budget: bytes.
      highest: largest degree.
    """
    following = np.minimum(degrees, MAX_DEGREE - 1)
    cost = BYTES_PER_FLOAT * np.asarray([floats_of_band(degree) for degree in (1, 2, 3)])[following]
    strength = np.take_along_axis(strengths, following[:, None], axis=1)[:, 0]
    is_candidate = (degrees < highest) & (strength > 0)
    raised: np.ndarray = degrees + within_budget(strength, is_candidate, cost, budget)
    return raised
