"""Small rigid motions of cameras, so(3) × R³: a twist is [6], a rotation vector in radians and a translation.

θ is the angle |ω|, W the matrix with W·x = ω × x.
"""

import jax.numpy as jnp
from jax import Array

SMALL = 1e-2
"""Squared angle below which the series are exact to 14 digits."""


def rotation_exp(rotvec: Array) -> Array:
    """Return R [3, 3] = I + (sin θ/θ)·W + ((1 − cos θ)/θ²)·W², exactly I for 0, with derivatives of any order there."""
    squared = jnp.sum(rotvec * rotvec)
    is_small = squared < SMALL
    safe = jnp.where(is_small, 1.0, squared)
    angle = jnp.sqrt(safe)
    first = jnp.where(is_small, _series(squared, 1, 6, 120, 5040), jnp.sin(angle) / angle)
    second = jnp.where(is_small, _series(squared, 2, 24, 720, 40320), (1 - jnp.cos(angle)) / safe)
    x, y, z = rotvec[0], rotvec[1], rotvec[2]
    zero = jnp.zeros_like(x)
    W = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    # W² = ω·ωᵀ − θ²·I, without a product of matrices, which some devices round coarsely.
    W_squared = rotvec[:, None] * rotvec[None, :] - squared * jnp.eye(3, dtype=rotvec.dtype)
    return jnp.eye(3, dtype=rotvec.dtype) + first * W + second * W_squared


def moved_viewmat(twist: Array, viewmat: Array) -> Array:
    """Return world to camera [4, 4] followed by a twist [6] in the camera's frame, about its centre."""
    rotation = rotation_exp(twist[:3])
    rows = jnp.sum(rotation[:, :, None] * viewmat[None, :3], axis=1)
    return viewmat.at[:3].set(rows.at[:, 3].add(twist[3:]))


def _series(x: Array, *denominators: int) -> Array:
    """Return 1/a − x/b + x²/c − x³/d."""
    a, b, c, d = (1 / number for number in denominators)
    return a - x * (b - x * (c - x * d))
