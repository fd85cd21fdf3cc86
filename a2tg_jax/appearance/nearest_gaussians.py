"""The Gaussian nearest to a kernel of another shape, for files that know Gaussians only.

Of all Gaussians a·exp(−ρ/2k) it has the least squared difference from the kernel over the plane: for a given k, the
best a is ⟨f, g⟩/⟨g, g⟩ with g = exp(−ρ/2k) and ⟨g, g⟩ = k, and the best k maximises ⟨f, g⟩²/k. Both are tabulated over
the logarithm of the exponent.
"""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np

from a2tg_jax.appearance.copies import LARGEST_OPACITY
from a2tg_jax.appearance.exponents import LARGEST_LOG_EXPONENT, curves_of, falloff_of, log_exponents_of, shapes_of
from a2tg_jax.core.gaussians import Gaussians, logit

LEAST_OPACITY = 1e-6
NUM_SHAPES, NUM_SCALES, NUM_PLACES = 41, 121, 2001
LARGEST_PLACE = 12.0
"""Distance, in standard deviations, up to which kernels are compared."""
LEAST_LOG_SCALE, MOST_LOG_SCALE = -0.3, 0.9
"""Range of the logarithms of √k."""


def nearest_gaussians(gaussians: Gaussians, shapes: np.ndarray) -> Gaussians:
    """Return the Gaussians nearest to kernels of the given shapes [N]: other scales and opacities (host)."""
    log_exponents, peaks, log_scales = _table()
    own = log_exponents_of(shapes)
    opacities = np.asarray(gaussians.opacities, np.float64) * np.interp(own, log_exponents, peaks)
    dtype = gaussians.means.dtype
    limited = jnp.asarray(np.clip(opacities, LEAST_OPACITY, LARGEST_OPACITY), dtype)
    larger = np.asarray(gaussians.log_scales) + np.interp(own, log_exponents, log_scales)[:, None]
    return dataclasses.replace(gaussians, logit_opacities=logit(limited), log_scales=jnp.asarray(larger, dtype))


@functools.cache
def _table() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return logarithms of exponents in order, and of the nearest Gaussian of each a and the logarithm of √k."""
    log_exponents = np.linspace(-LARGEST_LOG_EXPONENT, LARGEST_LOG_EXPONENT, NUM_SHAPES)
    radii = np.linspace(0, LARGEST_PLACE, NUM_PLACES)
    curves = curves_of(jnp.asarray(shapes_of(log_exponents))[:, None])
    kernels = np.asarray(falloff_of(curves, jnp.asarray(radii**2)[None]), np.float64)
    log_scales = np.linspace(LEAST_LOG_SCALE, MOST_LOG_SCALE, NUM_SCALES)
    squares = np.exp(2 * log_scales)
    weighted = np.exp(-0.5 * radii**2 / squares[:, None]) * radii * (2 * radii[1])
    products = kernels @ weighted.T
    best = np.argmax(products**2 / squares, axis=1)
    return log_exponents, products[np.arange(NUM_SHAPES), best] / squares[best], log_scales[best]
