"""Alignment of test views before they are scored: their colours by least squares, their poses by descent.

A model trained with exposures or refined poses has none for a test photograph. As is customary, these few numbers are
fitted to the test photograph itself, with the model fixed.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from a2tg_jax.appearance import Appearance
from a2tg_jax.base.checks import check_mask, check_shape
from a2tg_jax.core.cameras import Camera, moved_viewmat
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.core.optim import adam_init, adam_update
from a2tg_jax.model import Model, check_is_model
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.rasterize.room import TileRoom
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.renderer import plan_render
from a2tg_jax.scene import View, check_are_views, view_image
from a2tg_jax.training.losses import SSIM_WINDOW, photometric_loss

NUM_STEPS = 100
FIRST_RATE = 2e-3
LAST_RATE = 2e-5
"""Learning rates in radians and units of the normalised world, falling exponentially: 2.5° over all steps."""


def color_fit(image: ArrayLike, target: ArrayLike, mask: ArrayLike | None = None) -> np.ndarray:
    """Return the affine colour map [3, 4] = [A | b] that minimises |A·image + b − target|² (host).

    Args:
      image: [H, W, 3] a render.
      target: [H, W, 3] the photograph.
      mask: [H, W] bool, the pixels that count; None: all.

    Returns:
      float64. The smallest solution if an image of few colours leaves it open.

    Raises:
      ValueError: if the shapes differ, the mask is not boolean, or a colour that counts is not finite.
    """
    check_shape("image", image, ("H", "W", 3))
    check_shape("target", target, np.shape(image))
    if mask is not None:
        check_mask("mask", mask, np.shape(image)[:2])
    counts = np.ones(np.shape(image)[:2], bool) if mask is None else np.asarray(mask)
    colors = np.asarray(image, np.float64)[counts]
    targets = np.asarray(target, np.float64)[counts]
    for name, values in (("image", colors), ("target", targets)):
        if not np.isfinite(values).all():
            raise ValueError(f"{name} must be finite where its pixels count; it has NaN or infinite colours")
    inputs = np.concatenate([colors, np.ones((len(colors), 1))], axis=1)
    # Normal equations, 4 × 4, instead of a row a pixel; lstsq takes the least solution of singular ones.
    return np.linalg.lstsq(inputs.T @ inputs, inputs.T @ targets, rcond=None)[0].T


def align_poses(
    views: Sequence[View],
    model: Model,
    *,
    background: ArrayLike | None = None,
    settings: RenderSettings = RenderSettings(),  # noqa: B008 - frozen
    num_steps: int = NUM_STEPS,
) -> tuple[View, ...]:
    """Return the views with cameras from which the model looks most like their photographs (host).

    After BARF (Lin et al., 2021).

    Adam minimises the photometric loss over a twist of the camera in its own frame; each view keeps its best step, so
    that no loss increases.

    Args:
      views: views near their true poses.
      model: the model, which stays fixed.
      background: [3] colour; None is the model's own.
      settings: static options without a capacity.
      num_steps: number of Adam steps.

    Returns:
      The views, with the cameras found.

    Raises:
      ValueError: if an argument has the wrong type, or there are no views.
    """
    check_are_views(views, "align_poses(scene.test, model)")
    check_is_model(model)
    model = model.live
    background = jnp.asarray(model.background if background is None else background, model.gaussians.means.dtype)
    settings = plan_render(model, [view.camera for view in views], settings=settings)
    room = TileRoom({"views": settings.capacity or 0})
    descend = jax.jit(_descent, static_argnums=(6, 7))
    aligned = []
    for view in views:
        target = jnp.asarray(view_image(view, np.asarray(background)), background.dtype)
        mask = None if view.mask is None else jnp.asarray(view.mask.read())[..., None]
        camera = jax.tree.map(lambda x: jnp.asarray(x, background.dtype), view.camera)
        inputs = (model.gaussians, model.appearance, camera, target, mask, background)
        twist, is_full = descend(*inputs, settings, num_steps)
        # A full tile list drops splats, which makes the loss wrong: the descent is repeated.
        while is_full:
            settings = dataclasses.replace(settings, capacity=room.enlarge("views"))
            twist, is_full = descend(*inputs, settings, num_steps)
        viewmat = moved_viewmat(twist, camera.viewmat).astype(jnp.float32)
        aligned.append(dataclasses.replace(view, camera=dataclasses.replace(view.camera, viewmat=viewmat)))
    return tuple(aligned)


def _descent(
    gaussians: Gaussians, appearance: Appearance, camera: Camera, target: Array, mask: Array | None, background: Array,
    settings: RenderSettings, num_steps: int,
) -> tuple[Array, Array]:  # fmt: skip
    """Return the twist with the smallest loss on Adam's path, and whether a render needs more capacity."""
    # SSIM needs a whole window.
    ssim_weight = 0.2 if min(target.shape[:2]) >= SSIM_WINDOW else 0.0
    photograph = target if mask is None else jnp.where(mask, target, 0.0)

    def loss(twist: Array) -> Any:
        moved = dataclasses.replace(camera, viewmat=moved_viewmat(twist, camera.viewmat))
        output, _ = render_traced(gaussians, moved, appearance, background, settings, has_geometry=False)
        color = output.color if mask is None else jnp.where(mask, output.color, 0.0)
        return photometric_loss(color, photograph, ssim_weight=ssim_weight), output.overflow

    def step(carry: Any, index: Array) -> tuple[Any, None]:
        twist, moments, least, best, is_full = carry
        (value, overflow), grad = jax.value_and_grad(loss, has_aux=True)(twist)
        # A NaN loss is not less, so it is never kept.
        best = jnp.where(value < least, twist, best)
        least = jnp.where(value < least, value, least)
        rate = FIRST_RATE * (LAST_RATE / FIRST_RATE) ** (index / num_steps)
        twist, moments = adam_update(twist, grad, moments, rate)
        return (twist, moments, least, best, is_full | overflow), None

    start = jnp.zeros(6, target.dtype)
    carry = start, adam_init(start), jnp.asarray(jnp.inf, target.dtype), start, jnp.zeros((), bool)
    # + 1: each loss belongs to the twist before its update, so that the last update is judged too.
    (_, _, _, best, is_full), _ = jax.lax.scan(step, carry, jnp.arange(num_steps + 1, dtype=target.dtype))
    return best, is_full
