"""Safe division, roots and norms, with finite values and gradients where the plain formulas have none.

Also the broadcast from splats to pixels, with a gradient that CPUs compute fast, and the difference of arrays that two
programs computed.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

Integer = Array | int
"""An integer, traced or not."""
MOST_DIFFERENCE = 1e-3
"""Largest `relative_difference` that counts as rounding of float32."""


def relative_difference(results: Sequence[ArrayLike], references: Sequence[ArrayLike]) -> float:
    """Return the largest |a − b| / |b| of pairs of arrays, Euclidean norms over a whole array; NaN if one is (host)."""
    pairs = [(np.asarray(a, np.float64), np.asarray(b, np.float64)) for a, b in zip(results, references, strict=True)]
    # Python's max would drop NaN.
    return float(np.max([np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in pairs if b.size]))


def factor_to(most: float, columns: Sequence[Array]) -> Array:
    """Return the factor [N] by which the largest magnitude of a row of columns [N] becomes `most`; 1 if it is smaller.
    It has no gradient."""
    largest = functools.reduce(jnp.maximum, (jnp.abs(jax.lax.stop_gradient(column)) for column in columns))
    return jnp.where(largest > most, most / largest, 1.0)


def safe_divide(numerator: Array, denominator: Array, fallback: float = 0.0) -> Array:
    """Return numerator / denominator, or `fallback` with zero gradient where the denominator is 0."""
    is_zero = denominator == 0
    # `where` differentiates both branches: a division by 0 in the unused one makes gradients NaN.
    quotient = numerator / jnp.where(is_zero, 1.0, denominator)
    return jnp.where(is_zero, fallback, quotient)


def safe_sqrt(x: Array) -> Array:
    """Return sqrt(max(x, 0)), with zero gradient where x <= 0."""
    is_positive = ~(x <= 0)  # NaN stays NaN
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, x, 1.0)), 0.0)


def first_rows(num_rows: int, num: Integer) -> Array:
    """Return [num_rows] bool, True in the first `num` rows: of a model, those whose Gaussians exist."""
    return jnp.arange(num_rows, dtype=jnp.int32) < num


def where_rows(is_chosen: Array, x: Array, y: Array) -> Array:
    """Return [N, ...] the rows of x that are chosen [N], and the others of y."""
    return jnp.where(is_chosen.reshape(-1, *[1] * (y.ndim - 1)), x, y)


def at_least(x: Array, least: float) -> Array:
    """Return max(x, least), with derivative 1 where x = least; JAX's maximum has ½ there.

    A parameter on the bound therefore moves if the gradient leads inside. Sums that miss the bound by rounding, up to
    4 ε, count as on it and are returned unchanged. NaN stays NaN.
    """
    return jnp.where(x < least - _rounding_of(x), jnp.asarray(least, x.dtype), x)


def within(x: Array, least: float, most: float) -> Array:
    """Return x clipped to [least, most], with derivative 1 on both bounds, as in `at_least`."""
    return jnp.where(x > most + _rounding_of(x), jnp.asarray(most, x.dtype), at_least(x, least))


def _rounding_of(x: Array) -> float:
    """Return 4 ε of an array's dtype."""
    return 4 * float(jnp.finfo(x.dtype).eps)  # type: ignore[no-untyped-call]


def safe_norm(x: Array, axis: int = -1, keepdims: bool = False) -> Array:
    """Return the Euclidean norm along `axis`, with zero gradient at the origin."""
    return safe_sqrt(jnp.sum(x * x, axis=axis, keepdims=keepdims))


def normalize(x: Array, axis: int = -1) -> Array:
    """Return x / |x| along `axis`; the zero vector stays zero, with zero gradient."""
    return safe_divide(x, jnp.broadcast_to(safe_norm(x, axis, keepdims=True), x.shape))


def pixel_sum(x: Array) -> Array:
    """Return x [..., P] summed over the last axis.

    A product with ones is vectorised everywhere. CPUs do not vectorise a reduction; they fuse it with its operand,
    which is then computed one pixel at a time.
    """
    # HIGHEST: GPUs may otherwise round the factors of a product to TF32.
    return jnp.dot(x, jnp.ones(x.shape[-1], x.dtype), precision=jax.lax.Precision.HIGHEST)


@functools.partial(jax.custom_vjp, nondiff_argnums=(1,))
def spread_to_pixels(x: Array, num: int) -> Array:
    """Broadcast x [...] over a new last axis of `num` pixels; the gradient is a `pixel_sum`."""
    return jnp.broadcast_to(x[..., None], (*x.shape, num))


spread_to_pixels.defvjp(
    lambda x, num: (spread_to_pixels(x, num), None), lambda num, _, cotangent: (pixel_sum(cotangent),)
)
