"""Shrinking of textures where it costs next to nothing: the reverse of upscaling, for finished models.

A texture is halved along the side where its pairs of texels differ least, weighted by h. A texture of one texel is only
another colour and opacity, and merges into those of its Gaussian. Rounds of the cheapest steps per byte are taken, as
many as a loss of PSNR on given views allows.

h is the visibility of a texel, Σ over pixels and views of (∂picture/∂texel)², by Hutchinson's estimator with a vector
of random signs for each view. Changing texels by δ then changes the squared error by about Σ h·δ².
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from a2tg_jax.appearance import in_words
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import SH_C0, Gaussians
from a2tg_jax.core.origin import Color
from a2tg_jax.data import View
from a2tg_jax.data.scene import check_are_views
from a2tg_jax.finish.compaction import loss_on_views
from a2tg_jax.model import Model, check_is_model
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.renderer import plan_render
from a2tg_jax.texture import BYTES_PER_TEXEL, NEUTRAL_TEXEL, Textures, allocate_textures

LEAST_OPACITY = 1e-4
"""Largest opacity of a Gaussian after absorbing a texel's alpha: its logit must be finite."""
LEAST_SAVED = 0.005
"""Smallest share of a model's bytes that a round must save for another one."""


def shrink_textures(
    model: Model, views: Sequence[View], *, max_loss: float = 0.02, background: Color | None = None
) -> Model:
    """Return the model with smaller textures and as many Gaussians as before (host).

    Args:
      model: with textures of signed RGB.
      views: views to measure the loss on, such as the training views.
      max_loss: largest loss of PSNR in dB, as a mean over the views.
      background: [3] colour; None is the model's own.

    Returns:
      A model of no more bytes, with a loss of at most `max_loss`; the same model if nothing shrinks.

    Raises:
      ValueError: if there are no views, the loss is negative, or the model has no such textures.
    """
    _check(model, views, max_loss)
    model = model.live
    background = model.background if background is None else background
    loss = loss_on_views(model, views, background=background)
    while True:
        shrunk = _shrunk_once(model, views, background, lambda found: loss(found) <= max_loss)
        saved = model.num_bytes - shrunk.num_bytes
        model = shrunk
        if saved < LEAST_SAVED * model.num_bytes:
            return model


def can_shrink(model: Model) -> bool:
    """Return whether the model has textures that can shrink: signed RGB and projected alpha."""
    options = model.appearance.texture_options if model.appearance.is_portable else None
    return options is not None and options.rgb == "signed" and options.alpha == "projected"


def _check(model: Model, views: Sequence[View], max_loss: float) -> None:
    check_is_model(model)
    check_are_views(views, "shrink_textures(model, scene.train)")
    if not views:
        raise ValueError("views must hold at least one view; got none")
    if not max_loss >= 0:
        raise ValueError(f"max_loss must be at least 0 dB; got {max_loss}")
    if not can_shrink(model):
        raise ValueError(
            f"{in_words(model.appearance)} cannot shrink: only textures with signed RGB and projected alpha can"
        )


def _shrunk_once(
    model: Model, views: Sequence[View], background: ArrayLike | None, is_allowed: Callable[[Model], bool]
) -> Model:
    """Return the model after the cheapest allowed steps, at most one for each texture."""
    step = halve_textures(model, texel_weights(model, views, background))
    saved = step.saved
    order = np.argsort(step.cost / np.maximum(saved, 1), kind="stable")
    order = order[saved[order] > 0]

    def after(count: int) -> Model:
        is_chosen = np.zeros(model.num, bool)
        is_chosen[order[:count]] = True
        return taken(model, step, is_chosen)

    # The most steps that are allowed, by bisection: what is lost grows with their number.
    least, most, best = 0, len(order), model
    while least < most:
        middle = (least + most + 1) // 2
        found = after(middle)
        if is_allowed(found):
            least, best = middle, found
        else:
            most = middle - 1
        if most - least < LEAST_SAVED * len(order):
            break
    return best


class Step(NamedTuple):
    """One step for each texture, of N."""

    gaussians: Gaussians
    """Gaussians after absorbing their 1×1 textures."""
    textures: Textures
    cost: np.ndarray
    """[N] estimated growth of the squared error."""
    saved: np.ndarray
    """[N] bytes."""


def halve_textures(model: Model, weights: Textures) -> Step:
    """Return all textures halved along the cheaper side, and single texels merged (host).

    Args:
      model: with textures.
      weights: h of every texel, in the layout of the model.
    """
    assert model.textures is not None
    textures = model.textures
    old_sizes, cost = textures.sizes, np.zeros(textures.num)
    sizes = old_sizes.copy()
    pieces = []
    for index, (tv, tu) in enumerate(textures.bucket_sizes):
        ids = np.flatnonzero(np.asarray(textures.bucket) == index)
        rows = np.asarray(textures.row)[ids]
        old, own = (np.asarray(tree.buckets[index])[rows] for tree in (textures, weights))
        choices = [_halved_along(old, own, axis) for axis, side in ((1, tv), (2, tu)) if side > 1 and side % 2 == 0]
        if (tv, tu) == (1, 1):
            sizes[ids] = 0
        elif choices:
            costs = np.stack([own_cost for _, own_cost in choices])
            best = costs.argmin(axis=0)
            cost[ids] = costs.min(axis=0)
            for place, (smaller, _) in enumerate(choices):
                is_own = best == place
                sizes[ids[is_own]] = smaller.shape[1:3]
                pieces.append((ids[is_own], smaller[is_own]))
        else:
            pieces.append((ids, old))
    new = _filled(sizes, pieces, textures.buckets[0].dtype)
    saved = BYTES_PER_TEXEL * (old_sizes.prod(axis=1) - sizes.prod(axis=1))
    return Step(_with_single_texels(model), new, cost, saved)


def _halved_along(texels: np.ndarray, weights: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return textures [n, Tv, Tu, 4] with weighted means of pairs along an axis, and the cost [n] of each."""
    pairs = texels.reshape(*texels.shape[:axis], -1, 2, *texels.shape[axis + 1 :])
    own = weights.reshape(pairs.shape) + 1e-9
    means = (own * pairs).sum(axis=axis + 1) / own.sum(axis=axis + 1)
    error = own * (pairs - np.expand_dims(means, axis + 1)) ** 2
    return means.astype(texels.dtype), error.sum(axis=tuple(range(1, error.ndim)))


def _with_single_texels(model: Model) -> Gaussians:
    """Return the Gaussians after absorbing the colour and opacity of textures of one texel."""
    gaussians, textures = model.gaussians, model.textures
    assert textures is not None
    texels = np.tile(np.asarray(NEUTRAL_TEXEL, np.float64), (textures.num, 1))
    if (1, 1) in textures.bucket_sizes:
        index = textures.bucket_sizes.index((1, 1))
        ids = np.flatnonzero(np.asarray(textures.bucket) == index)
        texels[ids] = np.asarray(textures.buckets[index])[np.asarray(textures.row)[ids], 0, 0]
    sh = np.array(gaussians.sh, np.float64)
    sh[:, 0] += texels[:, :3] / SH_C0
    opacities = np.clip(np.asarray(gaussians.opacities, np.float64) * texels[:, 3], LEAST_OPACITY, 1 - LEAST_OPACITY)
    logits = np.where(texels[:, 3] == 1, np.asarray(gaussians.logit_opacities), np.log(opacities / (1 - opacities)))
    dtype = gaussians.means.dtype
    return dataclasses.replace(gaussians, sh=jnp.asarray(sh, dtype), logit_opacities=jnp.asarray(logits, dtype))


def taken(model: Model, step: Step, is_chosen: np.ndarray) -> Model:
    """Return the model in which the chosen Gaussians [N] have taken their step (host)."""
    old = model.textures
    assert old is not None
    sizes = np.where(is_chosen[:, None], step.textures.sizes, old.sizes)
    pieces = []
    for textures, is_from in ((old, ~is_chosen), (step.textures, is_chosen)):
        for index, bucket in enumerate(textures.buckets):
            ids = np.flatnonzero(is_from & (np.asarray(textures.bucket) == index))
            pieces.append((ids, np.asarray(bucket)[np.asarray(textures.row)[ids]]))
    textures = _filled(sizes, pieces, old.buckets[0].dtype)

    def chosen(before: Array, after: Array) -> Array:
        return jnp.where(is_chosen.reshape(-1, *[1] * (before.ndim - 1)), after, before)

    gaussians = jax.tree.map(chosen, model.gaussians, step.gaussians)
    return dataclasses.replace(model, gaussians=gaussians).with_textures(textures)


def _filled(sizes: np.ndarray, pieces: Sequence[tuple[np.ndarray, np.ndarray]], dtype: np.dtype[Any]) -> Textures:
    """Return textures of the given sizes [N, 2] from pieces: Gaussians and their texels [n, Tv, Tu, 4] of one size."""
    empty = allocate_textures(sizes, dtype=dtype)
    buckets, rows = [np.array(bucket) for bucket in empty.buckets], np.asarray(empty.row)
    for ids, texels in pieces:
        if len(ids):
            buckets[empty.bucket_sizes.index(texels.shape[1:3])][rows[ids]] = texels
    return dataclasses.replace(empty, buckets=tuple(map(jnp.asarray, buckets)))


def texel_weights(model: Model, views: Sequence[View], background: ArrayLike | None) -> Textures:
    """Return h of every texel in some views, whose photographs are not used. Arguments as in `texel_weights_of`."""
    return texel_weights_of(model, [view.camera for view in views], background)


def texel_weights_of(model: Model, cameras: Sequence[Camera], background: ArrayLike | None) -> Textures:
    """h of every texel, in the layout of the model (host).

    Args:
      model: with textures.
      cameras: views in which texels are visible.
      background: [3] colour.
    """
    assert model.textures is not None
    settings = plan_render(model, cameras)
    background = jnp.asarray(background, model.gaussians.means.dtype)
    total = tuple(map(jnp.zeros_like, model.textures.buckets))
    for index, camera in enumerate(cameras):
        total = jax.tree.map(jnp.add, total, _jitted()(model, camera, background, jax.random.key(index), settings))
    return dataclasses.replace(model.textures, buckets=total)


@functools.cache
def _jitted() -> jax.stages.Wrapped:
    return jax.jit(_weights_in, static_argnums=(4,))


def _weights_in(
    model: Model, camera: Camera, background: Array, key: Array, settings: RenderSettings
) -> tuple[Array, ...]:
    """Return the weights from one view, bucket by bucket."""
    textures = model.textures
    assert textures is not None

    def draw(buckets: tuple[Array, ...]) -> Array:
        shown = model.with_textures(dataclasses.replace(textures, buckets=buckets))
        output, _ = render_traced(shown.gaussians, camera, shown.appearance, background, settings, has_geometry=False)
        return output.color

    color, back = jax.vjp(draw, textures.buckets)
    (slopes,) = back(jax.random.rademacher(key, color.shape, color.dtype))
    return tuple(map(jnp.square, slopes))
