"""Smaller textures where that changes pictures least: the reverse of upscaling, for finished models.

A texture is halved along the side where its pairs of texels differ less, weighted by h. h is the visibility of a texel,
Σ over pixels and views of (∂picture/∂texel)², by Hutchinson's estimator with a vector of random signs for each view.
Changing texels by δ then changes the squared error by about Σ h·δ².

`shrink_textures` takes rounds of the cheapest steps per byte, as many as a loss of PSNR on given views allows. Textures
of one texel are only another colour and opacity: they merge into their Gaussians. `fewest_texels` shrinks to a number
of texels.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from a2tg_jax import Camera, Gaussians, Model, RenderSettings, Textures, View, plan_render
from a2tg_jax.core.origin import Color
from a2tg_jax.core.sh import SH_C0
from a2tg_jax.finish.compaction import loss_on_views
from a2tg_jax.model import check_is_model
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.render import background_array
from a2tg_jax.scene import check_are_views
from a2tg_jax.texture import BYTES_PER_TEXEL

LEAST_OPACITY = 1e-4
"""Smallest opacity after absorbing a texel's alpha, and distance of the largest from 1: logits must be finite."""
LEAST_SAVED = 0.005
"""Smallest share of a model's bytes that a round must save for another one."""
LEAST_WEIGHT = 1e-9
"""Visibility of texels that no view shows; it keeps means finite."""
Group = tuple[np.ndarray, np.ndarray]
"""Indices [n] of Gaussians and their textures [n, Tv, Tu, C], as of `Textures.groups`."""


def shrink_textures(
    model: Model, views: Sequence[View], *, max_loss: float = 0.02, background: Color | None = None
) -> Model:
    """Return the model with smaller textures and as many Gaussians as before (host).

    Args:
      model: model with textures of signed RGB.
      views: views to measure the loss on, such as the training views.
      max_loss: largest loss of PSNR in dB, as a mean over the views.
      background: [3] colour; None is the model's own.

    Returns:
      A model of no more bytes, with a loss of at most `max_loss`; the same model if nothing shrinks.

    Raises:
      ValueError: if there are no views, the loss is negative, or the model has no such textures.
    """
    check_is_model(model)
    check_are_views(views, "shrink_textures(model, scene.train)")
    if not max_loss >= 0:
        raise ValueError(f"max_loss must be at least 0 dB; got {max_loss}")
    if not can_shrink(model):
        raise ValueError(
            f"{model.appearance.description} cannot shrink: only textures with signed RGB and projected alpha can"
        )
    model = model.live
    if background is None:
        background = model.background
    loss = loss_on_views(model, views, background=background)
    cameras = [view.camera for view in views]
    while True:
        step = halve_textures(model, texel_weights(model, cameras, background))
        shrunk = _cheapest(model, step, lambda other: loss(other) <= max_loss)
        saved = model.num_bytes - shrunk.num_bytes
        model = shrunk
        if saved < LEAST_SAVED * model.num_bytes:
            return model


def can_shrink(model: Model) -> bool:
    """Return whether the model has textures that can shrink: signed RGB and projected alpha."""
    options = model.appearance.texture_options if model.appearance.is_portable else None
    return options is not None and options.rgb == "signed" and options.alpha == "projected"


class Step(NamedTuple):
    """One step for each texture, of N."""

    gaussians: Gaussians  # After absorbing their 1×1 textures.
    textures: Textures  # [2N] before all steps, and after them.
    cost: np.ndarray  # [N] estimated growth of the squared error.
    saved: np.ndarray  # [N] bytes.


def _cheapest(model: Model, step: Step, is_allowed: Callable[[Model], bool]) -> Model:
    """Return the model after as many of the cheapest steps per byte as allowed."""
    order = np.argsort(step.cost / np.maximum(step.saved, 1), kind="stable")
    # Textures of odd sides have no step.
    order = order[step.saved[order] > 0]
    # By bisection: what is lost grows with the number of steps.
    least = 0
    most = len(order)
    best = model
    while least < most:
        middle = (least + most + 1) // 2
        tried = taken(model, step, np.isin(np.arange(model.num), order[:middle]))
        if is_allowed(tried):
            least = middle
            best = tried
        else:
            most = middle - 1
        # Each trial draws all views: the last few steps are not worth one.
        if most - least < LEAST_SAVED * len(order):
            break
    return best


def halve_textures(model: Model, weights: Textures) -> Step:
    """Return all textures halved along the cheaper even side, and single texels merged, given h of every texel in the
    layout of the model (host)."""
    assert model.textures is not None
    textures = model.textures
    gaussians = model.gaussians
    halved: list[Group] = []
    cost = np.zeros(textures.num)
    single = np.tile(np.asarray(Textures.padding, np.float64), (textures.num, 1))
    for (ids, texels), (_, visible) in zip(textures.groups(), weights.groups(), strict=True):
        # The reverse of doubling: odd sides were never doubled.
        axes = [axis for axis in (1, 2) if texels.shape[axis] > 1 and texels.shape[axis] % 2 == 0]
        for chosen, smaller, _, costs in _halved(ids, texels, visible + LEAST_WEIGHT, axes):
            cost[chosen] = costs
            halved.append((chosen, smaller))
        if texels.shape[1:3] == (1, 1):
            single[ids] = texels[:, 0, 0]
            halved.append((ids, texels[:, :0, :0]))
        elif not axes:
            halved.append((ids, texels))
    sh = np.array(gaussians.sh, np.float64)
    sh[:, 0] += single[:, :3] / SH_C0
    opacities = np.clip(np.asarray(gaussians.opacities, np.float64) * single[:, 3], LEAST_OPACITY, 1 - LEAST_OPACITY)
    # Gaussians that absorb no alpha keep their logit to the last bit.
    logits = np.where(single[:, 3] == 1, np.asarray(gaussians.logit_opacities), np.log(opacities / (1 - opacities)))
    dtype = gaussians.means.dtype
    absorbed = dataclasses.replace(gaussians, sh=jnp.asarray(sh, dtype), logit_opacities=jnp.asarray(logits, dtype))
    after = Textures.of_groups(halved)
    saved = BYTES_PER_TEXEL * (textures.sizes.prod(axis=1) - after.sizes.prod(axis=1))
    return Step(absorbed, Textures.joined([textures, after]), cost, saved)


def taken(model: Model, step: Step, is_chosen: np.ndarray) -> Model:
    """Return the model in which the chosen Gaussians [N] have taken their step (host)."""

    def chosen(before: Array, after: Array) -> Array:
        return jnp.where(is_chosen.reshape(-1, *[1] * (before.ndim - 1)), after, before)

    gaussians = jax.tree.map(chosen, model.gaussians, step.gaussians)
    # Row i + N is texture i after its step.
    textures = step.textures.take(np.arange(model.num) + model.num * is_chosen)
    return dataclasses.replace(model, gaussians=gaussians).with_textures(textures)


def texel_weights(model: Model, cameras: Sequence[Camera], background: ArrayLike) -> Textures:
    """Return h of every texel in some views over a background [3], in the layout of the model (host)."""
    assert model.textures is not None
    settings = plan_render(model, cameras)
    background = background_array(background, model.gaussians)
    total = tuple(map(jnp.zeros_like, model.textures.buckets))
    jitted = jax.jit(_weights_in_view, static_argnums=(4,))
    for index, camera in enumerate(cameras):
        # A key for each view, fixed, so that the same model shrinks in the same way.
        total = jax.tree.map(jnp.add, total, jitted(model, camera, background, jax.random.key(index), settings))
    return dataclasses.replace(model.textures, buckets=total)


def _weights_in_view(
    model: Model, camera: Camera, background: Array, key: Array, settings: RenderSettings
) -> tuple[Array, ...]:
    """Return h of every texel in one view, bucket by bucket."""
    textures = model.textures
    assert textures is not None

    def draw(buckets: tuple[Array, ...]) -> Array:
        shown = model.with_textures(dataclasses.replace(textures, buckets=buckets))
        output, _ = render_traced(shown.gaussians, camera, shown.appearance, background, settings, has_geometry=False)
        return output.color

    color, back = jax.vjp(draw, textures.buckets)
    # Hutchinson: for random signs ε, E[(Jᵀε)²] is the sum of J² over the pixels, h.
    (slopes,) = back(jax.random.rademacher(key, color.shape, color.dtype))
    return tuple(map(jnp.square, slopes))


# Textures of few texels in all


def fewest_texels(textures: Textures, weights: Textures, most: int) -> list[Group]:
    """Return textures with at most `most` texels in total, at least one each, in a table for each size (host).

    Each texture has a sequence of halvings down to one texel; those that change least per texel saved are taken. Empty
    textures become a neutral texel. Weights are as `texel_weights` returns them.
    """
    start: list[Group] = []
    for (ids, texels), (_, squares) in zip(textures.groups(), weights.groups(), strict=True):
        weighted = np.tile(np.asarray([*Textures.padding, LEAST_WEIGHT]), (len(ids), 1, 1, 1))
        if texels.size:
            # The visibility becomes a fifth channel, which is added up where texels are joined.
            visible = squares.astype(np.float64).sum(axis=-1, keepdims=True) + LEAST_WEIGHT
            weighted = np.concatenate([texels.astype(np.float64), visible], axis=-1)
        start.append((ids, weighted))
    # An empty first entry: concatenation needs one even if no texture can be halved.
    steps: list[tuple[np.ndarray, ...]] = [(np.zeros(0, int),) * 4]
    least = np.zeros(textures.num)
    # The textures before all steps, after the first one of each, and so on.
    rows = [_merged(start)]
    while rows[-1]:
        smaller: list[Group] = []
        for ids, texels in rows[-1]:
            for chosen, halved, cost in _halved_table(ids, texels):
                saved = texels[0, ..., 0].size - halved[0, ..., 0].size
                # A step counts at least as much as the one before it, so that it never comes first.
                least[chosen] = np.maximum(least[chosen], cost / saved)
                smaller.append((chosen, halved))
                steps.append((chosen, np.full(len(chosen), len(rows)), least[chosen], np.full(len(chosen), saved)))
        rows.append(_merged(smaller))
    ids, numbers, costs, saved_texels = (np.concatenate(parts) for parts in zip(*steps, strict=True))
    order = np.lexsort((numbers, costs))  # By cost, and steps of one texture in their order.
    excess = sum(texels[..., 0].size for _, texels in rows[0]) - most
    # + 1: the step that reaches the excess is included.
    count = int(np.searchsorted(np.cumsum(saved_texels[order]), excess)) + 1 if excess > 0 else 0
    # A texture takes its steps in order, so that their number says which.
    num_steps = np.bincount(ids[order[:count]], minlength=textures.num)
    after_steps: list[Group] = []
    for number, tables in enumerate(rows):
        for ids, texels in tables:
            is_last = num_steps[ids] == number
            after_steps.append((ids[is_last], texels[is_last, ..., :4]))
    return _merged(after_steps)


def _merged(tables: list[Group]) -> list[Group]:
    """Return one table for each size, ascending."""
    by_size: dict[Any, list[Group]] = {}
    for ids, texels in tables:
        if len(ids):
            by_size.setdefault(texels.shape[1:3], []).append((ids, texels))
    columns = [zip(*by_size[size], strict=True) for size in sorted(by_size)]
    return [(np.concatenate(ids), np.concatenate(texels)) for ids, texels in columns]


def _halved_table(ids: np.ndarray, texels: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield indices, halved textures [n, Tv, Tu, 5] and costs of a table, by the side that is halved."""
    axes = [axis for axis in (1, 2) if texels.shape[axis] > 1]
    for chosen, smaller, weights, cost in _halved(ids, texels[..., :4], texels[..., 4:], axes):
        yield chosen, np.concatenate([smaller, weights], axis=-1), cost


def _halved(
    ids: np.ndarray, texels: np.ndarray, weights: np.ndarray, axes: Sequence[int]
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Halve textures [n, Tv, Tu, 4] along the axis where that costs less; an odd last texel stays.

    Yields, for each chosen axis, the indices, weighted means of pairs, sums of their weights, and costs.
    """
    choices = []
    for axis in axes if len(ids) else ():
        size = texels.shape[axis]
        starts = np.arange(0, size, 2)
        # reduceat leaves an odd last texel by itself.
        sums = np.add.reduceat(weights, starts, axis=axis)
        means = np.add.reduceat(weights * texels, starts, axis=axis) / sums
        # δ of the module's Σ h·δ².
        error = weights * (texels - np.take(means, np.arange(size) // 2, axis=axis)) ** 2
        choices.append((means, sums, error.sum(axis=(1, 2, 3))))
    costs = np.asarray([cost for *_, cost in choices])
    for place, parts in enumerate(choices):
        is_cheapest = costs.argmin(axis=0) == place
        if is_cheapest.any():
            means, sums, cost = (part[is_cheapest] for part in parts)
            yield ids[is_cheapest], means, sums, cost
