"""Geometry of a capture: its subject, its vertical, its most central camera, and a turntable around the subject.

c is a camera centre, d its optical axis (unit); all of it in float64 on the host.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from a2tg_jax.core.cameras import Camera, looking
from a2tg_jax.core.similarity import camera_centers

MIN_AXIS_SPREAD = 1e-3
"""Smallest eigenvalue of the mean of I - d·dᵀ (about the squared angle between axes) that fixes a point."""
LEAST_FACING = 0.5
"""Smallest median cosine between optical axes and the directions to the subject."""
LARGEST_ELEVATION = np.radians(80)
FEWEST = 4
"""Smallest number of cameras whose right axes say more than their mean up."""
LEAST_SPREAD = 0.025
"""Smallest second eigenvalue of the right axes' moments: headings that spread by 9°."""
LARGEST_RATIO = 0.25
"""Largest ratio of their first to their second eigenvalue."""
LEAST_COSINE = 0.5
"""Smallest cosine between the vertical and the cameras' mean up."""


def nearest_point(centers: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return argmin_x Σ |(I - d·dᵀ)(x - c)|² for lines through `centers` along unit `axes`, or the mean centre."""
    projections = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal_matrix = projections.mean(axis=0)
    if np.linalg.eigvalsh(normal_matrix)[0] < MIN_AXIS_SPREAD:
        return centers.mean(axis=0)
    return np.linalg.solve(normal_matrix, np.einsum("vij,vj->i", projections, centers) / len(centers))


def vertical_of(viewmats: np.ndarray) -> np.ndarray:
    """Return the vertical [3] of cameras [V, 4, 4], as the viewer estimates it (web/src/vertical.ts).

    It is the axis closest to perpendicular to all right axes in least squares, or the cameras' mean up if the right
    axes do not determine it.
    """
    up: np.ndarray = -viewmats[:, 1, :3].mean(axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    rights = viewmats[:, 0, :3]
    (least, middle, _), vectors = np.linalg.eigh(rights.T @ rights / len(rights))
    axis: np.ndarray = vectors[:, 0]
    is_open = middle < LEAST_SPREAD or least > LARGEST_RATIO * middle
    if len(viewmats) < FEWEST or is_open or abs(axis @ up) < LEAST_COSINE:
        return up
    return np.asarray(axis * np.sign(axis @ up))


def central_camera(viewmats: np.ndarray) -> int:
    """Return the index of the camera [V, 4, 4] whose axis passes nearest to the subject and which is nearest to the
    median camera; both count alike."""
    centers, axes = camera_centers(viewmats), viewmats[:, 2, :3]
    subject = nearest_point(centers, axes)
    misses = np.linalg.norm(np.cross(subject - centers, axes), axis=1)
    remote = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    return int(np.argmin(misses + remote))


def turntable(cameras: Sequence[Camera], num_frames: int) -> list[Camera]:
    """Return a closed orbit around the subject, the point nearest to all optical axes, about the capture's vertical.

    It keeps the cameras' mean distance and elevation, looks at the subject with a level horizon, and begins at the side
    of the first camera, whose intrinsics and image size are used throughout.

    Raises:
      ValueError: if there are no cameras or frames, or the cameras do not look at one subject.
    """
    if not cameras or num_frames < 1:
        raise ValueError(f"an orbit needs a camera and a frame; got {len(cameras)} cameras, {num_frames} frames")
    viewmats = np.stack([np.asarray(camera.viewmat, np.float64) for camera in cameras])
    centers, axes = camera_centers(viewmats), viewmats[:, 2, :3]
    subject, up = nearest_point(centers, axes), vertical_of(viewmats)
    offsets = centers - subject
    distances = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    if np.median(-np.sum(offsets * axes, axis=1) / distances) < LEAST_FACING:
        raise ValueError("the cameras do not look at one subject to orbit; choose --path smooth")
    elevation = np.clip(
        np.arcsin(np.clip(offsets @ up / distances, -1, 1)).mean(), -LARGEST_ELEVATION, LARGEST_ELEVATION
    )
    # The unit direction of the first offset perpendicular to the vertical; any such one if the offset is vertical.
    for vector in (offsets[0], *np.eye(3)):
        across = vector - (vector @ up) * up
        if np.linalg.norm(across) > 1e-3 * np.linalg.norm(vector):
            break
    side = across / np.linalg.norm(across)
    first, place = cameras[0], distances.mean()
    frames = []
    for angle in np.arange(num_frames) * (2 * np.pi / num_frames):
        heading = np.cos(angle) * side + np.sin(angle) * np.cross(up, side)
        outward = np.cos(elevation) * heading + np.sin(elevation) * up
        viewmat = looking(subject + place * outward, -outward, -up)
        frames.append(Camera(jnp.asarray(viewmat, first.viewmat.dtype), first.K, first.width, first.height))
    return frames
