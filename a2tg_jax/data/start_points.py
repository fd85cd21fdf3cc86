"""Points to start from: whether views see them, and random ones where the cameras look. All in the normalised world."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from a2tg_jax.core.capture_geometry import LEAST_FACING
from a2tg_jax.core.geometry import NEAR_PLANE
from a2tg_jax.core.similarity import camera_centers

NUM_RANDOM_POINTS = 10_000
OBJECT_SHARE = 0.8958
"""Half the side of an object's cube over half the width that cameras see at its centre: the cube of ±1.3 of NeRF's
synthetic objects, whose cameras are 4.031 away and see 39.6°."""
NEAREST, FARTHEST = 0.4, 2.0
"""Depths of random points before cameras around a subject, in units of their distance from it."""
SHALLOWEST, DEEPEST = 0.5, 10.0
"""Depths of random points before other cameras."""
FIRST_LOOK = 10_000
"""Number of points, evenly chosen, that a view is tried with before all of them."""


class Sight(NamedTuple):
    """Part of the world that a view shows."""

    viewmat: np.ndarray
    """[4, 4] world to camera."""
    K: np.ndarray
    """[3, 3]."""
    low: np.ndarray
    """[2] smallest x and y in the image plane of K."""
    high: np.ndarray
    """[2] largest ones."""

    @staticmethod
    def of(viewmat: np.ndarray, K: np.ndarray, size: tuple[int, ...], rays: ArrayLike | None) -> "Sight":
        """Return what a view of (height, width) shows, with `rays` as `Camera.rays` has them."""
        if rays is None:
            return Sight(viewmat, K, np.zeros(2), np.array(size[::-1], np.float64))
        return Sight(viewmat, K, np.nanmin(rays, axis=(0, 1)), np.nanmax(rays, axis=(0, 1)))

    def num_seen(self, points: np.ndarray) -> int:
        """Return the number of points [P, 3] that are in the picture and not too near to be drawn."""
        own = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        own = own[own[:, 2] > NEAR_PLANE]
        places = own @ self.K[:2].T / own[:, 2:]
        return int(((places >= self.low) & (places <= self.high)).all(axis=1).sum())


def unseeing(points: np.ndarray, sights: Sequence[Sight]) -> list[int]:
    """Return the numbers of the views that see none of the points [P, 3]."""
    some = points[:: max(1, len(points) // FIRST_LOOK)]
    return [number for number, sight in enumerate(sights) if not (sight.num_seen(some) or sight.num_seen(points))]


def random_points(sights: Sequence[Sight], object_axes: np.ndarray | None = None, seed: int = 0) -> np.ndarray:
    """Return random points [NUM_RANDOM_POINTS, 3] where cameras look; each view sees some.

    They are in a cube around an object that all views show, or else in the pyramids that the views show.

    Args:
      sights: of the training views. The origin is the point nearest to their optical axes.
      object_axes: [3, 3] axes of the cube of a scene that is an object, by columns; None of other scenes.
      seed: random seed.
    """
    rng = np.random.default_rng(seed)
    viewmats = np.stack([sight.viewmat for sight in sights])
    centers, axes = camera_centers(viewmats), viewmats[:, 2, :3]
    distances = np.linalg.norm(centers, axis=1)
    slopes = np.stack([(sight.high - sight.low) / np.diag(sight.K)[:2] for sight in sights])
    if object_axes is not None:
        half_side = OBJECT_SHARE * np.median(distances * slopes.min(axis=1) / 2)
        points: np.ndarray = rng.uniform(-half_side, half_side, (NUM_RANDOM_POINTS, 3)) @ object_axes.T
        if not unseeing(points, sights):
            return points
    view = np.arange(NUM_RANDOM_POINTS) % len(sights)
    low, high = (np.stack([getattr(sight, side) for sight in sights])[view] for side in ("low", "high"))
    places = np.concatenate([rng.uniform(low, high), np.ones((NUM_RANDOM_POINTS, 1))], axis=1)
    to_rays = np.linalg.inv(np.stack([sight.K for sight in sights]))[view]
    share = rng.uniform(size=NUM_RANDOM_POINTS)
    facing = -np.einsum("vi,vi->v", centers, axes) / np.maximum(distances, 1e-12)
    if np.median(facing) >= LEAST_FACING:
        depths = (NEAREST + (FARTHEST - NEAREST) * share) * np.maximum(distances, SHALLOWEST)[view]
    else:
        depths = SHALLOWEST * (DEEPEST / SHALLOWEST) ** share
    own = np.einsum("pij,pj->pi", to_rays, places) * depths[:, None]
    offsets: np.ndarray = np.einsum("pji,pj->pi", viewmats[view, :3, :3], own)
    offsets += centers[view]
    return offsets
