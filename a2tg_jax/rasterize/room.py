"""Room for tile lists (host): pairs of views are counted; capacities are planned, enlarged and rounded.

A pair is a splat and a tile that it may touch. Programs are compiled for a capacity, and no image depends on it.
"""

import dataclasses
import functools
import math
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np
from jax import Array

from a2tg_jax.appearance import Appearance
from a2tg_jax.base.checks import check_kind
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.rasterize.compositor import list_tiles
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.rasterize.splats import drawn_splats
from a2tg_jax.rasterize.tile_pixels import tile_pixels
from a2tg_jax.rasterize.tiles import TileGrid

HEAD_ROOM = 1.25
"""Default of the capacity that is planned, as a multiple of the pairs that were counted."""
LEAST_CAPACITY = 1024


@dataclasses.dataclass(frozen=True)
class TileRoom:
    """Capacities of tile lists, by image size and whatever else programs are compiled for.

    Each is a power of two or three quarters of one, so that programs are compiled for few capacities.
    """

    capacities: dict[Any, int] = dataclasses.field(default_factory=dict)

    def plan(self, place: object, pairs: float, head_room: float = HEAD_ROOM, most: float = 2) -> int:
        """Return a capacity for a number of pairs: the present one of the place if it is large enough and at most
        `most` times as large as needed, or a new one."""
        needed = max(head_room * pairs, LEAST_CAPACITY)
        present = self.capacities.get(place, 0)
        # Lists that overflowed in an earlier training of a sweep would overflow again.
        return present if needed <= present <= most * needed else self._renew(place, needed)

    def enlarge(self, place: object, pairs: float = 0) -> int:
        """Return a new capacity, at least twice the present one, after a list overflowed with a number of pairs."""
        return self._renew(place, max(HEAD_ROOM * pairs, 2 * self.capacities.get(place, 0), LEAST_CAPACITY))

    def _renew(self, place: object, needed: float) -> int:
        power = 1 << (math.ceil(needed) - 1).bit_length()
        smaller = power * 3 // 4
        self.capacities[place] = smaller if smaller >= needed else power
        return self.capacities[place]


def with_capacity(
    settings: RenderSettings, gaussians: Gaussians, camera: Camera, appearance: Appearance, num_live: object = None
) -> RenderSettings:
    """Return the settings; if they lack a capacity, with one for this view, which an eager call can find.

    Raises:
      ValueError: under jit or vmap without a capacity.
    """
    check_kind("settings", settings, RenderSettings)
    if settings.capacity is not None:
        return settings
    gaussians, camera, appearance, num_live = jax.tree.map(_primal_value, (gaussians, camera, appearance, num_live))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((gaussians, camera, appearance, num_live))):
        raise ValueError(
            "settings.capacity is needed under jit and vmap, where shapes are fixed: "
            "settings = plan_render(model, cameras) outside, then pass settings=settings"
        )
    pairs = most_pairs(gaussians, [camera], appearance, settings, num_live)
    if pairs == 0 and has_rows(gaussians, num_live):
        warn_of_empty("the camera")
    return dataclasses.replace(settings, capacity=TileRoom().plan(None, pairs))


class EmptyRenderWarning(UserWarning):
    """An eager render or planned views show no Gaussian: mostly, a camera's matrix follows another convention."""


def has_rows(gaussians: Gaussians, num_live: Any) -> bool:
    """Return whether there are Gaussians that exist (host)."""
    return gaussians.num > 0 and (num_live is None or int(num_live) > 0)


def warn_of_empty(cameras: str) -> None:
    """Warn that no Gaussian is visible from cameras, in words."""
    warn(
        f"no Gaussian is visible from {cameras}: viewmat must be world to camera (np.linalg.inv of camera to world), "
        "with OpenCV axes, x right, y down, z forward (np.diag([1, -1, -1, 1]) @ viewmat of OpenGL or Blender), in the "
        "world and the unit of the Gaussians; or all are fainter than 1/255",
        EmptyRenderWarning,
    )


def _primal_value(x: object) -> Any:
    """Return the concrete array behind the tracers of `jax.grad`, or the tracer if jit or vmap hides the value."""
    while isinstance(x, jax.core.Tracer):
        try:
            return np.asarray(jax.lax.stop_gradient(x))
        except jax.errors.TracerArrayConversionError:
            inner = getattr(x, "primal", None)
            if inner is None:
                return x
            x = inner
    return x


def most_pairs(
    gaussians: Gaussians,
    cameras: Iterable[Camera],
    appearance: Appearance,
    settings: RenderSettings,
    num_live: object = None,
) -> int:
    """Return the largest number of (splat, tile) pairs of the first `num_live` rows in a view, before the outline test
    (host)."""
    if not gaussians.num:
        return 0
    count = functools.partial(_jitted_count(), gaussians)
    options = settings.tile_size, settings.near_plane, num_live
    try:
        return max(int(count(settings.finer(camera), appearance, *options)) for camera in cameras)
    except jax.errors.ConcretizationTypeError as error:
        raise ValueError("capacities are planned on the host: call plan_render outside jit and vmap") from error


@functools.cache
def _jitted_count() -> jax.stages.Wrapped:
    def count(
        gaussians: Gaussians, camera: Camera, appearance: Appearance, tile_size: int, near_plane: float, num_live: Any
    ) -> Array:
        M, cutoff = jax.lax.stop_gradient(drawn_splats(gaussians, camera, appearance, num_live))
        grid = TileGrid(camera.width, camera.height, tile_size)
        pixels = None if camera.rays is None else tile_pixels(camera.rays, tile_size)
        # Every compositor counts the same pairs.
        return list_tiles("auto", M, cutoff, near_plane, grid, 0, pixels).num_pairs

    return jax.jit(count, static_argnums=(3, 4))
