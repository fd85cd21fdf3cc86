"""A renderer for cameras that move: room for the tile lists is allocated on the host and kept while it suffices."""

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from typing import Any

import jax.numpy as jnp

from a2tg_jax.appearance import AppearanceRule, Plain
from a2tg_jax.core.cameras import Camera, check_camera, resize_camera
from a2tg_jax.core.gaussians import Gaussians, check_gaussians
from a2tg_jax.core.jit import jit
from a2tg_jax.model import Model
from a2tg_jax.render import RenderOutput, RenderSettings, capacity_for, check_background, pairs_of_view, render_traced

FIRST_ROOM = 1.5
"""Head room over the views that room is first made for."""
GROWTH = 3
"""The least factor by which room grows."""
PLANNED_CAMERAS = 16
"""Of a model's own cameras, so many are looked at before room is made."""

Size = tuple[int, int]


class Renderer:
    """Draws one model from any camera.

    Each image size is compiled for a capacity, which suffices for the first view and the model's own cameras. A view
    that needs more is drawn again with at least three times the room, so that a long flight compiles a few times only,
    and no camera is refused. Models of equal shapes share what is compiled.

        renderer = Renderer(model)
        for camera in smooth_path(cameras, 200):
            image = renderer(camera).color
    """

    def __init__(
        self,
        model: Model | Gaussians,
        rule: AppearanceRule | None = None,
        *,
        cameras: Iterable[Camera] = (),
        capacities: Mapping[Size, int] | None = None,
        background: Any = None,
        settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
        has_geometry: bool = True,
    ):
        """Prepares to draw.

        Args:
          model: a model; or Gaussians, of which all rows show.
          rule: what the Gaussians show; None is plain 2DGS. A model says it itself.
          cameras: room is made for these at once; others may come.
          capacities: room to begin with, such as that of a renderer of a model like this one.
          background: [3] colour; None is the model's own, or black.
          settings: all but the capacity, which is found.
          has_geometry: without, depth, normal and distortion are zeros, and cost nothing.

        Raises:
          ValueError: if a rule is given beside a model, or an argument has another shape than it must have.
        """
        if isinstance(model, Model) and rule is not None:
            raise ValueError("rule: a model says itself what its splats show; give Gaussians with a rule")
        model = model if isinstance(model, Model) else Model(model, appearance=Plain(settings.texture.max_alpha))
        background = model.background if background is None else background
        check_background(background)
        check_gaussians(model.gaussians)
        self._gaussians, self._num_live = model.gaussians, model.num_live
        self._rule = model.rule if rule is None else rule
        self._background = jnp.asarray(background, model.gaussians.means.dtype)
        self._settings, self._has_geometry = settings, has_geometry
        own = [] if model.origin is None else model.origin.cameras
        self._known = own[:: -(-len(own) // PLANNED_CAMERAS) or 1]
        self.capacities: dict[Size, int] = dict(capacities or {})
        """Room for (splat, tile) pairs by image size, (width, height)."""
        self._plan(list(cameras))

    def __call__(self, camera: Camera) -> RenderOutput:
        """What a camera sees (host); never an overflow."""
        check_camera(camera)
        size = camera.width, camera.height
        if size not in self.capacities:
            cameras = [camera, *(resize_camera(known, *size) for known in self._known)]
            # A first view may see next to nothing; where all are seen, each Gaussian is in a tile at least.
            pairs = max(self._gaussians.num, *map(self._num_pairs, cameras))
            self.capacities[size] = capacity_for(pairs, FIRST_ROOM)
        output, pairs = self._draw(camera)
        while bool(output.overflow):
            self.capacities[size] = max(capacity_for(int(pairs)), GROWTH * self.capacities[size])
            output, pairs = self._draw(camera)
        return output

    def _plan(self, cameras: list[Camera]) -> None:
        """Room for all these cameras."""
        for camera in cameras:
            check_camera(camera)
            size = camera.width, camera.height
            self.capacities[size] = max(self.capacities.get(size, 0), capacity_for(self._num_pairs(camera)))

    def _num_pairs(self, camera: Camera) -> int:
        return pairs_of_view(self._gaussians, camera, self._rule, self._settings, self._num_live)

    def _draw(self, camera: Camera):
        settings = dataclasses.replace(self._settings, capacity=self.capacities[camera.width, camera.height])
        draw = _jitted_draw()
        return draw(self._gaussians, self._num_live, camera, self._rule, self._background, settings, self._has_geometry)


@functools.cache
def _jitted_draw() -> jit:
    """Draws on the device; its cache counts the compilations."""

    def draw(gaussians, num_live, camera, rule, background, settings, has_geometry):
        return render_traced(
            gaussians, camera, rule, background, settings, has_geometry=has_geometry, num_live=num_live
        )

    return jit(draw, static_argnums=(5, 6))
