"""From photographs with poses in the original world to a scene in the normalised one.

Every scene gets the same origin, orientation and size before training. All of it is float64 numpy.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from a2tg_jax import Camera, DepthMap, Mask, Picture, Scene, Similarity, View
from a2tg_jax.base.even_spacing import evenly_chosen
from a2tg_jax.base.text import counted, first_names, in_bytes
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.cameras import LARGEST_COORDINATE, MAX_SKEW, check_calibration
from a2tg_jax.core.sight import FIRST_LOOK, Sight, unseeing
from a2tg_jax.data.capture_geometry import (
    LEAST_FACING,
    camera_centers,
    distance_to_subject,
    outlying_cameras,
    subject_of,
)
from a2tg_jax.data.photo_points import MOST_PLAIN, MOST_VIEWS, Look, agreeing_points, plain_share
from a2tg_jax.scene import ray_bytes, rays_of_lenses

MANY_LENSES = 8
"""Number of lenses beyond which it is likely that each photograph was calibrated alone."""
GENERIC_NAMES = {
    "0", "capture", "colmap", "data", "dataset", "dense", "images", "input", "output", "photos", "scene", "sfm",
    "sparse", "undistorted",
}  # fmt: skip
"""Names of folders, in lower case, that do not distinguish scenes."""
NUM_POINTS = 10_000
"""Number of points made for a scene without any. Views that see none of these get further ones."""
NUM_CANDIDATES = 100_000
"""Number of random points among which they are chosen."""
OBJECT_SHARE = 0.8958
"""Half the side of an object's cube over half the width that cameras see at its centre: the cube of ±1.3 of NeRF's
synthetic objects, whose cameras are 4.031 away and see 39.6°."""
NEAREST = 0.4
DEEPEST_AROUND = 2.0
"""Depths of random points in front of cameras around a subject, in units of their distance from it."""
SHALLOWEST = 0.5
DEEPEST = 10.0
"""Depths of random points in front of other cameras."""
GREY = 128 / 255
"""Colour of points whose colour is unknown."""
FARTHEST = 1e5
"""Largest distance of a camera from the median centre, in units of the median distance."""
MIN_UP_LENGTH = 1e-3
"""Shortest mean of the cameras' unit up vectors that still defines up."""
COARSEST = 1e-4
"""Largest rounding of coordinates without a warning, in units of the distance of the cameras: 0.1 pixels at a focal
length of 1,000."""
ZERO_SPREAD = 1e-9
"""Distance below which cameras count as one place, relative to their distance from the origin."""
VALIDATION_EVERY = 8
"""Interval of validation views among the training views."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    """One photograph with its pose in the original world, before normalisation."""

    name: str
    viewmat: np.ndarray
    """[4, 4] float64 world to camera (OpenCV)."""
    K: np.ndarray
    """[3, 3] float64 intrinsics in pixels of the picture."""
    picture: Picture
    mask: Mask | None = None
    rays: np.ndarray | None = None
    """[H, W, 2] rays of the pixels, as in `Camera.rays`, NaN where there is none; None for a pinhole."""
    depth: DepthMap | None = None
    panorama: int | None = None

    def sight(self, viewmat: np.ndarray) -> Sight:
        """Return what it shows from a pose [4, 4] in any world."""
        return Sight.of(viewmat, self.K, self.picture.size, self.rays)


@dataclasses.dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in the original world."""

    points: np.ndarray
    """[P, 3]."""
    colors: np.ndarray
    """[P, 3] uint8."""


def assemble_scene(
    name: str, train: Sequence[Shot], test: Sequence[Shot], cloud: PointCloud | None, *, source: str,
    is_object: bool = False,
) -> Scene:  # fmt: skip
    """Normalise the world and assemble the scene.

    Args:
      name: name of the scene.
      train, test: shots to train and to test on, in any order.
      cloud: surface points. With fewer than two, or if no training view sees one, points where the photographs agree
        are used, or else random ones where the cameras look, with a warning. Another warning counts training views
        that see no point.
      source: name of the input in messages.
      is_object: whether all views show one whole object: it is then searched in a cube as well, and there is no
        warning.

    Raises:
      ValueError: if the shots or their poses make no scene.
    """
    # Sorted for _check_shots, and so that sums over cameras do not depend on the order of the files.
    shots = sorted([*train, *test], key=lambda shot: shot.name)
    _check_shots(shots, len(train), source)
    poses = np.stack([shot.viewmat for shot in shots])
    is_outlying = _warn_of_outlying(shots, poses, cloud, source)
    try:
        transform = normalizing_similarity(poses[~is_outlying])
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None
    warn_of_rounding("camera positions", camera_centers(poses), transform, source)
    viewmats = {shot.name: transform.apply_to_viewmat(shot.viewmat) for shot in shots}
    sights = [shot.sight(viewmats[shot.name]) for shot in train]
    usable = None if cloud is None else _usable_points(cloud, transform, source)
    start = None if usable is None else _seen_points(usable, train, sights, source)
    if start is None:
        lacks = "has no" if usable is None or len(usable.points) < 2 else "no training view sees any of its"
        looks = _looks(train, viewmats)
        start = _made_points(sights, looks, transform.rotation if is_object else None)
        obstacle = _obstacle(looks) if start.is_random else ""
        if cloud is not None or obstacle or not is_object:
            kind = f"random points, since {obstacle}" if obstacle else "points where photographs agree"
            warn(f"{source}: {lacks} sparse points; starts from {len(start.points):,} {kind}")
    views = [_view(shot, viewmats[shot.name]) for shot in shots]
    test_names = {shot.name for shot in test}
    return Scene(
        name=name,
        train=tuple(view for view in views if view.name not in test_names),
        test=tuple(view for view in views if view.name in test_names),
        points=np.asarray(start.points, np.float32),
        colors=start.colors.astype(np.float32) / np.float32(255),
        transform=transform,
        scale=scene_scale(camera_centers(np.stack(list(viewmats.values()))[~is_outlying])),
    )


def _check_shots(shots: Sequence[Shot], num_train: int, source: str) -> None:
    """Raise ValueError if the shots, sorted by name, make no scene, or one is so far away that it moves the origin."""
    if len(shots) < 2:
        raise ValueError(f"{source}: has {len(shots)} view(s) with a pose; at least two are needed")
    if num_train < 1:
        raise ValueError(
            f"{source}: holds out every view for testing; choose another test_every, or 0 for no test views"
        )
    for shot, following in itertools.pairwise(shots):
        if shot.name == following.name:
            raise ValueError(f"{source}: lists {shot.name} twice; remove one")
    for shot in shots:
        if shot.mask is not None and shot.mask.num == 0:
            raise ValueError(
                f"{source}: the mask of {shot.name} excludes every pixel; remove the photograph or correct the mask"
            )
    centers = camera_centers(np.stack([shot.viewmat for shot in shots]))
    # Medians, because one camera far away would move a mean towards itself.
    distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    farthest = int(np.argmax(distances))
    # A median of 0, with most cameras at one place, is no unit.
    if 0 < FARTHEST * np.median(distances) < distances[farthest]:
        raise ValueError(
            f"{source}: {shots[farthest].name} is more than {FARTHEST:g} times as far away as half of the cameras; "
            "remove it from the scene or correct the pose"
        )


def _view(shot: Shot, viewmat: np.ndarray) -> View:
    """Return the shot with its camera in the normalised world."""
    height, width = shot.picture.size
    check_calibration(viewmat, shot.K, width, height, shot.name)
    rays: Any = shot.rays  # Views of one lens share the array.
    camera = Camera(jnp.asarray(viewmat, jnp.float32), jnp.asarray(shot.K, jnp.float32), width, height, rays)
    mask = shot.mask
    if rays is not None:
        has_ray = np.isfinite(rays).all(axis=2)
        mask = Mask.of(has_ray if mask is None else has_ray & mask.read())
    # Batches of views without masks carry one bool per view (scene.counted_pixels).
    if mask is not None and mask.is_full:
        mask = None
    return View(shot.name, camera, shot.picture, mask, shot.depth, shot.panorama)


# The world


def rigid_viewmat(viewmat: np.ndarray, what: str) -> np.ndarray:
    """Return the rigid motion nearest to a nearly rigid world-to-camera matrix [4, 4], such as a rounded pose, with the
    same camera centre -R⁻¹·t. `what` is its name."""
    rigid = rigid_motion(viewmat, what)
    # In map coordinates t is millions of metres long: with another R, the same t would be another place.
    rigid[:3, 3] = rigid[:3, :3] @ np.linalg.solve(viewmat[:3, :3], viewmat[:3, 3])
    return rigid


def rigid_motion(motion: np.ndarray, what: str) -> np.ndarray:
    """Return the rigid motion nearest to a nearly rigid matrix [4, 4], with the same translation, such as the position
    in a camera-to-world matrix. `what` is its name."""
    rotation = motion[:3, :3]
    if not (np.abs(motion) <= LARGEST_COORDINATE).all():  # False for NaN.
        largest = np.abs(motion).max()
        fault = f"exceeds ±{LARGEST_COORDINATE:g}, at {largest:g}" if np.isfinite(largest) else "is not finite"
        raise ValueError(f"{what}: its pose {fault}; remove it from the scene or correct the pose")
    # The nearest orthogonal matrix to R = U·S·Vᵀ is U·Vᵀ; it is a reflection if its determinant is -1.
    left, singular_values, right = np.linalg.svd(rotation)
    if np.abs(singular_values - 1).max() > MAX_SKEW or np.linalg.det(rotation) < 0:
        raise ValueError(f"{what}: its pose is not a rigid motion; rotations must be orthonormal and right-handed")
    rigid = np.eye(4)
    rigid[:3, :3] = left @ right
    rigid[:3, 3] = motion[:3, 3]
    return rigid


def _warn_of_outlying(shots: Sequence[Shot], poses: np.ndarray, cloud: PointCloud | None, source: str) -> np.ndarray:
    """Return [V] bool, the shots whose cameras are far from all others, which a warning names."""

    def distance_of(indices: np.ndarray) -> float:
        """Return the median depth of what cameras see of the cloud."""
        depths = []
        if cloud is not None:
            points = evenly_chosen(cloud.points[are_somewhere(cloud.points)], FIRST_LOOK)
            for index in indices.tolist():
                is_seen, of_points = shots[index].sight(poses[index]).seen(points, 0.0)
                if is_seen.any():
                    depths.append(np.median(of_points[is_seen]))
        return float(np.median(depths)) if depths else distance_to_subject(poses[indices])

    is_outlying = outlying_cameras(poses, distance_of)
    if is_outlying.any():
        names = [shots[index].name for index in np.flatnonzero(is_outlying).tolist()]
        warn(
            f"{source}: {counted(len(names), 'camera')} of {len(shots)} far from all others: {first_names(names)}. "
            "The others alone decide the world's origin and unit. If these poses are wrong, remove the photographs or "
            "correct the poses"
        )
    return is_outlying


def warn_of_rounding(what: str, positions: np.ndarray, transform: Similarity, source: str) -> None:
    """Warn if positions [..., 3] in the original world are numbers of float32, whose steps are large there.

    `transform` leads to the normalised world, in which the cameras' distance is 1.
    """
    steps = np.spacing(np.abs(positions).astype(np.float32)).astype(np.float64)
    is_coarse = steps * transform.scale > COARSEST
    coarse = positions[is_coarse]
    steps = steps[is_coarse]
    # Positions that come from inverting a matrix differ from float32 by rounding of float64.
    is_float32 = np.abs(coarse - coarse.astype(np.float32)) <= 1e-3 * steps
    is_whole = np.abs(coarse - np.rint(coarse)) <= 1e-3  # Such as a grid in metres, which lost nothing.
    if not len(coarse) or not is_float32.all() or (is_whole.all() and steps.max() < 1):
        return
    warn(
        f"{source}: {what} were rounded to float32, in steps of {steps.max():g}, which is "
        f"{steps.max() * transform.scale:.2g} of the cameras' distance from the subject: give them in float64, or "
        "subtract an offset before they become float32"
    )


def normalizing_similarity(viewmats: np.ndarray) -> Similarity:
    """Return the similarity to the normalised world of rigid world-to-camera matrices [V, 4, 4].

    The origin is the point nearest to all optical axes in least squares, or the mean camera centre if the axes are
    nearly parallel. The mean camera-up becomes +z, unless the ups cancel. The median distance of the cameras from the
    origin becomes 1.
    """
    centers = camera_centers(viewmats)
    origin = subject_of(viewmats)
    rotation = np.eye(3)
    # The rows of R are the axes of the camera in the world; y is down.
    up = -viewmats[:, 1, :3].mean(axis=0)
    if np.linalg.norm(up) >= MIN_UP_LENGTH:  # The smallest rotation that turns up to +z.
        up = up / np.linalg.norm(up)
        axis = np.cross(up, [0.0, 0.0, 1.0])
        sine = np.linalg.norm(axis)
        axis = axis / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])  # Up is z or -z: any level axis.
        rotation = Rotation.from_rotvec(axis * np.arctan2(sine, up[2])).as_matrix()
    zero = ZERO_SPREAD * max(float(np.linalg.norm(centers, axis=1).max()), np.finfo(np.float64).tiny)
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    distance = float(np.median(np.linalg.norm(centers - origin, axis=1)))
    if min(spread, distance) <= zero:
        raise ValueError("all cameras are at one place; photographs from different positions are needed")
    return Similarity(1.0 / distance, rotation, -rotation @ origin / distance)  # x' = R·(x - origin) / distance


def scene_scale(centers: np.ndarray) -> float:
    """Return 1.1 × the largest distance of a camera centre [V, 3] from their mean, the unit of the means' learning
    rate."""
    # As getNerfppNorm of 3DGS, whose learning rates are in this unit.
    return 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())


# Points to start from


def are_somewhere(points: np.ndarray) -> np.ndarray:
    """Return [P] bool, whether the coordinates of points [P, 3] are finite and not too large."""
    return np.asarray((np.abs(points) <= LARGEST_COORDINATE).all(axis=1))  # False for NaN.


def _usable_points(cloud: PointCloud, transform: Similarity, source: str) -> PointCloud:
    """Return the points in the normalised world whose coordinates are finite and not too large; a warning counts the
    others."""
    is_usable = are_somewhere(cloud.points)
    # Again in the normalised world: its unit is small if the cameras are close together.
    is_usable[is_usable] = are_somewhere(transform.apply(cloud.points[is_usable]))
    if not is_usable.all():
        left_out = counted(int(np.count_nonzero(~is_usable)), "point")
        warn(f"{source}: {left_out} left out, not finite or beyond ±{LARGEST_COORDINATE:g}")
    points = cloud.points[is_usable]
    warn_of_rounding("points", points, transform, source)
    return PointCloud(transform.apply(points), cloud.colors[is_usable])


def _seen_points(cloud: PointCloud, train: Sequence[Shot], sights: Sequence[Sight], source: str) -> PointCloud | None:
    """Return points of the normalised world, with a warning that counts training views that see none, or None if no
    view sees any."""
    # Initial Gaussians are as large as the distances to their neighbours, so one point is not enough.
    if len(cloud.points) < 2:
        return None
    blind = unseeing(cloud.points, sights)
    if len(blind) == len(sights):
        return None
    if blind:
        warn(
            f"{source}: {len(blind)} of {len(sights)} training views see none of its points, such as "
            f"{train[blind[0]].name}: nothing to start from there"
        )
    return cloud


@dataclasses.dataclass(frozen=True, eq=False)
class _MadePoints(PointCloud):
    """Points of a scene that has none, in the normalised world."""

    is_random: bool


def _looks(train: Sequence[Shot], viewmats: Mapping[str, np.ndarray]) -> list[Look]:
    """Return photographs to compare: not those that validation holds out, unless there are no others."""
    kept = every_kth(train, VALIDATION_EVERY)[0] or train
    compared = evenly_chosen([shot for shot in kept if shot.rays is None], MOST_VIEWS)
    return [Look(shot.picture, shot.mask, viewmats[shot.name], shot.K) for shot in compared]


def _made_points(sights: Sequence[Sight], looks: Sequence[Look], object_axes: np.ndarray | None) -> _MadePoints:
    """Return points where photographs agree, or random grey ones. Each view sees some."""
    random = random_points(sights, object_axes)
    points, colors = agreeing_points(looks, random, NUM_POINTS)
    is_random = len(points) < 2
    if is_random:
        points = random[:NUM_POINTS]
        colors = np.full(points.shape, GREY)
    else:
        blind = unseeing(points, sights)
        if blind:
            # As many for each of them as for the others, at random.
            num = NUM_POINTS * len(blind) // len(sights)
            more = random_points([sights[index] for index in blind])[:num]
            points = np.concatenate([points, more])
            colors = np.concatenate([colors, np.full(more.shape, GREY)])
    return _MadePoints(points, np.rint(255 * colors).astype(np.uint8), is_random)


def _obstacle(looks: Sequence[Look]) -> str:
    """Return why there are no points where photographs agree."""
    if not looks:
        return "photographs that keep a lens's distortion are not compared"
    if plain_share(looks) > MOST_PLAIN:
        return (
            f"{plain_share(looks):.0%} of the photographs is plain, such as a wall or the sky, where they would agree "
            "anywhere: give points of a reconstruction, such as a2tg sfm finds"
        )
    return "the photographs agree nowhere"


def random_points(sights: Sequence[Sight], object_axes: np.ndarray | None = None) -> np.ndarray:
    """Return random points [NUM_CANDIDATES, 3] where cameras look; each view sees some.

    They are in the pyramids that the views show; the first half of them in a cube around an object, if all views show
    one.

    Args:
      sights: what each training view shows. The origin is the point nearest to their optical axes.
      object_axes: [3, 3] axes of the object's cube, as columns; None for other scenes.
    """
    rng = np.random.default_rng(0)
    viewmats = np.stack([sight.viewmat for sight in sights])
    K = np.stack([sight.K for sight in sights])
    low = np.stack([sight.low for sight in sights])
    high = np.stack([sight.high for sight in sights])
    centers = camera_centers(viewmats)
    axes = viewmats[:, 2, :3]
    distances = np.linalg.norm(centers, axis=1)
    cube = np.zeros((0, 3))
    if object_axes is not None:
        # Width and height that a view shows at distance 1.
        slopes = (high - low) / np.diagonal(K, axis1=1, axis2=2)[:, :2]
        half_side = OBJECT_SHARE * np.median(distances * slopes.min(axis=1) / 2)
        filled = rng.uniform(-half_side, half_side, (NUM_CANDIDATES // 2, 3)) @ object_axes.T
        if not unseeing(filled, sights):
            cube = filled
    # Each other point is on a random ray of one view, at a random depth, and the views take turns.
    num = NUM_CANDIDATES - len(cube)
    view = np.arange(num) % len(sights)
    places = np.concatenate([rng.uniform(low[view], high[view]), np.ones((num, 1))], axis=1)
    share = rng.uniform(size=num)
    # Cosine between the optical axis and the direction to the origin: near 1 if the cameras surround a subject.
    facing = -np.einsum("vi,vi->v", centers, axes) / np.maximum(distances, 1e-12)
    if np.median(facing) >= LEAST_FACING:
        # A camera at the origin would have all of its points at its own centre.
        reach = np.maximum(distances, SHALLOWEST)
        depths = (NEAREST + (DEEPEST_AROUND - NEAREST) * share) * reach[view]
    else:
        # Even in log depth: as many points for each doubling of the distance.
        depths = SHALLOWEST * (DEEPEST / SHALLOWEST) ** share
    in_frame = np.einsum("pij,pj->pi", np.linalg.inv(K)[view], places) * depths[:, None]
    # Back to the world, x = Rᵀ·in_frame + centre; "pji" transposes R.
    offsets = np.einsum("pji,pj->pi", viewmats[view, :3, :3], in_frame)
    return np.concatenate([cube, offsets + centers[view]])


# Views that are held out


Held = TypeVar("Held", Shot, View)
"""A photograph before or after its view is made."""


def with_validation_views(scene: Scene) -> Scene:
    """Return the scene for choosing options: every eighth training view is held out instead of the test views.

    Cameras, points and world of the whole scene stay. Test views are left out, so that no choice depends on them.
    The views of a panorama are held out together and count as one.

    Args:
      scene: a scene with two training views or more.

    Returns:
      A scene whose `test` are the validation views.

    Raises:
      ValueError: if there is only one training view or panorama.
    """
    train, held_out = split_views(scene.train, VALIDATION_EVERY)
    if not train:
        only = "1" if len(scene.train) == 1 else f"1 panorama, cut into {len(scene.train)} views"
        raise ValueError(f"{scene.name}: validation views are taken from at least 2 training views; there is {only}")
    return dataclasses.replace(scene, train=tuple(train), test=tuple(held_out))


def check_test_every(test_every: int) -> None:
    if test_every < 0 or test_every == 1 or test_every != int(test_every):
        raise ValueError(f"test_every must be 0 (no test views) or a whole number of at least 2; got {test_every}")


def every_kth(shots: Sequence[Held], test_every: int) -> tuple[list[Held], list[Held]]:
    """Return (train, test) as `split_views` does, of shots or views in order of names."""
    return split_views(sorted(shots, key=lambda shot: shot.name), test_every)


def split_views(views: Sequence[Held], every: int) -> tuple[list[Held], list[Held]]:
    """Return the views that are kept, and the ones that are held out: 0, k, 2k, …; none for k = 0.

    The views of a panorama count as one. Alone, a held-out view would have training views from the same point.
    """
    numbers: dict[tuple[int | None, int], int] = {}
    kept: list[Held] = []
    held_out: list[Held] = []
    for index, view in enumerate(views):
        # A panorama has one key, any other view its own; len(numbers) is the next free number.
        number = numbers.setdefault((view.panorama, index if view.panorama is None else 0), len(numbers))
        (held_out if every and number % every == 0 else kept).append(view)
    return kept, held_out


def warn_of_lenses(scene: Scene) -> None:
    """Warn if most photographs have their own lens: the rays of each then take more memory than its pixels."""
    views = [view for view in (*scene.train, *scene.test) if view.camera.rays is not None]
    num = len(rays_of_lenses(views))
    if num > MANY_LENSES and 2 * num > len(views):
        warn(
            f"{scene.name}: {len(views)} photographs have {num} lenses, whose rays take {in_bytes(ray_bytes(views))}: "
            'calibrate photographs of one camera together, or undistort them (lens="undistort")'
        )


def scene_name(folder: Path) -> str:
    """Return the end of a folder's path, from the last name that says more than "scene" or "colmap" does."""
    # The first part is the root, which is no name.
    parts = folder.resolve().parts
    specific = [at for at, part in enumerate(parts) if at and part.lower() not in GENERIC_NAMES]
    return "/".join(parts[specific[-1] if specific else -1 :])
