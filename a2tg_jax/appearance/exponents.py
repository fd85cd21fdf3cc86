"""Kernels with an exponent per Gaussian, in place of the Gaussian falloff.

A generalised Gaussian has an exponent β: β = 1 is the Gaussian, a larger one is flat in the middle and ends at an edge,
a smaller one is peaked and has long tails (GES, Hamdi et al., 2024). At squared distance ρ, in standard deviations, the
falloff is

    exp(−((ρ + δ)^β − δ^β) / ((2 + δ)^β − δ^β)),   δ = 0.02

which is 1 at the centre and 1/e at ρ = 2 for every β, as a Gaussian's is. δ keeps the slope at the centre finite.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance.part import Part
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.pytree import pytree

OFFSET = 0.02
"""δ, in squared standard deviations."""
LARGEST_LOG_EXPONENT = 1.0
"""Largest logarithm of an exponent, and of its inverse."""
MOST_SHARE = 1 - 1e-7
"""Largest tanh of a shape that is read, so that the shape is finite."""
MOST_ROUNDED = 1.5
"""Largest tanh of a shape in a file: half the coarsest step beyond the range."""
LARGEST_RHO = 1e6
"""Squared distance beyond which the falloff is 0 in any case; its powers stay finite up to there."""


@pytree
class Exponents(Part):
    """Shapes of the kernels."""

    shapes: Array | None = None
    """[N] shapes s of the exponents exp(tanh s); 0 is a Gaussian. None until allocated."""

    def allocate(self, gaussians: Gaussians) -> "Exponents":
        return dataclasses.replace(self, shapes=jnp.zeros(gaussians.num, gaussians.means.dtype))

    def check(self, gaussians: Gaussians) -> None:
        if self.shapes is None or self.shapes.shape != (gaussians.num,):
            found = None if self.shapes is None else list(self.shapes.shape)
            raise ValueError(f"shapes must be [{gaussians.num}], one for each Gaussian; got {found}")


class Curve(NamedTuple):
    """The exponent of the falloff as a function of ρ: scale·((ρ + δ)^β − start)."""

    exponents: Array
    """β [N]."""
    scales: Array
    """[N] inverse of its increase from ρ = 0 to 2, so that it is 1 there."""
    starts: Array
    """[N] δ^β."""


def exponents_of(shapes: Array) -> Array:
    """Return the exponents β = exp(tanh s), in (1/e, e), of shapes."""
    return jnp.exp(LARGEST_LOG_EXPONENT * jnp.tanh(shapes))


def log_exponents_of(shapes: np.ndarray) -> np.ndarray:
    """Return the logarithms of the exponents of shapes, within ±1, as files keep them (host)."""
    return LARGEST_LOG_EXPONENT * np.tanh(np.asarray(shapes, np.float64))


def shapes_of(log_exponents: np.ndarray) -> np.ndarray:
    """Return the shapes of logarithms of exponents in a file (host).

    Logarithms that rounding has moved beyond ±1 are cut to ±1.

    Raises:
      ValueError: if one is NaN or farther out than rounding moves it.
    """
    shares = np.asarray(log_exponents, np.float64) / LARGEST_LOG_EXPONENT
    if not (np.abs(shares) <= MOST_ROUNDED).all():
        raise ValueError(f"the logarithms of the exponents of kernels must be within ±{LARGEST_LOG_EXPONENT:g}")
    return np.arctanh(np.clip(shares, -MOST_SHARE, MOST_SHARE))


def curves_of(shapes: Array) -> Curve:
    """Return the curves of shapes [N]."""
    exponents = exponents_of(shapes)
    starts = jnp.exp(exponents * np.log(OFFSET))
    return Curve(exponents, 1 / (jnp.exp(exponents * np.log(2 + OFFSET)) - starts), starts)


def falloff_of(curve: Curve, rho: Array) -> Array:
    """Return kernels at squared distances, which broadcast with the numbers of the curve."""
    rho = jnp.minimum(rho, LARGEST_RHO)
    return jnp.exp(-curve.scales * (jnp.exp(curve.exponents * jnp.log(rho + OFFSET)) - curve.starts))


def reach_of(curve: Curve, bound: Array) -> Array:
    """Return the squared distance [N] at which kernels are as small as a Gaussian is at `bound`; not positive where
    the bound is not."""
    reach = jnp.maximum(bound, 0.0) / (2 * curve.scales) + curve.starts
    return jnp.where(bound > 0, jnp.exp(jnp.log(reach) / curve.exponents) - OFFSET, bound)
