"""Scenes: photographs with their cameras, and points, in the normalised world."""

import dataclasses
import html
import math
from collections.abc import Sequence

import numpy as np
from jax import Array

from a2tg_jax.base.checks import check_array, check_kind, check_number, check_shape
from a2tg_jax.base.even_spacing import evenly_chosen
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.text import counted, shortened
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.cameras import Camera, check_camera, check_is_camera
from a2tg_jax.core.notebook_display import THUMBNAIL, enlarged, html_image, png
from a2tg_jax.core.origin import BLACK, Origin
from a2tg_jax.core.pictures import DepthMap, Mask, Picture
from a2tg_jax.core.similarity import Similarity, check_similarity

LONGEST_PREVIEW = 800
"""Longest side in pixels of the picture of a view in a notebook."""
NUM_THUMBNAILS = 8

Kind = tuple[int, int, int]
"""Height, width and lens of a view."""


@dataclasses.dataclass(frozen=True, eq=False)
class View(NamedFields):
    """One photograph with its camera."""

    name: str
    """Path of the image below the scene's image folder, with forward slashes; unique in its scene."""
    camera: Camera
    """Its camera in the normalised world, float32, of the image's size."""
    picture: Picture
    """Its pixels, in memory or on disk; an array uint8 [H, W, 3], [H, W, 4], or grey [H, W] may be given as well."""
    mask: Mask | None = None
    """Mask of the pixels that count in losses and metrics, or an array [H, W] bool; None counts all."""
    depth: DepthMap | None = None
    """Depth map for `loss.depth_weight`, or an array [H, W] of floats; None if there is none."""
    panorama: int | None = None
    """Number of the panorama that it was cut from; None for a photograph. Its views are held out together."""

    def __post_init__(self) -> None:
        """Convert arrays to pictures, masks and depth maps.

        Raises:
          ValueError: if they are of another kind or shape.
        """
        check_is_camera(self.camera, f"view {self.name}: camera")
        for field, kind in (("picture", Picture), ("mask", Mask), ("depth", DepthMap)):
            value = getattr(self, field)
            try:
                # The dataclass is frozen.
                object.__setattr__(self, field, None if value is None and field != "picture" else kind.of(value))
            except ValueError as error:
                raise ValueError(f"view {self.name}: {error}") from error

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
class Scene(NamedFields):
    """Photographs, cameras and points in the normalised world. A value of numpy arrays, not a pytree."""

    name: str
    """Name, such as the folder's."""
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
    """scene_scale: 1.1 × the largest distance of a camera, train or test, from their mean; cameras far from all others,
    of which loading warns, do not count."""

    @property
    def origin(self) -> Origin:
        """Its cameras, training views first, and its world."""
        views = [*self.train, *self.test]
        return Origin.of_cameras(
            [view.camera for view in views],
            [view.name for view in views],
            is_test=[False] * len(self.train) + [True] * len(self.test),
            transform=self.transform,
        )

    def __repr__(self) -> str:
        sizes = {view.picture.size for view in (*self.train, *self.test)}
        height, width = max(sizes, key=math.prod, default=(0, 0))
        size = f"{width}×{height}" if len(sizes) < 2 else f"{len(sizes)} sizes to {width}×{height}"
        views = f"{counted(len(self.train), 'training view')}, {counted(len(self.test), 'test view')}"
        return f"Scene({self.name!r}, {views}, {size}, {counted(len(self.points), 'point')})"

    def _repr_html_(self) -> str:
        """Return the line above thumbnails of a few training views, evenly spaced, for notebooks."""
        views = evenly_chosen(self.train, NUM_THUMBNAILS)
        images = (html_image(png(view.picture.read(), THUMBNAIL), view.name) for view in views)
        return f"<div>{html.escape(repr(self))}</div><div>{' '.join(images)}</div>"


def check_scene(scene: Scene) -> None:
    """Raise ValueError, naming the field or the view, unless there are valid training views, of different names, and
    points and colours of right shapes. Whether points are finite is checked where Gaussians start from them."""
    if not isinstance(scene.train, tuple | list) or not all(isinstance(view, View) for view in scene.train):
        raise ValueError(f"scene.train must be a tuple of views; got {shortened(scene.train)}")
    if not scene.train:
        raise ValueError("scene.train must hold at least one view; got none")
    for view in scene.train:
        check_view(view)
    names = [view.name for view in scene.train]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"scene.train has two views called {twice!r}: give each its own name")
    check_array("scene.points", scene.points)
    check_shape("scene.points", scene.points, ("P", 3))
    check_shape("scene.colors", scene.colors, scene.points.shape)
    if len(scene.points) < 2:
        raise ValueError(f"scene.points must hold at least two points; got {len(scene.points)}")
    check_similarity(scene.transform, "scene.transform")
    check_number("scene.scale", scene.scale, above=0)


def check_are_views(views: Sequence[View], call: str) -> None:
    """Raise ValueError, which shows the right call, unless the views are a list or a tuple of at least one view, each
    as `check_view` wants it."""
    others = [item for item in views if not isinstance(item, View)] if isinstance(views, list | tuple) else [views]
    if others:
        raise ValueError(f"views must be views, such as scene.train; got {type(others[0]).__name__}: use {call}")
    if not views:
        raise ValueError("views must hold at least one view; got none (scene.test needs a test_every that leaves some)")
    for view in views:
        check_view(view)


def check_view(view: View) -> None:
    """Raise ValueError, naming the view, unless its photograph, mask and depth map have the size of its camera, and
    some pixels count."""
    check_camera(view.camera, f"view {view.name}: camera")
    height = view.camera.height
    width = view.camera.width
    picture = view.picture
    if picture.shape not in ((height, width, 3), (height, width, 4)) or picture.dtype != np.uint8:
        raise ValueError(
            f"picture of view {view.name} must be uint8 {[height, width, 3]}, as large as its camera says, or have "
            f"an opacity as 4th channel; got {np.dtype(picture.dtype)} {list(picture.shape)}"
        )
    for name, image in (("mask", view.mask), ("depth", view.depth)):
        if image is not None and image.shape != (height, width):
            raise ValueError(
                f"{name} of view {view.name} must be {[height, width]}, as large as its camera says; "
                f"got {list(image.shape)}"
            )
    if view.mask is not None and not view.mask.num:
        raise ValueError(f"the mask of view {view.name} excludes every pixel: leave the view out or fix its mask")


def kinds_of(views: Sequence[View]) -> list[Kind]:
    """Return height, width and lens of each view. Lens 0 is a pinhole; others are numbered in order of appearance."""
    numbers = {key: number for number, key in enumerate(rays_of_lenses(views), 1)}
    return [(*view.picture.size, numbers.get(id(view.camera.rays), 0)) for view in views]


def rays_of_lenses(views: Sequence[View]) -> dict[int, Array]:
    """Return the rays of each lens by their identity, in order of appearance; its views share the array."""
    # By identity: arrays have no hash, and lenses.Lens.rays gives views of one lens one array.
    return {id(view.camera.rays): view.camera.rays for view in views if view.camera.rays is not None}


def ray_bytes(views: Sequence[View]) -> int:
    """Return the bytes of the rays of the views' lenses; views of one lens count once."""
    return sum(int(rays.nbytes) for rays in rays_of_lenses(views).values())


def views_by_kind(views: Sequence[View]) -> list[list[View]]:
    """Return the views of each image size and lens, both in order of appearance."""
    groups: dict[Kind, list[View]] = {}
    for kind, view in zip(kinds_of(views), views, strict=True):
        groups.setdefault(kind, []).append(view)
    return list(groups.values())


def counted_pixels(views: Sequence[View]) -> np.ndarray:
    """Return [V, H, W, 1] bool, True at pixels that count, for views of one size; [V, 1, 1, 1] if all do."""
    if all(view.mask is None for view in views):
        return np.ones((len(views), 1, 1, 1), bool)
    masks = [np.ones(view.picture.size, bool) if view.mask is None else view.mask.read() for view in views]
    return np.stack(masks)[..., None]


def view_image(view: View, background: Sequence[float] | np.ndarray | None = None) -> np.ndarray:
    """Return the view's image as floats, over a background if it is transparent.

    Args:
      view: one view.
      background: [3] colour in [0, 1], or an image [H, W, 3] of colours; to compare with a model, `model.background`.
        None is black, with a warning if the image is transparent.

    Returns:
      [H, W, 3] float32 in [0, 1].

    Raises:
      ValueError: if it is no view, or the background is neither a colour nor an image of the view's size.

    Examples:
      >>> photograph = a2tg.view_image(scene.test[0], model.background)
      >>> photograph.shape, photograph.dtype
      ((36, 48, 3), dtype('float32'))
    """
    check_kind("view", view, View)
    pixels = view.picture.read()
    color = pixels[..., :3].astype(np.float32) / np.float32(255)
    if background is None:
        if view.has_alpha:
            warn(
                "the image is transparent and was put on black: use view_image(view, model.background) to compare it "
                "with a model, or give another background"
            )
        background = BLACK
    check_shape("background", background, color.shape if np.ndim(background) == 3 else (3,))
    if not view.has_alpha:
        return color
    alpha = pixels[..., 3:].astype(np.float32) / np.float32(255)
    return alpha * color + (1 - alpha) * np.asarray(background, np.float32)
