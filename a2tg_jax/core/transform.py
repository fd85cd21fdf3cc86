"""Gaussians carried from one world to another by a similarity x' = scale·R·x + translation.

Real spherical harmonics of one degree turn among themselves, so their rotation is one small matrix per degree.
It is fitted to the basis itself at fixed directions, so that it agrees with the renderer's signs and order.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from a2tg_jax.core.gaussians import Gaussians, check_gaussians
from a2tg_jax.core.sh import sh_basis
from a2tg_jax.core.similarity import Similarity, check_similarity

NUM_DIRECTIONS = 64
SH_DEGREES = (slice(0, 1), slice(1, 4), slice(4, 9), slice(9, 16))


def transform_gaussians(gaussians: Gaussians, similarity: Similarity) -> Gaussians:
    """Return the same Gaussians in the world that `similarity` leads to (host).

    A camera carried along sees the same image: means and scales follow the similarity, quaternions and SH its rotation.

    Args:
      gaussians: N Gaussians.
      similarity: map from their world to the new one.

    Returns:
      N Gaussians of the same dtype; the quaternions are unit.

    Raises:
      ValueError: if a field of the Gaussians has another shape than it must have, or the similarity is none.
    """
    check_gaussians(gaussians)
    check_similarity(similarity, "similarity")
    rotation = np.asarray(similarity.rotation, np.float64)
    means = similarity.apply(np.asarray(gaussians.means, np.float64))
    turned = Rotation.from_matrix(rotation) * Rotation.from_quat(np.asarray(gaussians.quats), scalar_first=True)
    log_scales = np.asarray(gaussians.log_scales, np.float64) + np.log(similarity.scale)
    turned_sh = sh_rotation(rotation)[: gaussians.sh.shape[1], : gaussians.sh.shape[1]]
    sh = np.einsum("lk,nkc->nlc", turned_sh, np.asarray(gaussians.sh, np.float64))
    dtype = gaussians.means.dtype
    return Gaussians(
        means=jnp.asarray(means, dtype),
        quats=jnp.asarray(turned.as_quat(scalar_first=True), dtype),
        log_scales=jnp.asarray(log_scales, dtype),
        logit_opacities=gaussians.logit_opacities,
        sh=jnp.asarray(sh, dtype),
    )


def sh_rotation(rotation: np.ndarray) -> np.ndarray:
    """Return the matrix D [16, 16] with Σ_k Y_k(R d)·(D c)_k = Σ_k Y_k(d)·c_k for every direction d and coefficients c.

    Args:
      rotation: R, [3, 3].

    Returns:
      float64, block diagonal with one orthogonal block per degree.
    """
    directions = _fixed_directions()
    before, after = _basis(directions), _basis(directions @ rotation.T)
    matrix = np.zeros((16, 16))
    for degree in SH_DEGREES:
        matrix[degree, degree] = np.linalg.lstsq(after[:, degree], before[:, degree], rcond=None)[0]
    return matrix


def _fixed_directions() -> np.ndarray:
    """Return unit vectors [NUM_DIRECTIONS, 3] spread evenly over the sphere (a Fibonacci lattice)."""
    index = np.arange(NUM_DIRECTIONS) + 0.5
    z, angle = 1 - 2 * index / NUM_DIRECTIONS, np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)


def _basis(directions: np.ndarray) -> np.ndarray:
    """Return the renderer's basis [P, 16] in float64."""
    with jax.enable_x64(True):
        return np.asarray(sh_basis(jnp.asarray(directions)))
