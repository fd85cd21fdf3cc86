"""Render of a view as training differentiates it: project, list the tiles, composite."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.appearance import Appearance
from a2tg_jax.appearance.base import num_colors_of
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.numerics import Integer
from a2tg_jax.parallel.exchange import composite_on_devices
from a2tg_jax.rasterize.compositor import Composited, composite, list_tiles
from a2tg_jax.rasterize.kernels.choice import check_compositor
from a2tg_jax.rasterize.pixel import Statistic
from a2tg_jax.rasterize.render_types import Geometry, RenderOutput, RenderSettings
from a2tg_jax.rasterize.splats import CompositingSettings, kernel_of, num_channels, project_gaussians
from a2tg_jax.rasterize.supersampling import box_mean, finer
from a2tg_jax.rasterize.tile_pixels import pixels_of
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
      sh_degree: replaces that of the settings; may be traced.
      num_live: number of rows that exist; may be traced.
      probe: [N, 4] zeros, at which the gradient is the statistic and the number of pixels (`compositor.composite`).
      statistic: kind of statistic (`rasterize.pixel.positional_gradient`); not used without a probe.

    Raises:
      ValueError: if a probe is given with `settings.supersample`.
    """
    if settings.supersample > 1:
        if probe is not None:
            raise ValueError("supersample must be 1 where statistics of gradients are gathered")
        factor, settings = settings.supersample, dataclasses.replace(settings, supersample=1)
        output, num_pairs = render_traced(
            gaussians, finer(camera, factor), appearance, background, settings,
            has_geometry=has_geometry, sh_degree=sh_degree, num_live=num_live,
        )  # fmt: skip
        color, alpha, geometry = jax.tree.map(
            lambda image: box_mean(image, factor), (output.color, output.alpha, output.geometry)
        )
        return RenderOutput(color, alpha, output.overflow, geometry), num_pairs
    check_compositor(settings.compositor)
    num = gaussians.means.shape[0]
    if num == 0:
        return _empty_view(camera, num_colors_of(appearance), has_geometry, background), jnp.zeros((), jnp.float32)
    degree = settings.sh_degree if sh_degree is None else sh_degree
    splats, cutoff = project_gaussians(gaussians, camera, appearance, settings.near_plane, degree, num_live)
    kernel, texels, regions = kernel_of(
        appearance,
        splats,
        tile_size=settings.tile_size,
        near_plane=settings.near_plane,
        has_geometry=has_geometry,
        statistic=None if probe is None else statistic,
        has_rays=camera.rays is not None,
    )
    grid = TileGrid(camera.width, camera.height, settings.tile_size)
    compositing = CompositingSettings(kernel, grid, settings.compositor, settings.tile_batch)
    jacobian = jax.lax.stop_gradient(camera.K @ camera.viewmat[:3, :3])
    probe = jnp.zeros((num, 4), splats.M.dtype) if probe is None else probe
    capacity = settings.capacity or 0
    if settings.exchange is None:
        M, pixels = jax.lax.stop_gradient(splats.M), pixels_of(camera, settings.tile_size)
        lists = list_tiles(compositing, M, cutoff, capacity, pixels)
        image = composite(compositing, splats, texels, regions, cutoff, lists, jacobian, probe)
        shown = Composited(*image, lists.num_pairs, lists.overflow)
    else:
        shown = composite_on_devices(
            compositing, settings.exchange, capacity, splats, texels, regions, cutoff, jacobian, probe, camera.rays
        )
    taint = jnp.where(jnp.any(jnp.isnan(cutoff)), jnp.nan, 0.0).astype(shown.channels.dtype)
    channels, transmittance = shown.channels + taint, shown.transmittance + taint
    output = _output(channels, transmittance, kernel.num_colors, has_geometry, background, shown.overflow)
    return output, shown.num_pairs


def _empty_view(camera: Camera, num_colors: int, has_geometry: bool, background: Array) -> RenderOutput:
    """Return the output of a view without Gaussians."""
    size = camera.height, camera.width
    channels = jnp.zeros((num_channels(has_geometry, num_colors), *size), background.dtype)
    transmittance = jnp.ones(size, background.dtype)
    return _output(channels, transmittance, num_colors, has_geometry, background, jnp.asarray(False))


def _output(
    channels: Array, transmittance: Array, num_colors: int, has_geometry: bool, background: Array, overflow: Array
) -> RenderOutput:
    color = jnp.moveaxis(channels[:num_colors], 0, -1) + transmittance[..., None] * background[None, None, :]
    alpha = 1 - transmittance
    if not has_geometry:
        return RenderOutput(color, alpha, overflow)
    depth, squared = channels[num_colors], channels[num_colors + 1]
    normal = jnp.moveaxis(channels[num_colors + 2 :], 0, -1)
    return RenderOutput(color, alpha, overflow, Geometry(depth, normal, alpha * squared - depth * depth))
