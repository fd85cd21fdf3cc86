"""Gradients of the losses of views, and the statistic that shows where a model lacks detail."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.appearance import Appearance, check_is_appearance
from a2tg_jax.appearance.base import num_colors_of
from a2tg_jax.base.checks import check_literal, kind_of, short_repr
from a2tg_jax.core.cameras import Camera, check_camera
from a2tg_jax.core.gaussians import Gaussians, check_gaussians
from a2tg_jax.core.numerics import safe_norm
from a2tg_jax.core.pytree import combine, partition
from a2tg_jax.events import read_probe
from a2tg_jax.model import Model, check_is_model
from a2tg_jax.rasterize.pixel import Statistic
from a2tg_jax.rasterize.render_types import RenderOutput, RenderSettings
from a2tg_jax.rasterize.room import with_capacity
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.render import background_array
from a2tg_jax.training.corrections import Correction, corrected_camera


class ViewGradients(NamedTuple):
    """Result of `view_gradients`, for N Gaussians."""

    value: Array
    """The loss, a scalar."""
    gradient: Model
    """Its gradient in all floats of the model, with None for integers (`partition`)."""
    norms: Array
    """[N] norms of Σ_pixels |∂L/∂mean|, through the Gaussian factor alone (A²TG, gradient-driven selection). Other
    statistics differentiate by the position on the screen, in units of half an image."""
    is_visible: Array
    """[N] whether the Gaussian was composited at any pixel."""
    output: RenderOutput
    """Render of the view. If `output.overflow` is set, the capacity was too small and no result is valid."""
    num_pairs: Array
    """Number of pairs, the least capacity (`plan_render`)."""

    def __repr__(self) -> str:
        return short_repr(self)


def view_gradients(
    loss: Callable[[Model, RenderOutput], Array],
    model: Model,
    camera: Camera,
    *,
    background: Any = None,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    has_geometry: bool = True,
    sh_degree: int | Array | None = None,
    statistic: Statistic = "position",
) -> ViewGradients:
    """Render a view and differentiate a loss of it in one pass; meant for jit.

    Average the statistic over views with `GradientStatistics`:

        statistics = statistics.observe(gradients.norms, gradients.is_visible)

    Args:
      loss: of the model, for regularisers, and of the view; a scalar.
      model: differentiated in all its floats.
      camera: the view.
      background: [3] colour, or as many numbers as a splat has; None is the model's own, or 0 for other than three.
      settings: with a capacity under jit (`plan_render`); an eager call finds its own.
      has_geometry: if False, depth, normal and distortion cost nothing, and reading them raises ValueError.
      sh_degree: overrides the settings' degree; may be traced.
      statistic: position by which the norms differentiate: "position", the mean in the world, as in A²TG; "screen",
        its projection, pixel by pixel in absolute value; "center", its projection, signed, as in 2DGS.

    Returns:
      Loss, gradient and statistic of the view.

    Raises:
      ValueError: if an argument is of another kind or has a wrong shape, if there is no such statistic, or under jit
        without a capacity.

    Examples:
      >>> photograph = jnp.asarray(a2tg.view_image(scene.test[0]))
      >>> loss = lambda model, output: a2tg.photometric_loss(output.color, photograph)
      >>> gradients = a2tg.view_gradients(loss, model, camera)
      >>> gradients.gradient.gaussians.means.shape, gradients.norms.shape
      ((200, 3), (200,))
    """
    check_literal("statistic", statistic, Statistic)
    check_is_model(model)
    check_gaussians(model.gaussians, "model.gaussians")
    check_is_appearance(model.appearance, model.gaussians)
    check_camera(camera)
    background = model.default_background if background is None else background
    background = background_array(background, model.gaussians, num_colors_of(model.appearance))
    settings = with_capacity(settings, model.gaussians, camera, model.appearance, model.num_live)

    def of_view(model: Model, view: TracedView, output: RenderOutput) -> tuple[Array, RenderOutput]:
        return loss(model, output), output

    result = differentiate(
        of_view, model, TracedView(camera, background), settings,
        has_geometry=has_geometry, sh_degree=sh_degree, statistic=statistic, has_probe=True,
    )  # fmt: skip
    statistics, is_visible = read_probe(result.probe, statistic, camera.width, camera.height)
    floats, _ = partition(model)
    gradient = dataclasses.replace(floats, gaussians=result.gaussians, appearance=result.appearance)
    return ViewGradients(result.value, gradient, safe_norm(statistics), is_visible, result.auxiliary, result.num_pairs)


def value_and_grad(loss: Callable[..., Any], *, has_aux: bool = False) -> Callable[..., tuple[Any, Any]]:
    """Return a function that gives a loss and its gradient in all floats of its first argument, such as a model.

    `jax.value_and_grad` rejects a model and textures, which have integers: places of textures. The gradient has None
    for these: it has the form of the floats of `partition(model)`, which an optimizer updates and `combine` puts back.

    Args:
      loss: of a pytree with floats, such as a model or textures, and of any further arguments, which are not
        differentiated; a scalar.
      has_aux: whether the loss returns (scalar, anything) instead.

    Returns:
      A function of the loss's arguments that returns the loss's value and the gradient, a pytree like the first
      argument. It raises ValueError if the first argument has no floats.

    Examples:
      >>> brightness = lambda model: jnp.mean(model.render(camera).color)
      >>> value, gradient = a2tg.value_and_grad(brightness)(model)
      >>> gradient.gaussians.sh.shape
      (200, 4, 3)
      >>> textures = a2tg.allocate_textures(np.full((gaussians.num, 2), 4))
      >>> of_textures = lambda textures: jnp.mean(a2tg.render_image(gaussians, camera, textures).color)
      >>> value, gradient = a2tg.value_and_grad(of_textures)(textures)
      >>> gradient.buckets[0].shape[1:], gradient.bucket
      ((4, 4, 4), None)
    """

    def of_floats(floats: Any, rest: Any, *args: object, **kwargs: object) -> Any:
        return loss(combine(floats, rest), *args, **kwargs)

    differentiate = jax.value_and_grad(of_floats, has_aux=has_aux)

    def of_pytree(tree: Any, *args: object, **kwargs: object) -> tuple[Any, Any]:
        floats, rest = partition(tree)
        if not jax.tree.leaves(floats):
            raise ValueError(
                f"the first argument of the loss must be a pytree with floats, such as a model; got {kind_of(tree)}"
            )
        return differentiate(floats, rest, *args, **kwargs)

    return of_pytree


class TracedView(NamedTuple):
    """View that `differentiate` renders, with its corrections, which are differentiated."""

    camera: Camera
    background: Array
    """[3]."""
    corrections: tuple[Correction, ...] = ()
    rows: tuple[Array, ...] = ()
    """The view's row of each correction."""
    target: Any = None
    """Arrays that the loss compares the render with."""


class Differentiated(NamedTuple):
    """Result of `differentiate`."""

    value: Array
    """The loss, a scalar."""
    auxiliary: Any
    """Second result of the loss function."""
    num_pairs: Array
    """Number of pairs, the least capacity."""
    gaussians: Gaussians
    """Gradient in the Gaussians."""
    appearance: Appearance
    """Gradient in the floats of the appearance."""
    rows: tuple[Array, ...]
    """Gradient in the view's row of each correction."""
    probe: Any
    """[N, 4] gradient at the probe, for `read_probe`; None without a probe."""


def differentiate(
    loss: Callable[[Model, TracedView, RenderOutput], tuple[Array, object]],
    model: Model,
    view: TracedView,
    settings: RenderSettings,
    *,
    has_geometry: bool,
    sh_degree: int | Array | None,
    statistic: Statistic | None,
    has_probe: bool,
) -> Differentiated:
    """Render a view and differentiate its loss: the core of `view_gradients`, which describes the arguments, and of the
    training step.

    The loss is a function of the model, the corrected view and its render, and returns a scalar and any auxiliary
    value. It is differentiated in all floats of the model and the view's rows.
    """
    floats, rest = partition(model.appearance)

    def of_floats(
        gaussians: Gaussians, floats: Appearance, rows: tuple[Array, ...], probe: Array | None, view: TracedView
    ) -> tuple[Array, tuple[Any, Array]]:
        corrected = view._replace(rows=rows, camera=corrected_camera(view.corrections, rows, view.camera))
        appearance = combine(floats, rest)
        output, num_pairs = render_traced(
            gaussians, corrected.camera, appearance, view.background, settings,
            has_geometry=has_geometry, sh_degree=sh_degree, num_live=model.num_live, probe=probe, statistic=statistic,
        )  # fmt: skip
        rendered = dataclasses.replace(model, gaussians=gaussians, appearance=appearance)
        value, auxiliary = loss(rendered, corrected, output)
        return value, (auxiliary, num_pairs)

    # Adds nothing to the render; the gradient at it is the statistic.
    probe = jnp.zeros((model.num_rows, 4), jnp.result_type(model.gaussians.means)) if has_probe else None
    with_gradients = jax.value_and_grad(of_floats, argnums=(0, 1, 2, 3), has_aux=True)
    (value, (auxiliary, num_pairs)), gradients = with_gradients(model.gaussians, floats, view.rows, probe, view)
    return Differentiated(value, auxiliary, num_pairs, *gradients)
