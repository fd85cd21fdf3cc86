"""Adam's learning rates of the Gaussians, and how they differ between Gaussians and change during a stage."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.core.sh import NUM_BASES
from a2tg_jax.model import Model

COOLED = 0.1
"""Factor of learning rates at the end of a cooldown."""
LARGEST_RATIO = 5.0
"""Largest ratio of a Gaussian's size to the mean of all that its learning rate follows."""


@pytree
class LearningRates:
    """Adam's learning rates of the Gaussians."""

    means: float = 1.6e-4
    """Learning rate of the means, times scene_scale; decays exponentially over each stage."""
    means_final_factor: float = 0.01
    """Factor of the means' learning rate at the end of a stage."""
    log_scales: float = 5e-3
    """Learning rate of the logarithms of the scales."""
    quats: float = 1e-3
    """Learning rate of the rotations."""
    logit_opacities: float = 5e-2
    """Learning rate of the logits of the opacities."""
    sh_degree0: float = 2.5e-3
    """Learning rate of the colours, the spherical harmonics of degree 0."""
    sh_rest: float = 1.25e-4
    """Learning rate of the other spherical harmonics."""
    means_by_size: float = static(default=0.0, is_addition=True)
    """Power p of size in the means' learning rate. Gaussians larger than the mean of all have (size / mean)^p times the
    rate, at most 5^p; 0: the same for all. Sizes and their mean are geometric means."""
    cooldown: float = static(default=0.0, is_addition=True)
    """Share of a stage, at its end, in which the rates of the Gaussians and of what they show fall linearly to a tenth;
    0: they do not. The systems of this library cool down in their last stage only."""

    def of_gaussians(self, means: Any, sh_degree: int = 3) -> Gaussians:
        """Return one rate per field of the Gaussians, which broadcasts against it.

        Args:
          means: present rate of the means, a scalar or [N, 1] (`of_means`).
          sh_degree: degree of spherical harmonics of the Gaussians, 0 to 3.
        """
        sh = jnp.full((1, NUM_BASES[sh_degree], 1), self.sh_rest).at[:, 0].set(self.sh_degree0)
        fields: Any = (means, self.quats, self.log_scales, self.logit_opacities, sh)
        return Gaussians(*fields)

    def of_means(self, rate: Array, model: Model) -> Array:
        """Return the present rates of the means: [N, 1] where they follow the sizes, or else the one rate.

        Args:
          rate: of Gaussians that are not larger than the mean of all.
          model: N Gaussians.
        """
        if not self.means_by_size:
            return rate
        return rate * excess_sizes(model.gaussians, model.live_count)[:, None] ** self.means_by_size

    def cooled(self, rates: Any, progress: Array) -> Any:
        """Return learning rates, a pytree, at a share of the stage: lower ones during the cooldown."""
        if not self.cooldown:
            return rates
        done = jnp.clip((progress - (1 - self.cooldown)) / self.cooldown, 0.0, 1.0)
        factor = 1 - (1 - COOLED) * done
        return jax.tree.map(lambda rate: rate * factor.astype(jnp.result_type(rate, float)), rates)


def excess_sizes(gaussians: Gaussians, num_live: Array | int) -> Array:
    """Return [N] ratios of sizes to the geometric mean of the live Gaussians, at least 1 and at most 5.

    Args:
      gaussians: N rows.
      num_live: rows in use; may be traced.
    """
    log_sizes = jnp.mean(gaussians.log_scales, axis=1)
    is_live = jnp.arange(gaussians.num, dtype=jnp.int32) < num_live
    mean = jnp.sum(jnp.where(is_live, log_sizes, 0.0)) / jnp.maximum(num_live, 1).astype(log_sizes.dtype)
    return jnp.clip(jnp.exp(log_sizes - mean), 1.0, LARGEST_RATIO)
