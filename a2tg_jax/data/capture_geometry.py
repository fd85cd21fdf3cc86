"""Geometry of a capture: its subject, cameras that do not belong to it, and the turn that makes it upright (host).

c is a camera centre, d its optical axis (unit); all of it in float64.
"""

from collections.abc import Callable, Sequence

import numpy as np

from a2tg_jax import Camera

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
SURROUNDED = np.radians(120)
"""Largest angle about the vertical without a camera at which cameras surround their subject."""
FRONT_ANGLE = np.radians(30)
"""Angle between directions from the subject within which cameras show the same side of it."""
FARTHER_COUNTS = 0.3
"""Weight of a distance above the usual one, relative to one below."""


def camera_centers(viewmats: np.ndarray) -> np.ndarray:
    """Return the positions [V, 3] of cameras given as rigid world-to-camera matrices [V, 4, 4]: c = -Rcᵀ·t."""
    centers: np.ndarray = np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])
    return -centers


def subject_of(viewmats: np.ndarray) -> np.ndarray:
    """Return the point [3] nearest to the optical axes of cameras [V, 4, 4], argmin_x Σ |(I - d·dᵀ)(x - c)|², or the
    mean centre if the axes are about parallel."""
    centers = camera_centers(viewmats)
    axes = viewmats[:, 2, :3]
    # Normal equations of the least squares: Σ P·x = Σ P·c with P = I − d·dᵀ.
    projections = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal_matrix = projections.mean(axis=0)
    if np.linalg.eigvalsh(normal_matrix)[0] < MIN_AXIS_SPREAD:
        return centers.mean(axis=0)
    return np.linalg.solve(normal_matrix, np.einsum("vij,vj->i", projections, centers) / len(centers))


def distance_to_subject(viewmats: np.ndarray) -> float:
    """Return the median distance of cameras [V, 4, 4] from the point nearest to their optical axes; NaN if most do not
    look there, such as along a street."""
    offsets = subject_of(viewmats) - camera_centers(viewmats)
    distances = np.linalg.norm(offsets, axis=1)
    facing = np.sum(offsets * viewmats[:, 2, :3], axis=1) / np.maximum(distances, 1e-12)
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


def matrices_of(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the world-to-camera matrices [V, 4, 4] of cameras, in float64."""
    return np.array([camera.viewmat for camera in cameras], np.float64).reshape(-1, 4, 4)


def without_outlying(cameras: Sequence[Camera]) -> list[Camera]:
    """Return the cameras without those far from all others."""
    is_outlying = outlying_cameras(matrices_of(cameras))
    return [camera for camera, is_far in zip(cameras, is_outlying, strict=True) if not is_far]


def perpendicular(direction: np.ndarray) -> np.ndarray:
    """Return a vector [3] perpendicular to a direction [3], not of unit length."""
    return np.cross(direction, np.eye(3)[np.abs(direction).argmin()])


def largest_gap(viewmats: np.ndarray, up: np.ndarray) -> float:
    """Return the largest angle in radians, at the subject and about the vertical `up` [3], without a camera [V, 4, 4];
    2π with one camera, or if they do not look at one subject, such as from the middle of a room."""
    if np.isnan(distance_to_subject(viewmats)):
        return 2 * np.pi
    offsets = camera_centers(viewmats) - subject_of(viewmats)
    side = perpendicular(up)
    angles = np.sort(np.arctan2(offsets @ np.cross(up, side), offsets @ side))
    return float(np.diff(angles, append=angles[0] + 2 * np.pi).max())


def front_camera(viewmats: np.ndarray, up: np.ndarray) -> int:
    """Return the index of the camera [V, 4, 4] that shows the subject's front, about centred and not too near.

    The front is the side of the first camera, where people begin, if cameras surround the subject, and otherwise the
    side of most cameras. Deviations in angle (of `FRONT_ANGLE`), centre and logarithm of the distance are weighed.
    Without a subject, it is the camera in the middle.
    """
    centers = camera_centers(viewmats)
    if np.isnan(distance_to_subject(viewmats)):
        return int(np.argmin(np.linalg.norm(centers - centers.mean(axis=0), axis=1)))
    offsets = centers - subject_of(viewmats)
    distances = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    usual = np.median(distances)
    directions = offsets / distances[:, None]
    cosines = np.clip(directions @ directions.T, -1, 1)
    closeness = np.exp(-0.5 * (np.arccos(cosines) / FRONT_ANGLE) ** 2)
    seen = closeness[0] if largest_gap(viewmats, up) < SURROUNDED else closeness.mean(axis=0)
    misses = np.linalg.norm(np.cross(offsets, viewmats[:, 2, :3]), axis=1) / usual
    farther = np.log(distances / usual)
    # Near cameras may cut the subject off; far ones only show it smaller.
    deviations = np.where(farther < 0, -farther, FARTHER_COUNTS * farther)
    return int(np.argmax(seen / seen.max() - misses - deviations))


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
