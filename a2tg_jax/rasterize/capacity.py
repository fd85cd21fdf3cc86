"""Room that a view needs: pairs of splat and tile, counted on the host."""

import dataclasses
import functools
from typing import Any

import jax
import numpy as np
from jax import Array

from a2tg_jax.appearance import Appearance, check_is_appearance
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.checks import check_kind
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.geometry import screen_bounds
from a2tg_jax.parallel.exchange_room import room_of_view
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.rasterize.splats import drawn_splats
from a2tg_jax.rasterize.supersampling import finer
from a2tg_jax.rasterize.tile_pixels import pixels_of
from a2tg_jax.rasterize.tiles import TileGrid, count_pairs

HEAD_ROOM = 1.25


def capacity_for(pairs: int, head_room: float = HEAD_ROOM) -> int:
    """Return a capacity with head room for a number of pairs, rounded up so that few shapes occur."""
    return max(1024, -(-int(pairs * head_room) // 1024) * 1024)


def with_capacity(
    settings: RenderSettings, gaussians: Gaussians, camera: Camera, appearance: Appearance, num_live: Any = None
) -> RenderSettings:
    """Return the settings; if they lack a capacity, with one for this view, which an eager call can find.

    Raises:
      ValueError: under jit or vmap without a capacity.
    """
    check_kind("settings", settings, RenderSettings)
    check_is_appearance(appearance)
    if settings.capacity is not None:
        return settings
    gaussians, camera, appearance, num_live = jax.tree.map(_primal_value, (gaussians, camera, appearance, num_live))
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((gaussians, camera, appearance, num_live))):
        raise ValueError(
            "settings.capacity is needed under jit and vmap, where shapes are fixed: "
            "settings = plan_render(model, cameras) outside, then pass settings=settings"
        )
    pairs = pairs_to_draw(gaussians, camera, appearance, settings, num_live)
    return dataclasses.replace(settings, capacity=capacity_for(pairs))


def _primal_value(x: Any) -> Any:
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


def pairs_of_view(
    gaussians: Gaussians, camera: Camera, appearance: Appearance, settings: RenderSettings, num_live: Any = None
) -> int:
    """Return the (splat, tile) pairs of the first `num_live` rows in a view, before the outline test (host)."""
    check_is_appearance(appearance)
    if not gaussians.num:
        return 0
    camera = finer(camera, settings.supersample)
    try:
        return int(_jitted_count()(gaussians, camera, appearance, settings.tile_size, settings.near_plane, num_live))
    except jax.errors.ConcretizationTypeError as error:
        raise ValueError("capacities are planned on the host: call plan_render outside jit and vmap") from error


def pairs_to_draw(
    gaussians: Gaussians, camera: Camera, appearance: Appearance, settings: RenderSettings, num_live: Any = None
) -> int:
    """Return the least capacity for a view (host): its pairs or, on several devices, what the fullest band needs."""
    pairs = pairs_of_view(gaussians, camera, appearance, settings, num_live)
    if settings.exchange is None or not pairs:
        return pairs
    return max(pairs, room_of_view(gaussians, camera, appearance, settings, num_live).pairs)


@functools.cache
def _jitted_count() -> jax.stages.Wrapped:
    return jax.jit(_count_pairs, static_argnums=(3, 4))


def _count_pairs(
    gaussians: Gaussians, camera: Camera, appearance: Appearance, tile_size: int, near_plane: float, num_live: Any
) -> Array:
    M, cutoff = drawn_splats(gaussians, camera, appearance, num_live)
    pixels = pixels_of(camera, tile_size)
    bounds = screen_bounds(M, cutoff, near_plane)
    return count_pairs(bounds, TileGrid(camera.width, camera.height, tile_size), pixels)
