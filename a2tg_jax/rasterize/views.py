"""Render of a view, or of several at once, as training differentiates it: project, list the tiles, composite."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.appearance import AppearanceRule
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.rasterize.compositor import Composited, composite, refusal
from a2tg_jax.rasterize.exchange import composite_in_bands
from a2tg_jax.rasterize.kernels.choice import choose, instead_of
from a2tg_jax.rasterize.kernels.native import composite as native
from a2tg_jax.rasterize.pixel import Statistic
from a2tg_jax.rasterize.render_types import GEOMETRY, IMAGES, RenderOutput, RenderSettings
from a2tg_jax.rasterize.splats import CompositingSettings, Compositor, Splats, project_gaussians
from a2tg_jax.rasterize.supersampling import box_mean, finer
from a2tg_jax.rasterize.tile_pixels import pixels_of
from a2tg_jax.rasterize.tiles import TileGrid, tile_lists

BATCH_ON_ACCELERATOR = 4096


def render_traced(
    gaussians: Gaussians,
    camera: Camera,
    rule: AppearanceRule,
    background: Array,
    settings: RenderSettings,
    *,
    has_geometry: bool = True,
    sh_degree: Any = None,
    num_live: Any = None,
    probe: Array | None = None,
    statistic: Statistic | None = "position",
) -> tuple[RenderOutput, Array]:
    """Return the output, which training differentiates, and the number of pairs of the view for `capacity_for`.

    Args:
      gaussians, camera, rule: as for `render_appearance`.
      background: [3] colour, or as many numbers as the rule has colours.
      settings: static options, with a capacity.
      has_geometry: if False, depth, normal and distortion are None, cost nothing, and reading them raises ValueError.
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
            gaussians, finer(camera, factor), rule, background, settings,
            has_geometry=has_geometry, sh_degree=sh_degree, num_live=num_live,
        )  # fmt: skip
        rendered = IMAGES if has_geometry else [name for name in IMAGES if name not in GEOMETRY]
        images = {name: box_mean(getattr(output, name), factor) for name in rendered}
        return output._replace(**images), num_pairs
    options: dict[str, Any] = {
        "has_geometry": has_geometry, "sh_degree": sh_degree, "num_live": num_live, "statistic": statistic,
    }  # fmt: skip
    if settings.exchange is None:
        return _rendered(_alone, gaussians, camera, rule, background, settings, probe=probe, **options)
    cameras = dataclasses.replace(camera, viewmat=camera.viewmat[None], K=camera.K[None])
    gaussians, background, probe = jax.tree.map(lambda x: x[None], (gaussians, background, probe))
    views = render_together(gaussians, cameras, rule, background, settings, probe=probe, **options)
    only: tuple[RenderOutput, Array] = jax.tree.map(lambda x: x[0], views)
    return only


def render_together(
    gaussians: Gaussians,
    cameras: Camera,
    rule: AppearanceRule,
    backgrounds: Array,
    settings: RenderSettings,
    *,
    has_geometry: bool = True,
    sh_degree: Any = None,
    num_live: Any = None,
    probe: Array | None = None,
    statistic: Statistic | None = "position",
) -> tuple[RenderOutput, Array]:
    """Return what `render_traced` does for each of G views, drawn at once by the devices of an exchange.

    Args:
      gaussians, cameras, backgrounds, probe: as for `render_traced`, [G, ...]: each view has its own copy of the
        Gaussians, so that gradients are of each view. The rays of the cameras, [H, W, 2], are shared.
      rule: shared by the views.
      settings: with a capacity and an exchange, whose number of devices G divides; without supersampling.
      has_geometry, sh_degree, num_live, statistic: as for `render_traced`.

    Raises:
      ValueError: if the settings lack an exchange or are supersampled, or G does not divide the devices.
    """
    num_views = backgrounds.shape[0]
    if settings.exchange is None or settings.exchange.num % num_views:
        num_devices = 1 if settings.exchange is None else settings.exchange.num
        raise ValueError(f"so many views must divide the devices of settings.exchange; got {num_views}, {num_devices}")
    if settings.supersample > 1:
        raise ValueError("supersample must be 1 where several views are drawn at once")
    return _rendered(
        jax.vmap, gaussians, cameras, rule, backgrounds, settings,
        has_geometry=has_geometry, sh_degree=sh_degree, num_live=num_live, probe=probe, statistic=statistic,
    )  # fmt: skip


def _alone(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of one view unchanged, where `jax.vmap` makes it one of several."""
    return function


def _rendered(
    each: Callable[..., Callable[..., Any]], gaussians: Gaussians, camera: Camera, rule: AppearanceRule,
    background: Array, settings: RenderSettings, *, has_geometry: bool, sh_degree: Any, num_live: Any,
    probe: Array | None, statistic: Statistic | None,
) -> tuple[RenderOutput, Array]:  # fmt: skip
    """Return the output of one view, or of several if `each` is `jax.vmap`; other arguments as of `render_traced`."""
    compositor = choose(settings.compositor)
    if camera.rays is not None and compositor == "cuda":
        compositor = _for_rays(settings)
    compositing = _compositing_settings(
        camera, settings, compositor, has_geometry, None if probe is None else statistic, rule.num_colors
    )
    *views, num, _ = gaussians.means.shape
    if num == 0:
        return each(functools.partial(_empty_view, compositing))(background), jnp.zeros(views, jnp.float32)
    degree = settings.sh_degree if sh_degree is None else sh_degree

    def projected(gaussians: Gaussians, viewmat: Array, K: Array) -> tuple[Splats, Array, Array]:
        seen = dataclasses.replace(camera, viewmat=viewmat, K=K)
        splats, cutoff = project_gaussians(gaussians, seen, rule, settings.near_plane, degree, num_live)
        return splats, cutoff, jax.lax.stop_gradient(K @ viewmat[:3, :3])

    splats, cutoff, jacobian = each(projected)(gaussians, camera.viewmat, camera.K)
    of_one = splats if each is _alone else jax.tree.map(lambda x: x[0], splats)
    if reason := refusal(compositing, rule, of_one):
        settings = dataclasses.replace(settings, compositor=instead_of(settings.compositor, type(rule), reason))
        return _rendered(
            each, gaussians, camera, rule, background, settings,
            has_geometry=has_geometry, sh_degree=sh_degree, num_live=num_live, probe=probe, statistic=statistic,
        )  # fmt: skip
    probe = jnp.zeros((*views, num, 4), splats.M.dtype) if probe is None else probe
    shown = _composited(compositing, settings, splats, rule, cutoff, jacobian, probe, camera)

    def shaded(shown: Composited, cutoff: Array, background: Array) -> RenderOutput:
        taint = jnp.where(jnp.any(jnp.isnan(cutoff)), jnp.nan, 0.0).astype(shown.channels.dtype)
        channels, transmittance = shown.channels + taint, shown.transmittance + taint
        return _output(compositing, channels, transmittance, background, shown.overflow)

    return each(shaded)(shown, cutoff, background), shown.num_pairs


def _composited(
    compositing: CompositingSettings, settings: RenderSettings, splats: Splats, rule: AppearanceRule, cutoff: Array,
    jacobian: Array, probe: Array, camera: Camera,
) -> Composited:  # fmt: skip
    """Return the image without background, of one device; or those of several views, of several devices."""
    capacity = settings.capacity or 0
    if settings.exchange is not None:
        arrays = splats, rule, cutoff, jacobian, probe, camera.rays
        return composite_in_bands(compositing, settings.exchange, capacity, *arrays)
    pixels = pixels_of(camera, settings.tile_size)
    M, near_plane, grid = jax.lax.stop_gradient(splats.M), compositing.near_plane, compositing.grid
    if pixels is None and compositing.compositor == "native":
        lists = native.tile_lists(M, cutoff, near_plane, grid, capacity)
    else:
        lists = tile_lists(M, cutoff, near_plane, grid, capacity, pixels)
    channels, transmittance = composite(compositing, splats, rule, cutoff, lists, jacobian, probe)
    return Composited(channels, transmittance, lists.num_pairs, lists.overflow)


def _for_rays(settings: RenderSettings) -> Compositor:
    """Return the compositor in place of CUDA kernels for a camera with a ray for each pixel."""
    if settings.compositor != "auto":
        raise ValueError("compositor='cuda' cannot render cameras with rays: say 'xla', or 'auto'")
    return "xla"


def _compositing_settings(
    camera: Camera,
    settings: RenderSettings,
    compositor: Compositor,
    has_geometry: bool,
    statistic: Statistic | None,
    num_colors: int,
) -> CompositingSettings:
    grid = TileGrid(camera.width, camera.height, settings.tile_size)
    return CompositingSettings(
        grid=grid,
        near_plane=settings.near_plane,
        has_geometry=has_geometry,
        statistic=statistic,
        compositor=compositor,
        tile_batch=min(_tile_batch(settings) or grid.num, grid.num) if compositor in ("xla", "autodiff") else 1,
        num_colors=num_colors,
        has_rays=camera.rays is not None,
    )


def _tile_batch(settings: RenderSettings) -> int:
    if settings.tile_batch is None:
        return 1 if jax.default_backend() == "cpu" else BATCH_ON_ACCELERATOR
    return settings.tile_batch


def _empty_view(compositing: CompositingSettings, background: Array) -> RenderOutput:
    """Return the output of a view without Gaussians."""
    grid = compositing.grid
    channels = jnp.zeros((compositing.num_channels, grid.height, grid.width), background.dtype)
    transmittance = jnp.ones((grid.height, grid.width), background.dtype)
    return _output(compositing, channels, transmittance, background, jnp.asarray(False))


def _output(
    compositing: CompositingSettings, channels: Array, transmittance: Array, background: Array, overflow: Array
) -> RenderOutput:
    first = compositing.num_colors
    color = jnp.moveaxis(channels[:first], 0, -1) + transmittance[..., None] * background[None, None, :]
    alpha = 1 - transmittance
    if not compositing.has_geometry:
        nothing: Any = None
        return RenderOutput(color, alpha, nothing, nothing, overflow, nothing)
    depth, squared = channels[first], channels[first + 1]
    normal = jnp.moveaxis(channels[first + 2 :], 0, -1)
    return RenderOutput(color, alpha, depth, normal, overflow, distortion=alpha * squared - depth * depth)
