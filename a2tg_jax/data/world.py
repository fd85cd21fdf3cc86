"""The normalised world: every scene is brought to the same origin, orientation and size before training.

c is a camera centre, d its optical axis (unit), R a rotation, s a scale; all of it in float64 on the host.
"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from a2tg_jax.cameras import MAX_SKEW

MIN_AXIS_SPREAD = 1e-3
"""Smallest eigenvalue of the mean of I - d·dᵀ (about the squared angle between axes) that fixes a point."""
MIN_UP_LENGTH = 1e-3
"""Shortest mean of the cameras' unit up vectors that still tells where up is."""
ZERO_SPREAD = 1e-9
"""Cameras closer together than this, relative to their distance from the origin, stand at one place."""


@dataclasses.dataclass(frozen=True, eq=False)
class Similarity:
    """x' = scale·rotation·x + translation, from the original world to the normalised one (or back, `inverse`)."""

    scale: float
    """Positive factor of lengths."""
    rotation: np.ndarray
    """[3, 3] rotation matrix."""
    translation: np.ndarray
    """[3], in units of the new world."""

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Positions [..., 3] of the old world in the new one; `scale` multiplies lengths, `rotation` directions."""
        return self.scale * np.asarray(points) @ self.rotation.T + self.translation

    def apply_to_viewmat(self, viewmat: np.ndarray) -> np.ndarray:
        """World-to-camera matrix [4, 4] of the new world for one of the old; again a rigid motion.

        The camera frame is scaled along with the world, which no pinhole camera notices:
        s·(Rc·x + t) = (Rc·Rᵀ)·x' + (s·t - Rc·Rᵀ·translation).
        """
        moved = np.eye(4)
        moved[:3, :3] = viewmat[:3, :3] @ self.rotation.T
        moved[:3, 3] = self.scale * viewmat[:3, 3] - moved[:3, :3] @ self.translation
        return moved

    def then(self, other: "Similarity") -> "Similarity":
        """This similarity, and after it another."""
        return Similarity(self.scale * other.scale, other.rotation @ self.rotation, other.apply(self.translation))

    def inverse(self) -> "Similarity":
        """The way back: brings results (points, lengths, directions, cameras) to the original world."""
        return Similarity(1.0 / self.scale, self.rotation.T, -self.rotation.T @ self.translation / self.scale)


def check_similarity(similarity: Similarity, what: str) -> None:
    """Raises ValueError, calling it `what`, unless its scale is positive, its rotation is one, and all is finite."""
    scale, rotation, translation = similarity.scale, similarity.rotation, similarity.translation
    if not (0 < scale < np.inf and np.isfinite(translation).all()):
        raise ValueError(f"{what} must have a positive scale and a finite translation; got {scale:g}, {translation}")
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=MAX_SKEW) and np.linalg.det(rotation) > 0
    if not is_rotation:  # Also of NaN.
        raise ValueError(f"{what} must have a rotation; got {np.asarray(rotation).tolist()}")


def camera_centers(viewmats: np.ndarray) -> np.ndarray:
    """Positions [V, 3] of cameras given as rigid world-to-camera matrices [V, 4, 4]: c = -Rcᵀ·t."""
    return -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])


def normalizing_similarity(viewmats: np.ndarray) -> Similarity:
    """The similarity to the normalised world.

    The origin goes to the point nearest, in least squares, to all optical axes (to the mean camera centre where the
    axes are nearly parallel), the mean camera-up to +z (kept as it is where the ups cancel), and the median distance
    of the cameras from the origin becomes 1.

    Args:
      viewmats: [V, 4, 4] rigid world-to-camera matrices (OpenCV: x right, y down, z forward).

    Raises:
      ValueError: if all the cameras, or the most of them, stand at one place, so that there is no size to normalise.
    """
    centers = camera_centers(viewmats)
    origin = _nearest_point(centers, viewmats[:, 2, :3])
    rotation = _rotation_to_z(-viewmats[:, 1, :3].mean(axis=0))
    zero = ZERO_SPREAD * max(float(np.linalg.norm(centers, axis=1).max()), np.finfo(np.float64).tiny)
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    distance = float(np.median(np.linalg.norm(centers - origin, axis=1)))
    if min(spread, distance) <= zero:
        raise ValueError("all the cameras stand at one place; photographs from different positions are needed")
    return Similarity(1.0 / distance, rotation, -rotation @ origin / distance)


def scene_scale(centers: np.ndarray) -> float:
    """1.1 × the largest distance of a camera centre [V, 3] from their mean, the unit of the means' learning rate."""
    return 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())


def _nearest_point(centers: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """argmin_x Σ |(I - d·dᵀ)(x - c)|² for lines through `centers` along unit `axes`, or the mean centre."""
    projections = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal_matrix = projections.mean(axis=0)
    if np.linalg.eigvalsh(normal_matrix)[0] < MIN_AXIS_SPREAD:
        return centers.mean(axis=0)
    return np.linalg.solve(normal_matrix, np.einsum("vij,vj->i", projections, centers) / len(centers))


def _rotation_to_z(up: np.ndarray) -> np.ndarray:
    """The smallest rotation [3, 3] that turns `up` to +z."""
    if np.linalg.norm(up) < MIN_UP_LENGTH:
        return np.eye(3)
    up = up / np.linalg.norm(up)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    axis = axis / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
    return Rotation.from_rotvec(axis * np.arctan2(sine, up[2])).as_matrix()
