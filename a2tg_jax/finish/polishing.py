"""Best colours for given shapes: least squares over the parameters in which a picture is linear.

A picture is linear in the RGB texels, and in the spherical harmonics of Gaussians whose colour is not clipped at 0.
With positions, rotations, scales, opacities and alpha textures fixed, the squared error over all views is quadratic in
them. A few steps of conjugate gradients on J d = photograph − picture come near its minimum: J draws a change of
colours, and its transpose is the backward pass.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from a2tg_jax import Camera, Model, RenderSettings, View, plan_render
from a2tg_jax.appearance.base import color_sums
from a2tg_jax.appearance.parts import MAX_DEGREE
from a2tg_jax.base.checks import check_kind
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.scene import check_are_views, views_by_kind
from a2tg_jax.training.batches import Photographs, over_background, stack_views


class Colors(NamedTuple):
    """Colours, in which a picture is linear."""

    sh: Array  # [N, K, 3] of the Gaussians.
    bands: Any  # Coefficients of higher degrees, or ().
    rgb: tuple[Array, ...]  # [capacity, Tv, Tu, 3] of each bucket of textures.


def polish(
    model: Model, views: Sequence[View], *, num_steps: int = 5, ridge: float = 1.0, background: ArrayLike | None = None
) -> Model:
    """Return the model with colours that lower the squared error over the views.

    Args:
      model: Gaussians with or without textures of signed RGB, exponents and bands.
      views: training views.
      num_steps: number of steps of conjugate gradients; each draws every view forwards and backwards. Few steps
        regularise, many overfit the training views.
      ridge: weight of the squared changes, against squared errors summed over pixels.
      background: [3] colour; None is the model's own.

    Returns:
      The model with other colours; its geometry stays.

    Raises:
      ValueError: if there is no view, or a picture is not linear in the appearance parameters.

    Examples:
      >>> polished = a2tg.polish(model, scene.train, num_steps=2)
      >>> a2tg.evaluate(scene.train, polished).psnr > a2tg.evaluate(scene.train, model).psnr
      True
    """
    check_kind("model", model, Model, "use polish(model, scene.train)")
    check_are_views(views, "polish(model, scene.train)")
    if not model.appearance.is_linear:
        raise ValueError(
            f"a picture is not linear in the colours of {model.appearance.description}: Gaussians with or without "
            "textures of signed RGB can be polished"
        )
    model = model.live
    dtype = model.gaussians.means.dtype
    background = jnp.asarray(model.background if background is None else background, dtype)
    # Planned once: colours do not change which splats a tile lists.
    settings = plan_render(model, [view.camera for view in views])
    # Views of one size and lens share a program.
    groups = [stack_views(alike).of(None, dtype) for alike in views_by_kind(views)]
    changes = jax.jit(_solve, static_argnums=(3, 4))(model, groups, background, settings, num_steps, ridge)
    return with_colors(model, jax.tree.map(jnp.add, colors_of(model), changes))


def _solve(
    model: Model, groups: list[Photographs], background: Array, settings: RenderSettings, num_steps: int,
    ridge: ArrayLike,
) -> Colors:  # fmt: skip
    """Return the changes of the colours."""
    # A linear function has the same derivative everywhere: it is taken at 0.
    nothing = jax.tree.map(jnp.zeros_like, colors_of(model))

    def pulled(residual: Callable[[Camera, Photographs], Array]) -> Colors:
        """Return the transpose of `draw_change`, summed over all views, of a function's images where pixels count."""
        total: Colors = nothing
        for group in groups:

            def step(total: Colors, view: Photographs, rays: Array | None = group.rays) -> tuple[Colors, None]:
                height, width = view.images.shape[:2]
                camera = Camera(view.viewmats, view.Ks, width, height, rays)
                _, back = jax.vjp(lambda change: draw_change(model, change, camera, settings), nothing)
                counted = residual(camera, view)
                if view.masks is not None:
                    counted = jnp.where(view.masks[..., None], counted, 0)
                return jax.tree.map(jnp.add, total, back(counted)[0]), None

            # scan slices every leaf by view; all views of a group share the rays.
            total, _ = jax.lax.scan(step, total, group._replace(rays=None))
        return total

    def missing(camera: Camera, view: Photographs) -> Array:
        output, _ = render_traced(model.gaussians, camera, model.appearance, background, settings, has_geometry=False)
        return over_background(view.images, view.alphas, background) - output.color

    def normal(change: Colors) -> Colors:
        back = pulled(lambda camera, _: draw_change(model, change, camera, settings))
        return jax.tree.map(lambda of_back, of_change: of_back + ridge * of_change, back, change)

    # Normal equations (JᵀWJ + ridge)·d = JᵀW·(photograph − picture); tol 0: always num_steps steps.
    changes, _ = jax.scipy.sparse.linalg.cg(normal, pulled(missing), maxiter=num_steps, tol=0.0)
    return changes


def draw_change(model: Model, change: Colors, camera: Camera, settings: RenderSettings) -> Array:
    """Return the change [H, W, 3] of a picture by a change of the colours, a linear function."""
    is_shown = color_sums(model.appearance, model.gaussians, camera, MAX_DEGREE) + 0.5 > 0
    changed = with_colors(model, change)
    sums = color_sums(changed.appearance, changed.gaussians, camera, MAX_DEGREE)
    # Where max(·, 0) cuts a colour off, its derivative is 0.
    appearance = dataclasses.replace(changed.appearance, given_colors=jnp.where(is_shown, sums, 0.0))
    # Over black: the background is the constant of an affine picture, not part of J.
    black = jnp.zeros(3, model.gaussians.means.dtype)
    output, _ = render_traced(model.gaussians, camera, appearance, black, settings, has_geometry=False)
    return output.color


def colors_of(model: Model) -> Colors:
    """Return the colours, in which a picture of the model is linear."""
    tables = (model.appearance.coefficients, model.textures)
    bands, textures = (() if table is None else table.buckets for table in tables)
    return Colors(model.gaussians.sh, bands, tuple(bucket[..., :3] for bucket in textures))


def with_colors(model: Model, colors: Colors) -> Model:
    """Return the model with other colours; alpha textures stay."""
    appearance = model.appearance
    if appearance.coefficients is not None:
        table = dataclasses.replace(appearance.coefficients, buckets=colors.bands)
        appearance = appearance.with_coefficients(table)
    if appearance.textures is not None:
        pairs = zip(colors.rgb, appearance.textures.buckets, strict=True)
        buckets = tuple(jnp.concatenate([rgb, old[..., 3:]], -1) for rgb, old in pairs)
        appearance = appearance.with_textures(dataclasses.replace(appearance.textures, buckets=buckets))
    gaussians = dataclasses.replace(model.gaussians, sh=colors.sh)
    return dataclasses.replace(model, gaussians=gaussians, appearance=appearance)
