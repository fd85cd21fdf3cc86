"""Smooth camera paths: around the subject of a capture, past its cameras, or through chosen views (host)."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation, Slerp

from a2tg_jax import Camera, Origin, resize_camera
from a2tg_jax.base.checks import check_int
from a2tg_jax.core.cameras import MAX_SKEW, check_camera, checked_cameras
from a2tg_jax.data.capture_geometry import (
    camera_centers,
    distance_to_subject,
    front_camera,
    matrices_of,
    outlying_cameras,
    subject_of,
    without_outlying,
)

LARGEST_ELEVATION = np.radians(80)  # a camera straight above has no level horizon (`looking`)
SMOOTHING = 0.06
"""Standard deviation of the smoothing, as a fraction of the path."""
TURN_WEIGHT = 0.5
"""Weight of a change of direction relative to a change of position when cameras are ordered."""


def turntable(cameras: Sequence[Camera], num_frames: int, up: ArrayLike | None = None) -> list[Camera]:
    """Return a closed orbit around the subject, the point nearest to all optical axes.

    It keeps the cameras' mean distance and elevation, looks at the subject with a level horizon, and begins at its
    front. Cameras far from all others do not count.

    Args:
      cameras: at least one; the first one's intrinsics and image size are used throughout.
      num_frames: number of cameras on the orbit, at least one.
      up: [3] unit vertical of the orbit, such as `model.origin.up`; None: estimated from the cameras.

    Returns:
      `num_frames` cameras.

    Raises:
      ValueError: if there are no cameras or frames, the cameras do not look at one subject, or `up` has another length.
    """
    check_int("num_frames", num_frames, 1)
    cameras = without_outlying(checked_cameras(cameras))
    if not cameras:
        raise ValueError("an orbit needs a camera; got none")
    viewmats = matrices_of(cameras)
    if np.isnan(distance_to_subject(viewmats)):
        raise ValueError("cameras must look at one subject to orbit, and these do not: take smooth_path, `path` smooth")
    subject = subject_of(viewmats)
    up = Origin.of_cameras(cameras).vertical if up is None else np.asarray(up)
    if up.shape != (3,) or not abs(np.linalg.norm(up) - 1) < MAX_SKEW:
        raise ValueError(f"up must be 3 numbers of unit length; got {up}")
    offsets = camera_centers(viewmats) - subject
    distances = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    elevation = np.arcsin(np.clip(offsets @ up / distances, -1, 1)).mean()
    elevation = np.clip(elevation, -LARGEST_ELEVATION, LARGEST_ELEVATION)
    # The unit direction of the front's offset perpendicular to the vertical; any such one if the offset is vertical.
    for vector in (offsets[front_camera(viewmats, up)], *np.eye(3)):
        across = vector - (vector @ up) * up
        if np.linalg.norm(across) > 1e-3 * np.linalg.norm(vector):
            break
    side = across / np.linalg.norm(across)
    radius = distances.mean()
    orbit = []
    for angle in np.arange(num_frames) * (2 * np.pi / num_frames):
        heading = np.cos(angle) * side + np.sin(angle) * np.cross(up, side)
        outward = np.cos(elevation) * heading + np.sin(elevation) * up
        orbit.append(looking(subject + radius * outward, -outward, -up))
    return _moved(cameras[0], orbit)


def front_view(origin: Origin) -> int:
    """Return the index of the camera that shows the subject's front: a training view, if there is one, and not far from
    all others."""
    candidates = [index for index, is_test in enumerate(origin.is_test) if not is_test] or range(len(origin.names))
    ordered = np.array(sorted(candidates, key=origin.names.__getitem__))
    viewmats = np.asarray(origin.viewmats, np.float64)[ordered]
    near = np.flatnonzero(~outlying_cameras(viewmats))
    return int(ordered[near[front_camera(viewmats[near], origin.vertical)]])


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
      target: [3] point to look at, different from the position.
      width: width of the image in pixels.
      height: height of the image in pixels.
      fov: angle of view in degrees along the longer side of the image, between 0 and 180.
      up: [3] vertical of the world, near +z for the cameras of a scene.

    Returns:
      The camera.

    Raises:
      ValueError: if the target is at the position or along the vertical, or the angle of view is out of range.

    Examples:
      >>> camera = a2tg.look_at([0, -3, 1], [0, 0, 0], width=48, height=36, fov=50)
      >>> model.render(camera).color.shape
      (36, 48, 3)
    """
    vectors = {name: np.asarray(v, np.float64) for name, v in (("position", position), ("target", target), ("up", up))}
    for name, vector in vectors.items():
        if vector.shape != (3,) or not np.isfinite(vector).all():
            raise ValueError(f"{name} must be 3 finite numbers; got {vector}")
    center, subject, up = vectors.values()
    forward = subject - center
    if np.linalg.norm(np.cross(forward, up)) <= 1e-6 * np.linalg.norm(forward) * np.linalg.norm(up):
        wanted = f"target must be in a direction that is not along up; it is at {forward} from the camera"
        raise ValueError(f"{wanted}, and up is {up}: pass another up")
    if not 0 < fov < 180:
        raise ValueError(f"fov must be between 0 and 180 degrees; got {fov}")
    viewmat = looking(center, forward, -up)
    K = intrinsics(width, height, np.radians(fov))
    # `float` is JAX's default dtype, float64 under x64.
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

    Returns:
      `num_frames` cameras.

    Raises:
      ValueError: if there are fewer than two cameras or no frames.

    Examples:
      >>> flight = a2tg.smooth_path([view.camera for view in scene.train], 5)
      >>> [model.render(camera).color.shape for camera in flight][-1]
      (36, 48, 3)
    """
    from scipy.ndimage import gaussian_filter1d  # Not at import, which models do.

    check_int("num_frames", num_frames, 1)
    cameras = checked_cameras(cameras)
    if len(cameras) < 2:
        raise ValueError(f"a path needs two cameras; got {len(cameras)}")
    viewmats = matrices_of(cameras)
    centers = camera_centers(viewmats)
    forwards = viewmats[:, 2, :3]
    downs = viewmats[:, 1, :3]
    # The tour begins at an end of the set, and always goes to the nearest camera that it has not visited.
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max() or 1.0
    # In radii of the capture, so that positions compare with directions.
    features = np.concatenate([centers / spread, TURN_WEIGHT * forwards], axis=1)
    tour = [int(np.linalg.norm(features - features.mean(axis=0), axis=1).argmax())]
    left = np.delete(np.arange(len(centers)), tour)
    while len(left):
        nearest = int(np.linalg.norm(features[left] - features[tour[-1]], axis=1).argmin())
        tour.append(int(left[nearest]))
        left = np.delete(left, nearest)
    knots = np.concatenate([centers, forwards, downs], axis=1)[tour]
    # The polyline through the cameras is smoothed, and then passed at constant speed.
    along = _lengths(knots, 1e-9)
    num_fine = max(20 * num_frames, 1000)
    dense = _interpolated(np.linspace(0.0, along[-1], num_fine), along, knots)
    # "nearest" repeats the end points, so that the path never leads beyond the cameras.
    dense = gaussian_filter1d(dense, SMOOTHING * num_fine, axis=0, mode="nearest")
    travelled = _lengths(dense, 1e-12)
    curve = _interpolated(np.linspace(0.0, travelled[-1], num_frames), travelled, dense)
    return _moved(cameras[0], [looking(*np.split(row, 3)) for row in curve])


def path_through(views: Sequence[Camera], num_frames: int) -> list[Camera]:
    """Return a smooth flight through views in their order, at constant speed between two of them.

    Positions follow a cubic spline; directions turn evenly, and intrinsics change evenly, from view to view.

    Args:
      views: at least one; the first one's image size is used throughout.
      num_frames: number of cameras on the path, at least one.

    Returns:
      `num_frames` cameras.

    Raises:
      ValueError: if there are no views or no frames.
    """
    from scipy.interpolate import CubicSpline  # Not at import, which would take 0.1 s longer.

    check_int("num_frames", num_frames, 1)
    views = checked_cameras(views, "views")
    if not views:
        raise ValueError("a path needs a view; got none")
    first = views[0]
    views = [resize_camera(view, first.width, first.height) for view in views]
    if len(views) == 1:
        return [first] * num_frames
    viewmats = matrices_of(views)
    rotations = Rotation.from_matrix(viewmats[:, :3, :3])
    centers = camera_centers(viewmats)
    # Time grows with distance and turn, so that the flight does not rush through a view.
    ways = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    turns = (rotations[1:] * rotations[:-1].inv()).magnitude()
    steps = ways / max(ways.mean(), 1e-12) + turns / max(turns.mean(), 1e-12)
    # Splines need increasing times, also where two views are equal.
    knots = np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1e-3))])
    times = np.linspace(0.0, knots[-1], num_frames)
    places = CubicSpline(knots, centers, bc_type="natural")(times)
    turned = Slerp(knots, rotations)(times).as_matrix()
    Ks = np.stack([np.asarray(view.K, np.float64).ravel() for view in views])
    lenses = _interpolated(times, knots, Ks).reshape(-1, 3, 3)
    dtype = first.viewmat.dtype
    size = (first.width, first.height)
    return [
        Camera(jnp.asarray(viewmat_of_axes(R, c), dtype), jnp.asarray(K, dtype), *size)
        for R, c, K in zip(turned, places, lenses, strict=True)
    ]


def _moved(camera: Camera, viewmats: Sequence[np.ndarray]) -> list[Camera]:
    """Return a camera, as a pinhole camera, at other places."""
    dtype = camera.viewmat.dtype
    return [dataclasses.replace(camera, viewmat=jnp.asarray(viewmat, dtype), rays=None) for viewmat in viewmats]


def _lengths(points: np.ndarray, least: float) -> np.ndarray:
    """Return the lengths [n] of a polyline up to each of its points [n, C] (positions first); each edge counts `least`
    more, so that they increase."""
    steps = np.linalg.norm(np.diff(points[:, :3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps + least)])


def _interpolated(places: np.ndarray, knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return rows of values [n, C] at the knots [n], interpolated at places [m]."""
    return np.stack([np.interp(places, knots, column) for column in values.T], axis=1)


def intrinsics(width: int, height: int, field_of_view: float) -> np.ndarray:
    """Return K [3, 3] of square pixels with the principal point in the middle. The field of view is in radians, across
    the longer side."""
    focal = max(width, height) / (2 * np.tan(field_of_view / 2))
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def looking(center: np.ndarray, forward: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Return the world-to-camera matrix [4, 4] at `center`, with z along `forward` and y closest to `down`."""
    z = forward / np.linalg.norm(forward)
    # A right-handed frame: x = y × z, y = z × x.
    x = np.cross(down, z)
    x /= np.linalg.norm(x)
    return viewmat_of_axes(np.stack([x, np.cross(z, x), z]), center)


def viewmat_of_axes(rotation: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return the world-to-camera matrix [4, 4] of a camera's axes, as rows, and its position."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ center
    return viewmat
