"""The subject of a capture: what its cameras look at, without its floor and background (host).

Points are in the frame of the cameras: the origin is the point nearest to all their axes, +z is up, and their median
distance from it is 1.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from a2tg_jax import Model, Origin
from a2tg_jax.base.even_spacing import evenly_chosen
from a2tg_jax.data.capture_geometry import LEAST_FACING, camera_centers, outlying_cameras, perpendicular
from a2tg_jax.io.columns import opacities_of

FEWEST_CAMERAS = 3
MOST_CAMERAS = 24
"""Largest number of cameras whose axes are followed into the model, evenly chosen."""
LEAST_SPREAD = 0.01
"""Smallest eigenvalue of the mean of I − d·dᵀ: axes that differ by about 6°."""
TYPICAL_MISS = 0.1
"""Sine of the angle by which an axis may miss the point before it counts for less."""
REACH = 0.8
"""Largest distance of the subject from the point, in units of the distance of the nearest tenth of the cameras."""
LARGEST_SCALE = 0.2
"""Standard deviation beyond which a Gaussian counts as one of this size."""
LARGEST_AREA = 0.05**2
"""Area beyond which a Gaussian counts as one of this size."""
MOST_PLANES = 3
"""Largest number of planes: a floor, and walls behind the subject."""
NUM_POINTS = 3000
"""Number of points, drawn by their opaque area, that are searched for planes."""
NUM_TRIALS = 1000
"""Number of planes that are tried, each through three of the points."""
FLATNESS = 0.015
"""Distance from a plane up to which a point is in it."""
LEAST_IN_PLANE = 0.05
"""Smallest share of the points that are in a plane."""
LEAST_BEFORE = 0.95
"""Smallest share of the cameras on the near side of a plane."""
LARGEST_TILT = np.radians(20)
"""Largest angle between a floor's normal and the vertical."""
LEAST_DEPTH = 0.1
"""Smallest distance of the point from a wall."""
LARGEST_COSINE = 0.5
"""Largest cosine between the normals of two planes."""
NUM_SECTORS = 12
"""Number of directions around the subject that are searched for a plane."""
LEAST_COVER = 0.4
"""Smallest share of these directions in which a plane continues."""
SIDE = 1 / 64
"""Side of a voxel."""
DENSITY = 0.2
"""Opaque area in a voxel, over the area of one of its faces, from which on it is solid."""
NEAR = 0.15
"""Distance from the point, as a standard deviation, within which a voxel is taken to be of the subject."""
TYPICAL_RADIUS = 0.3
"""Distance from the point at which the length of a seam is weighted by 1."""
LEAST_OPAQUE = 0.05
"""Opaque area that a voxel between others has at least, in units of the area of one of its faces."""
MOST_BELOW = 0.1
"""Share of the area of a free-standing subject below a plane from which on the plane is a part of it."""
LEAST_INSIDE = 0.6
"""Smallest share of a Gaussian's samples that are in the region of the subject."""
MISS = np.radians(3)
"""Angle by which an axis may miss the subject."""
LEAST_MEETING = 0.25
"""Smallest share of the axes that meet the subject."""
SURE = 0.7
"""Smallest sureness from which on nothing needs to be checked."""


class Subject(NamedTuple):
    """The Gaussians of the subject, and how sure that is."""

    is_kept: np.ndarray
    """[N] whether a Gaussian belongs to the subject."""
    sureness: float
    """From 0 to 1, the smallest of five shares: of the optical axes that meet the subject first, of the directions
    around it in which its floor or wall continues, of its distance from the cameras that is free, of what holds it
    together that the seam leaves, and of what stays the same with other thresholds."""
    check: str
    """Why that share is small, and what to check."""

    @property
    def words(self) -> str:
        """How sure it is, in words."""
        if self.sureness >= SURE:
            return f"{_percent(self.sureness)} sure"
        return f"not sure ({_percent(self.sureness)}): {self.check}"


class _Frame(NamedTuple):
    """Cameras that look at one point, and the frame around it."""

    axes: np.ndarray
    """[3, 3] horizontal axes and the vertical, one a row."""
    centre: np.ndarray
    """[3] the point."""
    distance: float
    """Median distance of the cameras."""
    centers: np.ndarray
    """[V, 3] camera centres in the frame."""
    directions: np.ndarray
    """[V, 3] optical axes in the frame."""


class _Matter(NamedTuple):
    """Gaussians in the frame."""

    samples: np.ndarray
    """[N, 5, 3] centre, and the points one standard deviation from it along both axes."""
    normals: np.ndarray
    """[N, 3]."""
    scales: np.ndarray
    """[N, 2] standard deviations."""
    opacities: np.ndarray
    """[N]."""
    areas: np.ndarray
    """[N] opaque area."""


class _Part(NamedTuple):
    """A connected region."""

    is_kept: np.ndarray
    """[N] whether a Gaussian is in it."""
    seam: float
    """Length of the seam along which it was cut off, over the root of its area; 0 if it ends by itself."""


class _Plane(NamedTuple):
    """A floor or a wall, n·x = offset, that splats scatter about."""

    normal: np.ndarray
    """[3] towards the cameras."""
    offset: float
    thickness: float
    """Height above the plane up to which splats belong to it."""


def find_subject(model: Model) -> Subject:
    """Return which Gaussians belong to the subject (host).

    1. The point of interest is nearest to all optical axes, in robust least squares.
    2. Planes with much opaque area around the point, below or behind it, are the floor and walls. What is in them or
       beyond them does not belong to the subject.
    3. Space is divided into voxels. Of the connected regions of solid voxels, the subject is the one with the most area
       near the point. If it reaches the limit, 0.8 of the distance of the nearest cameras, it is cut along the smallest
       seam: the minimum cut between the point and the limit, by the opaque area of neighbouring voxels.

    Args:
      model: a model with its cameras.

    Returns:
      The subject.

    Raises:
      ValueError: if there is none: there are too few cameras, they look outwards or in parallel, or at nothing.
    """
    model = model.live
    frame = _frame_of(model.origin)
    matter = _matter_of(model, frame)
    reach = REACH * float(np.quantile(np.linalg.norm(frame.centers, axis=1), 0.1))
    planes: list[_Plane] = []
    covers: list[float] = []
    part = _connected(matter, planes, reach)
    for plane in _planes_of(matter, frame):
        # If the subject ends by itself, a plane with something of it below is its own, such as the seat of a chair.
        if part.seam == 0 and _share_below(matter, plane, part.is_kept) > MOST_BELOW:
            continue
        above = _connected(matter, [*planes, plane], reach)
        cover = _cover(matter, plane, above.is_kept)
        if cover >= LEAST_COVER:
            planes.append(plane)
            covers.append(cover)
            part = above
    meeting = _meeting(matter, frame, part.is_kept)
    if meeting < LEAST_MEETING:
        past = f"{_percent(1 - meeting)} of the cameras see nothing near the point that their axes have in common"
        raise ValueError(f"no subject: {past}; crop the model instead")
    sureness, check = _sureness(matter, planes, part, reach, max(covers, default=1.0), meeting)
    return Subject(part.is_kept, sureness, check)


def _frame_of(origin: Origin | None) -> _Frame:
    """Return the frame of the cameras. Raises ValueError if they do not look at one point."""
    origin = origin or Origin.of_cameras([])
    viewmats = origin.viewmats
    if len(viewmats):
        viewmats = viewmats[~outlying_cameras(viewmats)]
    if len(viewmats) < FEWEST_CAMERAS:
        need = f"it follows from what at least {FEWEST_CAMERAS} cameras look at"
        raise ValueError(f"no subject: {need}, and the model has {len(viewmats)}")
    centers = camera_centers(viewmats)
    directions = viewmats[:, 2, :3]
    projections = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    if np.linalg.eigvalsh(projections.mean(axis=0))[0] < LEAST_SPREAD:
        raise ValueError("no subject: the cameras look in parallel, at no common point; crop the model instead")
    weights = np.ones(len(centers))
    for _ in range(10):
        normal_matrix = np.einsum("v,vij->ij", weights, projections)
        point = np.linalg.solve(normal_matrix, np.einsum("v,vij,vj->i", weights, projections, centers))
        offsets = point - centers
        distances = np.linalg.norm(offsets, axis=1)
        cosines = np.sum(offsets * directions, axis=1) / np.maximum(distances, 1e-12)
        misses = np.where(cosines > 0, np.sqrt(np.maximum(1 - cosines**2, 0)), 1.0)
        weights = 1 / (1 + (misses / TYPICAL_MISS) ** 2)
    distance = float(np.median(distances))
    if np.median(cosines) < LEAST_FACING or distance < 1e-9:
        raise ValueError(
            "no subject: most cameras look away from the point that their axes have in common, outwards or along a "
            "way; crop the model instead"
        )
    up = origin.vertical
    across = perpendicular(up)
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(up, across), up])
    return _Frame(axes, point, distance, (centers - point) @ axes.T / distance, directions @ axes.T)


def _matter_of(model: Model, frame: _Frame) -> _Matter:
    gaussians = model.gaussians
    means = (np.asarray(gaussians.means, np.float64) - frame.centre) @ frame.axes.T / frame.distance
    scales = np.asarray(gaussians.scales, np.float64) / frame.distance
    tangents = frame.axes @ np.asarray(gaussians.rotations, np.float64)
    steps = scales[:, None, :] * tangents[:, :, :2]
    samples = np.stack([np.zeros_like(means), steps[..., 0], -steps[..., 0], steps[..., 1], -steps[..., 1]], axis=1)
    samples += means[:, None]
    opacities = opacities_of(np.asarray(gaussians.logit_opacities))
    # ∫ exp(−(u² + v²)/2) over the plane is 2π·s_u·s_v.
    areas = np.minimum(2 * np.pi * np.minimum(scales, LARGEST_SCALE).prod(axis=1), LARGEST_AREA)
    return _Matter(samples, tangents[:, :, 2], scales, opacities, opacities * areas)


def _planes_of(matter: _Matter, frame: _Frame) -> list[_Plane]:
    """Return the planes, at most `MOST_PLANES`, that have the most opaque area around the point and below or behind it:
    all cameras are on the same side. The largest one comes first."""
    means = matter.samples[:, 0]
    distances = np.linalg.norm(means, axis=1)
    near = np.flatnonzero(distances < 1)
    weights = matter.areas[near] * np.exp(-(distances[near] ** 2))
    if not weights.sum() > 0:
        return []
    random = np.random.default_rng(0)
    points = means[random.choice(near, NUM_POINTS, p=weights / weights.sum())]
    planes: list[_Plane] = []
    while len(planes) < MOST_PLANES and len(points) > LEAST_IN_PLANE * NUM_POINTS:
        plane = _largest_plane(points, frame, planes, random)
        if plane is None:
            break
        planes.append(plane)
        points = points[points @ plane.normal - plane.offset > 2 * FLATNESS]
    return planes


def _largest_plane(
    points: np.ndarray, frame: _Frame, others: Sequence[_Plane], random: np.random.Generator
) -> _Plane | None:
    """Return the plane with the most of the points [P, 3], in the most directions (RANSAC), or None."""
    corners = points[random.integers(0, len(points), (NUM_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(lengths, 1e-12)[:, None]
    normals *= np.sign(normals @ frame.centers.mean(axis=0))[:, None]
    offsets = np.sum(normals * corners[:, 0], axis=1)
    is_before = np.mean(frame.centers @ normals.T > offsets, axis=0) > LEAST_BEFORE
    # A flat subject is barely above its floor. A wall close to the point may be the subject itself.
    is_floor = normals[:, 2] > np.cos(LARGEST_TILT)
    is_under = offsets < np.where(is_floor, FLATNESS, -LEAST_DEPTH)
    # A second floor is the top of something.
    is_new = np.all([np.abs(normals @ other.normal) < LARGEST_COSINE for other in others], axis=0)
    best = LEAST_IN_PLANE * NUM_POINTS * NUM_SECTORS
    plane = None
    for index in np.flatnonzero((lengths > 1e-9) & is_before & is_under & is_new):
        normal = normals[index]
        inliers = points[np.abs(points @ normal - offsets[index]) < FLATNESS]
        if len(inliers) * NUM_SECTORS > best:
            score = len(inliers) * len(np.unique(_sectors_of(inliers, normal)))
            if score > best:
                best = score
                plane = normal, offsets[index]
    if plane is None:
        return None
    normal, offset = plane
    for _ in range(5):
        inliers = points[np.abs(points @ normal - offset) < FLATNESS]
        middle = inliers.mean(axis=0)
        # `eigh` sorts eigenvalues in ascending order: the first vector is the normal.
        fitted = np.linalg.eigh(np.cov((inliers - middle).T))[1][:, 0]
        normal = fitted * np.sign(fitted @ normal)
        offset = float(middle @ normal)
    heights = points @ normal - offset
    spread = 1.4826 * float(np.median(np.abs(heights[np.abs(heights) < FLATNESS])))
    return _Plane(normal, offset, min(max(2.5 * spread, 0.01), 0.03))


def _sectors_of(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the numbers of the sectors [P], about a normal, in which points [P, 3] are."""
    first = perpendicular(normal)
    angles = np.arctan2(points @ np.cross(normal, first), points @ first) / (2 * np.pi)
    return (angles % 1 * NUM_SECTORS).astype(int) % NUM_SECTORS


def _heights(points: np.ndarray, planes: Sequence[_Plane]) -> np.ndarray:
    """Return the smallest height of points [..., 3] over what belongs to a plane; ∞ without one."""
    heights = np.full(points.shape[:-1], np.inf)
    for plane in planes:
        heights = np.minimum(heights, points @ plane.normal - plane.offset - plane.thickness)
    return heights


def _connected(
    matter: _Matter, planes: Sequence[_Plane], reach: float, side: float = SIDE, density: float = DENSITY
) -> _Part:
    """Return the connected region around the point, above the floor."""
    samples = matter.samples
    is_free = (_heights(samples, planes) > 0) & (np.sum(samples**2, axis=2) < reach**2)
    num = int(np.ceil(2 * reach / side)) + 4
    # Two empty voxels at each border, for the dilation.
    places = np.clip((samples + reach) / side + 2, 0, num - 1).astype(int)
    voxels = np.ravel_multi_index(tuple(np.moveaxis(places, 2, 0)), (num, num, num))
    areas = np.broadcast_to(matter.areas[:, None] / samples.shape[1], is_free.shape)
    opaque = np.bincount(voxels[is_free], areas[is_free], minlength=num**3).reshape(num, num, num) / side**2
    # Regions whose voxels almost touch are one.
    labels, _ = label(binary_dilation(opaque > density))
    # More than two layers of splats count no more.
    opaque = np.minimum(opaque, 2.0)
    squares = ((np.arange(num) - 1.5) * side - reach) ** 2
    distances = np.sqrt(squares[:, None, None] + squares[:, None] + squares)
    pull = opaque * np.exp(-0.5 * (distances / NEAR) ** 2)
    mass = np.bincount(labels.ravel(), pull.ravel())
    mass[0] = 0
    if not mass.any():
        return _Part(np.zeros(len(samples), bool), 0.0)
    is_region = labels == mass.argmax()
    # Farther seams count for more: of equal ones, the nearest ends the subject.
    hold = (opaque + LEAST_OPAQUE) * distances / TYPICAL_RADIUS
    is_inner, seam = _smallest_cut(is_region, hold, pull, distances > reach - 2 * side)
    is_inside = is_inner.ravel()[voxels] & is_free
    # A large Gaussian whose centre happens to be in the region is of the background.
    return _Part(is_inside[:, 0] & (is_inside.mean(axis=1) >= LEAST_INSIDE), seam)


def _smallest_cut(
    is_region: np.ndarray, hold: np.ndarray, pull: np.ndarray, is_limit: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the part [n, n, n] of a region that the minimum cut between `pull` and the limit leaves, and the length of
    the seam over the root of the part's area, both in voxels; 0 if the region does not reach the limit."""
    numbers = np.full(is_region.shape, -1)
    num = int(is_region.sum())
    numbers[is_region] = np.arange(num)
    starts = [np.full(num, num), np.arange(num)]
    ends = [np.arange(num), np.full(num, num + 1)]
    capacities = [pull[is_region], np.where(is_limit[is_region], 1e5, 0.0)]
    for axis in range(3):
        first, second = (np.moveaxis(numbers, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        here, there = (np.moveaxis(hold, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        is_pair = (first >= 0) & (second >= 0)
        starts += [first[is_pair], second[is_pair]]
        ends += [second[is_pair], first[is_pair]]
        capacities += [np.minimum(here, there)[is_pair]] * 2
    # Whole numbers, as `maximum_flow` wants them.
    whole = np.round(1000 * np.concatenate(capacities)).astype(np.int32)
    graph = coo_array((whole, (np.concatenate(starts), np.concatenate(ends))), shape=(num + 2, num + 2)).tocsr()
    found = maximum_flow(graph, num, num + 1)
    rest = graph - found.flow
    rest.data = np.maximum(rest.data, 0)
    rest.eliminate_zeros()
    is_inner = np.zeros(num + 2, bool)
    is_inner[breadth_first_order(rest, num, return_predecessors=False)] = True
    part = np.zeros(is_region.shape, bool)
    part[is_region] = is_inner[:num]
    return part, found.flow_value / 1000 / max(np.sqrt(part.sum()), 1.0)


def _cover(matter: _Matter, plane: _Plane, is_kept: np.ndarray) -> float:
    """Return the share of the directions around the subject in which a plane continues beyond it, or 0."""
    if not is_kept.any():
        return 0.0
    means = matter.samples[:, 0]
    offsets = means - np.median(means[is_kept], axis=0)
    distances = np.linalg.norm(offsets - (offsets @ plane.normal)[:, None] * plane.normal, axis=1)
    radius = float(np.quantile(distances[is_kept], 0.95))
    start = 1.1 * radius
    end = 2 * radius + 0.2
    is_around = (
        (np.abs(means @ plane.normal - plane.offset) < plane.thickness) & (distances > start) & (distances < end)
    )
    sectors = _sectors_of(offsets[is_around], plane.normal)
    areas = np.bincount(sectors, matter.areas[is_around], minlength=NUM_SECTORS)
    # A tenth of the sector.
    return float(np.mean(areas > 0.1 * np.pi * (end**2 - start**2) / NUM_SECTORS))


def _share_below(matter: _Matter, plane: _Plane, is_kept: np.ndarray) -> float:
    """Return the share of the subject's area that is below a plane."""
    is_below = matter.samples[:, 0] @ plane.normal - plane.offset < -plane.thickness
    return float(matter.areas[is_kept & is_below].sum() / max(matter.areas[is_kept].sum(), 1e-12))


def _meeting(matter: _Matter, frame: _Frame, is_kept: np.ndarray) -> float:
    """Return the share of the optical axes that meet the subject before anything else."""
    kept = matter.samples[is_kept, 0]
    if not len(kept):
        return 0.0
    shares = []
    cameras = evenly_chosen(np.stack([frame.centers, frame.directions], axis=1), MOST_CAMERAS)
    for center, direction in cameras:
        towards = kept - center
        towards /= np.linalg.norm(towards, axis=1)[:, None]
        cosines = towards @ direction
        nearest = int(cosines.argmax())
        if cosines[nearest] < np.cos(MISS):
            shares.append(0.0)
            continue
        shares.append(_share_seen(matter, center, towards[nearest], is_kept))
    return float(np.mean(shares))


def _share_seen(matter: _Matter, start: np.ndarray, direction: np.ndarray, is_chosen: np.ndarray) -> float:
    """Return the share of a ray's colour that comes from the chosen Gaussians, of what comes from any."""
    offsets = matter.samples[:, 0] - start
    slopes = matter.normals @ direction
    slopes = np.where(np.abs(slopes) < 1e-6, 1e-6, slopes)
    depths = np.sum(offsets * matter.normals, axis=1) / slopes
    hits = depths[:, None] * direction - offsets
    steps = matter.samples[:, 1::2] - matter.samples[:, :1]
    uv = np.einsum("nc,nkc->nk", hits, steps) / matter.scales**2
    alphas = np.where(depths > 0, matter.opacities * np.exp(-0.5 * np.minimum(np.sum(uv**2, axis=1), 1000)), 0)
    seen = np.flatnonzero(alphas > 1 / 255)
    order = seen[np.argsort(depths[seen])]
    passed = np.cumprod(1 - alphas[order])
    weights = alphas[order] * np.concatenate([[1.0], passed[:-1]])
    return float(np.sum(weights * is_chosen[order]) / max(np.sum(weights), 1e-12))


def _sureness(
    matter: _Matter, planes: Sequence[_Plane], part: _Part, reach: float, cover: float, meeting: float
) -> tuple[float, str]:
    """Return how sure a subject is, and what to check."""
    others = [
        _connected(matter, planes, reach, 1.5 * SIDE),
        _connected(matter, planes, reach, SIDE, 2.5 * DENSITY),
        _connected(matter, planes, reach, SIDE, 0.4 * DENSITY),
    ]
    for factor in (0.5, 2):
        other = [plane._replace(thickness=factor * plane.thickness) for plane in planes]
        others.append(_connected(matter, other, reach))
    areas = matter.areas
    is_kept = part.is_kept
    same = min(float(areas[is_kept & x.is_kept].sum() / areas[is_kept | x.is_kept].sum()) for x in others)
    room = 1 - float(np.quantile(np.linalg.norm(matter.samples[is_kept, 0], axis=1), 0.99)) / reach
    checks = {
        f"{_percent(1 - meeting)} of the cameras see something else first: check that it is what you mean": meeting,
        f"a floor or wall was found in {_percent(cover)} of the directions around it: check where it ends": cover,
        "it nearly reaches the cameras: check that no background is left": 3 * room,
        "it was cut off from what it touches: check the cut": 1 - part.seam / 2,
        f"{_percent(1 - same)} of it changes with other thresholds: check its edges": same,
    }
    check, least = min(checks.items(), key=lambda item: item[1])
    return min(max(least, 0.0), 1.0), check


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
