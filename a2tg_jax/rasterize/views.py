"""The render of a view that training differentiates, with a fixed capacity."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.appearance import Appearance
from a2tg_jax.appearance.base import num_colors_of
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.numerics import Integer
from a2tg_jax.rasterize.compositor import composite, list_tiles
from a2tg_jax.rasterize.kernels.platforms import check_compositor
from a2tg_jax.rasterize.pixel import Statistic
from a2tg_jax.rasterize.render_types import Geometry, RenderOutput, RenderSettings
from a2tg_jax.rasterize.splats import project_gaussians, settings_of_pass
from a2tg_jax.rasterize.tile_pixels import tile_pixels
from a2tg_jax.rasterize.tiles import TileGrid
from a2tg_jax.rasterize.view_groups import in_groups


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
    """Return the output, which training differentiates, and the number of pairs of the view for `TileRoom`.

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
    view = functools.partial(_render_view, settings, has_geometry, statistic)
    return in_groups(view, num, gaussians, camera, appearance, background, degree, num_live, probe)


def _render_view(
    settings: RenderSettings,
    has_geometry: bool,
    statistic: Statistic | None,
    gaussians: Gaussians,
    camera: Camera,
    appearance: Appearance,
    background: Array,
    degree: Integer,
    num_live: Integer | None,
    probe: Array | None,
) -> tuple[RenderOutput, Array]:
    """Return the results of `render_traced`, without supersampling, for N >= 1 Gaussians."""
    num = gaussians.num
    num_colors = num_colors_of(appearance)
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
