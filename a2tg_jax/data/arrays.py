"""Scenes of arrays: images and cameras that are already in memory."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from a2tg_jax.core.checks import check_kind, check_shape
from a2tg_jax.data.assembly import PointCloud, Shot, assemble_scene, rigid_viewmat
from a2tg_jax.data.depths import DepthMap
from a2tg_jax.data.masks import Mask
from a2tg_jax.data.observations import before_camera, observed_points, projected
from a2tg_jax.data.photo_store import Picture
from a2tg_jax.data.scene import Scene
from a2tg_jax.data.splits import check_test_every, every_kth


def scene_from_arrays(
    images: Sequence[np.ndarray],
    viewmats: Any,
    Ks: Any,
    points: Any = None,
    colors: Any = None,
    *,
    names: Sequence[str] | None = None,
    masks: Sequence[np.ndarray | None] | None = None,
    depths: Sequence[np.ndarray | None] | None = None,
    observed: Sequence[Any] | None = None,
    test_every: int = 8,
    name: str = "arrays",
) -> Scene:
    """Make a scene of images and cameras in any world, which is normalised as that of `load_scene`.

    Args:
      images: V images [H, W, 3] or, with straight alpha, [H, W, 4], uint8; sizes may differ. They are not copied.
      viewmats: [V, 4, 4] world-to-camera matrices, rigid; x is right, y down, z forward (OpenCV).
      Ks: [V, 3, 3] intrinsics in pixels, or [3, 3] for all.
      points: [P, 3] points to start from, in the same world; None: random ones, with a warning.
      colors: [P, 3] uint8 colours of the points; None: grey.
      names: of the views, each its own; None: numbers.
      masks: [H, W] bool for each image, True at pixels that count, or None.
      depths: [H, W] floats for each image, NaN where unknown, or None: inverse depth up to scale and shift for
        `loss.depth_weight`, or depth up to scale with `loss.depth_kind="depth"`.
      observed: for each image the indices [S] of the points that it observed, for `loss.points_weight`; may be empty.
      test_every: every k-th view is a test view; 0 keeps none.
      name: of the scene.

    Raises:
      ValueError: naming the argument, if one has another shape or kind, or the views make no scene.
    """
    check_test_every(test_every)
    num = len(images)
    viewmats = _matrices("viewmats", viewmats, (num, 4, 4))
    if not np.allclose(viewmats[:, 3], [0, 0, 0, 1]):
        raise ValueError("viewmats must end with the row 0, 0, 0, 1: transpose matrices that multiply row vectors")
    Ks = np.asarray(Ks)
    Ks = _matrices("Ks", np.broadcast_to(Ks, (num, 3, 3)) if Ks.shape == (3, 3) else Ks, (num, 3, 3))
    given = {"names": names, "masks": masks, "depths": depths, "observed": observed}
    for argument, values in given.items():
        if values is not None and len(values) != num:
            raise ValueError(f"{argument} must hold one item for each of {num} images; got {len(values)}")
    for argument, values in (("colors", colors), ("observed", observed)):
        if values is not None and points is None:
            raise ValueError(f"{argument} needs points")
    cloud = None if points is None else _cloud(points, colors)

    def shot(index: int) -> Shot:
        own = f"{index:04d}" if names is None else names[index]
        check_kind(f"names[{index}]", own, str)
        picture = _converted(f"images[{index}]", Picture.of, images[index])
        viewmat, points = rigid_viewmat(viewmats[index], f"viewmats[{index}]"), None
        if observed is not None and cloud is not None:
            chosen = _chosen(cloud.points, observed[index], f"observed[{index}]")
            ahead = before_camera(chosen, viewmat)
            points = observed_points(projected(ahead, Ks[index]), ahead[:, 2], picture.size)
        mask, depth = (
            None if values is None or values[index] is None
            else _converted(f"{argument}[{index}]", kind, np.asarray(values[index]), picture.size)
            for argument, values, kind in (("masks", masks, Mask.of), ("depths", depths, DepthMap.of))
        )  # fmt: skip
        return Shot(own, viewmat, Ks[index], picture, mask, depth=depth, points=points)

    shots = [shot(index) for index in range(num)]
    return assemble_scene(name, *every_kth(shots, test_every), cloud, source=f"the scene {name}")


def _matrices(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return matrices as float64 after checking their shape."""
    check_shape(name, values, shape)
    return np.asarray(values, np.float64)


def _converted(name: str, kind: Callable[[Any], Any], values: Any, size: tuple[int, int] | None = None) -> Any:
    """Return what a view has for an array, or raise ValueError, naming it, if it has another kind or size (H, W)."""
    try:
        made = kind(values)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    if size is not None and made.shape != size:
        raise ValueError(f"{name} must be as large as its image, {[*size]}; got {[*made.shape]}")
    return made


def _cloud(points: Any, colors: Any) -> PointCloud:
    """Return points and their colours, grey without."""
    points = np.asarray(points, np.float64)
    check_shape("points", points, ("P", 3))
    colors = np.full(points.shape, 128, np.uint8) if colors is None else np.asarray(colors)
    check_shape("colors", colors, points.shape)
    if colors.dtype != np.uint8:
        raise ValueError(
            f"colors must be uint8; got {colors.dtype}: say np.rint(255 * colors).astype(np.uint8) of [0, 1]"
        )
    return PointCloud(points, colors)


def _chosen(points: np.ndarray, indices: Any, what: str) -> np.ndarray:
    """Return some of the points."""
    indices = np.asarray(indices)
    is_index = indices.ndim == 1 and (np.issubdtype(indices.dtype, np.integer) or not indices.size)
    if not is_index or (indices.size and not 0 <= indices.min() <= indices.max() < len(points)):
        advice = ": say np.flatnonzero of a mask" if indices.dtype == bool else ""
        wanted = f"{what} must hold integers [S] from 0 to {len(points) - 1}, indices of points"
        raise ValueError(f"{wanted}; got {indices.dtype} {[*indices.shape]}{advice}")
    chosen: np.ndarray = points[indices.astype(int)]
    return chosen
