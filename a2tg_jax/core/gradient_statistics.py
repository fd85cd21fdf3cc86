"""The average gradient of each Gaussian over the views that saw it, by which events choose where detail is added.

A²TG averages ‖Σ_pixels |∂L/∂mean|‖ to choose what gets texels; adaptive density control averages the norm of the
gradient of the projected mean to choose what is cloned or split.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.checks import check_floats, check_shape
from a2tg_jax.core.numerics import safe_divide, safe_norm


def read_probe(found: Array, statistic: str, width: int, height: int) -> tuple[Array, Array]:
    """What the gradient at a probe says of each Gaussian (`render.render_traced`).

    Args:
      found: [..., N, 4] the gradient, of a view or of several.
      statistic: of which position: "position" in the world, or another, which is on the screen.
      width, height: of the views, in pixels.

    Returns:
      [..., N, 3] the statistic, on the screen in units of half an image, and [..., N] whether the Gaussian was
      composited at one pixel at least.
    """
    gradients = found[..., :3]
    if statistic != "position":
        half = jnp.asarray([width / 2, height / 2, 1.0], found.dtype)
        gradients = gradients * half.reshape((1,) * (found.ndim - 1) + (3,))
    return gradients, found[..., 3] > 0


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class GradientStatistics:
    """Sums for the average, over views, of the norm of a gradient of each Gaussian."""

    total: Array
    """[N] sum of the norms since the last event."""
    views: Array
    """[N] int32, views so far in which the Gaussian was composited at one pixel at least."""

    @staticmethod
    def init(num: int, dtype=jnp.float32) -> "GradientStatistics":
        """Empty sums for `num` Gaussians."""
        return GradientStatistics(jnp.zeros(num, dtype), jnp.zeros(num, jnp.int32))

    def observe(self, norms: Array, is_visible: Array) -> "GradientStatistics":
        """Adds one view: `norms` [N] counts where `is_visible` [N]."""
        check_floats("norms", norms, self.total.shape)
        check_shape("is_visible", is_visible, self.total.shape)
        total = self.total + jnp.where(is_visible, norms, 0.0)
        return GradientStatistics(total, self.views + is_visible.astype(jnp.int32))

    def observe_views(self, gradients: Array, is_visible: Array) -> "GradientStatistics":
        """Adds V views, one after the other: `gradients` [V, N, 3], whose norms count where `is_visible` [V, N]."""
        state = self
        for gradient, is_seen in zip(gradients, is_visible, strict=True):
            state = state.observe(safe_norm(gradient), is_seen)
        return state

    def average(self) -> Array:
        """[N] average norm over the views that saw the Gaussian; 0 where none did."""
        return safe_divide(self.total, self.views.astype(self.total.dtype))
