"""Depth priors: the rendered inverse depth against a depth map, or against the points that a photograph observed.

Depth maps are known up to scale and shift; the points of a reconstruction have the scale of its cameras.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.numerics import safe_divide
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.data.observations import ObservedPoints
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderOutput
from a2tg_jax.training.terms import Target

DepthKind = Literal["inverse", "depth"]
"""Meaning of depth maps: inverse depth up to scale and shift (monocular networks), or depth up to scale (sensors,
networks of metric depth, of which 0 is unknown)."""
LEAST_ALPHA = 0.5
"""Least rendered alpha of pixels that are compared."""


@pytree
class DepthPrior:
    """Mean absolute difference of inverse depths after scale and shift of least squares (`depth_loss`)."""

    weight: float
    kind: DepthKind = static(default="inverse")

    name = "depth"
    has_geometry = True
    has_depths = True

    def __call__(self, model: Model, target: Target, output: RenderOutput) -> Array:
        prior = target.depth if self.kind == "inverse" else safe_divide(jnp.ones_like(target.depth), target.depth)
        counts = jnp.isfinite(prior) if self.kind == "inverse" else target.depth > 0
        if target.mask is not None:
            counts = counts & target.mask
        return self.weight * depth_loss(output.depth, output.alpha, prior, counts, has_shift=self.kind == "inverse")


@pytree
class PointDepths:
    """Mean absolute difference of inverse depths at the points that the photograph observed (`points_loss`)."""

    weight: float

    name = "points"
    has_geometry = True
    has_points = True

    def __call__(self, model: Model, target: Target, output: RenderOutput) -> Array:
        return self.weight * points_loss(output.depth, output.alpha, target.points, target.mask)


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
    return _mean_error(scale * prior + shift, inverse, counts)


def points_loss(depth: Array, alpha: Array, points: ObservedPoints, mask: Array | None = None) -> Array:
    """Mean |1/z − alpha/depth| over the pixels of points of depth z that count and are covered.

    Args:
      depth: [H, W] rendered depth Σ z·α·T, not divided by alpha.
      alpha: [H, W] rendered alpha.
      points: [S], as `ObservedPoints` has them.
      mask: [H, W] bool, True at pixels that count; None: all.

    Returns:
      A scalar; 0 if no point counts.
    """
    depth, alpha = (_at(points.pixels, image) for image in (depth, alpha))
    counts = (points.depths > 0) & (alpha > LEAST_ALPHA) & (depth > 0)
    if mask is not None:
        counts = counts & _at(points.pixels, mask)
    known = safe_divide(jnp.ones_like(points.depths), points.depths)
    inverse, known = (jnp.where(counts, x, 0.0) for x in (safe_divide(alpha, depth), known))
    return _mean_error(known, inverse, counts)


def _at(pixels: Array, image: Array) -> Array:
    """Return the values [S] of an image [H, W] at pixels in order, 0 at those beyond its end."""
    values: Array = (
        image.reshape(-1).at[pixels].get(mode="fill", fill_value=0, unique_indices=True, indices_are_sorted=True)
    )
    return values


def _mean_error(one: Array, other: Array, counts: Array) -> Array:
    """Return the mean absolute difference over those that count; 0 if none does."""
    error = jnp.where(counts, jnp.abs(one - other), 0.0)
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
