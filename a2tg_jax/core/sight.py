"""The part of the world that a view shows, and which views see none of some points. On the host."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from a2tg_jax.core.cameras import Camera, pinhole_pixels
from a2tg_jax.core.geometry import NEAR_PLANE

FIRST_LOOK = 10_000
"""Number of evenly chosen points that a view is tested with first."""


class Sight(NamedTuple):
    """The part of the world that a view shows."""

    viewmat: np.ndarray
    """[4, 4] world to camera."""
    K: np.ndarray
    """[3, 3]."""
    low: np.ndarray
    """[2] smallest x and y in the image plane of K."""
    high: np.ndarray
    """[2] largest ones."""

    @staticmethod
    def of(viewmat: np.ndarray, K: np.ndarray, size: tuple[int, int], rays: ArrayLike | None) -> "Sight":
        """Return what a view of (height, width) shows, with `rays` as in `Camera.rays`."""
        if rays is None:
            height, width = size
            return Sight(viewmat, K, np.zeros(2), np.array([width, height], np.float64))
        places = np.asarray(rays).reshape(-1, 2)
        places = places[np.isfinite(places).all(axis=1)]
        # Without any ray, the rectangle is inverted and contains nothing.
        return Sight(viewmat, K, places.min(axis=0, initial=np.inf), places.max(axis=0, initial=-np.inf))

    @staticmethod
    def of_camera(camera: Camera) -> "Sight":
        """Return what a camera shows."""
        viewmat = np.asarray(camera.viewmat, np.float64)
        return Sight.of(viewmat, np.asarray(camera.K, np.float64), (camera.height, camera.width), camera.rays)

    def seen(self, points: np.ndarray, near_plane: float = NEAR_PLANE) -> tuple[np.ndarray, np.ndarray]:
        """Return which of the points [P, 3] are in the picture and beyond the near plane, [P] bool, and all depths
        [P]."""
        in_frame = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        is_seen = in_frame[:, 2] > near_plane
        places = pinhole_pixels(in_frame[is_seen], self.K)
        is_seen[is_seen] = ((places >= self.low) & (places <= self.high)).all(axis=1)
        return is_seen, in_frame[:, 2]

    def num_seen(self, points: np.ndarray, near_plane: float = NEAR_PLANE) -> int:
        """Return the number of points [P, 3] in the picture and beyond the near plane."""
        return int(self.seen(points, near_plane)[0].sum())


def unseeing(points: np.ndarray, sights: Sequence[Sight]) -> list[int]:
    """Return the indices of the views that see none of the points [P, 3]."""
    # Most views see one of a few points, which saves testing them all.
    some = points[:: max(1, len(points) // FIRST_LOOK)]
    return [number for number, sight in enumerate(sights) if not (sight.num_seen(some) or sight.num_seen(points))]
