"""Adam's learning rates of the Gaussians."""

import dataclasses
from typing import Any

import jax.numpy as jnp

from a2tg_jax.core.checks import check_number
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.pytree import pytree
from a2tg_jax.core.sh import NUM_BASES


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

    def check_options(self) -> None:
        """Raise ValueError, beginning with the name of the field, if a rate is out of range."""
        for field in dataclasses.fields(self):
            check_number(field.name, getattr(self, field.name), least=0)
        check_number("means_final_factor", self.means_final_factor, above=0)  # The decay is exponential.

    def of_gaussians(self, means: Any, sh_degree: int = 3) -> Gaussians:
        """Return one rate per field of the Gaussians, which broadcasts against it.

        Args:
          means: present rate of the means, a scalar.
          sh_degree: degree of spherical harmonics of the Gaussians, 0 to 3.
        """
        sh = jnp.full((1, NUM_BASES[sh_degree], 1), self.sh_rest).at[:, 0].set(self.sh_degree0)
        fields: Any = (means, self.quats, self.log_scales, self.logit_opacities, sh)
        return Gaussians(*fields)
