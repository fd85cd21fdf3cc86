"""The average gradient of each Gaussian over the views that saw it, by which events choose where to add detail.

A²TG averages ‖Σ_pixels |∂L/∂mean|‖ to choose what gets texels; adaptive density control averages the norm of the
gradient of the projected mean to choose what is cloned or split.
"""

import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from a2tg_jax.core.checks import check_floats, check_shape
from a2tg_jax.core.numerics import safe_divide, safe_norm
from a2tg_jax.core.pytree import pytree
from a2tg_jax.parallel.rows import zeros_beside


def read_probe(found: Array, statistic: str, width: int, height: int) -> tuple[Array, Array]:
    """Read the statistic of each Gaussian from the gradient at a probe (`render.render_traced`).

    Args:
      found: [..., N, 4] gradient of one view or several.
      statistic: kind of position: "position" in the world, or another one on the screen.
      width, height: size of the views in pixels.

    Returns:
      The statistic [..., N, 3], on the screen in units of half an image, and whether the Gaussian was composited at
      one or more pixels [..., N].
    """
    gradients = found[..., :3]
    if statistic != "position":
        half = jnp.asarray([width / 2, height / 2, 1.0], found.dtype)
        gradients = gradients * half.reshape((1,) * (found.ndim - 1) + (3,))
    return gradients, found[..., 3] > 0


@pytree
class GradientStatistics:
    """Sums from which each Gaussian's average gradient norm over views is computed."""

    total: Array
    """[N] sum of the norms since the last event."""
    views: Array
    """[N] int32 number of views in which the Gaussian was composited at one or more pixels."""

    @staticmethod
    def init(num: int, dtype: DTypeLike = jnp.float32, like: Array | None = None) -> "GradientStatistics":
        """Return empty sums for `num` Gaussians, spread like the rows of an array; None: on one device."""
        return GradientStatistics(zeros_beside(like, (num,), dtype), zeros_beside(like, (num,), jnp.int32))

    def observe(self, norms: Array, is_visible: Array) -> "GradientStatistics":
        """Add one view: `norms` [N] where `is_visible` [N]."""
        check_floats("norms", norms, self.total.shape)
        check_shape("is_visible", is_visible, self.total.shape)
        total = self.total + jnp.where(is_visible, norms, 0.0)
        return GradientStatistics(total, self.views + is_visible.astype(jnp.int32))

    def observe_views(self, gradients: Array, is_visible: Array) -> "GradientStatistics":
        """Add V views in order: the norms of `gradients` [V, N, 3] where `is_visible` [V, N]."""
        state = self
        for gradient, is_seen in zip(gradients, is_visible, strict=True):
            state = state.observe(safe_norm(gradient), is_seen)
        return state

    def average(self) -> Array:
        """Return the average norm [N] over the views that saw the Gaussian; 0 if none did."""
        return safe_divide(self.total, self.views.astype(self.total.dtype))
