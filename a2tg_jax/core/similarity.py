"""Similarities: maps between worlds that differ in position, orientation and size; float64 on the host."""

import dataclasses

import numpy as np

from a2tg_jax.core.cameras import MAX_SKEW
from a2tg_jax.core.checks import LARGEST_NUMBER, check_array, check_kind, check_shape


@dataclasses.dataclass(frozen=True, eq=False)
class Similarity:
    """Map x' = scale·rotation·x + translation, from the original world to the normalised one (or back, `inverse`)."""

    scale: float
    """Positive factor of lengths."""
    rotation: np.ndarray
    """[3, 3] rotation matrix."""
    translation: np.ndarray
    """[3], in units of the new world."""

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Return positions [..., 3] in the new world; `scale` multiplies lengths, `rotation` directions."""
        moved: np.ndarray = self.scale * np.asarray(points) @ self.rotation.T + self.translation
        return moved

    def apply_to_viewmat(self, viewmat: np.ndarray) -> np.ndarray:
        """Return the world-to-camera matrix [4, 4] of the new world for one of the old; again a rigid motion.

        The camera frame is scaled along with the world, which no pinhole camera notices:
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
    scale, rotation, translation = similarity.scale, similarity.rotation, similarity.translation
    if not (1 / LARGEST_NUMBER <= scale <= LARGEST_NUMBER and (np.abs(translation) <= LARGEST_NUMBER).all()):
        raise ValueError(
            f"{what} must have a positive scale and a finite translation, up to {LARGEST_NUMBER:g}, the scale from "
            f"{1 / LARGEST_NUMBER:g}; got {scale:g}, {np.asarray(translation).tolist()}"
        )
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=MAX_SKEW) and np.linalg.det(rotation) > 0
    if not is_rotation:  # Also of NaN.
        raise ValueError(f"{what} must have a rotation; got {np.asarray(rotation).tolist()}")


def camera_centers(viewmats: np.ndarray) -> np.ndarray:
    """Return the positions [V, 3] of cameras given as rigid world-to-camera matrices [V, 4, 4]: c = -Rcᵀ·t."""
    centers: np.ndarray = np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])
    return -centers
