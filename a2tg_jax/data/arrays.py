"""Scenes from arrays: images and cameras that are already in memory."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from a2tg_jax import DepthMap, Mask, Picture, Scene
from a2tg_jax.base.checks import check_kind, check_shape, check_unmasked, described, kind_of
from a2tg_jax.base.even_spacing import evenly_chosen
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.cameras import check_intrinsics
from a2tg_jax.core.pictures import how_to_convert
from a2tg_jax.data.assembly import (
    PointCloud,
    Shot,
    are_somewhere,
    assemble_scene,
    check_test_every,
    every_kth,
    rigid_viewmat,
    warn_of_rounding,
)
from a2tg_jax.data.capture_geometry import camera_centers, subject_of
from a2tg_jax.data.photo_points import MOST_VIEWS, Look, agreement

OFF_CENTER = 1.25
"""Smallest ratio between image size and twice the principal point, on both axes, that gives a warning."""
MOST_COMPARED = 100
"""Number of views that are tested with other conventions; ten times as many points are."""
LEAST_SEEN = 0.05
CLEARLY = 1.5
"""Smallest share of points in view by another convention, and its smallest ratio to the share by the given one."""
PRECISIONS = 0.2, 0.01
"""Largest offset of an axis from the common point, relative to its distance, for photographs and for renders."""
SUBJECT = 0.6
NUM_TRIED = 20_000
"""Half the side of the cube around the common point, in units of the cameras' distance, in which photographs are
compared at random points, and their number."""
MOST_DIFFERENCE = 0.9
"""Largest ratio of the difference of photographs to the one of photographs exchanged among the cameras (`BEST`)."""


def scene_from_arrays(
    images: Sequence[np.ndarray],
    viewmats: ArrayLike,
    Ks: ArrayLike,
    points: ArrayLike | None = None,
    colors: ArrayLike | None = None,
    *,
    names: Sequence[str] | None = None,
    masks: Sequence[np.ndarray | None] | None = None,
    depths: Sequence[np.ndarray | None] | None = None,
    test_every: int = 8,
    name: str = "arrays",
) -> Scene:
    """Make a scene of images and cameras in any world, which is normalised as `load_scene` does.

    Args:
      images: V images uint8, V ≥ 2: [H, W, 3], with straight alpha [H, W, 4], or grey [H, W] or [H, W, 1]; sizes may
        differ. They are not copied.
      viewmats: [V, 4, 4] world-to-camera matrices, rigid; x is right, y down, z forward (OpenCV). Rounded rotations
        are made orthonormal around the camera centre.
      Ks: [V, 3, 3] intrinsics in pixels, or [3, 3] for all.
      points: [P, 3] points to start from, in the same world; None: some where the images agree, with a
        warning.
      colors: [P, 3] uint8 colours of the points; None: grey.
      names: names of the views, all different; None: numbers.
      masks: [H, W] bool for each image, True at pixels that count, or None.
      depths: [H, W] floats for each image, NaN where unknown, or None: inverse depth up to scale and shift for
        `loss.depth_weight`, or depth up to scale with `loss.depth_kind="depth"`.
      test_every: every k-th view is a test view; 0 keeps none.
      name: name of the scene.

    Warns of likely mistakes: camera-to-world matrices, OpenGL axes (without points, only if the cameras surround a
    subject), intrinsics for another image size, colours in [0, 1] that were converted without a factor of 255, and map
    coordinates in float32.

    Returns:
      The scene in its normalised world; `Scene.transform` leads there from the given one.

    Raises:
      ValueError: naming the argument, if one has another shape or kind, or the views make no scene.

    Examples:
      >>> cameras = [view.camera for view in scene.train]
      >>> made = a2tg.scene_from_arrays(
      ...     [view.image for view in scene.train],
      ...     np.stack([camera.viewmat for camera in cameras]),
      ...     cameras[0].K,
      ...     points=scene.points,
      ... )
      >>> len(made.train) + len(made.test)
      10
    """
    check_test_every(test_every)
    check_kind("images", images, Iterable, "use a list of arrays uint8 [H, W, 3]")
    images = list(images)
    num = len(images)
    if num < 2:
        raise ValueError(f"images must hold at least two images, with a pose each; got {num}")
    viewmats = _numbers("viewmats", viewmats)
    check_shape("viewmats", viewmats, (num, 4, 4))
    if np.abs(viewmats[:, 3] - [0, 0, 0, 1]).max() > 1e-5:  # False for NaN, which rigid_viewmat reports.
        raise ValueError("viewmats must end with the row 0, 0, 0, 1: transpose matrices that multiply row vectors")
    Ks = _numbers("Ks", Ks)
    Ks = np.broadcast_to(Ks, (num, 3, 3)) if Ks.shape == (3, 3) else Ks
    check_shape("Ks", Ks, (num, 3, 3))
    for argument, values in {"names": names, "masks": masks, "depths": depths}.items():
        if values is not None and len(values) != num:
            raise ValueError(f"{argument} must hold one item for each of {num} images; got {len(values)}")
    if colors is not None and points is None:
        raise ValueError("colors needs points")
    cloud = None if points is None else _cloud(points, colors)

    shots = []
    for index in range(num):
        view_name = f"{index:04d}" if names is None else names[index]
        check_kind(f"names[{index}]", view_name, str)
        picture = _converted(f"images[{index}]", Picture.of, images[index])
        viewmat = rigid_viewmat(viewmats[index], f"viewmats[{index}]")
        height, width = picture.size
        check_intrinsics(Ks[index], width, height, f"Ks[{index}]")
        mask = depth = None
        if masks is not None and masks[index] is not None:
            mask = _converted(f"masks[{index}]", Mask.of, masks[index], picture.size)
        if depths is not None and depths[index] is not None:
            depth = _converted(f"depths[{index}]", DepthMap.of, depths[index], picture.size)
        shots.append(Shot(view_name, viewmat, Ks[index], picture, mask, depth=depth))
    for message in _mistakes(images, colors, shots, None if cloud is None else cloud.points):
        warn(f"the scene {name}: {message}")
    scene = assemble_scene(name, *every_kth(shots, test_every), cloud, source=f"the scene {name}")
    # Those of the shots are made orthonormal.
    warn_of_rounding("viewmats", viewmats[:, :3, 3], scene.transform, f"the scene {name}")
    return scene


def _mistakes(
    images: Sequence[object], colors: ArrayLike | None, shots: Sequence[Shot], points: np.ndarray | None
) -> Iterator[str]:
    # Colours in [0, 1] cast to uint8 are only 0 and 1. The first image usually settles it.
    pairs = zip(images, shots, strict=True)
    arrays = {"images": [shot.picture.read() for image, shot in pairs if not isinstance(image, Picture)]}
    if colors is not None:
        arrays["colors"] = [np.asarray(colors)]
    for name, of_name in arrays.items():
        largest = 0
        for array in of_name:
            largest = max(largest, int(np.max(array[..., :3], initial=0)))
            if largest > 1:
                break
        if largest == 1:
            yield f"{name} hold no value above 1 of 255: multiply colours in [0, 1] by 255 before astype(np.uint8)"
    # K of another image size is off on both axes, a crop along one side on one.
    sizes = np.array([shot.picture.size[::-1] for shot in shots], float)
    twice = np.array([2 * shot.K[:2, 2] for shot in shots])
    is_off = (np.maximum(twice, sizes) > OFF_CENTER * np.minimum(twice, sizes)).all(axis=1)
    if np.count_nonzero(is_off) > len(shots) / 2:
        first = int(np.argmax(is_off))
        width, height = sizes[first]
        of_width, of_height = twice[first]
        yield (
            f"Ks do not fit the images: {np.count_nonzero(is_off)} of {len(shots)} principal points are far from the "
            f"middle; Ks[{first}] would fit {of_width:g} × {of_height:g} pixels, but the image has {width:g} × "
            f"{height:g}. Multiply the first row of K by the ratio of the widths, the second by the ratio of the "
            "heights"
        )
    message = _likelier_poses(shots, None if points is None else points[are_somewhere(points)])
    if message:
        yield f"viewmats must be world to camera, x right, y down, z forward: {message}"


def _likelier_poses(shots: Sequence[Shot], points: np.ndarray | None) -> str:
    """Return a message if the poses only make sense by another convention.

    With points, the test is how many of them are in the images; without, whether all cameras look at one place. Axes of
    cameras that look outwards meet behind them, so for flipped axes the photographs must also agree there.
    """
    chosen = evenly_chosen(shots, MOST_COMPARED)
    given = np.stack([shot.viewmat for shot in chosen])
    flip = np.diag([1.0, -1.0, -1.0, 1.0])  # Between the camera axes of OpenGL and OpenCV.
    others = {
        "np.linalg.inv(viewmats), if these are camera to world": np.linalg.inv(given),
        "np.linalg.inv(viewmats @ np.diag([1, -1, -1, 1])), if these are camera to world with y up and z backward, as "
        "in Blender and NeRF": np.linalg.inv(given @ flip),
        "np.diag([1, -1, -1, 1]) @ viewmats, if these have y up and z backward, as in OpenGL": flip @ given,
    }
    if points is not None and len(points):
        some = evenly_chosen(points, 10 * MOST_COMPARED)
        share = _share_seen(chosen, given, some)
        shares = [_share_seen(chosen, viewmats, some) for viewmats in others.values()]
        best = int(np.argmax(shares))
        if shares[best] < LEAST_SEEN or share * CLEARLY > shares[best]:
            return ""
        return f"the views see {share:.0%} of the points, and would see {shares[best]:.0%} with {[*others][best]}"
    for precision in PRECISIONS:
        share = _share_that_meet(given, precision)
        shares = [_share_that_meet(viewmats, precision) for viewmats in others.values()]
        if share > 0.5:
            continue
        best = int(np.argmax(shares[:2]))
        if shares[2] >= 0.9 and _agree_on_subject(chosen, flip @ given):
            best = 2
        if shares[best] >= 0.9:
            return f"{share:.0%} of the cameras look at one place, and {shares[best]:.0%} would with {[*others][best]}"
    return ""


def _agree_on_subject(shots: Sequence[Shot], viewmats: np.ndarray) -> bool:
    """Return whether photographs agree around the point nearest to all optical axes, better than if they are exchanged
    among the cameras."""
    shots = evenly_chosen(shots, MOST_VIEWS)
    viewmats = evenly_chosen(viewmats, MOST_VIEWS)
    looks = [Look(shot.picture, shot.mask, viewmat, shot.K) for shot, viewmat in zip(shots, viewmats, strict=True)]
    centers = camera_centers(viewmats)
    subject = subject_of(viewmats)
    half_side = SUBJECT * np.median(np.linalg.norm(centers - subject, axis=1))
    points = subject + half_side * np.random.default_rng(0).uniform(-1, 1, (NUM_TRIED, 3))
    difference = agreement(looks, points)
    exchanged = []
    for shift in {1, len(looks) // 3, len(looks) // 2, len(looks) - 1} - {0}:
        for look, viewmat in zip(looks, np.roll(viewmats, shift, axis=0), strict=True):
            look.viewmat = viewmat
        exchanged.append(agreement(looks, points))
    return difference < MOST_DIFFERENCE * min(exchanged)


def _share_seen(shots: Sequence[Shot], viewmats: np.ndarray, points: np.ndarray) -> float:
    """Return the share of all points, averaged over the views, in an image."""
    sights = [shot.sight(viewmat) for shot, viewmat in zip(shots, viewmats, strict=True)]
    return float(np.mean([sight.num_seen(points, 0.0) for sight in sights])) / len(points)


def _share_that_meet(viewmats: np.ndarray, precision: float) -> float:
    """Return the share of cameras that look at the point nearest to all axes, to `precision` times its distance."""
    axes = viewmats[:, 2, :3]
    offsets = subject_of(viewmats) - camera_centers(viewmats)
    depths = np.sum(offsets * axes, axis=1)
    # The axes are unit vectors, so |offset × axis| is the distance from the point to the axis.
    distances = np.linalg.norm(np.cross(offsets, axes), axis=1)
    return float(np.mean((depths > 0) & (distances < precision * depths)))


def _numbers(name: str, values: ArrayLike) -> np.ndarray:
    """Return an array or nested lists as float64, or raise a ValueError that names them."""
    check_unmasked(name, values)
    try:
        if values is not None and not np.iscomplexobj(values):
            return np.asarray(values, np.float64)
    except (TypeError, ValueError):
        pass
    got = described(values) if hasattr(values, "dtype") else kind_of(values)
    raise ValueError(f"{name} must be an array of real numbers; got {got}")


def _converted(name: str, kind: Callable[[Any], Any], values: object, size: tuple[int, int] | None = None) -> Any:
    """Return `kind` of an array, or raise a ValueError that names it if its kind or size (H, W) is wrong."""
    check_unmasked(name, values)
    try:
        made = kind(values if size is None else np.asarray(values))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    if size is not None and made.shape != size:
        raise ValueError(f"{name} must be as large as its image, {[*size]}; got {[*made.shape]}")
    return made


def _cloud(points: ArrayLike, colors: ArrayLike | None) -> PointCloud:
    points = _numbers("points", points)
    check_shape("points", points, ("P", 3))
    check_unmasked("colors", colors)
    colors = np.full(points.shape, 128, np.uint8) if colors is None else np.asarray(colors)
    check_shape("colors", colors, points.shape)
    if colors.dtype != np.uint8:
        raise ValueError(f"colors must be uint8; got {colors.dtype}{how_to_convert(colors, 'colors')}")
    return PointCloud(points, colors)
