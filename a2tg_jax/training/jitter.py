"""Random displacements of the Gaussians in each step, a regulariser against overfitting.

The gradient is taken at displaced means, and the update changes the means themselves. So the loss is averaged over
displacements, which adds a penalty on its curvature (Bishop, 1995). Fits to the training views that depend on exact
positions become expensive, and these are the fits that break in other views.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.gaussians import Gaussians

STREAM = 0x6A69
"""Number that keeps these random numbers apart from those of events and backgrounds."""


def jittered(key: Array, gaussians: Gaussians, share: float) -> Gaussians:
    """Return Gaussians with displaced means: μ + share·√(s_x·s_y)·ε, ε standard normal in the world.

    Args:
      key: key of the iteration; `STREAM` is folded in.
      gaussians: N rows.
      share: standard deviation of each coordinate, as a share of the Gaussian's size.
    """
    means = gaussians.means
    noise = jax.random.normal(jax.random.fold_in(key, STREAM), means.shape, means.dtype)
    deviations = jnp.asarray(share, means.dtype) * gaussians.sizes[:, None]
    return dataclasses.replace(gaussians, means=means + deviations * noise)
