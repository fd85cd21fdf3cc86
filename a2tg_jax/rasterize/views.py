"""Renders of views: the room that a view needs, counted on the host, and the render that training differentiates."""

import dataclasses
import functools
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import Appearance
from a2tg_jax.appearance.base import num_colors_of
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.checks import check_kind
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.numerics import Integer
from a2tg_jax.rasterize.compositor import composite, list_tiles
from a2tg_jax.rasterize.kernels.platforms import check_compositor
from a2tg_jax.rasterize.pixel import Statistic
from a2tg_jax.rasterize.render_types import Geometry, RenderOutput, RenderSettings
from a2tg_jax.rasterize.splats import drawn_splats, project_gaussians, settings_of_pass
from a2tg_jax.rasterize.tile_pixels import tile_pixels
from a2tg_jax.rasterize.tiles import TileGrid


def render_traced(
    gaussians: Gaussians,
    camera: Camera,
    appearance: Appearance,
    background: Array,
    settings: RenderSettings,
    *,
    has_geometry: bool = True,
    sh_degree: Integer | None = None,
    num_live: Integer | None = None,
    probe: Array | None = None,
    statistic: Statistic | None = "position",
) -> tuple[RenderOutput, Array]:
    """Return the output, which training differentiates, and the number of pairs of the view for `capacity_for`.

    Args:
      gaussians, camera, appearance: as for `render_appearance`.
      background: [3] colour, or as many numbers as the appearance has colours.
      settings: static options, with a capacity.
      has_geometry: if False, depth, normal and distortion cost nothing, and reading them raises ValueError.
      sh_degree: highest degree of spherical harmonics, instead of the settings'; may be traced.
      num_live: number of rows that exist; may be traced.
      probe: [N, 4] zeros, at which the gradient is the statistic and the number of pixels (`compositor.composite`).
      statistic: kind of statistic (`rasterize.pixel.positional_gradient`); not used without a probe.

    Raises:
      ValueError: if a probe is given with `settings.supersample`.
    """
    if settings.supersample > 1:
        if probe is not None:
            raise ValueError("supersample must be 1 where statistics of gradients are gathered")
        finer = settings.finer(camera)
        factor = settings.supersample
        settings = dataclasses.replace(settings, supersample=1)
        output, num_pairs = render_traced(
            gaussians, finer, appearance, background, settings,
            has_geometry=has_geometry, sh_degree=sh_degree, num_live=num_live,
        )  # fmt: skip

        def box_mean(image: Array) -> Array:
            rows = image.reshape(camera.height, factor, camera.width, factor, *image.shape[2:])
            return rows.mean(axis=(1, 3))

        color, alpha, geometry = jax.tree.map(box_mean, (output.color, output.alpha, output.geometry))
        return RenderOutput(color, alpha, output.overflow, geometry), num_pairs
    # Before anything is traced, so that the error does not come from deep within JAX.
    check_compositor(settings.compositor)
    num = gaussians.num
    num_colors = num_colors_of(appearance)
    if num == 0:
        size = camera.height, camera.width
        channels = jnp.zeros((num_colors + 5 * has_geometry, *size), background.dtype)
        nothing = channels, jnp.ones(size, background.dtype), num_colors, has_geometry, background, jnp.asarray(False)
        return _output(*nothing), jnp.zeros((), jnp.float32)
    degree = settings.sh_degree if sh_degree is None else sh_degree
    splats, cutoff = project_gaussians(gaussians, camera, appearance, settings.near_plane, degree, num_live)
    grid = TileGrid(camera.width, camera.height, settings.tile_size)
    compositing, texels, regions = settings_of_pass(
        appearance, splats, grid, settings.near_plane, has_geometry=has_geometry,
        statistic=None if probe is None else statistic, has_rays=camera.rays is not None,
        compositor=settings.compositor, tile_batch=settings.tile_batch,
    )  # fmt: skip
    # Cameras get no gradient through the statistic.
    jacobian = jax.lax.stop_gradient(camera.K @ camera.viewmat[:3, :3])
    probe = jnp.zeros((num, 4), splats.M.dtype) if probe is None else probe
    # Which tiles a splat touches is piecewise constant.
    pixels = None if camera.rays is None else tile_pixels(camera.rays, settings.tile_size)
    M = jax.lax.stop_gradient(splats.M)
    lists = list_tiles(settings.compositor, M, cutoff, settings.near_plane, grid, settings.capacity or 0, pixels)
    channels, transmittance = composite(compositing, splats, texels, regions, cutoff, lists, jacobian, probe)
    # A splat with a number that is not finite spoils the whole image: a sum would hide it behind the splats in front.
    taint = jnp.where(jnp.any(jnp.isnan(cutoff)), jnp.nan, 0.0).astype(channels.dtype)
    channels = channels + taint
    transmittance = transmittance + taint
    return _output(channels, transmittance, num_colors, has_geometry, background, lists.overflow), lists.num_pairs


def _output(
    channels: Array, transmittance: Array, num_colors: int, has_geometry: bool, background: Array, overflow: Array
) -> RenderOutput:
    color = jnp.moveaxis(channels[:num_colors], 0, -1) + transmittance[..., None] * background[None, None, :]
    alpha = 1 - transmittance
    if not has_geometry:
        return RenderOutput(color, alpha, overflow)
    # Σ_ij w_i w_j (z_i − z_j)² / 2 = Σ w · Σ w z² − (Σ w z)², without a double sum; alpha is Σ w.
    depth = channels[num_colors]
    squared = channels[num_colors + 1]
    normal = jnp.moveaxis(channels[num_colors + 2 :], 0, -1)
    return RenderOutput(color, alpha, overflow, Geometry(depth, normal, alpha * squared - depth * depth))


HEAD_ROOM = 1.25


def capacity_for(pairs: int, head_room: float = HEAD_ROOM) -> int:
    """Return a capacity with head room for a number of pairs, rounded up so that few shapes occur."""
    return max(1024, -(-int(pairs * head_room) // 1024) * 1024)


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
    pairs = pairs_of_view(gaussians, camera, appearance, settings, num_live)
    if pairs == 0 and has_rows(gaussians, num_live):
        warn_of_empty("the camera")
    return dataclasses.replace(settings, capacity=capacity_for(pairs))


class EmptyRenderWarning(UserWarning):
    """An eager render or planned views show no Gaussian: mostly, a camera's matrix follows another convention."""


def has_rows(gaussians: Gaussians, num_live: Any) -> bool:
    """Return whether there are Gaussians that exist (host)."""
    return gaussians.num > 0 and (num_live is None or int(num_live) > 0)


def warn_of_empty(cameras: str, stacklevel: int = 5) -> None:
    """Warn that no Gaussian is visible from cameras, in words."""
    warnings.warn(
        f"no Gaussian is visible from {cameras}: viewmat must be world to camera (np.linalg.inv of camera to world), "
        "with OpenCV axes, x right, y down, z forward (np.diag([1, -1, -1, 1]) @ viewmat of OpenGL or Blender), in the "
        "world and the unit of the Gaussians; or all are fainter than 1/255",
        EmptyRenderWarning,
        stacklevel=stacklevel,
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


def pairs_of_view(
    gaussians: Gaussians, camera: Camera, appearance: Appearance, settings: RenderSettings, num_live: object = None
) -> int:
    """Return the (splat, tile) pairs of the first `num_live` rows in a view, before the outline test (host)."""
    if not gaussians.num:
        return 0
    camera = settings.finer(camera)
    try:
        return int(_jitted_count()(gaussians, camera, appearance, settings.tile_size, settings.near_plane, num_live))
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
