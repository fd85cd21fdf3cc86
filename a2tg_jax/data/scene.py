"""Scenes: photographs with their cameras, and points, in the normalised world."""

import dataclasses
import html
import itertools
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.core.cameras import LARGEST_COORDINATE, MAX_SKEW, Camera, check_calibration
from a2tg_jax.core.display import THUMBNAIL, counted, enlarged, html_image, in_bytes, png
from a2tg_jax.core.origin import BLACK, Color, Origin
from a2tg_jax.core.similarity import Similarity, camera_centers
from a2tg_jax.data.depths import DepthMap
from a2tg_jax.data.masks import Mask
from a2tg_jax.data.photo_store import Picture
from a2tg_jax.data.world import normalizing_similarity, scene_scale
from a2tg_jax.host.remote_files import is_remote

NUM_RANDOM_POINTS = 10_000
MANY_LENSES = 8
"""Number of lenses beyond which it is likely that each photograph was calibrated alone."""
LONGEST_PREVIEW = 800
"""Longest side in pixels of the picture of a view in a notebook."""
NUM_THUMBNAILS = 8
"""Number of training views in the picture of a scene."""
VALIDATION_EVERY = 8
"""Interval of validation views among the training views."""
FARTHEST = 1e5
"""Largest distance of a camera from the median centre, in units of the median distance."""
GENERIC_NAMES = {
    "0", "capture", "colmap", "data", "dataset", "dense", "images", "input", "output", "photos", "scene", "sfm",
    "sparse", "undistorted",
}  # fmt: skip
"""Names of folders, in lower case, that do not tell one scene from another."""


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """One photograph with its camera."""

    name: str
    """Path of the image below the scene's image folder, with forward slashes; unique in its scene."""
    camera: Camera
    """Its camera in the normalised world, float32, of the image's size."""
    picture: Picture
    """Its pixels, in memory or on disk; an array [H, W, 3] or [H, W, 4] uint8 may be given, too."""
    mask: Mask | None = None
    """Mask of the pixels that count in losses and metrics; None counts all. An array [H, W] bool may be given, too."""
    depth: DepthMap | None = None
    """Depth map for `loss.depth_weight`; None without one. An array [H, W] of floats may be given, too."""
    panorama: int | None = None
    """Number of the panorama that it was cut from; None of a photograph. Its views are held out together."""

    def __post_init__(self) -> None:
        """Convert arrays to pictures, masks and depth maps."""
        object.__setattr__(self, "picture", Picture.of(self.picture))
        object.__setattr__(self, "mask", None if self.mask is None else Mask.of(self.mask))
        object.__setattr__(self, "depth", None if self.depth is None else DepthMap.of(self.depth))

    @property
    def image(self) -> np.ndarray:
        """Pixels [H, W, 3] uint8. If they are kept on disk, each access reads them."""
        return np.ascontiguousarray(self.picture.read()[..., :3])

    @property
    def alpha(self) -> np.ndarray | None:
        """Opacity [H, W] uint8 (straight: `image` is not multiplied by it), or None for an opaque photograph."""
        return np.ascontiguousarray(self.picture.read()[..., 3]) if self.has_alpha else None

    @property
    def has_alpha(self) -> bool:
        """Whether the photograph has an opacity. This does not read it."""
        return self.picture.shape[2] == 4

    def __repr__(self) -> str:
        height, width = self.picture.size
        more = (", with alpha" if self.has_alpha else "") + ("" if self.mask is None else ", with a mask")
        return f"View({self.name!r}, {width}×{height}{more})"

    def _repr_png_(self) -> bytes:
        return png(enlarged(self.picture.read()), LONGEST_PREVIEW)


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Photographs, cameras and points in the normalised world. Lives on the host; not a pytree."""

    name: str
    train: tuple[View, ...]
    """Views to train on, sorted by name; at least one."""
    test: tuple[View, ...]
    """Held-out test views, sorted by name; may be empty."""
    points: np.ndarray
    """[P, 3] float32 surface points to start from, P >= 2."""
    colors: np.ndarray
    """[P, 3] float32 colours of the points in [0, 1]."""
    transform: Similarity
    """Similarity from the original world of the input to the normalised world; its inverse brings results back."""
    scale: float
    """scene_scale: 1.1 × the largest distance of a camera, train or test, from their mean."""

    def __repr__(self) -> str:
        views = [counted(len(self.train), "training view"), counted(len(self.test), "test view")]
        return f"Scene({self.name!r}, {', '.join(views)}, {self._sizes()}, {counted(len(self.points), 'point')})"

    def _repr_html_(self) -> str:
        """Return the line above thumbnails of a few training views, evenly spaced, for notebooks."""
        chosen = {len(self.train) * place // NUM_THUMBNAILS for place in range(NUM_THUMBNAILS)} if self.train else set()
        views = [self.train[index] for index in sorted(chosen)]
        images = (html_image(png(view.picture.read(), THUMBNAIL), view.name) for view in views)
        return f"<div>{html.escape(repr(self))}</div><div>{' '.join(images)}</div>"

    def _sizes(self) -> str:
        """Return the size of the images, or the number of sizes and the largest."""
        sizes = {view.picture.size for view in (*self.train, *self.test)}
        height, width = max(sizes, key=math.prod, default=(0, 0))
        return f"{width}×{height}" if len(sizes) < 2 else f"{len(sizes)} sizes to {width}×{height}"


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


@dataclasses.dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in the original world."""

    points: np.ndarray
    """[P, 3]."""
    colors: np.ndarray
    """[P, 3] uint8."""


Held = TypeVar("Held", Shot, View)
"""A photograph before or after its view is made."""


def check_are_views(views: Sequence[View], call: str) -> None:
    """Raise ValueError, which shows the right call, unless the views are a list or a tuple of views."""
    is_list = isinstance(views, list | tuple)
    odd = next((item for item in views if not isinstance(item, View)), None) if is_list else views
    if odd is not None:
        raise ValueError(f"views must be views, such as scene.train; got {type(odd).__name__}: say {call}")


def origin_of_scene(scene: Scene, background: Color = BLACK) -> Origin:
    """Return the cameras and the world of a scene, training views first."""
    views = [*scene.train, *scene.test]
    return Origin.of_cameras(
        [view.camera for view in views],
        [view.name for view in views],
        is_test=[False] * len(scene.train) + [True] * len(scene.test),
        transform=scene.transform,
        background=background,
    )


def kinds_of(views: Sequence[View]) -> list[tuple[int, int, int]]:
    """Return height, width and lens of each view. Lens 0 is a pinhole; others are numbered in order of appearance."""
    numbers = {key: number for number, key in enumerate(_lenses(views), 1)}
    return [(*view.picture.size, numbers.get(id(view.camera.rays), 0)) for view in views]


def _lenses(views: Sequence[View]) -> dict[int, Array]:
    """Return the rays of each lens by their identity, in order of appearance; its views share the array."""
    return {id(view.camera.rays): view.camera.rays for view in views if view.camera.rays is not None}


def ray_bytes(views: Sequence[View]) -> int:
    """Return the bytes of the rays of the views' lenses; those of one lens count once."""
    return sum(int(rays.nbytes) for rays in _lenses(views).values())


def warn_of_lenses(scene: Scene) -> None:
    """Warn if most photographs have a lens of their own: the rays of each then take more memory than its pixels."""
    views = [view for view in (*scene.train, *scene.test) if view.camera.rays is not None]
    num = len(_lenses(views))
    if num > MANY_LENSES and 2 * num > len(views):
        warnings.warn(
            f"{scene.name}: {len(views)} photographs have {num} lenses, whose rays take {in_bytes(ray_bytes(views))}: "
            "calibrate photographs of one camera together, or undistort them (--lens undistort)",
            stacklevel=3,
        )


def views_by_kind(views: Sequence[View]) -> list[list[View]]:
    """Return the views of each image size and lens, both in order of appearance."""
    groups: dict[tuple[int, int, int], list[View]] = {}
    for kind, view in zip(kinds_of(views), views, strict=True):
        groups.setdefault(kind, []).append(view)
    return list(groups.values())


def counted_pixels(views: Sequence[View]) -> np.ndarray:
    """Return [V, H, W, 1] bool, True at pixels that count, for views of one size; [V, 1, 1, 1] if all do."""
    if all(view.mask is None for view in views):
        return np.ones((len(views), 1, 1, 1), bool)
    masks = [np.ones(view.picture.size, bool) if view.mask is None else view.mask.read() for view in views]
    return np.stack(masks)[..., None]


def view_image(view: View, background: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the view's image as floats, over a background if it is transparent.

    Args:
      view: one view.
      background: [3] colour in [0, 1], or an image [H, W, 3] of colours.

    Returns:
      [H, W, 3] float32 in [0, 1].
    """
    pixels = view.picture.read()
    color = pixels[..., :3].astype(np.float32) / np.float32(255)
    if not view.has_alpha:
        return color
    alpha = pixels[..., 3:].astype(np.float32) / np.float32(255)
    composed: np.ndarray = alpha * color + (1 - alpha) * np.asarray(background, np.float32)
    return composed


def assemble_scene(
    name: str, train: Sequence[Shot], test: Sequence[Shot], cloud: PointCloud | None, *, source: str
) -> Scene:
    """Normalise the world and assemble the scene.

    Args:
      name: of the scene.
      train: shots to train on, any order.
      test: shots to test on; may be empty.
      cloud: surface points. With fewer than two, random points in a cube around the cameras and their target are used,
        with a warning.
      source: name of the input in messages.

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
    cloud = cloud and _usable(cloud, transform, source)
    if cloud is None or len(cloud.points) < 2:
        message = f"{source}: has no sparse points; starting from {NUM_RANDOM_POINTS:,} random points instead"
        warnings.warn(message, stacklevel=3)
        points, colors = random_points(np.zeros(3), float(np.abs(centers).max()))
    else:
        points, colors = transform.apply(cloud.points), cloud.colors

    def views(group: Sequence[Shot]) -> tuple[View, ...]:
        return tuple(_view(shot, viewmats[shot.name]) for shot in sorted(group, key=lambda shot: shot.name))

    return Scene(
        name=name,
        train=views(train),
        test=views(test),
        points=np.asarray(points, np.float32),
        colors=colors.astype(np.float32) / np.float32(255),
        transform=transform,
        scale=scene_scale(centers),
    )


def scene_name(folder: Path | str) -> str:
    """Return the end of a folder's path or URL, from the last name that tells more than "scene" or "colmap" does."""
    is_url = isinstance(folder, str) or is_remote(folder)
    parts = ("", *str(folder).split("/")[2:]) if is_url else Path(folder).resolve().parts
    told = [at for at, part in enumerate(parts) if at and part.lower() not in GENERIC_NAMES]
    return "/".join(parts[told[-1] if told else -1 :])


def with_validation_views(scene: Scene) -> Scene:
    """Return the scene for choosing options: every eighth training view is held out in place of the test views.

    Cameras, points and world stay those of the whole scene. Test views are left out, so that no choice can see them.
    The views of a panorama are held out together and count as one.

    Raises:
      ValueError: if there is one training view, or one panorama, only.
    """
    train, held_out = split_views(scene.train, VALIDATION_EVERY)
    if not train:
        only = "1" if len(scene.train) == 1 else f"1 panorama, cut into {len(scene.train)} views"
        raise ValueError(f"{scene.name}: validation views are taken from at least 2 training views; there is {only}")
    return dataclasses.replace(scene, train=tuple(train), test=tuple(held_out))


def check_test_every(test_every: int) -> None:
    """Raise ValueError unless some views are left for training."""
    if test_every < 0 or test_every == 1:
        raise ValueError(f"test_every must be 0 (no test views) or at least 2; got {test_every}")


def every_kth(shots: Sequence[Shot], test_every: int) -> tuple[list[Shot], list[Shot]]:
    """Return (train, test): test shots are 0, k, 2k, … in order of names; none for k = 0. Shots of a panorama count as
    one."""
    return split_views(sorted(shots, key=lambda shot: shot.name), test_every)


def split_views(views: Sequence[Held], every: int) -> tuple[list[Held], list[Held]]:
    """Return the views that are kept, and those that are held out: 0, k, 2k, …; none for k = 0.

    The views of a panorama count as one. Alone, a held-out view would have training views from the same point.
    """
    numbers: dict[tuple[int | None, int], int] = {}
    kept: list[Held] = []
    held_out: list[Held] = []
    for index, view in enumerate(views):
        number = numbers.setdefault((view.panorama, index if view.panorama is None else 0), len(numbers))
        (held_out if every and number % every == 0 else kept).append(view)
    return kept, held_out


def random_points(center: np.ndarray, half_side: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return points [NUM_RANDOM_POINTS, 3] uniform in a cube and mid-grey colours (uint8) of the same shape."""
    offsets = np.random.default_rng(seed).uniform(-half_side, half_side, (NUM_RANDOM_POINTS, 3))
    return center + offsets, np.full((NUM_RANDOM_POINTS, 3), 128, np.uint8)


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
    message = f"{source}: {np.count_nonzero(~is_usable)} points are not finite, or beyond ±{LARGEST_COORDINATE:g}"
    warnings.warn(f"{message}; they are left out", stacklevel=4)
    return PointCloud(cloud.points[is_usable], cloud.colors[is_usable])


def _are_somewhere(points: np.ndarray) -> np.ndarray:
    """Return [P] whether all coordinates of a point are within bounds."""
    are_within: np.ndarray = (np.abs(points) <= LARGEST_COORDINATE).all(axis=1)  # False for NaN.
    return are_within


def _view(shot: Shot, viewmat: np.ndarray) -> View:
    """Return the shot with its camera in the normalised world."""
    height, width = shot.pixels.shape[:2]
    check_calibration(viewmat, shot.K, width, height, shot.name)
    rays: Any = shot.rays  # Views of one lens share the array.
    camera = Camera(jnp.asarray(viewmat, jnp.float32), jnp.asarray(shot.K, jnp.float32), width, height, rays)
    mask = shot.mask
    if shot.rays is not None and not np.isfinite(shot.rays).all():
        has_ray = np.isfinite(shot.rays).all(axis=2)
        mask = Mask.of(has_ray if mask is None else has_ray & mask.read())
    mask = None if mask is None or mask.is_full else mask
    return View(shot.name, camera, Picture.of(shot.pixels), mask, shot.depth, shot.panorama)
