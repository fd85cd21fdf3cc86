"""Depth priors: the rendered inverse depth against a depth map that is known up to scale and shift."""

from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.numerics import safe_divide
from a2tg_jax.events import event, static
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderOutput
from a2tg_jax.training.terms import Target

DepthKind = Literal["inverse", "depth"]
"""Meaning of depth maps: inverse depth up to scale and shift (monocular networks), or depth up to scale (sensors,
networks of metric depth, of which 0 is unknown)."""
LEAST_ALPHA = 0.5
"""Least rendered alpha of pixels that are compared."""


@event
class DepthPrior:
    """Mean absolute difference of inverse depths after scale and shift of least squares (`depth_loss`)."""

    weight: float
    kind: DepthKind = static(default="inverse")

    has_geometry = True
    has_depths = True

    def __call__(self, model: Model, target: Target, output: RenderOutput) -> Array:
        assert target.depth is not None
        prior = target.depth if self.kind == "inverse" else safe_divide(jnp.ones_like(target.depth), target.depth)
        counts = jnp.isfinite(prior) if self.kind == "inverse" else target.depth > 0
        if target.mask is not None:
            counts = counts & target.mask
        return self.weight * depth_loss(output.depth, output.alpha, prior, counts, has_shift=self.kind == "inverse")


def depth_loss(depth: Array, alpha: Array, prior: Array, counts: Array, *, has_shift: bool = True) -> Array:
    """Mean |s·prior + t − alpha/depth| over the pixels that count and are covered.

    s ≥ 0 and t are the least squares solution of this view. No gradient goes through them.

    Args:
      depth: [H, W] rendered depth Σ z·α·T, not divided by alpha.
      alpha: [H, W] rendered alpha.
      prior: [H, W] inverse depth up to scale and shift.
      counts: [H, W] bool, the pixels in which the prior is known.
      has_shift: whether there is a shift; without, t = 0.

    Returns:
      A scalar; 0 if no pixel counts.
    """
    counts = counts & (alpha > LEAST_ALPHA) & (depth > 0)
    inverse = jnp.where(counts, safe_divide(alpha, depth), 0.0)
    prior = jnp.where(counts, prior, 0.0)
    scale, shift = jax.lax.stop_gradient(scale_and_shift(prior, inverse, counts, has_shift=has_shift))
    error = jnp.where(counts, jnp.abs(scale * prior + shift - inverse), 0.0)
    return jnp.sum(error) / jnp.maximum(jnp.sum(counts), 1).astype(error.dtype)


def scale_and_shift(prior: Array, inverse: Array, counts: Array, *, has_shift: bool = True) -> tuple[Array, Array]:
    """Return s ≥ 0 and t that minimise Σ (s·prior + t − inverse)² over the pixels that count.

    Where all values of the prior are equal, s is 0.
    """
    weights = counts.astype(prior.dtype)
    num = jnp.maximum(jnp.sum(weights), 1)
    zero = jnp.zeros((), prior.dtype)
    middle, wanted = (jnp.sum(weights * x) / num if has_shift else zero for x in (prior, inverse))
    centered = weights * (prior - middle)
    scale = safe_divide(jnp.sum(centered * (inverse - wanted)), jnp.sum(centered * centered))
    scale = jnp.maximum(scale, 0)
    return scale, wanted - scale * middle
