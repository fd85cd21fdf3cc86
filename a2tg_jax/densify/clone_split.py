"""Adaptive density control (3DGS, Kerbl et al., 2023; 2DGS, Huang et al., 2024): clone, split, prune, reset opacities.

Arrays hold N rows, of which the first `num_live` exist. All changes happen inside the step at fixed shapes: later rows
move up over pruned ones, and copies are appended while there is room.
"""

import dataclasses
import math
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.base.checks import check_fields
from a2tg_jax.core.budget import number_to_reach
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.numerics import first_rows
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import partition, pytree, static
from a2tg_jax.events import (
    Change,
    EventInfo,
    GradientStatistics,
    Now,
    Statistic,
    StepEvent,
    Times,
    clear_moments,
    gather_moments,
    gather_rows,
    multiples,
)
from a2tg_jax.model import Model

SPLIT_SHRINK = 1.6
"""Factor by which the halves of a split Gaussian are smaller."""
LEAST_BETWEEN_RESETS = 500
RECOVERY = 100
"""Number of iterations after a reset without pruning of faint Gaussians: Adam needs them to raise an opacity again."""


class CloneSplitPlan(NamedTuple):
    """Kept rows and doubled rows; [N] booleans."""

    is_kept: Array
    is_cloned: Array
    is_split: Array


@pytree
class CloneSplitPrune(StepEvent):
    """Event that clones small Gaussians and splits large ones with large gradients, and prunes faint or too large ones.

    Adaptive density control of 3DGS (Kerbl et al., 2023), as 2DGS (Huang et al., 2024) uses it.

    It happens every max(10, n/300) of n iterations, from n/60 to n/2. The programs of 3DGS and 2DGS also have a largest
    radius on the screen. They reset the radii to 0 just before reading them, so it has no effect and is left out.

    Examples:
      >>> a2tg.CloneSplitPrune(cap=5000, threshold=2e-4).times(30_000)
      range(600, 15000, 100)
    """

    cap: int = static(default=500_000)
    """Largest number of Gaussians and of allocated rows; a memory_budget replaces it. If there is no room for all
    copies, the largest gradients come first, and the others are counted."""
    threshold: float = 2e-4
    """Smallest average gradient that is densified, by the position on the screen in units of half an image. With a
    memory_budget the largest gradients are densified, however small."""
    dense_share: float = 0.01
    """Share of scene_scale above which Gaussians are split; smaller ones are cloned."""
    least_opacity: float = 0.05  # as in 2DGS; 0.005 is compared in experiments/NOTEBOOK.md
    """Smallest opacity; fainter Gaussians are pruned."""
    largest_share: float = 0.1
    """Largest size as a share of scene_scale; larger Gaussians are pruned after the first reset of opacities."""

    limited_by = "cap"
    impossible: ClassVar[str] = "adaptive density control would prune every Gaussian; a lower least_opacity keeps some"

    def check_options(self) -> None:
        check_fields(self, "cap", least=2)
        check_fields(self, "threshold", "dense_share", "largest_share", least=0)
        check_fields(self, "least_opacity", least=0, most=0.99)

    @property
    def statistic(self) -> Statistic:
        return "center"

    def times(self, num_iterations: int) -> Times:
        # In 3DGS's program after 500 and before 15,000 of 30,000 iterations, every 100.
        return multiples(max(10, round(num_iterations / 300)), num_iterations // 60 + 1, num_iterations // 2 - 1)

    def num_rows(self, num: int, num_iterations: int) -> int:
        return max(num, self.cap)

    def apply(self, now: Now, model: Model, moments: AdamState, state: GradientStatistics) -> Change:
        plan, num_refused = self.plan(now, model, state.average())
        model, moments = apply_plan(now.keys[0], plan, model, moments)
        return Change(model, moments, self.init(model), EventInfo(jnp.any(plan.is_kept), num_refused))

    def plan(self, now: Now, model: Model, gradients: Array) -> tuple[CloneSplitPlan, Array]:
        """Return the plan of each row, given its average gradient, and the number of Gaussians without room."""
        is_kept = first_rows(model.num_rows, model.live_count) & ~self._is_pruned(now, model)
        # Copies of pruned rows would be pruned as well.
        is_wanted = is_kept & (gradients >= self.threshold)
        room = min(model.num_rows, self.cap) - jnp.sum(is_kept, dtype=jnp.int32)
        plan = self._planned(now, model, is_kept, is_wanted & (_ranks(gradients, is_wanted) < room))
        return plan, jnp.sum(is_wanted & ~(plan.is_cloned | plan.is_split), dtype=jnp.int32)

    def _is_pruned(self, now: Now, model: Model) -> Array:
        """Return a mask [N] of rows that are too faint or too large."""
        opacities = model.appearance.opacities(model.gaussians)
        between = reset_interval(now.num_iterations)
        is_late = now.iteration > between
        since_reset = now.iteration % between
        is_faint = (opacities < self.least_opacity) & ~(is_late & (since_reset < RECOVERY))
        return is_faint | (is_late & (jnp.max(model.gaussians.scales, axis=1) > self.largest_share * now.scene_scale))

    def _planned(self, now: Now, model: Model, is_kept: Array, is_doubled: Array) -> CloneSplitPlan:
        """Split large doubled rows and clone small ones."""
        is_large = jnp.max(model.gaussians.scales, axis=1) > self.dense_share * now.scene_scale
        return CloneSplitPlan(is_kept, is_doubled & ~is_large, is_doubled & is_large)


@pytree
class FillingDensity(CloneSplitPrune):
    """Variant of `CloneSplitPrune` whose growth in each event is chosen to end at the cap, regardless of the threshold.
    If pruning would leave too few Gaussians, the most opaque stay."""

    def num_rows(self, num: int, num_iterations: int) -> int:
        count = len(self.times(num_iterations))
        if num * 2.0**count < self.cap:
            raise ValueError(
                f"cap has room for {self.cap:,} Gaussians, but {num:,} Gaussians at most double in each of the "
                f"{count} densifications of {num_iterations} iterations"
            )
        return max(num, self.cap)

    def plan(self, now: Now, model: Model, gradients: Array) -> tuple[CloneSplitPlan, Array]:
        assert now.num_left is not None
        is_there = first_rows(model.num_rows, model.live_count)
        num_live = jnp.sum(is_there, dtype=jnp.int32)
        reached = number_to_reach(num_live, self.cap, now.num_left)
        # An event doubles a Gaussian once at most.
        reached = jnp.minimum(reached, 2 * num_live)
        is_kept = is_there & ~self._is_pruned(now, model)
        opacities = model.appearance.opacities(model.gaussians)
        # Rows that are kept anyway come first.
        place = _ranks(jnp.where(is_kept, jnp.inf, opacities), is_there)
        # Half of the number to reach, since each of these can be doubled.
        is_kept = is_kept | (is_there & jnp.any(is_kept) & (place < (reached + 1) // 2))
        num_doubled = reached - jnp.sum(is_kept, dtype=jnp.int32)
        is_doubled = is_kept & (_ranks(gradients, is_kept) < num_doubled)
        return self._planned(now, model, is_kept, is_doubled), jnp.zeros((), jnp.int32)


def _ranks(values: Array, is_ranked: Array) -> Array:
    """Return [N] int32 ranks in descending order of value. Ties keep the order of rows; unranked rows come last."""
    num = values.shape[0]
    order = jnp.argsort(jnp.where(is_ranked, -values, jnp.inf), stable=True)
    return jnp.zeros(num, jnp.int32).at[order].set(jnp.arange(num, dtype=jnp.int32))


def apply_plan(key: Array, plan: CloneSplitPlan, model: Model, moments: AdamState) -> tuple[Model, AdamState]:
    """Move kept rows up, in order, and append the copies of doubled ones. New rows start with zero moments.

    Both halves of a split Gaussian are drawn from it, each a Gaussian 1.6 times smaller. A clone has the place of its
    original, which keeps its moments.
    """
    num = model.num_rows
    index = jnp.arange(num, dtype=jnp.int32)
    is_doubled = plan.is_cloned | plan.is_split
    num_kept = jnp.sum(plan.is_kept, dtype=jnp.int32)
    num_copies = jnp.sum(is_doubled, dtype=jnp.int32)
    # Sorting masks stably puts marked rows first, in their order, at fixed shapes.
    kept_first = jnp.argsort(~plan.is_kept, stable=True).astype(jnp.int32)
    doubled_first = jnp.argsort(~is_doubled, stable=True).astype(jnp.int32)
    is_copy = (index >= num_kept) & (index < num_kept + num_copies)
    rows = jnp.where(is_copy, doubled_first[jnp.maximum(index - num_kept, 0)], kept_first)
    exists = index < num_kept + num_copies
    is_half = plan.is_split[rows] & exists
    moments = clear_moments(model, gather_moments(moments, rows), is_copy | is_half | ~exists)
    model = gather_rows(model, rows)
    gaussians = split_in_half(key, model.gaussians, is_half)
    return dataclasses.replace(model, gaussians=gaussians, num_live=num_kept + num_copies), moments


def split_in_half(key: Array, gaussians: Gaussians, is_half: Array) -> Gaussians:
    """Return marked rows [N] at a point drawn from their Gaussian, 1.6 times smaller."""
    drawn = jax.random.normal(key, gaussians.scales.shape, gaussians.means.dtype) * gaussians.scales
    axes = gaussians.rotations[:, :, :2]
    means = gaussians.means + jnp.sum(axes * drawn[:, None, :], axis=2)
    return dataclasses.replace(
        gaussians,
        means=jnp.where(is_half[:, None], means, gaussians.means),
        log_scales=gaussians.log_scales - jnp.where(is_half[:, None], math.log(SPLIT_SHRINK), 0.0),
    )


def reset_interval(num_iterations: Array | int) -> Array:
    """Return the iterations between two resets of opacities: 3,000 of 30,000 as published, scaled, at least 500."""
    return jnp.maximum(num_iterations // 10, LEAST_BETWEEN_RESETS)


@pytree
class OpacityReset(StepEvent):
    """Event that resets opacities above `most` to `most`: every max(500, n/10) of n iterations, until n/2.

    3DGS (Kerbl et al., 2023).
    """

    most: float = 0.01
    """Largest opacity after a reset, every max(500, n/10) of n iterations until n/2."""

    num_keys: ClassVar[int] = 0

    def check_options(self) -> None:
        check_fields(self, "most", above=0, below=1)

    def times(self, num_iterations: int) -> Times:
        every = int(reset_interval(num_iterations))
        return multiples(every, every, num_iterations // 2 - 1)

    def apply(self, now: Now, model: Model, moments: AdamState, state: tuple[()]) -> Change:
        gaussians, appearance = model.appearance.limit_opacities(model.gaussians, jnp.asarray(self.most))
        limited = dataclasses.replace(model, gaussians=gaussians, appearance=appearance)
        old_floats, _ = partition(model)
        new_floats, _ = partition(limited)

        def cleared(moment: Array, old: Array, new: Array) -> Array:
            # `is`: `limit_opacities` returns the same array where it changes nothing.
            return moment if new is old else jnp.zeros_like(moment)

        # Moments belong to the values before the reset.
        mu = jax.tree.map(cleared, moments.mu, old_floats, new_floats)
        nu = jax.tree.map(cleared, moments.nu, old_floats, new_floats)
        return Change(limited, dataclasses.replace(moments, mu=mu, nu=nu), state)
