"""Similarities: maps between worlds that differ in position, orientation and size; float64 on the host.

Real spherical harmonics of one degree turn among themselves, so their rotation is one small matrix per degree. It is
fitted to the basis itself at fixed directions, so that it agrees with the renderer's signs and order.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from a2tg_jax.base.checks import LARGEST_NUMBER, check_array, check_kind, check_shape
from a2tg_jax.base.even_spacing import fibonacci
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.core.cameras import MAX_SKEW
from a2tg_jax.core.gaussians import Gaussians, check_gaussians
from a2tg_jax.core.sh import NUM_BASES, sh_basis


@dataclasses.dataclass(frozen=True, eq=False)
class Similarity(NamedFields):
    """Map x' = scale·rotation·x + translation, from the original world to the normalised one (or back, `inverse`).

    Examples:
      >>> twice = a2tg.Similarity(scale=2.0, rotation=np.eye(3), translation=np.array([0.0, 0.0, 1.0]))
      >>> twice.apply(np.ones((1, 3)))
      array([[2., 2., 3.]])
      >>> model.transform(twice).num
      200
    """

    scale: float
    """Positive factor of lengths."""
    rotation: np.ndarray
    """[3, 3] rotation matrix."""
    translation: np.ndarray
    """[3], in units of the new world."""

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Return positions [..., 3] in the new world; `scale` multiplies lengths, `rotation` directions."""
        return self.scale * np.asarray(points) @ self.rotation.T + self.translation

    def apply_to_viewmat(self, viewmat: np.ndarray) -> np.ndarray:
        """Return the world-to-camera matrix [4, 4] of the new world for one of the old; again a rigid motion.

        The camera frame is scaled along with the world, which changes no image of a pinhole camera:
        s·(Rc·x + t) = (Rc·Rᵀ)·x' + (s·t - Rc·Rᵀ·translation).
        """
        moved = np.eye(4)
        moved[:3, :3] = viewmat[:3, :3] @ self.rotation.T
        moved[:3, 3] = self.scale * viewmat[:3, 3] - moved[:3, :3] @ self.translation
        return moved

    def then(self, other: "Similarity") -> "Similarity":
        """Return this similarity followed by another."""
        return Similarity(self.scale * other.scale, other.rotation @ self.rotation, other.apply(self.translation))

    def inverse(self) -> "Similarity":
        """Return the inverse, which maps points, lengths, directions and cameras to the original world."""
        return Similarity(1.0 / self.scale, self.rotation.T, -self.rotation.T @ self.translation / self.scale)


def check_similarity(similarity: Similarity, what: str) -> None:
    """Raise ValueError, naming it `what`, unless scale is positive, rotation is a rotation, and all is finite."""
    check_kind(what, similarity, Similarity)
    check_array(f"{what}.rotation", similarity.rotation, "use np.asarray")
    check_shape(f"{what}.rotation", similarity.rotation, (3, 3))
    check_shape(f"{what}.translation", similarity.translation, (3,))
    scale = similarity.scale
    rotation = similarity.rotation
    translation = similarity.translation
    if not (1 / LARGEST_NUMBER <= scale <= LARGEST_NUMBER and (np.abs(translation) <= LARGEST_NUMBER).all()):
        raise ValueError(
            f"{what} must have a positive scale and a finite translation, up to {LARGEST_NUMBER:g}, the scale from "
            f"{1 / LARGEST_NUMBER:g}; got {scale:g}, {np.asarray(translation).tolist()}"
        )
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=MAX_SKEW) and np.linalg.det(rotation) > 0
    if not is_rotation:  # Also of NaN.
        raise ValueError(f"{what} must have a rotation; got {np.asarray(rotation).tolist()}")


NUM_DIRECTIONS = 64


def transform_gaussians(gaussians: Gaussians, similarity: Similarity) -> Gaussians:
    """Return the same Gaussians in the world that `similarity` leads to (host).

    The image of a camera carried along stays the same: means and scales follow the similarity, quaternions, unit in the
    result, and SH its rotation.

    Args:
      gaussians: N Gaussians.
      similarity: map from their world to the new one.

    Returns:
      N Gaussians of the same dtype.

    Raises:
      ValueError: if a field of the Gaussians has a wrong shape, or the similarity is none.
    """
    check_gaussians(gaussians)
    check_similarity(similarity, "similarity")
    rotation = np.asarray(similarity.rotation, np.float64)
    means = similarity.apply(np.asarray(gaussians.means, np.float64))
    quats = np.asarray(gaussians.quats, np.float64)
    # The renderer draws quaternions of zeros as unrotated.
    quats = np.where(quats.any(axis=1, keepdims=True), quats, [1.0, 0.0, 0.0, 0.0])
    from scipy.spatial.transform import Rotation  # Not at import of the package, which would take 0.2 s longer.

    turned = Rotation.from_matrix(rotation) * Rotation.from_quat(quats, scalar_first=True)
    log_scales = np.asarray(gaussians.log_scales, np.float64) + np.log(similarity.scale)
    # D is block diagonal: lower degrees need its upper left part only.
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

    It is float64, block diagonal with one orthogonal block per degree.
    """
    directions = fibonacci(NUM_DIRECTIONS)
    # The fit is exact: rotations keep degrees apart, and 64 directions determine 7 functions.
    before = _basis(directions)
    after = _basis(directions @ rotation.T)
    matrix = np.zeros((16, 16))
    for first, end in itertools.pairwise((0, *NUM_BASES)):
        matrix[first:end, first:end] = np.linalg.lstsq(after[:, first:end], before[:, first:end], rcond=None)[0]
    return matrix


def _basis(directions: np.ndarray) -> np.ndarray:
    """Return the renderer's basis [P, 16] in float64."""
    # Without x64 JAX would cut the directions to float32.
    with jax.enable_x64(True):
        return np.asarray(sh_basis(jnp.asarray(directions)))
