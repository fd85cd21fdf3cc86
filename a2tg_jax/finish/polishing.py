"""Best colours for given shapes: least squares over the parameters in which a picture is linear.

A picture is linear in the RGB texels, and in the spherical harmonics of those Gaussians whose colour is not cut off at
0. With positions, rotations, scales, opacities and alpha textures fixed, the squared error over all views is quadratic
in them. A few steps of conjugate gradients on J d = photograph − picture come near its minimum: J draws a change of
colours, and its transpose is the backward pass.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from a2tg_jax.appearance import in_words
from a2tg_jax.appearance.base import color_sums
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.checks import check_kind
from a2tg_jax.core.optim import solve_cg
from a2tg_jax.data import View, counted_pixels, view_image, views_by_kind
from a2tg_jax.data.scene import check_are_views
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.renderer import plan_render

HIGHEST_DEGREE = 3


class Colors(NamedTuple):
    """Colours, in which a picture is linear."""

    sh: Array
    """[N, K, 3] of the Gaussians."""
    bands: Any
    """Coefficients of higher degrees, or ()."""
    rgb: tuple[Array, ...]
    """[capacity, Tv, Tu, 3] of each bucket of textures."""


class Targets(NamedTuple):
    """Photographs over the background, of V views of one image size and lens, with the weights of their pixels."""

    viewmats: Array
    Ks: Array
    images: Array
    """[V, H, W, 3] over the background."""
    weights: Array
    """[V, H, W, 1]: 1 where a pixel counts, else 0; [V, 1, 1, 1] if all do."""
    rays: Array | None = None
    """[H, W, 2] rays of the lens; None of a pinhole."""


def polish(
    model: Model, views: Sequence[View], *, num_steps: int = 5, ridge: float = 1.0, background: ArrayLike | None = None
) -> Model:
    """Return the model with colours that lower the squared error over the views.

    Args:
      model: of Gaussians with or without textures of signed RGB, exponents and bands.
      views: training views.
      num_steps: number of steps of conjugate gradients; each draws every view forwards and backwards. Few steps
        regularise, many overfit the training views.
      ridge: weight of the squared changes beside the squared error, summed over pixels.
      background: [3] colour; None is the model's own.

    Raises:
      ValueError: if there is no view, or a picture is not linear in the appearance parameters.
    """
    _check(model, views)
    model = model.live
    background = jnp.asarray(model.background if background is None else background, model.gaussians.means.dtype)
    settings = plan_render(model, [view.camera for view in views])
    groups = _stacked(views, background)
    changes = _jitted()(model, groups, background, settings, num_steps, ridge)
    return with_colors(model, jax.tree.map(jnp.add, colors_of(model), changes))


@functools.cache
def _jitted() -> jax.stages.Wrapped:
    return jax.jit(_solve, static_argnums=(3, 4))


def _solve(
    model: Model,
    groups: list[Targets],
    background: Array,
    settings: RenderSettings,
    num_steps: int,
    ridge: ArrayLike,
) -> Colors:
    """Return the changes of the colours."""

    def over_views(function: Callable[[Camera, Targets], Colors]) -> Colors:
        """Return the sum over all views of a function of camera and photograph."""
        total: Colors = jax.tree.map(jnp.zeros_like, colors_of(model))
        for group in groups:
            height, width = group.images.shape[1:3]

            seen = functools.partial(Camera, width=width, height=height, rays=group.rays)

            def step(total: Colors, view: Targets, seen: Callable[..., Camera] = seen) -> tuple[Colors, None]:
                return jax.tree.map(jnp.add, total, function(seen(view.viewmats, view.Ks), view)), None

            total, _ = jax.lax.scan(step, total, group._replace(rays=None))
        return total

    def right(camera: Camera, view: Targets) -> Colors:
        residual = view.images - _drawn(model, camera, background, settings)
        return _transpose(model, camera, settings, view.weights * residual)

    def normal(change: Colors) -> Colors:
        def of_view(camera: Camera, view: Targets) -> Colors:
            return _transpose(model, camera, settings, view.weights * draw_change(model, change, camera, settings))

        return over_views(of_view)

    changes: Colors = solve_cg(normal, over_views(right), ridge=ridge, maxiter=num_steps, tol=0.0)
    return changes


def _drawn(model: Model, camera: Camera, background: Array, settings: RenderSettings) -> Array:
    output, _ = render_traced(model.gaussians, camera, model.appearance, background, settings, has_geometry=False)
    return output.color


def draw_change(model: Model, change: Colors, camera: Camera, settings: RenderSettings) -> Array:
    """Return the change [H, W, 3] of a picture by a change of the colours, a linear function."""
    is_shown = color_sums(model.appearance, model.gaussians, camera, HIGHEST_DEGREE) + 0.5 > 0
    changed = with_colors(model, change)
    sums = color_sums(changed.appearance, changed.gaussians, camera, HIGHEST_DEGREE)
    appearance = dataclasses.replace(changed.appearance, given_colors=jnp.where(is_shown, sums, 0.0))
    black = jnp.zeros(3, model.gaussians.means.dtype)
    output, _ = render_traced(model.gaussians, camera, appearance, black, settings, has_geometry=False)
    return output.color


def _transpose(model: Model, camera: Camera, settings: RenderSettings, image: Array) -> Colors:
    """Return the transpose of `draw_change`, of an image."""
    nothing = jax.tree.map(jnp.zeros_like, colors_of(model))
    _, back = jax.vjp(lambda change: draw_change(model, change, camera, settings), nothing)
    transposed: Colors = back(image)[0]
    return transposed


def colors_of(model: Model) -> Colors:
    """Return the colours, in which a picture of the model is linear."""
    tables = model.appearance.coefficients, model.textures
    bands, textures = (() if table is None else table.buckets for table in tables)
    return Colors(model.gaussians.sh, bands, tuple(bucket[..., :3] for bucket in textures))


def with_colors(model: Model, colors: Colors) -> Model:
    """Return the model with other colours; alpha textures stay."""
    gaussians = dataclasses.replace(model.gaussians, sh=colors.sh)
    model = dataclasses.replace(model, gaussians=gaussians)
    if (coefficients := model.appearance.coefficients) is not None:
        appearance = model.appearance.with_coefficients(dataclasses.replace(coefficients, buckets=colors.bands))
        model = dataclasses.replace(model, appearance=appearance)
    if model.textures is None:
        return model
    pairs = zip(colors.rgb, model.textures.buckets, strict=True)
    buckets = tuple(jnp.concatenate([rgb, old[..., 3:]], -1) for rgb, old in pairs)
    return model.with_textures(dataclasses.replace(model.textures, buckets=buckets))


def _check(model: Model, views: Sequence[View]) -> None:
    check_kind("model", model, Model, "say polish(model, scene.train)")
    check_are_views(views, "polish(model, scene.train)")
    if not views:
        raise ValueError("views must hold at least one view; got none")
    if not model.appearance.is_linear:
        raise ValueError(
            f"a picture is not linear in the colours of {in_words(model.appearance)}: Gaussians with or without "
            "textures of signed RGB can be polished"
        )


def _stacked(views: Sequence[View], background: Array) -> list[Targets]:
    """Return the views, one stack for each image size and lens, in the dtype of the background."""
    color, dtype = np.asarray(background), background.dtype
    return [
        Targets(
            jnp.stack([jnp.asarray(view.camera.viewmat, dtype) for view in own]),
            jnp.stack([jnp.asarray(view.camera.K, dtype) for view in own]),
            jnp.stack([jnp.asarray(view_image(view, color), dtype) for view in own]),
            jnp.asarray(counted_pixels(own), dtype),
            None if own[0].camera.rays is None else jnp.asarray(own[0].camera.rays, dtype),
        )
        for own in views_by_kind(views)
    ]
