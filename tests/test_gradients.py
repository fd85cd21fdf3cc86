"""A view's gradients and its statistic in one call, and a training loop written with them by hand."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from oracle import DEFAULT_RULES
from scenes_random import CAPACITY, as_camera, as_gaussians, as_textures, draw_scene

import a2tg_jax as a2tg
from a2tg_jax import Appearance, Model, RenderSettings, Seen, Texture, view_gradients
from a2tg_jax.events import read_probe
from a2tg_jax.rasterize.views import render_traced


@pytest.mark.usefixtures("x64")
def test_gradients_are_those_of_the_image_and_the_statistic_is_the_oracles():
    scene = draw_scene(4)
    cotangent = np.random.default_rng(4).normal(size=(scene.height, scene.width, 3))
    model = Model(as_gaussians(scene, "float64"), Appearance(texture=Texture(as_textures(scene, "float64"))))
    camera = as_camera(scene, "float64")
    settings = RenderSettings(capacity=CAPACITY)

    def loss(model, output):
        return jnp.sum(output.color * jnp.asarray(cotangent)) + jnp.sum(model.gaussians.opacities)

    def plain(model):
        return loss(model, model.render(camera, background=scene.background, settings=settings))

    how = functools.partial(view_gradients, loss, background=scene.background, settings=settings)
    found = jax.jit(how)(model, camera)
    value, gradient = jax.jit(a2tg.value_and_grad(plain))(model)
    np.testing.assert_allclose(found.value, value, rtol=1e-12)
    for ours, wanted in zip(jax.tree.leaves(found.gradient), jax.tree.leaves(gradient), strict=True):
        np.testing.assert_allclose(ours, wanted, rtol=1e-9, atol=1e-12)
    expected = oracle.gradient_statistic(scene, cotangent, DEFAULT_RULES, "position")
    np.testing.assert_allclose(found.norms, np.linalg.norm(expected, axis=1), rtol=1e-8, atol=1e-10 * expected.max())
    is_seen = np.count_nonzero(oracle.render(scene).weights, axis=(1, 2)) > 0
    np.testing.assert_array_equal(found.is_visible, is_seen)
    assert 0 < is_seen.sum() < len(is_seen)


def test_a_gradient_of_textures_has_none_for_their_places():
    scene = draw_scene(4)
    gaussians, camera, textures = (make(scene, "float32") for make in (as_gaussians, as_camera, as_textures))
    settings = RenderSettings(capacity=CAPACITY)

    def loss(textures, factor):
        return factor * jnp.mean(a2tg.render_image(gaussians, camera, textures, settings=settings).color ** 2)

    def of_buckets(buckets):
        return loss(dataclasses.replace(textures, buckets=buckets), 2.0)

    value, found = jax.jit(a2tg.value_and_grad(loss))(textures, 2.0)
    wanted = jax.jit(jax.value_and_grad(of_buckets))(textures.buckets)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-6), (value, found.buckets), wanted)
    assert found.bucket is None and found.row is None
    with pytest.raises(ValueError, match="a pytree with floats, such as a model; got ndarray"):
        a2tg.value_and_grad(loss)(np.arange(3), 2.0)


@pytest.mark.long
@pytest.mark.parametrize("event", [a2tg.Upscale(), a2tg.CloneSplitPrune(), a2tg.Upscale(gradient="screen")])
def test_norms_are_those_that_events_average(event):
    """Also where the statistic is by the position on the screen, whose thresholds are in units of half an image."""
    scene = draw_scene(4)
    model = Model(as_gaussians(scene, "float32"))
    camera = as_camera(scene, "float32")
    settings = RenderSettings(capacity=CAPACITY)
    loss = lambda model, output: jnp.sum(output.color**2)  # noqa: E731
    found = view_gradients(loss, model, camera, settings=settings, statistic=event.statistic)

    def of_probe(probe):
        output, _ = render_traced(
            model.gaussians, camera, model.appearance, jnp.zeros(3), settings, probe=probe, statistic=event.statistic
        )
        return loss(model, output)

    gradients = jax.grad(of_probe)(jnp.zeros((50, 4)))
    seen = Seen(
        camera, *read_probe(gradients[None], event.statistic, camera.width, camera.height), gradients[None, :, :3]
    )
    average = event.observe(event.init(model), model, seen).average()
    assert average.max() > 0
    np.testing.assert_allclose(jnp.where(found.is_visible, found.norms, 0.0), average, rtol=1e-5, atol=1e-6)


def test_a_loop_by_hand_learns_and_upscales():
    """Adam on two views, then the textures of the Gaussians with the largest statistic double, and Adam again."""
    scene = draw_scene(4)
    cameras = [as_camera(scene, "float32")] * 2
    truth = [a2tg.render_image(as_gaussians(scene, "float32"), camera).color for camera in cameras]
    gaussians = dataclasses.replace(as_gaussians(scene, "float32"), sh=jnp.zeros((50, 16, 3)))
    textures = a2tg.allocate_textures(np.ones((50, 2), int))
    model = Model(gaussians, Appearance(texture=Texture(textures)))
    settings = a2tg.plan_render(model, cameras, head_room=4)

    @jax.jit
    def step(model, moments, statistics, camera, target):
        loss = lambda model, output: a2tg.photometric_loss(output.color, target)  # noqa: E731
        found = view_gradients(loss, model, camera, settings=settings, has_geometry=False)
        floats, rest = a2tg.partition(model)
        update = a2tg.adam_update(floats, found.gradient, moments, 0.005)
        model = a2tg.combine(update.params, rest)
        model = dataclasses.replace(model, appearance=a2tg.project_appearance(model.appearance))
        return model, update.state, statistics.observe(found.norms, found.is_visible), found.value

    def train(model, moments):
        statistics = a2tg.GradientStatistics.init(model.num)
        losses = []
        for _ in range(15):
            for camera, target in zip(cameras, truth, strict=True):
                model, moments, statistics, loss = step(model, moments, statistics, camera, target)
                losses.append(float(loss))
        return model, moments, statistics, losses

    model, moments, statistics, before = train(model, a2tg.adam_init(a2tg.partition(model)[0]))
    assert before[-1] < 0.8 * before[0]

    sizes = model.textures.sizes
    proposed = a2tg.next_sizes(sizes, model.gaussians.scales, k_a=4.0, k_s=0.01, cap=4)
    chosen = a2tg.select(statistics.average(), sizes, proposed, fraction=0.25)
    sizes = np.where(chosen[:, None], proposed, sizes)
    grown = a2tg.reallocate(model.textures, sizes, moments)
    assert grown.moments.mu.gaussians.means is moments.mu.gaussians.means and grown.moments.count is moments.count
    moments = grown.moments
    model = model.with_textures(grown.textures)
    assert model.num_bytes == 232 * 50 + 16 * sizes.prod(axis=1).sum() and chosen.sum() == 13

    model, moments, statistics, after = train(model, moments)
    assert after[-1] < before[-1]
