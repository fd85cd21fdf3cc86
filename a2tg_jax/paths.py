"""A smooth camera path past the cameras of a scene."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter1d

from a2tg_jax.cameras import Camera
from a2tg_jax.data.world import camera_centers

SMOOTHING = 0.06
"""Standard deviation of the smoothing, as a share of the path."""
TURN_WEIGHT = 0.5
"""How much a change of viewing direction counts against a change of place when the cameras are put in order."""


def smooth_path(cameras: Sequence[Camera], num_frames: int) -> list[Camera]:
    """Cameras that fly past the given ones, of constant speed, smooth in position and direction.

    The cameras are visited in a short tour; positions, viewing directions and down vectors are then smoothed along it,
    so the path stays where photographs were taken and the scene is well known.

    Args:
      cameras: at least two; the first one's intrinsics and image size are used throughout.
      num_frames: number of cameras on the path, at least one.

    Raises:
      ValueError: if there are fewer than two cameras or no frames.
    """
    if len(cameras) < 2 or num_frames < 1:
        raise ValueError(f"a path needs two cameras and a frame; got {len(cameras)} cameras, {num_frames} frames")
    viewmats = np.stack([np.asarray(camera.viewmat, np.float64) for camera in cameras])
    centers = camera_centers(viewmats)
    forwards, downs = viewmats[:, 2, :3], viewmats[:, 1, :3]
    tour = _short_tour(centers, forwards)
    knots = np.concatenate([centers, forwards, downs], axis=1)[tour]
    curve = _smoothed(knots, num_frames)
    first = cameras[0]
    return [
        Camera(jnp.asarray(_look(*np.split(row, 3)), first.viewmat.dtype), first.K, first.width, first.height)
        for row in curve
    ]


def _short_tour(centers: np.ndarray, forwards: np.ndarray) -> list[int]:
    """An order of the cameras that goes to the nearest unvisited one, starting at an end of the set."""
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max() or 1.0
    features = np.concatenate([centers / spread, TURN_WEIGHT * forwards], axis=1)
    start = int(np.linalg.norm(features - features.mean(axis=0), axis=1).argmax())
    tour, left = [start], set(range(len(centers))) - {start}
    while left:
        candidates = sorted(left)
        distances = np.linalg.norm(features[candidates] - features[tour[-1]], axis=1)
        tour.append(candidates[int(distances.argmin())])
        left.remove(tour[-1])
    return tour


def _smoothed(knots: np.ndarray, num_frames: int) -> np.ndarray:
    """[num_frames, C] points at constant speed on a smoothed polyline through [n, C] knots (positions first)."""
    steps = np.linalg.norm(np.diff(knots[:, :3], axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps + 1e-9)])
    fine = max(20 * num_frames, 1000)
    places = np.linspace(0.0, along[-1], fine)
    dense = np.stack([np.interp(places, along, column) for column in knots.T], axis=1)
    dense = gaussian_filter1d(dense, SMOOTHING * fine, axis=0, mode="nearest")
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(dense[:, :3], axis=0), axis=1) + 1e-12)])
    wanted = np.linspace(0.0, travelled[-1], num_frames)
    return np.stack([np.interp(wanted, travelled, column) for column in dense.T], axis=1)


def _look(center: np.ndarray, forward: np.ndarray, down: np.ndarray) -> np.ndarray:
    """World-to-camera matrix [4, 4] at `center`, z along `forward`, y as near to `down` as it can be."""
    z = forward / np.linalg.norm(forward)
    x = np.cross(down, z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ center
    return viewmat
