"""Room for tile lists: planned for given cameras, or kept and enlarged by a renderer for moving cameras (host)."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

from jax import Array
from numpy.typing import ArrayLike

from a2tg_jax.appearance import Appearance, check_is_appearance
from a2tg_jax.appearance.base import num_colors_of
from a2tg_jax.base.checks import check_kind, check_number
from a2tg_jax.base.even_spacing import evenly_chosen
from a2tg_jax.base.text import counted
from a2tg_jax.core.cameras import Camera, check_camera, checked_cameras, resize_camera
from a2tg_jax.core.gaussians import Gaussians, check_gaussians
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderOutput, RenderSettings
from a2tg_jax.rasterize.room import HEAD_ROOM, TileRoom, has_rows, most_pairs, warn_of_empty
from a2tg_jax.render import appearance_of, background_array, jitted_render
from a2tg_jax.texture import Textures

PLANNED_CAMERAS = 16
"""Number of a model's own cameras for which the first capacity is planned."""

Size = tuple[int, int]


def plan_render(
    gaussians: Model | Gaussians,
    cameras: Camera | Sequence[Camera],
    textures: Textures | None = None,
    *,
    appearance: Appearance | None = None,
    head_room: float = HEAD_ROOM,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
) -> RenderSettings:
    """Return the settings with a capacity that suffices for every camera, with head room.

    Args:
      gaussians: a model, alone; or N Gaussians.
      cameras: one or more.
      textures: textures of the Gaussians; without them, the splats are plain 2DGS.
      appearance: appearance of the Gaussians, instead of textures.
      head_room: factor, at least 1, on the pairs of the fullest view.
      settings: static options; their capacity is replaced.

    Returns:
      The settings, with a capacity of (splat, tile) pairs.

    Raises:
      ValueError: if there is no camera, an argument is of another kind or out of range, textures or an appearance are
        given besides a model or each other, or under jit and vmap, where shapes are fixed.

    Examples:
      >>> settings = a2tg.plan_render(model, [view.camera for view in scene.train])
      >>> draw = jax.jit(lambda camera: model.render(camera, settings=settings).color)
      >>> draw(camera).shape
      (36, 48, 3)
    """
    check_kind("gaussians", gaussians, (Model, Gaussians))
    cameras = checked_cameras(cameras)
    if not cameras:
        raise ValueError("cameras must be one camera at least; got none")
    check_number("head_room", head_room, least=1)
    check_kind("settings", settings, RenderSettings)
    model = _model_of(gaussians, appearance, textures, settings)
    most = most_pairs(model.gaussians, cameras, model.appearance, settings, model.num_live)
    if most == 0 and has_rows(model.gaussians, model.num_live):
        warn_of_empty("any of the cameras")
    return dataclasses.replace(settings, capacity=TileRoom().plan(None, most, head_room))


def _model_of(
    gaussians: Model | Gaussians, appearance: Appearance | None, textures: Textures | None, settings: RenderSettings
) -> Model:
    """Return a model itself, or one of Gaussians with an appearance or textures. ValueError: more is given, or they do
    not fit."""
    if isinstance(gaussians, Model):
        if appearance is not None or textures is not None:
            raise ValueError("appearance: a model has its own; give the model alone, or Gaussians")
        model = gaussians
    elif appearance is not None and textures is not None:
        raise ValueError("give an appearance or textures, not both")
    else:
        check_gaussians(gaussians)
        appearance = appearance_of(gaussians, textures, settings) if appearance is None else appearance
        model = Model(gaussians, appearance)
    check_gaussians(model.gaussians)
    check_is_appearance(model.appearance, model.gaussians)
    return model


class Renderer:
    """Renderer of one model from any camera.

    Each image size is compiled for a capacity that suffices for the first view and the model's own cameras. A view that
    needs more is drawn again with at least twice the capacity. A long flight therefore compiles only a few times,
    and no camera is refused. Models of equal shapes share compiled programs.

    Examples:
      >>> renderer = a2tg.Renderer(model)
      >>> cameras = [view.camera for view in scene.train]
      >>> frames = [renderer(camera).color for camera in a2tg.smooth_path(cameras, 3)]
      >>> len(frames)
      3
    """

    def __init__(
        self,
        model: Model | Gaussians,
        appearance: Appearance | None = None,
        *,
        cameras: Camera | Iterable[Camera] = (),
        capacities: Mapping[Size, int] | None = None,
        background: ArrayLike | None = None,
        settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
        has_geometry: bool = True,
    ):
        """Prepare to draw.

        Args:
          model: a model, or Gaussians of which all rows exist.
          appearance: appearance of Gaussians; None is plain 2DGS. A model has its own.
          cameras: one or more for which the first capacities are planned; others may follow.
          capacities: initial capacities, such as `capacities` of the renderer of a similar model.
          background: [3] colour, or as many numbers as a splat has; None is the model's own, or black.
          settings: static options; the renderer finds the capacity.
          has_geometry: if False, depth, normal and distortion cost nothing, and reading them raises ValueError.

        Raises:
          ValueError: if an appearance is given besides a model, or an argument has a wrong shape.
        """
        check_kind("model", model, (Model, Gaussians))
        check_kind("settings", settings, RenderSettings)
        model = _model_of(model, appearance, None, settings)
        background = model.default_background if background is None else background
        self._gaussians = model.gaussians
        self._num_live = model.num_live
        self._appearance = model.appearance
        self._background = background_array(background, model.gaussians, num_colors_of(model.appearance))
        self._settings = settings
        self._has_geometry = has_geometry
        cameras_of_model = [] if model.origin is None else model.origin.cameras
        self._planned = evenly_chosen(cameras_of_model, PLANNED_CAMERAS)
        self._room = TileRoom(dict(capacities or {}))
        by_size: dict[Size, list[Camera]] = {}
        for camera in checked_cameras(cameras):
            by_size.setdefault((camera.width, camera.height), []).append(camera)
        for size, alike in by_size.items():
            self._plan(size, alike)

    @property
    def capacities(self) -> Mapping[Size, int]:
        """Capacities for (splat, tile) pairs by image size, (width, height)."""
        return self._room.capacities

    def __repr__(self) -> str:
        sizes = ", ".join(f"{width}×{height}" for width, height in self.capacities) or "no size yet"
        return f"Renderer({counted(self._gaussians.num, 'Gaussian')}, {sizes})"

    def __call__(self, camera: Camera) -> RenderOutput:
        """Render the view of a camera; never an overflow."""
        check_camera(camera)
        size = camera.width, camera.height
        if size not in self._room.capacities:
            self._plan(size, [camera])
        output, needed = self._draw(camera)
        while bool(output.overflow):
            # A camera that approaches will list more yet.
            self._room.enlarge(size, 2 * int(needed))
            output, needed = self._draw(camera)
        return output

    def _plan(self, size: Size, cameras: Sequence[Camera]) -> None:
        """Plan the capacity of an image size for cameras of this size and for the model's own."""
        cameras = [*cameras, *(resize_camera(planned, *size) for planned in self._planned)]
        pairs = most_pairs(self._gaussians, cameras, self._appearance, self._settings, self._num_live)
        # A first view may see next to nothing: in another one all Gaussians may be visible, in a tile or more each.
        self._room.plan(size, max(self._gaussians.num, pairs))

    def _draw(self, camera: Camera) -> tuple[RenderOutput, Array]:
        settings = dataclasses.replace(self._settings, capacity=self.capacities[camera.width, camera.height])
        return jitted_render()(
            self._gaussians, camera, self._appearance, self._background, settings,
            has_geometry=self._has_geometry, num_live=self._num_live,
        )  # fmt: skip
