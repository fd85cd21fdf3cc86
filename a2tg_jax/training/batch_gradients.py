"""Loss and gradients of the views of one step, traced."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderOutput, RenderSettings
from a2tg_jax.training.batches import Photographs
from a2tg_jax.training.corrections import corrected_color, penalties
from a2tg_jax.training.gradients import Differentiated, View, differentiate, differentiate_together
from a2tg_jax.training.returned import check_scalar
from a2tg_jax.training.stage import Background, Clock, LossTerm, Stage
from a2tg_jax.training.terms import Target


class BatchGradients(NamedTuple):
    """Loss and gradients of the V views of a step, [V, ...]."""

    loss: Array
    psnr: Array
    num_pairs: Array
    is_overflow: Array
    grads: tuple[Gaussians, Any, tuple[Array, ...]]
    """Gradients in the Gaussians, the appearance parameters, and the view's row of each correction. Where G views are
    drawn at once, those in parameters are [V/G, ...], each a mean over G views."""
    statistic: Array | None
    """[V, N, 4], the gradient at the probe of `render_traced`; None if no event gathers it."""
    terms: dict[str, Array]
    """Summands of the loss by name."""


def batch_gradients(
    settings: RenderSettings,
    stage: Stage,
    clock: Clock,
    model: Model,
    batch: Photographs,
    backgrounds: Array,
    iteration: Array,
    own: tuple[Array, ...],
    is_gathering: bool,
) -> BatchGradients:
    """Return loss and gradients of every view: one after the other, or as many at once as the devices share.

    Args:
      settings: with room for each view.
      stage: its loss terms and corrections.
      clock: `stage.clock()`.
      model: N rows.
      batch: V photographs.
      backgrounds: [V, 3].
      iteration: from 1.
      own: for each correction, its rows [V, ...] of these views.
      is_gathering: whether an event still gathers the stage's statistic.
    """
    height, width = batch.images.shape[1:3]
    highest = settings.sh_degree
    degree = jnp.minimum((iteration - 1) // clock.sh_interval, highest) if stage.raises_sh_degree else highest
    options: dict[str, Any] = {
        "has_geometry": stage.has_geometry, "sh_degree": degree,
        "statistic": stage.statistic, "has_probe": is_gathering,
    }  # fmt: skip

    def loss(shown: Model, seen: View, output: RenderOutput) -> tuple[Array, tuple[Array, Array, dict[str, Array]]]:
        image, alpha, mask, depth, points = seen.target
        photograph = _black_outside(mask, _over(image, alpha, seen.background))
        target = Target(seen.camera, photograph, seen.background, mask, depth, clock.progress(iteration - 1), points)
        color = corrected_color(seen.corrections, seen.rows, output.color)
        output = output._replace(color=_black_outside(mask, color))
        told: dict[str, Array] = {}
        values: list[Array] = []
        for index, term in enumerate(stage.losses):
            parts = term_parts(term, shown, target, output)
            for name, part in parts.items():
                check_scalar(f"stage {stage.name!r}: losses[{index}]", part)
                told[name if name not in told else f"{name}_{index + 1}"] = part
            values.append(functools.reduce(jnp.add, parts.values()))
        if added := penalties(seen.corrections, seen.rows):
            told["corrections"] = functools.reduce(jnp.add, added)
        value = functools.reduce(jnp.add, [*values, *added])
        error = _mean_over(mask, (jnp.clip(output.color, 0, 1) - target.image) ** 2)
        return value, (error, output.overflow, told)

    def gradients_by(derivative: Callable[..., Differentiated], arrays: tuple[Any, ...]) -> BatchGradients:
        viewmat, K, background, rows, pictures = arrays
        view = View(Camera(viewmat, K, width, height, batch.rays), background, stage.corrections, rows, pictures)
        found = derivative(loss, model, view, settings, **options)
        error, overflow, terms = found.told
        grads = found.gaussians, found.params, found.rows
        return BatchGradients(found.value, -10 * jnp.log10(error), found.num_pairs, overflow, grads, found.probe, terms)

    pictures = batch.images, batch.alphas, batch.masks, batch.depths, batch.points
    arrays = batch.viewmats, batch.Ks, backgrounds, own, pictures
    num, exchange = backgrounds.shape[0], settings.exchange
    num_at_once = 1 if exchange is None else exchange.num_at_once(num)
    gradients: BatchGradients
    if num_at_once == 1:
        gradients = jax.lax.map(functools.partial(gradients_by, differentiate), arrays)
        return gradients
    rounds = jax.tree.map(lambda x: x.reshape(num_at_once, num // num_at_once, *x.shape[1:]).swapaxes(0, 1), arrays)
    gradients = jax.lax.map(functools.partial(gradients_by, differentiate_together), rounds)
    return _of_views(gradients, num_at_once)


def term_parts(term: LossTerm, model: Model, target: Target, output: RenderOutput) -> dict[str, Array]:
    """Return the summands of a loss term by name; most terms are one."""
    parts: dict[str, Array]
    if hasattr(term, "parts"):
        parts = term.parts(model, target, output)
    else:
        parts = {getattr(term, "name", type(term).__name__): term(model, target, output)}
    return parts


def _of_views(rounds: BatchGradients, num_at_once: int) -> BatchGradients:
    """Return the gradients of rounds of views [V/G, G, ...] as those of views [V, ...]; of parameters, mean ones.

    Each of the G groups of devices draws V/G views in a row, whose photographs alone it needs
    (`Exchange.sharding_of_pictures`).
    """
    gaussians, sums, rows = rounds.grads
    rounds = rounds._replace(grads=(gaussians, None, rows))
    views: BatchGradients = jax.tree.map(
        lambda x: x.swapaxes(0, 1).reshape(x.shape[0] * x.shape[1], *x.shape[2:]), rounds
    )
    means = jax.tree.map(lambda x: x / num_at_once, sums)
    return views._replace(grads=(views.grads[0], means, views.grads[2]))


def _over(image: Array, alpha: Array | None, background: Array) -> Array:
    """Return a photograph as floats, composed over the background."""
    color = image.astype(background.dtype) / 255
    if alpha is None:
        return color
    weight = alpha.astype(background.dtype)[..., None] / 255
    return weight * color + (1 - weight) * background[None, None, :]


def _black_outside(mask: Array | None, color: Array) -> Array:
    """Return an image [H, W, 3] with excluded pixels black, so that no loss term sees them."""
    return color if mask is None else jnp.where(mask[..., None], color, jnp.zeros_like(color))


def _mean_over(mask: Array | None, values: Array) -> Array:
    """Return the mean of values [H, W, 3] over the pixels that count; the values of the others are 0."""
    mean = jnp.mean(values)
    return mean if mask is None else mean / jnp.mean(mask.astype(values.dtype))


def drawn_backgrounds(key: Array, kind: Background, num: int, dtype: Any) -> Array:
    """Return the colours [V, 3] behind the views of a step."""
    if kind == "random":
        return jax.random.uniform(key, (num, 3), dtype)
    return jnp.full((num, 3), 1.0 if kind == "white" else 0.0, dtype)
