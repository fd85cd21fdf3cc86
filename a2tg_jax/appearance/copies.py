"""Coincident copies that together look like one Gaussian (3DGS-MCMC, Kheradmand et al., 2024, relocation)."""

import math

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.gaussians import logit

DEAD_OPACITY = 0.005
MAX_SHARES = 51
LARGEST_OPACITY = 1 - 2**-23
QUADRATURE_END = 5.0
QUADRATURE_STEPS = 32


def share(logit_opacities: Array, log_scales: Array, num_shares: Array) -> tuple[Array, Array]:
    """Return opacity and size of `num_shares` coincident copies that replace one Gaussian (3DGS-MCMC, relocation).

    o' = 1 - (1 - o)^(1/N), clamped to [0.005, 1 - 2⁻²³], keeps the opacity at the centre; the scales, multiplied by
    o / S(o', N), keep the integral of the opacity along a line through it.

    Args:
      logit_opacities: [N] logits of the originals.
      log_scales: [N, 2] log-scales of the originals.
      num_shares: [N] integers of at least 1; 1 leaves a row unchanged.

    Returns:
      logit_opacities [N] and log_scales [N, 2] of each copy.
    """
    dtype = logit_opacities.dtype
    opacities = shared_opacities(logit_opacities, num_shares.astype(dtype))
    log_ratio = jax.nn.log_sigmoid(logit_opacities) - jnp.log(stacked_integral(opacities, num_shares))
    is_shared = num_shares > 1
    return (
        jnp.where(is_shared, logit(opacities), logit_opacities),
        jnp.where(is_shared[:, None], log_scales + log_ratio[:, None], log_scales),
    )


def shared_opacities(logit_opacities: Array, num_shares: Array) -> Array:
    """Return 1 - (1 - o)^(1/n) [N], clamped to [0.005, 1 - 2⁻²³]: the opacity of n layers as opaque as one of o.

    Args:
      logit_opacities: [N] logits of the originals.
      num_shares: [N] floats n of at least 1.
    """
    # log(1 - o) straight from the logit: 1 - o itself has no digits left when o is close to 1.
    log_transparency = jax.nn.log_sigmoid(-logit_opacities)
    return jnp.clip(-jnp.expm1(log_transparency / num_shares), DEAD_OPACITY, LARGEST_OPACITY)


def stacked_integral(opacities: Array, num_shares: Array) -> Array:
    """Return S = π^(-1/2)·∫ [1 - (1 - o·e^(-x²))^N] dx: the opacity of N coincident Gaussians, integrated along a line.

    Equal to the binomial double sum of 3DGS-MCMC, without its cancellation. The integrand is even and entire, so the
    trapezoidal rule converges exponentially: 32 steps on [0, 5] are off by less than 1e-10 for N up to 51.

    Args:
      opacities: [N] in (0, 1).
      num_shares: [N] integers, 1 to 51.

    Returns:
      Positive integrals [N]; `opacities` itself if `num_shares` is 1.
    """
    count = num_shares.astype(opacities.dtype)
    spacing = QUADRATURE_END / QUADRATURE_STEPS

    def integrand(x: float | Array) -> Array:
        return -jnp.expm1(count * jnp.log1p(-opacities * jnp.exp(-jnp.asarray(x * x, opacities.dtype))))

    def add_node(node: Array, total: Array) -> Array:
        # Without jit, JAX hands Python's integers to the body of a loop.
        return total + integrand(jnp.asarray(node, opacities.dtype) * spacing)

    # A loop over nodes, not an axis of nodes: the memory stays that of one value per row.
    half = jax.lax.fori_loop(1, QUADRATURE_STEPS + 1, add_node, 0.5 * integrand(0.0))
    whole: Array = half * (2 * spacing / math.sqrt(math.pi))
    return whole
