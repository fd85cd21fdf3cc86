"""Views under `vmap` equal those drawn one by one: images, gradients, statistics and flags, in every nesting."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_camera, as_gaussians, as_textures, assert_all_close, draw_smooth_scene, quick_then_long

import a2tg_jax as a2tg
from a2tg_jax import Camera, RenderSettings, render_image, set_num_threads
from a2tg_jax.rasterize import view_groups
from a2tg_jax.rasterize.kernels.native import ffi

SCENE = draw_smooth_scene(53, width=24, height=20)
CAMERA = as_camera(SCENE, "float32")
SHIFTS = jnp.asarray([[0.0, 0, 0], [0.05, 0, 0], [0, -0.04, 0.1], [0.02, 0.03, 0], [-0.05, 0, 0.05]])
VIEWMATS = jnp.stack([CAMERA.viewmat.at[:3, 3].add(shift) for shift in SHIFTS])
COMPOSITORS = quick_then_long(["native"], ["xla", "autodiff", "cuda"])


TEXTURES = as_textures(SCENE, "float32")


def some_gaussians():
    return as_gaussians(SCENE, "float32")


def some_model():
    """Gaussians and texels."""
    return some_gaussians(), TEXTURES.buckets


def some_models():
    """The same of two models, [2, ...]."""
    return jax.tree.map(lambda x: jnp.stack([x, x + 0.02]), some_model())


def loss(model, viewmat, compositor="auto"):
    gaussians, buckets = model
    camera = Camera(viewmat, CAMERA.K, CAMERA.width, CAMERA.height)
    textures = dataclasses.replace(TEXTURES, buckets=buckets)
    settings = RenderSettings(capacity=1024, tile_size=8, compositor=compositor)
    output = render_image(gaussians, camera, textures, settings=settings)
    return jnp.sum(output.color**2) + jnp.sum(output.depth * output.alpha)


@functools.cache
def one_by_one():
    """Losses [5] of the views, and their gradients in the model and in the matrices [5, ...]."""
    one = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))
    results = [one(some_model(), viewmat) for viewmat in VIEWMATS]
    return jax.tree.map(lambda *each: jnp.stack(each), *results)


def in_groups_of(monkeypatch, size):
    """Let views be drawn in groups of a size."""
    monkeypatch.setattr(view_groups, "group_size", lambda num_views, num_rows: min(size, num_views))


@pytest.mark.parametrize("size", [1, 2, 5])
@pytest.mark.parametrize("compositor", COMPOSITORS)
def test_views_and_their_gradients_are_those_of_a_loop(monkeypatch, compositor, size):
    """The gradient of a sum over views, and the gradient of each view; the last group may be smaller."""
    in_groups_of(monkeypatch, size)
    values, (of_model, of_viewmats) = one_by_one()
    losses = jax.vmap(functools.partial(loss, compositor=compositor), in_axes=(None, 0))

    def total(model, viewmats):
        each = losses(model, viewmats)
        return jnp.sum(each), each

    differentiate = jax.jit(jax.grad(total, argnums=(0, 1), has_aux=True))
    (of_sum, of_each), found = differentiate(some_model(), VIEWMATS)
    np.testing.assert_allclose(found, values, rtol=1e-6)
    assert_all_close(of_each, of_viewmats, 2e-5, 2e-5)
    assert_all_close(of_sum, jax.tree.map(lambda x: x.sum(0), of_model), 2e-5, 2e-5)
    each = jax.vmap(jax.grad(functools.partial(loss, compositor=compositor)), in_axes=(None, 0))
    assert_all_close(jax.jit(each)(some_model(), VIEWMATS), of_model, 2e-5, 2e-5)


@pytest.mark.parametrize("size", [1, 5])
@pytest.mark.parametrize("compositor", COMPOSITORS)
def test_two_models_from_several_cameras(monkeypatch, compositor, size):
    in_groups_of(monkeypatch, size)
    models = some_models()
    one = jax.jit(jax.value_and_grad(loss))
    each = [[one(jax.tree.map(lambda x, k=k: x[k], models), viewmat) for viewmat in VIEWMATS[:3]] for k in range(2)]
    wanted = jnp.asarray([[value for value, _ in row] for row in each])
    gradients = [jax.tree.map(lambda *x: sum(x), *(gradient for _, gradient in row)) for row in each]
    of_view = functools.partial(loss, compositor=compositor)
    of_pairs = jax.vmap(jax.vmap(of_view, in_axes=(None, 0)), in_axes=(0, None))

    def total(models):
        found = of_pairs(models, VIEWMATS[:3])
        return jnp.sum(found), found

    of_models, found = jax.jit(jax.grad(total, has_aux=True))(models)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    assert_all_close(of_models, jax.tree.map(lambda *x: jnp.stack(x), *gradients), 2e-5, 2e-5)
    # One camera; and the outer axis last.
    last = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), models)
    of_one = jax.jit(jax.vmap(jax.value_and_grad(of_view), in_axes=(-1, None)))(last, VIEWMATS[0])
    first = [row[0] for row in each]
    assert_all_close(of_one, jax.tree.map(lambda *x: jnp.stack(x), *first), 2e-5, 2e-5)


@pytest.mark.parametrize("statistic", quick_then_long(["position"], ["screen", "center"]))
def test_the_statistic_of_each_view_is_its_own(monkeypatch, statistic):
    in_groups_of(monkeypatch, 2)
    model = a2tg.Model(some_gaussians())
    settings = RenderSettings(capacity=1024)

    def gradients(viewmat):
        camera = Camera(viewmat, CAMERA.K, CAMERA.width, CAMERA.height)
        brightness = lambda model, output: jnp.sum(output.color**2)  # noqa: E731
        found = a2tg.view_gradients(brightness, model, camera, settings=settings, statistic=statistic)
        return found.value, found.norms, found.is_visible, found.num_pairs, found.gradient.gaussians

    one = jax.jit(gradients)
    wanted = jax.tree.map(lambda *each: jnp.stack(each), *map(one, VIEWMATS))
    found = jax.jit(jax.vmap(gradients))(VIEWMATS)
    assert wanted[1].max() > 0.1 and wanted[2].any()
    assert_all_close(found, wanted, 2e-5, 2e-5)


@pytest.mark.parametrize("compositor", quick_then_long(["native"], ["xla", "cuda"]))
def test_an_overflow_is_that_of_its_view(monkeypatch, compositor):
    in_groups_of(monkeypatch, 2)
    # From afar, all splats are in one tile; near by, each is in many.
    near = CAMERA.viewmat.at[2, 3].add(-0.3)
    far = CAMERA.viewmat.at[2, 3].add(20.0)
    viewmats = jnp.stack([far, near, far])
    cameras = [Camera(viewmat, CAMERA.K, CAMERA.width, CAMERA.height) for viewmat in viewmats]
    counts = [a2tg.plan_render(some_gaussians(), [camera], settings=RenderSettings(tile_size=1)) for camera in cameras]
    assert counts[1].capacity > counts[0].capacity
    settings = RenderSettings(tile_size=1, capacity=counts[0].capacity, compositor=compositor)

    def show(viewmat):
        camera = Camera(viewmat, CAMERA.K, CAMERA.width, CAMERA.height)
        return render_image(some_gaussians(), camera, background=(0.1, 0.2, 0.3), settings=settings)

    found = jax.jit(jax.vmap(show))(viewmats)
    assert found.overflow.tolist() == [False, True, False]
    np.testing.assert_allclose(found.color[1], np.broadcast_to(np.float32([0.1, 0.2, 0.3]), found.color[1].shape))
    np.testing.assert_allclose(found.color[0], jax.jit(show)(far).color, atol=1e-6)
    np.testing.assert_array_equal(found.color[0], found.color[2])
    assert found.alpha[0].max() > 0.1


def test_forward_mode_goes_through_groups(monkeypatch):
    in_groups_of(monkeypatch, 2)
    of_view = functools.partial(loss, some_model(), compositor="autodiff")
    tangents = jnp.ones_like(VIEWMATS) * 0.01
    found = jax.jvp(jax.vmap(of_view), (VIEWMATS,), (tangents,))
    wanted = [jax.jvp(of_view, (viewmat,), (tangents[0],)) for viewmat in VIEWMATS]
    assert_all_close(found, tuple(jnp.stack(each) for each in zip(*wanted, strict=True)), 2e-5, 2e-5)


@pytest.mark.usefixtures("threads")
def test_sizes_of_groups():
    set_num_threads(2)
    sizes = {(64, 10_000): 8, (6, 10_000): 6, (64, 100): 64, (10, 30_000): 2, (7, 20_000): 4, (9, 10**6): 1}
    assert {views: view_groups.group_size(*views) for views in sizes} == sizes


@pytest.mark.usefixtures("threads")
def test_a_call_of_a_batch_has_every_member_once():
    """Shared arrays have length 1; nested batches have several axes; a member has one thread if there are enough."""
    threads = []

    def handler(arguments, results):
        x, y = arguments
        threads.append(ffi.threads_of_handler())
        results[0][...] = x + y
        results[1][...] = y.sum()

    name = ffi.registered("test batch", None, 1, lambda: handler)
    call = lambda x, y: ffi.call(name, [((3,), jnp.float32), ((), jnp.float32)], x, y)  # noqa: E731
    x = jnp.arange(12.0).reshape(4, 3)
    y = jnp.arange(6.0).reshape(3, 2) * 100
    set_num_threads(3)
    pairs = jax.jit(jax.vmap(jax.vmap(call, in_axes=(0, None)), in_axes=(None, 1)))(x, y)
    np.testing.assert_array_equal(pairs[0], x[None] + y.T[:, None])
    np.testing.assert_array_equal(pairs[1], np.broadcast_to(np.asarray(y.sum(0))[:, None], (2, 4)))
    assert threads == [1] * 8
    threads.clear()
    two = jax.jit(jax.vmap(call, in_axes=(0, None)))(x[:2], y[:, 1])
    np.testing.assert_array_equal(two[0], x[:2] + y[None, :, 1])
    assert threads == [3] * 2
    none = jax.jit(jax.vmap(call, in_axes=(0, None)))(x[:0], y[:, 1])
    assert none[0].shape == (0, 3) and len(threads) == 2


@pytest.mark.usefixtures("threads")
def test_an_error_in_a_batch_reaches_the_caller():
    def handler(arguments, results):
        results[0][...] = arguments[0]
        if arguments[0][0] == 2:
            raise RuntimeError("the member 2")

    name = ffi.registered("test batch with an error", None, 1, lambda: handler)
    set_num_threads(2)
    batch = jax.vmap(lambda x: ffi.call(name, [((1,), jnp.float32)], x))
    with pytest.raises(jax.errors.JaxRuntimeError, match="the member 2"):
        jax.block_until_ready(batch(jnp.arange(5.0)[:, None]))
    assert ffi.threads_of_handler() == 2
