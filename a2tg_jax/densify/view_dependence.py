"""Adaptive spherical harmonics: a degree per Gaussian, raised where the gradient is large, lowered where it is idle.

The image is linear in the coefficients. So the gradient of a coefficient that a Gaussian does not have yet is known: Σ
over views of ∂L/∂colour · Y(direction). Residuals that many views share add up in it, others cancel.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from a2tg_jax.appearance.parts import MAX_DEGREE, Coefficients, degrees_of_sizes, floats_of_band, sizes_of_degrees
from a2tg_jax.base.checks import check_fields
from a2tg_jax.base.text import bytes_of
from a2tg_jax.core.budget import BYTES_PER_FLOAT, MOST_ROOM, event_budget, within_budget
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.core.sh import NUM_BASES, directions_from, sh_basis
from a2tg_jax.core.table import Layout, Size, resize
from a2tg_jax.events import Change, Due, FractionsEvent, Seen
from a2tg_jax.model import Model


@pytree
class BandStatistics:
    """Sums over views of the gradient at all 16 coefficients of each Gaussian, whether it has them or not."""

    total: Array
    """[N, 16, 3]."""
    views: Array
    """[] int32, views so far."""

    @staticmethod
    def init(num: int, dtype: DTypeLike = jnp.float32) -> "BandStatistics":
        """Return empty sums for `num` Gaussians."""
        return BandStatistics(jnp.zeros((num, NUM_BASES[-1], 3), dtype), jnp.zeros((), jnp.int32))

    def observe(self, means: Array, centers: Array, colors: Array) -> "BandStatistics":
        """Add V views: cameras at centers [V, 3], and gradients [V, N, 3] by the colour of each Gaussian."""
        total = self.total
        # One view at a time: all at once would take [V, N, 16, 3].
        for center, color in zip(centers, colors, strict=True):
            basis = sh_basis(directions_from(center, means))
            total = total + basis[:, :, None] * color[:, None, :]
        return BandStatistics(total, self.views + len(colors))

    def strengths(self) -> np.ndarray:
        """Return [N, 3] norm of the average gradient at the coefficients of degree 1, 2 and 3 (host)."""
        total = np.asarray(self.total)
        views = max(1, int(self.views))
        bands = [total[:, first:end] / views for first, end in itertools.pairwise(NUM_BASES)]
        return np.stack([np.linalg.norm(band, axis=(1, 2)) for band in bands], axis=1)


@pytree
class AdaptDegrees(FractionsEvent):
    """Event that lowers idle degrees and raises others by one where the gradient per byte is largest, within a budget.

    It needs an appearance with `Bands`.
    """

    budget_mb: float = 0.0
    """Largest reported memory in MB (10^6 bytes)."""
    at: tuple[float, ...] = static(default=(0.05, 0.1))
    """Fractions of the stage at which degrees change. Each time spends an equal part of the remaining budget."""
    highest: int = static(default=MAX_DEGREE)
    """Highest degree."""
    idle: float = 0.0
    """Smallest change of a colour by a band (root mean square over all directions); bands below it are removed."""

    observes = True  # `Seen.colors`, which needs no statistic

    def check_options(self) -> None:
        super().check_options()
        check_fields(self, "budget_mb", "idle", least=0)
        check_fields(self, "highest", least=0, most=MAX_DEGREE)

    def num_programs(self, num_iterations: int) -> int:
        return 0  # `with_room` has made room, unless degrees may take more than half of the budget.

    def most_bytes(self, num_bytes: float, num: int, num_iterations: int) -> float:
        of_bands = BYTES_PER_FLOAT * 3 * NUM_BASES[self.highest] * num
        return max(num_bytes, min(bytes_of(self.budget_mb), num_bytes + of_bands))

    def with_room(
        self, model: Model, moments: AdamState, num_bytes: float, num_iterations: int
    ) -> tuple[Model, AdamState]:
        table = model.appearance.coefficients
        base = model.gaussians.sh_degree
        if table is None:
            return model, moments
        budget = bytes_of(self.budget_mb)
        left = budget - model.num_bytes + BYTES_PER_FLOAT * table.count_floats(model.num)
        # Each time raises a degree by one.
        highest = min(self.highest, base + len(self.times(num_iterations)))
        room = most_blocks(left, base, highest, model.num, table)
        if BYTES_PER_FLOAT * len(table.padding) * room.num_elements > MOST_ROOM * budget:
            return model, moments
        table, moments = resize(table, table.sizes, moments, room=room)
        return dataclasses.replace(model, appearance=model.appearance.with_coefficients(table)), moments

    def init(self, model: Model) -> BandStatistics:
        return BandStatistics.init(model.num_rows, model.gaussians.means.dtype)

    def observe(self, state: BandStatistics, model: Model, seen: Seen) -> BandStatistics:
        centers = jax.vmap(lambda camera: camera.center)(seen.cameras)
        return state.observe(model.gaussians.means, centers, seen.colors)

    def apply(self, due: Due, model: Model, moments: AdamState, state: BandStatistics) -> Change:
        table = model.appearance.coefficients
        base = model.gaussians.sh_degree
        num = model.num
        if table is None:
            raise ValueError(
                f"{model.appearance.description} cannot raise degrees: the stage needs Appearance(bands=Bands())"
            )
        degrees = without_idle(table, base, self.idle)
        floats = 3 * np.asarray(NUM_BASES)
        # Bytes of bands that are removed now can be spent at once.
        saved = BYTES_PER_FLOAT * int((floats[model.degrees[:num]] - floats[degrees[:num]]).sum())
        used = model.num_bytes - saved
        budget = event_budget(bytes_of(self.budget_mb), used, due.index, due.count)
        degrees[:num] = raised_degrees(degrees[:num], state.strengths()[:num], budget, self.highest)
        table, moments = resize(table, sizes_of_degrees(degrees, base), moments, room=table.layout)
        model = dataclasses.replace(model, appearance=model.appearance.with_coefficients(table))
        return Change(model, moments, self.init(model))


def most_blocks(num_bytes: float, base_degree: int, highest: int, num: int, table: Coefficients) -> Layout:
    """Return a layout with room for all blocks, of degrees up to the highest, that `num` Gaussians can have within some
    bytes (host)."""
    # All Gaussians may have none.
    counts: dict[Size, int] = {(0,): table.num}
    for degree in range(base_degree + 1, highest + 1):
        size = NUM_BASES[degree] - NUM_BASES[base_degree]
        count = min(num, max(0, int(num_bytes // (BYTES_PER_FLOAT * 3 * size))))
        if count:
            counts[size,] = count
    return Layout.of(counts)


def without_idle(table: Coefficients, base_degree: int, idle: float) -> np.ndarray:
    """Return [N] degrees, one less if the highest band changes the colour by less than `idle` (host).

    Spherical harmonics are orthonormal. So the mean square of a band, over all directions and three channels, is the
    sum of its squared coefficients divided by 12π.
    """
    degrees = degrees_of_sizes(table.sizes, base_degree)
    for blocks, owners in zip(table.buckets, table.owners, strict=True):
        rows = np.asarray(owners)
        is_used = rows < table.num
        rows = rows[is_used]
        if not blocks.size or not len(rows):
            continue
        # All blocks of a bucket are of one degree.
        last = floats_of_band(int(degrees[rows[0]])) // 3
        energy = np.square(np.asarray(blocks)[is_used][:, -last:]).sum(axis=(1, 2)) / (12 * np.pi)
        degrees[rows[energy < idle**2]] -= 1
    return degrees


def raised_degrees(degrees: np.ndarray, strengths: np.ndarray, budget: float, highest: int = MAX_DEGREE) -> np.ndarray:
    """Return [N] degrees, raised by one in descending order of gradient per added byte within a budget (host).

    Strengths [N, 3] are of the bands of degree 1, 2 and 3; the budget is in bytes.
    """
    # Gaussians of the highest degree need some valid band here, and are no candidates below.
    following = np.minimum(degrees, MAX_DEGREE - 1)
    cost = BYTES_PER_FLOAT * np.asarray([floats_of_band(degree) for degree in (1, 2, 3)])[following]
    strength = np.take_along_axis(strengths, following[:, None], axis=1)[:, 0]
    is_candidate = (degrees < highest) & (strength > 0)
    return degrees + within_budget(strength, is_candidate, cost, budget)
