"""One training step, jitted once per image size and stage: render, loss, gradient, Adam, noise, densification.

Overflow of the tile lists, or a gradient that is not finite, leaves the state as it was; the caller is told.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from a2tg_jax.adapt import GradientStatistics
from a2tg_jax.appearance.textured import project_texels
from a2tg_jax.cameras import Camera
from a2tg_jax.config import TrainConfig
from a2tg_jax.gaussians import Gaussians
from a2tg_jax.losses import mean_opacity, mean_scale, normal_consistency, photometric_loss
from a2tg_jax.mcmc import grow, perturb, relocate
from a2tg_jax.numerics import safe_norm
from a2tg_jax.optim import AdamState, adam_init, adam_update, exponential_decay
from a2tg_jax.render import RenderSettings, appearance_of, render_traced
from a2tg_jax.schedule import is_densify_event, sh_degree_at
from a2tg_jax.texture import AtlasLayout, Textures


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState:
    """All that training changes; everything else is derived from the configuration and the iteration."""

    gaussians: Gaussians
    """Allocated rows, of which the first `num_live` exist."""
    moments: AdamState
    """Adam's memory of the Gaussians."""
    textures: Textures | None
    """None in stage 1 and in a stage 2 without textures."""
    texture_moments: AdamState | None
    statistics: GradientStatistics | None
    """The average positional gradient since the last upscaling; None once no upscaling is ahead."""
    num_live: Array
    """int32."""
    iteration: Array
    """int32, iterations of this stage done so far."""


@dataclasses.dataclass(frozen=True)
class StepSettings:
    """What a compiled step is made for; hashable."""

    config: TrainConfig
    stage: int
    render: RenderSettings
    """With a capacity."""

    @property
    def num_iterations(self) -> int:
        return self.config.stage1_iterations if self.stage == 1 else self.config.stage2_iterations


class Batch(NamedTuple):
    """Views of one image size; V of them."""

    viewmats: Array
    """[V, 4, 4]."""
    Ks: Array
    """[V, 3, 3]."""
    images: Array
    """[V, H, W, 3] uint8."""
    alphas: Array | None
    """[V, H, W] uint8, or None where the images are opaque."""


class StepInfo(NamedTuple):
    """Scalars about a step, for the host."""

    loss: Array
    psnr: Array
    """Mean over the views, in dB."""
    num_pairs: Array
    """The most pairs among the views: what the capacity must hold."""
    is_overflow: Array
    is_finite: Array
    """Whether loss, gradients and updated parameters are."""
    has_hosts: Array
    """False when every Gaussian is dead."""


def initial_state(gaussians: Gaussians, num_live: int, textures: Textures | None, has_statistics: bool) -> TrainState:
    """The state before the first iteration of a stage."""
    return TrainState(
        gaussians=gaussians,
        moments=adam_init(gaussians),
        textures=textures,
        texture_moments=None if textures is None else adam_init(textures),
        statistics=GradientStatistics.init(gaussians.num) if has_statistics else None,
        num_live=jnp.asarray(num_live, jnp.int32),
        iteration=jnp.zeros((), jnp.int32),
    )


@functools.cache
def jitted_step():
    """`train_step`, jitted, with the state's buffers donated; its cache counts the traces."""
    return jax.jit(train_step, static_argnums=0, donate_argnums=1)


def train_step(
    how: StepSettings, state: TrainState, batch: Batch, layout: AtlasLayout | None, scene_scale: Array, key: Array
) -> tuple[TrainState, StepInfo]:
    """One iteration.

    Args:
      how: static.
      state: donated.
      batch: the views.
      layout: of the textures.
      scene_scale: factor of the means' learning rate.
      key: of the stage; each iteration folds in its number.
    """
    iteration = state.iteration + 1
    key_background, key_noise, key_relocate, key_grow = jax.random.split(jax.random.fold_in(key, iteration), 4)
    backgrounds = _backgrounds(key_background, how.config.background, batch.viewmats.shape[0])
    views = _gradients(how, state, batch, layout, backgrounds, iteration)
    grads = jax.tree.map(lambda g: jnp.mean(g, axis=0), views.grads)

    rates = how.config.rates
    decayed = exponential_decay(rates.means, rates.means_final_factor, state.iteration, how.num_iterations)
    rate = decayed.astype(scene_scale.dtype) * scene_scale
    new = _updated(how, state, grads, rate)
    if how.stage == 1 or how.config.densify.noise_in_stage2:
        new = dataclasses.replace(new, gaussians=perturb(key_noise, new.gaussians, new.num_live, rate))
    has_hosts = jnp.asarray(True)
    if how.stage == 1 and how.config.densify.is_enabled:
        new, has_hosts = jax.lax.cond(
            is_densify_event(iteration, how.num_iterations),
            lambda s: _densify(key_relocate, key_grow, s, how.config.densify.cap),
            lambda s: (s, jnp.asarray(True)),
            new,
        )
    is_overflow = jnp.any(views.is_overflow)
    is_finite = _all_finite((views.loss, grads, new.gaussians, new.textures))
    new = dataclasses.replace(new, statistics=_with_views(state.statistics, views.tap), iteration=iteration)
    is_good = is_finite & ~is_overflow & has_hosts
    chosen = jax.tree.map(lambda a, b: jnp.where(is_good, a, b), new, state)
    info = StepInfo(
        jnp.mean(views.loss), jnp.mean(views.psnr), jnp.max(views.num_pairs), is_overflow, is_finite, has_hosts
    )
    return chosen, info


class _ViewGradients(NamedTuple):
    """Per view [V, ...]."""

    loss: Array
    psnr: Array
    num_pairs: Array
    is_overflow: Array
    grads: tuple[Gaussians, Textures | None]
    tap: Array | None


def _gradients(how: StepSettings, state: TrainState, batch: Batch, layout, backgrounds, iteration) -> _ViewGradients:
    """Loss and gradients of every view, one after the other."""
    height, width = batch.images.shape[1:3]
    highest = how.config.sh_degree
    degree = sh_degree_at(iteration, how.num_iterations, highest) if how.stage == 1 else highest
    tap = None if state.statistics is None else jnp.zeros((state.gaussians.num, 4), state.gaussians.means.dtype)

    def one_view(view):
        viewmat, K, image, alpha, background = view
        target = _target(image, alpha, background)
        camera = Camera(viewmat, K, width, height)

        def loss(gaussians, textures, tap):
            rule = appearance_of(gaussians, textures, layout, how.render)
            needs_geometry = how.config.loss.normal_weight > 0 or how.config.loss.distortion_weight > 0
            output, num_pairs = render_traced(
                gaussians, camera, rule, background, how.render,
                has_geometry=needs_geometry, sh_degree=degree, num_live=state.num_live, tap=tap,
            )  # fmt: skip
            value = _loss(how.config, output, target, camera, gaussians, state.num_live)
            error = jnp.mean((jnp.clip(output.color, 0, 1) - target) ** 2)
            return value, (error, num_pairs, output.overflow)

        differentiate = jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True)
        (value, (error, num_pairs, overflow)), grads = differentiate(state.gaussians, state.textures, tap)
        return _ViewGradients(value, -10 * jnp.log10(error), num_pairs, overflow, grads[:2], grads[2])

    views = (batch.viewmats, batch.Ks, batch.images, batch.alphas, backgrounds)
    return jax.lax.map(one_view, views)


def _loss(config: TrainConfig, output, target, camera: Camera, gaussians: Gaussians, num_live: Array) -> Array:
    weights = config.loss
    value = photometric_loss(output.color, target, ssim_weight=weights.ssim_weight)
    if weights.normal_weight > 0:
        value += weights.normal_weight * normal_consistency(output.normal, output.depth, output.alpha, camera)
    if weights.distortion_weight > 0:
        value += weights.distortion_weight * jnp.mean(output.distortion)
    if weights.opacity_weight > 0:
        value += weights.opacity_weight * mean_opacity(gaussians, num_live)
    if weights.scale_weight > 0:
        value += weights.scale_weight * mean_scale(gaussians, num_live)
    return value


def _target(image: Array, alpha: Array | None, background: Array) -> Array:
    color = image.astype(background.dtype) / 255
    if alpha is None:
        return color
    weight = alpha.astype(background.dtype)[..., None] / 255
    return weight * color + (1 - weight) * background[None, None, :]


def _backgrounds(key: Array, kind: str, num: int) -> Array:
    if kind == "random":
        return jax.random.uniform(key, (num, 3))
    return jnp.full((num, 3), 1.0 if kind == "white" else 0.0)


def _updated(how: StepSettings, state: TrainState, grads, rate_of_means: Array) -> TrainState:
    """The state after Adam, with texels projected to where they belong."""
    rates = how.config.rates
    sh_rates = jnp.full((1, 16, 1), rates.sh_rest).at[:, 0].set(rates.sh_degree0)
    per_field: Any = Gaussians(rate_of_means, rates.quats, rates.log_scales, rates.logit_opacities, sh_rates)  # type: ignore[arg-type]
    gaussians, moments = adam_update(state.gaussians, grads[0], state.moments, per_field)
    state = dataclasses.replace(state, gaussians=gaussians, moments=moments)
    if state.textures is None or state.texture_moments is None:
        return state
    textures, texture_moments = adam_update(state.textures, grads[1], state.texture_moments, rates.texels)
    textures = project_texels(textures, how.render.texture)
    return dataclasses.replace(state, textures=textures, texture_moments=texture_moments)


def _densify(key_relocate: Array, key_grow: Array, state: TrainState, cap: int) -> tuple[TrainState, Array]:
    moments = (state.moments.mu, state.moments.nu)
    cap = min(cap, state.gaussians.num)
    moved = relocate(key_relocate, state.gaussians, moments, state.num_live)
    grown = grow(key_grow, moved.gaussians, moved.moments, moved.num_live, cap)
    mu, nu = grown.moments
    adam = dataclasses.replace(state.moments, mu=mu, nu=nu)
    state = dataclasses.replace(state, gaussians=grown.gaussians, moments=adam, num_live=grown.num_live)
    return state, moved.info.has_hosts


def _with_views(statistics: GradientStatistics | None, taps: Array | None) -> GradientStatistics | None:
    """The statistic, where one is kept, after the views of a batch; taps [V, N, 4]."""
    if statistics is None or taps is None:
        return None
    for tap in taps:
        statistics = statistics.accumulate(safe_norm(tap[:, :3]), tap[:, 3] > 0)
    return statistics


def _all_finite(tree) -> Array:
    return functools.reduce(jnp.logical_and, [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)])
