"""The gradients of one view's loss, and with them the statistic that tells where a model lacks detail."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.cameras import Camera, check_camera
from a2tg_jax.core.gaussians import Gaussians, check_gaussians
from a2tg_jax.core.gradient_statistics import read_probe
from a2tg_jax.core.numerics import safe_norm
from a2tg_jax.model import Model
from a2tg_jax.rasterize.pixel import Statistic
from a2tg_jax.render import RenderOutput, RenderSettings, check_background, render_traced, with_capacity


class ViewGradients(NamedTuple):
    """What `view_gradients` returns, of N Gaussians."""

    value: Array
    """The loss, a scalar."""
    gaussians: Gaussians
    """Its gradient in the Gaussians."""
    params: Any
    """Its gradient in what they show."""
    norms: Array
    """[N] norms of Σ_pixels |∂L/∂mean|, through the Gaussian factor alone (A²TG, gradient-driven selection); of another
    statistic, which is by the position on the screen, in units of half an image."""
    is_visible: Array
    """[N] whether the Gaussian was composited at one pixel at least."""
    output: RenderOutput
    """The view; `output.overflow` says that the capacity did not suffice, and nothing here may be used."""
    num_pairs: Array
    """What a capacity must hold (`plan_render`)."""


def view_gradients(
    loss: Callable[[Model, RenderOutput], Array],
    model: Model,
    camera: Camera,
    *,
    background: Any = None,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    has_geometry: bool = True,
    sh_degree: Any = None,
    statistic: Statistic = "position",
) -> ViewGradients:
    """Renders a view and differentiates any loss of it, in one pass; meant for jit.

    Average the statistic over views with `GradientStatistics`:

        statistics = statistics.observe(found.norms, found.is_visible)

    Args:
      loss: of the model, for regularisers, and of the view; a scalar.
      model: differentiated in its Gaussians and parameters.
      camera: the view.
      background: [3] colour; None is the model's own.
      settings: with a capacity under jit (`plan_render`); an eager call finds its own.
      has_geometry: without, depth, normal and distortion are zeros, and cost nothing.
      sh_degree: overrides the settings' by a value that may be traced.
      statistic: of which position on its way to the screen (`rasterize.pixel.positional_gradient`).

    Raises:
      ValueError: if an argument has another shape than it must have, or under jit without a capacity.
    """
    background = model.background if background is None else background
    check_gaussians(model.gaussians, "model.gaussians")
    check_camera(camera)
    check_background(background)
    dtype = model.gaussians.means.dtype
    settings = with_capacity(settings, model.gaussians, camera, model.rule, model.num_live)

    def of_parameters(gaussians, params, probe):
        shown = dataclasses.replace(model, gaussians=gaussians, params=params)
        output, num_pairs = render_traced(
            gaussians, camera, shown.rule, jnp.asarray(background, dtype), settings,
            has_geometry=has_geometry, sh_degree=sh_degree, num_live=model.num_live, probe=probe, statistic=statistic,
        )  # fmt: skip
        return loss(shown, output), (output, num_pairs)

    probe = jnp.zeros((model.gaussians.num, 4), dtype)
    differentiate = jax.value_and_grad(of_parameters, argnums=(0, 1, 2), has_aux=True)
    (value, (output, num_pairs)), (gaussians, params, found) = differentiate(model.gaussians, model.params, probe)
    statistics, is_visible = read_probe(found, statistic, camera.width, camera.height)
    return ViewGradients(value, gaussians, params, safe_norm(statistics), is_visible, output, num_pairs)
