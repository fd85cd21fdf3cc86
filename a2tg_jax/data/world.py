"""Normalised world: every scene gets the same origin, orientation and size before training.

c is a camera centre, d its optical axis (unit), R a rotation, s a scale; all of it in float64 on the host.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from a2tg_jax.core.capture_geometry import nearest_point
from a2tg_jax.core.similarity import Similarity, camera_centers

MIN_UP_LENGTH = 1e-3
"""Shortest mean of the cameras' unit up vectors that still defines up."""
ZERO_SPREAD = 1e-9
"""Distance below which cameras count as one place, relative to their distance from the origin."""


def normalizing_similarity(viewmats: np.ndarray) -> Similarity:
    """Return the similarity to the normalised world.

    The origin is the point nearest to all optical axes in least squares, or the mean camera centre if the axes are
    nearly parallel. The mean camera-up becomes +z, unless the ups cancel. The median distance of the cameras from the
    origin becomes 1.

    Args:
      viewmats: [V, 4, 4] rigid world-to-camera matrices (OpenCV: x right, y down, z forward).

    Raises:
      ValueError: if all or most cameras stand at one place, so that there is no size to normalise.
    """
    centers = camera_centers(viewmats)
    origin = nearest_point(centers, viewmats[:, 2, :3])
    rotation = _rotation_to_z(-viewmats[:, 1, :3].mean(axis=0))
    zero = ZERO_SPREAD * max(float(np.linalg.norm(centers, axis=1).max()), np.finfo(np.float64).tiny)
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    distance = float(np.median(np.linalg.norm(centers - origin, axis=1)))
    if min(spread, distance) <= zero:
        raise ValueError("all cameras stand at one place; photographs from different positions are needed")
    return Similarity(1.0 / distance, rotation, -rotation @ origin / distance)


def scene_scale(centers: np.ndarray) -> float:
    """Return 1.1 × the largest distance of a camera centre [V, 3] from their mean, the unit of the means' learning
    rate."""
    return 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())


def _rotation_to_z(up: np.ndarray) -> np.ndarray:
    """Return the smallest rotation [3, 3] that turns `up` to +z."""
    if np.linalg.norm(up) < MIN_UP_LENGTH:
        return np.eye(3)
    up = up / np.linalg.norm(up)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    axis = axis / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
    rotation: np.ndarray = Rotation.from_rotvec(axis * np.arctan2(sine, up[2])).as_matrix()
    return rotation
