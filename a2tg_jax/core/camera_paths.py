"""Geometry of a capture, and smooth camera paths: around its subject, past its cameras, or through chosen views (host).

c is a camera centre, d its optical axis (unit); all of it in float64.
"""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation, Slerp

from a2tg_jax.base.checks import check_int
from a2tg_jax.core.cameras import (
    Camera,
    camera_centers,
    check_camera,
    checked_cameras,
    intrinsics,
    looking,
    resize_camera,
    viewmat_of_axes,
)

MIN_AXIS_SPREAD = 1e-3
"""Smallest eigenvalue of the mean of I - d·dᵀ (about the squared angle between axes) that fixes a point."""
LEAST_FACING = 0.5
"""Smallest median cosine between optical axes and the directions to the subject."""
FEWEST_TO_COMPARE = 5
"""Smallest number of cameras of which one may count as outlying."""
FAR = 5.0
"""Distance beyond which a camera is outlying if its axis also misses the others by more than `LARGEST_MISS`; like the
next two, in units of the distance of the other cameras from their subject."""
FARTHEST = 30.0
"""Distance beyond which a camera is outlying in any case: it sees the subject at a thirtieth of the others' size."""
LARGEST_MISS = 3.0
LARGEST_ELEVATION = np.radians(80)  # a camera straight above has no level horizon (`looking`)
FEWEST = 4
"""Smallest number of cameras whose right axes are trusted over their mean up."""
LEAST_SPREAD = 0.025
"""Smallest second eigenvalue of the right axes' moments: headings that spread by 9°."""
LARGEST_RATIO = 0.25
"""Largest ratio of their first to their second eigenvalue."""
LEAST_COSINE = 0.5
"""Smallest cosine between the vertical and the cameras' mean up."""
SMOOTHING = 0.06
"""Standard deviation of the smoothing, as a fraction of the path."""
TURN_WEIGHT = 0.5
"""Weight of a change of direction relative to a change of position when cameras are ordered."""


def nearest_point(centers: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return argmin_x Σ |(I - d·dᵀ)(x - c)|² for lines through `centers` along unit `axes`, or the mean centre."""
    # Normal equations of the least squares: Σ P·x = Σ P·c with P = I − d·dᵀ.
    projections = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal_matrix = projections.mean(axis=0)
    if np.linalg.eigvalsh(normal_matrix)[0] < MIN_AXIS_SPREAD:
        return centers.mean(axis=0)
    return np.linalg.solve(normal_matrix, np.einsum("vij,vj->i", projections, centers) / len(centers))


def distance_to_subject(viewmats: np.ndarray) -> float:
    """Return the median distance of cameras [V, 4, 4] from the point nearest to their optical axes; NaN if most do not
    look there, such as along a street."""
    centers = camera_centers(viewmats)
    axes = viewmats[:, 2, :3]
    offsets = nearest_point(centers, axes) - centers
    distances = np.linalg.norm(offsets, axis=1)
    facing = np.sum(offsets * axes, axis=1) / np.maximum(distances, 1e-12)
    return float(np.median(distances)) if np.median(facing) >= LEAST_FACING else np.nan


def outlying_cameras(viewmats: np.ndarray, distance_of: Callable[[np.ndarray], float] | None = None) -> np.ndarray:
    """Return [V] bool, True for cameras [V, 4, 4] that are too far from the others to show the same subject, mostly
    because their poses are wrong.

    At most a third of the cameras are outlying, and a gap separates them: even the nearest of them is `FAR` times as
    far from the middle as all others are, and as these are from their subject. A long trajectory has no such gap.

    Args:
      viewmats: world-to-camera matrices.
      distance_of: function from indices of cameras to their distance from their subject, or NaN if it is unknown;
        None: `distance_to_subject`.
    """
    num = len(viewmats)
    is_outlying = np.zeros(num, bool)
    centers = camera_centers(viewmats)
    axes = viewmats[:, 2, :3]
    offsets = np.median(centers, axis=0) - centers
    distances = np.linalg.norm(offsets, axis=1)
    # |offset × axis| is the distance from the middle to the axis; behind a camera, the distance from the camera counts.
    misses = np.where(np.sum(offsets * axes, axis=1) > 0, np.linalg.norm(np.cross(offsets, axes), axis=1), distances)
    order = np.argsort(distances, kind="stable")
    for num_others in range(num - num // 3, num if num >= FEWEST_TO_COMPARE else 0):
        others = order[:num_others]
        rest = order[num_others:]
        extent = distances[others[-1]]
        # All others at one place, such as a panorama, have no extent to compare with.
        if not 0 < FAR * extent < distances[rest[0]]:
            continue
        distance = distance_to_subject(viewmats[others]) if distance_of is None else distance_of(others)
        reach = extent if np.isnan(distance) else max(extent, distance)
        far = FARTHEST if np.isnan(distance) else FAR
        is_far = (distances > far * reach) & (misses > LARGEST_MISS * reach)
        is_outlying[rest] = ((distances > FARTHEST * reach) | is_far)[rest]
        if is_outlying.any():
            break
    return is_outlying


def without_outlying(cameras: Sequence[Camera]) -> list[Camera]:
    """Return the cameras without those far from all others."""
    is_outlying = outlying_cameras(_viewmats(cameras))
    return [camera for camera, is_far in zip(cameras, is_outlying, strict=True) if not is_far]


def vertical_of(viewmats: np.ndarray) -> np.ndarray:
    """Return the vertical [3] of cameras [V, 4, 4], as the viewer estimates it (web/src/vertical.ts).

    It is the axis closest to perpendicular to all right axes in least squares, or the cameras' mean up if the right
    axes do not determine it.
    """
    up: np.ndarray = -viewmats[:, 1, :3].mean(axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    rights = viewmats[:, 0, :3]
    # `eigh` sorts eigenvalues in ascending order: the first vector is nearest to perpendicular to all rights.
    (least, middle, _), vectors = np.linalg.eigh(rights.T @ rights / len(rights))
    axis: np.ndarray = vectors[:, 0]
    is_open = middle < LEAST_SPREAD or least > LARGEST_RATIO * middle
    if len(viewmats) < FEWEST or is_open or abs(axis @ up) < LEAST_COSINE:
        return up
    # The sign of an eigenvector is arbitrary.
    return np.asarray(axis * np.sign(axis @ up))


def vertical_in(viewmat: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the vertical [3] against which a camera is level, at the pitch that it has against the vertical `up`
    [3]; as in web/src/vertical.ts."""
    _, down, forward = viewmat[:3, :3]
    pitch = np.clip(forward @ up, -0.99, 0.99)
    return np.asarray(pitch * forward - np.sqrt(1 - pitch**2) * down)


def upright_rotation(vertical: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] from a world with this vertical [3] to one whose −y is up, as programs for splats
    expect.

    First, quarter or half turns lead the coordinate axis nearest to the vertical to −y, so that an upright capture only
    swaps its axes. The shortest rotation corrects what remains.
    """
    up = vertical / np.linalg.norm(vertical)
    nearest = np.eye(3)[np.abs(up).argmax()] * np.sign(up[np.abs(up).argmax()])
    half_turn = np.diag([-1.0, -1.0, 1.0])
    quarter = np.eye(3) if nearest[1] < 0 else half_turn @ _shortest_turn(nearest, np.array([0.0, 1.0, 0.0]))
    return np.asarray(_shortest_turn(quarter @ up, np.array([0.0, -1.0, 0.0])) @ quarter)


def _shortest_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the shortest rotation [3, 3] between unit vectors that are not opposite, by Rodrigues' formula."""
    x, y, z = np.cross(start, end)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1 + start @ end)


def central_camera(viewmats: np.ndarray) -> int:
    """Return the index of the camera [V, 4, 4] whose axis passes nearest to the subject and which is nearest to the
    median camera, with equal weight."""
    centers = camera_centers(viewmats)
    axes = viewmats[:, 2, :3]
    subject = nearest_point(centers, axes)
    misses = np.linalg.norm(np.cross(subject - centers, axes), axis=1)
    remote = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    return int(np.argmin(misses + remote))


def turntable(cameras: Sequence[Camera], num_frames: int, up: np.ndarray | None = None) -> list[Camera]:
    """Return a closed orbit around the subject, the point nearest to all optical axes, about the vertical `up` [3], by
    default the one estimated from the cameras.

    It keeps the cameras' mean distance and elevation, looks at the subject with a level horizon, and begins at the side
    of the first camera, whose intrinsics and image size are used throughout. Cameras far from all others do not count.

    Raises:
      ValueError: if there are no cameras or frames, or the cameras do not look at one subject.
    """
    if not cameras or num_frames < 1:
        raise ValueError(f"an orbit needs a camera and a frame; got {len(cameras)} cameras, {num_frames} frames")
    cameras = without_outlying(cameras)
    viewmats = _viewmats(cameras)
    centers = camera_centers(viewmats)
    axes = viewmats[:, 2, :3]
    subject = nearest_point(centers, axes)
    up = vertical_of(viewmats) if up is None else up
    offsets = centers - subject
    distances = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    if np.median(-np.sum(offsets * axes, axis=1) / distances) < LEAST_FACING:
        raise ValueError("cameras must look at one subject to orbit, and these do not: use smooth_path")
    elevation = np.clip(
        np.arcsin(np.clip(offsets @ up / distances, -1, 1)).mean(), -LARGEST_ELEVATION, LARGEST_ELEVATION
    )
    # The unit direction of the first offset perpendicular to the vertical; any such one if the offset is vertical.
    for vector in (offsets[0], *np.eye(3)):
        across = vector - (vector @ up) * up
        if np.linalg.norm(across) > 1e-3 * np.linalg.norm(vector):
            break
    side = across / np.linalg.norm(across)
    first = cameras[0]
    radius = distances.mean()
    frames = []
    for angle in np.arange(num_frames) * (2 * np.pi / num_frames):
        heading = np.cos(angle) * side + np.sin(angle) * np.cross(up, side)
        outward = np.cos(elevation) * heading + np.sin(elevation) * up
        viewmat = jnp.asarray(looking(subject + radius * outward, -outward, -up), first.viewmat.dtype)
        frames.append(Camera(viewmat, first.K, first.width, first.height))
    return frames


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
    viewmats = _viewmats(cameras)
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
    viewmats = _viewmats(views)
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


def _viewmats(cameras: Sequence[Camera]) -> np.ndarray:
    return np.stack([np.asarray(camera.viewmat, np.float64) for camera in cameras])


def _lengths(points: np.ndarray, least: float) -> np.ndarray:
    """Return the lengths [n] of a polyline up to each of its points [n, C] (positions first); each edge counts `least`
    more, so that they increase."""
    steps = np.linalg.norm(np.diff(points[:, :3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps + least)])


def _interpolated(places: np.ndarray, knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return rows of values [n, C] at the knots [n], interpolated at places [m]."""
    return np.stack([np.interp(places, knots, column) for column in values.T], axis=1)
