"""From photographs with poses in the original world to a scene in the normalised one."""

import dataclasses
import itertools
import warnings
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from a2tg_jax.core.cameras import LARGEST_COORDINATE, MAX_SKEW, Camera, check_calibration
from a2tg_jax.core.similarity import Similarity, camera_centers
from a2tg_jax.data.depths import DepthMap
from a2tg_jax.data.masks import Mask
from a2tg_jax.data.observations import ObservedPoints
from a2tg_jax.data.photo_store import Picture
from a2tg_jax.data.scene import Scene, View
from a2tg_jax.data.start_points import NUM_RANDOM_POINTS, Sight, random_points, unseeing
from a2tg_jax.data.world import normalizing_similarity, scene_scale
from a2tg_jax.host.text import counted

RANDOM_COLOR = 128
"""Mid-grey of random points."""
FARTHEST = 1e5
"""Largest distance of a camera from the median centre, in units of the median distance."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    """One photograph with its pose in the original world, before normalisation."""

    name: str
    viewmat: np.ndarray
    """[4, 4] float64 world to camera (OpenCV)."""
    K: np.ndarray
    """[3, 3] float64 intrinsics in pixels of `pixels`."""
    pixels: Picture | np.ndarray
    """[H, W, 3] or [H, W, 4] uint8, with straight alpha."""
    mask: Mask | None = None
    """Mask of the pixels that count; None without a mask."""
    rays: np.ndarray | None = None
    """[H, W, 2] rays of the pixels, as `Camera.rays` has them, NaN where there is none; None of a pinhole."""
    depth: DepthMap | None = None
    """Depth map; None without one."""
    panorama: int | None = None
    """Number of the panorama that it was cut from; None of a photograph."""
    points: ObservedPoints | None = None
    """Points that it observed, their depths in units of the original world; None if they are not known."""


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
      name: of the scene.
      train: shots to train on, any order.
      test: shots to test on; may be empty.
      cloud: surface points. With fewer than two, or if no training view sees one, random points where the cameras look
        are used, with a warning. Another warning counts training views that see no point.
      source: name of the input in messages.
      is_object: whether the scene is an object that all views show whole: random points are then in a cube around it,
        and expected.

    Raises:
      ValueError: if there are fewer than two shots or no training shot, two shots share a name, a pose is not a rigid
        motion, or all cameras stand at one place.
    """
    shots = sorted([*train, *test], key=lambda shot: shot.name)
    _check_shots(shots, len(train), source)
    _check_distances(shots, source)
    try:
        transform = normalizing_similarity(np.stack([shot.viewmat for shot in shots]))
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None
    viewmats = {shot.name: transform.apply_to_viewmat(shot.viewmat) for shot in shots}
    centers = camera_centers(np.stack(list(viewmats.values())))
    sights = [Sight.of(viewmats[shot.name], shot.K, shot.pixels.shape[:2], shot.rays) for shot in train]
    cloud = cloud and _usable(cloud, transform, source)
    points = None if cloud is None or len(cloud.points) < 2 else transform.apply(cloud.points)
    unseen_by = [] if points is None else unseeing(points, sights)
    if cloud is None or points is None or len(unseen_by) == len(sights):
        if cloud is not None or not is_object:
            lack = "has no" if points is None else "no training view sees any of its"
            message = f"{source}: {lack} sparse points; starting from {NUM_RANDOM_POINTS:,} random points instead"
            warnings.warn(message, stacklevel=3)
        points = random_points(sights, transform.rotation if is_object else None)
        colors = np.full(points.shape, RANDOM_COLOR, np.uint8)
    else:
        colors = cloud.colors
        if unseen_by:
            message = f"{source}: {len(unseen_by)} of {len(sights)} training views see none of its points, such as "
            warnings.warn(f"{message}{train[unseen_by[0]].name}: nothing to start from there", stacklevel=3)

    def views(group: Sequence[Shot]) -> tuple[View, ...]:
        return tuple(
            _view(shot, viewmats[shot.name], transform.scale) for shot in sorted(group, key=lambda shot: shot.name)
        )

    return Scene(
        name=name,
        train=views(train),
        test=views(test),
        points=np.asarray(points, np.float32),
        colors=colors.astype(np.float32) / np.float32(255),
        transform=transform,
        scale=scene_scale(centers),
    )


def rigid_viewmat(viewmat: np.ndarray, what: str) -> np.ndarray:
    """Return the rigid motion nearest to a nearly rigid matrix [4, 4], such as a rounded pose.

    Raises:
      ValueError: naming `what`, if the matrix is not finite or its rotation is not one.
    """
    rotation = viewmat[:3, :3]
    if not (np.abs(viewmat) <= LARGEST_COORDINATE).all():  # False for NaN.
        largest = np.abs(viewmat).max()
        found = f"lies beyond ±{LARGEST_COORDINATE:g}, at {largest:g}" if np.isfinite(largest) else "is not finite"
        raise ValueError(f"{what}: its pose {found}; remove it from the scene or correct the pose")
    left, singular_values, right = np.linalg.svd(rotation)
    if np.abs(singular_values - 1).max() > MAX_SKEW or np.linalg.det(rotation) < 0:
        raise ValueError(f"{what}: its pose is not a rigid motion; rotations must be orthonormal and right-handed")
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = left @ right, viewmat[:3, 3]
    return rigid


def _check_shots(shots: Sequence[Shot], num_train: int, source: str) -> None:
    """Raise ValueError if the shots, sorted by name, make no scene."""
    if len(shots) < 2:
        raise ValueError(f"{source}: has {len(shots)} view(s) with a pose; at least two are needed")
    if num_train < 1:
        raise ValueError(
            f"{source}: holds out every view for testing; choose another test_every, or 0 for no test views"
        )
    for shot, following in itertools.pairwise(shots):
        if shot.name == following.name:
            raise ValueError(f"{source}: lists {shot.name} twice; remove one")


def _check_distances(shots: Sequence[Shot], source: str) -> None:
    """Raise ValueError if a camera is so far away that it would move the origin."""
    centers = camera_centers(np.stack([shot.viewmat for shot in shots]))
    distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    farthest = int(np.argmax(distances))
    if 0 < FARTHEST * np.median(distances) < distances[farthest]:
        raise ValueError(
            f"{source}: {shots[farthest].name} stands more than {FARTHEST:g} times as far away as half of the cameras; "
            "remove it from the scene or correct the pose"
        )


def _usable(cloud: PointCloud, transform: Similarity, source: str) -> PointCloud:
    """Return the points within bounds; leave out others with a warning."""
    is_usable = _are_somewhere(cloud.points)
    is_usable[is_usable] = _are_somewhere(transform.apply(cloud.points[is_usable]))
    if is_usable.all():
        return cloud
    left_out = counted(int(np.count_nonzero(~is_usable)), "point")
    message = f"{source}: {left_out} left out, not finite or beyond ±{LARGEST_COORDINATE:g}"
    warnings.warn(message, stacklevel=4)
    return PointCloud(cloud.points[is_usable], cloud.colors[is_usable])


def _are_somewhere(points: np.ndarray) -> np.ndarray:
    """Return [P] whether all coordinates of a point are within bounds."""
    are_within: np.ndarray = (np.abs(points) <= LARGEST_COORDINATE).all(axis=1)  # False for NaN.
    return are_within


def _view(shot: Shot, viewmat: np.ndarray, scale: float) -> View:
    """Return the shot with its camera in the normalised world, which is `scale` times as large as the original."""
    height, width = shot.pixels.shape[:2]
    check_calibration(viewmat, shot.K, width, height, shot.name)
    rays: Any = shot.rays  # Views of one lens share the array.
    camera = Camera(jnp.asarray(viewmat, jnp.float32), jnp.asarray(shot.K, jnp.float32), width, height, rays)
    mask = shot.mask
    if shot.rays is not None and not np.isfinite(shot.rays).all():
        has_ray = np.isfinite(shot.rays).all(axis=2)
        mask = Mask.of(has_ray if mask is None else has_ray & mask.read())
    mask = None if mask is None or mask.is_full else mask
    points = None if shot.points is None else shot.points.scaled(scale)
    return View(shot.name, camera, Picture.of(shot.pixels), mask, shot.depth, shot.panorama, points)
