"""Densification that splits where the image is wrong: the schedule of MCMC, with hosts by gradient and halves.

3DGS-MCMC (`mcmc`) draws hosts by opacity and puts copies at the host's position. They separate slowly, and not where
detail is missing. Here the weight of a host is the change of the loss by a move of its own size. Host and copies become
halves, each at a point drawn from the host and 1.6 times smaller, as in adaptive density control (`clone_split`).

The low-pass filter draws every splat at least as large as itself. Two halves of a smaller splat that kept its opacity
would cover the same pixels and be about twice as opaque together, whereas two halves of a large splat cover 2/1.6² =
0.78 of its area. So halves share opacity in proportion to what the filter adds to their area (`logits_of_halves`).

Hosts are drawn without replacement. A splat at an outlying point covers whole views, so its weight is thousands of
times larger than others: with replacement it would be the host of nearly all new Gaussians.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.gaussians import logit, shared_opacities
from a2tg_jax.core.geometry import FILTER_VARIANCE, pixel_sizes
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import pytree
from a2tg_jax.densify.clone_split import SPLIT_SHRINK, split_in_half
from a2tg_jax.events import Change, EventInfo, GradientStatistics, Now, Seen, Statistic, clear_moments, gather_rows
from a2tg_jax.mcmc import FillingMcmc, Moves, plan_growth, plan_relocation
from a2tg_jax.model import Model

LEAST_WEIGHT = 1e-12
"""Weight of a host that no view has seen."""


@pytree
class SplitStatistics:
    """Statistics of N Gaussians over the steps since their last split."""

    gradients: GradientStatistics
    pixels: Array
    """[N] largest of the smaller standard deviations on the screen, in pixels; 0 if no view has composited it."""


@pytree
class SplitByGradient(FillingMcmc):
    """Event that moves dead Gaussians and adds new ones up to the cap, where the average gradient times the size is
    largest."""

    @property
    def statistic(self) -> Statistic:
        return "position"

    def init(self, model: Model) -> SplitStatistics:
        num = model.num_rows
        dtype = model.gaussians.means.dtype
        return SplitStatistics(GradientStatistics.init(num, dtype), jnp.zeros((num,), dtype))

    def observe(self, state: SplitStatistics, model: Model, seen: Seen) -> SplitStatistics:
        gaussians = model.gaussians
        of_view = functools.partial(pixel_sizes, gaussians.means, gaussians.scales)
        sizes = jnp.where(seen.is_visible, jax.vmap(of_view)(seen.cameras.viewmat, seen.cameras.K), 0.0)
        gradients = state.gradients.observe_views(seen.gradients, seen.is_visible)
        return SplitStatistics(gradients, jnp.maximum(state.pixels, jnp.max(sizes, axis=0)))

    def apply(self, now: Now, model: Model, moments: AdamState, state: SplitStatistics) -> Change:
        to_move, to_add, to_split = jax.random.split(now.keys[0], 3)
        num_live = model.live_count
        draw = functools.partial(draw_distinct_hosts, host_weights(model, state))
        moves = plan_relocation(to_move, model.appearance.opacities(model.gaussians), num_live, draw)
        model, moments, state = split_rows(to_split, moves, model, moments, state)
        cap = min(self.cap, model.num_rows)
        least = self.least(now, num_live)
        # Weights again, because moved rows are smaller and share their statistic.
        draw = functools.partial(draw_distinct_hosts, host_weights(model, state))
        moves = plan_growth(to_add, model.appearance.opacities(model.gaussians), num_live, cap, least, draw)
        model, moments, state = split_rows(now.keys[1], moves, model, moments, state)
        return Change(model, moments, state, EventInfo(is_possible=moves.info.has_hosts))


def host_weights(model: Model, state: SplitStatistics) -> Array:
    """Return [N] weights of hosts: average gradient by position, times the size."""
    return state.gradients.average() * model.gaussians.sizes + LEAST_WEIGHT


def draw_distinct_hosts(weights: Array, key: Array, is_host: Array, is_target: Array) -> Array:
    """Draw a host [N] int32 for every target with probability ∝ weight, none twice before each was drawn once.

    The order of log-weights plus Gumbel noise equals successive draws without replacement (Yellott, 1977). Only the
    entries of targets have a meaning, if there are any hosts.
    """
    # From 100,000 points: 26.0 dB, and 15.1 with replacement (experiments/NOTEBOOK.md).
    noisy = jnp.log(weights) + jax.random.gumbel(key, weights.shape, weights.dtype)
    order = jnp.argsort(jnp.where(is_host, -noisy, jnp.inf)).astype(jnp.int32)
    place = jnp.cumsum(is_target, dtype=jnp.int32) - 1
    # With more targets than hosts the order begins again.
    return order[jnp.maximum(place, 0) % jnp.maximum(jnp.sum(is_host, dtype=jnp.int32), 1)]


def split_rows(
    key: Array, moves: Moves, model: Model, moments: AdamState, state: SplitStatistics
) -> tuple[Model, AdamState, SplitStatistics]:
    """Copy rows from their hosts. Hosts and copies are halved, lose Adam's moments and share the statistic."""
    is_split = moves.is_reset | (moves.rows != jnp.arange(model.num_rows, dtype=jnp.int32))
    pixels = state.pixels[moves.rows]
    total = state.gradients.total / moves.num_shares.astype(state.gradients.total.dtype)
    gradients = GradientStatistics(total[moves.rows], state.gradients.views[moves.rows])
    # On the screen, halves are 1.6 times smaller as well.
    state = SplitStatistics(gradients, jnp.where(is_split, pixels / SPLIT_SHRINK, pixels))
    moments = clear_moments(model, moments, is_split)
    num_live = model.live_count + moves.info.num_added
    model = dataclasses.replace(gather_rows(model, moves.rows), num_live=num_live)
    gaussians = split_in_half(key, model.gaussians, is_split)
    if model.appearance.has_low_pass:
        logits = logits_of_halves(gaussians.logit_opacities, pixels)
        logits = jnp.where(is_split, logits, gaussians.logit_opacities)
        gaussians = dataclasses.replace(gaussians, logit_opacities=logits)
    return dataclasses.replace(model, gaussians=gaussians), moments, state


def logits_of_halves(logit_opacities: Array, pixels: Array) -> Array:
    """Return the logits of the opacities [N] of the halves of splats, given the logits before.

    The filter draws a splat over an area of max(s², filter²), where s [N] is its standard deviation in pixels. Without
    it, halves would have 1/1.6² of that area. Where the filter makes them k times larger, k in 1..1.6², their opacity
    is 1 − (1 − o)^(1/k), but not below the death opacity. Splats of 0 pixels, which no view has shown, keep theirs.
    """
    whole = jnp.maximum(pixels * pixels, FILTER_VARIANCE)
    half = jnp.maximum((pixels / SPLIT_SHRINK) ** 2, FILTER_VARIANCE)
    ratio = SPLIT_SHRINK**2 * half / whole
    shared = logit(shared_opacities(logit_opacities, ratio))
    return jnp.where((pixels > 0) & (ratio > 1), jnp.minimum(shared, logit_opacities), logit_opacities)
