"""Smooth camera paths: past the cameras of a scene, or through chosen views."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from a2tg_jax.core.cameras import (
    Camera,
    check_camera,
    checked_cameras,
    intrinsics,
    looking,
    resize_camera,
    viewmat_of_axes,
)
from a2tg_jax.core.checks import check_int
from a2tg_jax.core.similarity import camera_centers

SMOOTHING = 0.06
"""Standard deviation of the smoothing, as a fraction of the path."""
TURN_WEIGHT = 0.5
"""Weight of a change of direction relative to a change of position when cameras are ordered."""


def look_at(
    position: ArrayLike,
    target: ArrayLike,
    *,
    width: int,
    height: int,
    fov: float = 60.0,
    up: ArrayLike = (0.0, 0.0, 1.0),
) -> Camera:
    """Return a pinhole camera with `target` in the middle of its image, with a level horizon (host).

    Args:
      position: [3] position of the camera in the world.
      target: [3] point that it looks at, another than its position.
      width, height: size of the image in pixels.
      fov: angle of view in degrees along the longer side of the image, between 0 and 180.
      up: [3] vertical of the world; the cameras of a scene have it near +z.

    Raises:
      ValueError: if the target is at the position or along the vertical, or the angle of view is out of range.
    """
    vectors = {name: np.asarray(v, np.float64) for name, v in (("position", position), ("target", target), ("up", up))}
    for name, vector in vectors.items():
        if vector.shape != (3,) or not np.isfinite(vector).all():
            raise ValueError(f"{name} must be 3 finite numbers; got {vector}")
    center, seen, up = vectors.values()
    forward = seen - center
    if np.linalg.norm(np.cross(forward, up)) <= 1e-6 * np.linalg.norm(forward) * np.linalg.norm(up):
        wanted = f"target must lie in a direction that is not along up; it lies at {forward} from the camera"
        raise ValueError(f"{wanted}, and up is {up}: say another up=")
    if not 0 < fov < 180:
        raise ValueError(f"fov must lie between 0 and 180 degrees; got {fov}")
    viewmat, K = looking(center, forward, -up), intrinsics(width, height, np.radians(fov))
    camera = Camera(jnp.asarray(viewmat, float), jnp.asarray(K, float), width, height)
    check_camera(camera)
    return camera


def smooth_path(cameras: Sequence[Camera], num_frames: int) -> list[Camera]:
    """Return a flight past the given cameras at constant speed, smooth in position and direction.

    The cameras are visited in a short tour. Positions, viewing directions and down vectors are smoothed along it, so
    that the path stays where photographs were taken.

    Args:
      cameras: at least two; the first one's intrinsics and image size are used throughout.
      num_frames: number of cameras on the path, at least one.

    Raises:
      ValueError: if there are fewer than two cameras or no frames.
    """
    check_int("num_frames", num_frames, 1)
    cameras = checked_cameras(cameras)
    if len(cameras) < 2:
        raise ValueError(f"a path needs two cameras; got {len(cameras)}")
    viewmats = np.stack([np.asarray(camera.viewmat, np.float64) for camera in cameras])
    centers = camera_centers(viewmats)
    forwards, downs = viewmats[:, 2, :3], viewmats[:, 1, :3]
    tour = _short_tour(centers, forwards)
    knots = np.concatenate([centers, forwards, downs], axis=1)[tour]
    curve = _smoothed(knots, num_frames)
    first = cameras[0]
    return [
        Camera(jnp.asarray(looking(*np.split(row, 3)), first.viewmat.dtype), first.K, first.width, first.height)
        for row in curve
    ]


def path_through(views: Sequence[Camera], num_frames: int) -> list[Camera]:
    """Return a smooth flight through views in their order, at constant speed between two of them.

    Positions follow a cubic spline; directions turn evenly, and intrinsics change evenly, from view to view.

    Args:
      views: at least one; the first one's image size is used throughout.
      num_frames: number of cameras on the path, at least one.

    Raises:
      ValueError: if there are no views or no frames.
    """
    check_int("num_frames", num_frames, 1)
    views = checked_cameras(views, "views")
    if not views:
        raise ValueError("a path needs a view; got none")
    first = views[0]
    views = [resize_camera(view, first.width, first.height) for view in views]
    if len(views) == 1:
        return [first] * num_frames
    viewmats = np.stack([np.asarray(view.viewmat, np.float64) for view in views])
    rotations = Rotation.from_matrix(viewmats[:, :3, :3])
    centers = camera_centers(viewmats)
    # Time grows with distance and turn, so that the flight does not rush through a view.
    ways = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    turns = (rotations[1:] * rotations[:-1].inv()).magnitude()
    steps = ways / max(ways.mean(), 1e-12) + turns / max(turns.mean(), 1e-12)
    knots = np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1e-3))])
    times = np.linspace(0.0, knots[-1], num_frames)
    places, turned = CubicSpline(knots, centers, bc_type="natural")(times), Slerp(knots, rotations)(times).as_matrix()
    Ks = np.stack([np.asarray(view.K, np.float64).ravel() for view in views])
    lenses = np.stack([np.interp(times, knots, column) for column in Ks.T], axis=1).reshape(-1, 3, 3)
    dtype, size = first.viewmat.dtype, (first.width, first.height)
    return [
        Camera(jnp.asarray(viewmat_of_axes(R, c), dtype), jnp.asarray(K, dtype), *size)
        for R, c, K in zip(turned, places, lenses, strict=True)
    ]


def _short_tour(centers: np.ndarray, forwards: np.ndarray) -> list[int]:
    """Return an order of the cameras that always goes to the nearest unvisited one, from an end of the set."""
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
    """Return points [num_frames, C] at constant speed on a smoothed polyline through knots [n, C] (positions first)."""
    steps = np.linalg.norm(np.diff(knots[:, :3], axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps + 1e-9)])
    fine = max(20 * num_frames, 1000)
    places = np.linspace(0.0, along[-1], fine)
    dense = np.stack([np.interp(places, along, column) for column in knots.T], axis=1)
    dense = gaussian_filter1d(dense, SMOOTHING * fine, axis=0, mode="nearest")
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(dense[:, :3], axis=0), axis=1) + 1e-12)])
    wanted = np.linspace(0.0, travelled[-1], num_frames)
    return np.stack([np.interp(wanted, travelled, column) for column in dense.T], axis=1)
