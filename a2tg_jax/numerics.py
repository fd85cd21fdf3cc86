"""Safe division, roots and norms: each with the value and the gradient it has where the plain formula has none."""

import jax
import jax.numpy as jnp
from jax import Array


def safe_divide(numerator: Array, denominator: Array, fallback: float = 0.0) -> Array:
    """numerator / denominator, and `fallback` with zero gradient where the denominator is 0."""
    is_zero = denominator == 0
    quotient = numerator / jnp.where(is_zero, 1.0, denominator)
    return jnp.where(is_zero, fallback, quotient)


def safe_sqrt(x: Array) -> Array:
    """sqrt(max(x, 0)), with zero gradient where x <= 0."""
    is_positive = x > 0
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, x, 1.0)), 0.0)


def safe_norm(x: Array, axis: int = -1, keepdims: bool = False) -> Array:
    """Euclidean norm along `axis`, with zero gradient at the origin."""
    return safe_sqrt(jnp.sum(x * x, axis=axis, keepdims=keepdims))


def normalize(x: Array, axis: int = -1) -> Array:
    """x / |x| along `axis`; the zero vector stays zero, with zero gradient."""
    return safe_divide(x, jnp.broadcast_to(safe_norm(x, axis, keepdims=True), x.shape))


def stop_gradient_tree(tree):
    """The same pytree, cut from differentiation."""
    return jax.tree.map(jax.lax.stop_gradient, tree)
