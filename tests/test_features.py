"""Images of features: any number of channels, of either sign, with the weights of the picture and exact gradients."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from scenes_random import as_camera, as_gaussians, as_textures, draw_scene, draw_smooth_scene, quick_then_long

from a2tg_jax import (
    Appearance,
    Model,
    Renderer,
    RenderSettings,
    pytree,
    render_appearance,
    render_image,
    view_gradients,
)

SCENE = draw_scene(4, num=8, width=11, height=9)
SMOOTH = draw_smooth_scene(53, width=8, height=8)


def some_features(num: int, channels: int) -> np.ndarray:
    return np.random.default_rng(channels).normal(size=(num, channels))


def weighted(scene, features, background):
    """Σ weights·features + transmittance·background, of the oracle's weights: [H, W, D]."""
    image = oracle.render(scene)
    return np.einsum("nhw,nd->hwd", image.weights, features) + (1 - image.alpha)[..., None] * background


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    ("channels", "compositor"),
    quick_then_long([(8, "native")], [(1, "native"), (64, "native"), (64, "xla"), (8, "autodiff")]),
)
def test_features_are_weighted_as_colours_are(channels, compositor):
    """On a scene with textures, whose alpha counts; the gradients in features and background are the weights."""
    scene = SMOOTH
    features = some_features(6, channels)
    background = np.linspace(-1, 1, channels)
    cotangent = np.random.default_rng(1).normal(size=(8, 8, channels))
    gaussians = as_gaussians(scene, "float64")
    camera = as_camera(scene, "float64")
    textures = as_textures(scene, "float64")
    settings = RenderSettings(capacity=1024, compositor=compositor)

    def loss(features, background):
        shown = {"features": features, "background": background, "settings": settings}
        output = render_image(gaussians, camera, textures, **shown)
        return jnp.sum(jnp.asarray(cotangent) * output.color), output

    differentiate = jax.jit(jax.value_and_grad(loss, argnums=(0, 1), has_aux=True))
    (_, output), (d_features, d_background) = differentiate(jnp.asarray(features), jnp.asarray(background))
    expected = oracle.render(scene)
    assert output.color.shape == (8, 8, channels) and output.color.min() < 0
    np.testing.assert_allclose(output.color, weighted(scene, features, background), atol=1e-10)
    np.testing.assert_allclose(output.normal, expected.normal, atol=1e-10)
    np.testing.assert_allclose(d_features, np.einsum("nhw,hwd->nd", expected.weights, cotangent), atol=1e-9)
    left = np.einsum("hw,hwd->d", 1 - expected.alpha, cotangent)
    np.testing.assert_allclose(d_background, left, atol=1e-9)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("channels", quick_then_long([8], [64]))
def test_gradients_in_geometry_are_those_of_differences(channels):
    """Along one direction of all the Gaussians' numbers."""
    features = jnp.asarray(some_features(6, channels))
    camera = as_camera(SMOOTH, "float64")
    settings = RenderSettings(capacity=1024, compositor="native")

    @jax.jit
    @jax.value_and_grad
    def differentiate(gaussians):
        return jnp.sum(render_image(gaussians, camera, features=features, settings=settings).color ** 2)

    gaussians = as_gaussians(SMOOTH, "float64")
    step = 3e-6
    rng = np.random.default_rng(0)
    direction = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), gaussians)
    ahead, behind = (
        differentiate(jax.tree.map(lambda x, d, by=by: x + by * d, gaussians, direction))[0] for by in (step, -step)
    )
    _, gradient = differentiate(gaussians)
    slope = sum(jnp.sum(a * b) for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True))
    np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-6)
    assert not jnp.any(gradient.sh) and jnp.all(jnp.any(gradient.means != 0, axis=1))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("compositor", ["native", "xla"])
def test_a_gradient_in_features_alone_is_the_same(compositor):
    """Its backward pass computes nothing else."""
    features = jnp.asarray(some_features(6, 3))
    gaussians = as_gaussians(SMOOTH, "float64")
    textures = as_textures(SMOOTH, "float64")
    settings = RenderSettings(capacity=1024, compositor=compositor)
    camera = as_camera(SMOOTH, "float64")

    def loss(features, gaussians, textures):
        output = render_image(gaussians, camera, textures, features=features, settings=settings)
        return jnp.sum(output.color**2) + jnp.sum(output.depth)

    alone = jax.jit(jax.grad(loss))
    beside = jax.jit(jax.grad(loss, argnums=(0, 1)))
    found = alone(features, gaussians, textures)
    assert jnp.any(found)
    np.testing.assert_allclose(found, beside(features, gaussians, textures)[0], rtol=1e-12, atol=1e-13)


@pytest.mark.long
@pytest.mark.usefixtures("gpu_kernels")
@pytest.mark.parametrize("argnums", [(0, 1), (0,)])
def test_gpu_kernels_show_features(argnums):
    scene = draw_scene(4, num=4, width=8, height=8)
    gaussians = as_gaussians(scene, "float32")
    camera = as_camera(scene, "float32")
    features = jnp.asarray(some_features(4, 5), jnp.float32)

    def loss(features, gaussians, compositor):
        settings = RenderSettings(capacity=256, compositor=compositor)
        output = render_image(gaussians, camera, features=features, settings=settings)
        return jnp.sum(output.color**2) + jnp.sum(output.depth)

    found, wanted = (jax.grad(loss, argnums)(features, gaussians, name) for name in ("cuda", "xla"))
    compare = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-3)
    jax.tree.map(compare, found, wanted)


def test_features_of_a_model():
    """Of the rows that exist; the model's background is a colour, so the background of features is 0."""
    gaussians = as_gaussians(SCENE, "float32")
    camera = as_camera(SCENE, "float32")
    features = jnp.asarray(some_features(8, 4), jnp.float32)
    model = Model(gaussians, num_live=jnp.int32(5))
    expected = render_image(gaussians[:5], camera, features=features[:5]).color
    np.testing.assert_array_equal(model.render(camera, features=features).color, expected)
    none = render_image(gaussians[:0], camera, features=features[:0], background=jnp.arange(4.0))
    np.testing.assert_array_equal(none.color, np.broadcast_to(np.arange(4), (9, 11, 4)))


@pytree
class Two(Appearance):
    """A custom appearance with two channels."""

    num_colors = 2

    def own_colors(self, gaussians, camera, degree):
        return jnp.stack([gaussians.opacities, -gaussians.opacities], axis=1)

    def shade(self, numbers, values, u, v):
        return (0.1 * u, -0.1 * u), None


def test_an_appearance_may_have_other_colours_than_three():
    gaussians = as_gaussians(SCENE, "float32")
    camera = as_camera(SCENE, "float32")
    color = render_appearance(gaussians, camera, Two()).color
    assert color.shape == (9, 11, 2) and jnp.abs(color).max() > 0.1
    np.testing.assert_allclose(color[..., 0], -color[..., 1], atol=1e-6)
    model = Model(gaussians, Two(), background=(1.0, 1.0, 1.0))  # A colour, which two channels do not have.
    np.testing.assert_array_equal(model.render(camera).color, color)
    np.testing.assert_array_equal(Renderer(model)(camera).color, color)
    shifted = Renderer(model, background=(0.5, 0.25))(camera)
    added = np.multiply.outer(1 - np.asarray(shifted.alpha), [0.5, 0.25])
    np.testing.assert_allclose(shifted.color - color, added, atol=1e-6)


@pytest.mark.parametrize("background", [None, (0.5, 0.25)])
def test_gradients_of_views_take_other_colours_than_three(background):
    gaussians = as_gaussians(SCENE, "float32")
    camera = as_camera(SCENE, "float32")
    model = Model(gaussians, Two(), background=(1.0, 1.0, 1.0))
    found = view_gradients(lambda _, output: jnp.mean(output.color), model, camera, background=background)
    drawn = model.render(camera, background=background)
    np.testing.assert_allclose(found.value, jnp.mean(drawn.color), rtol=1e-6)


def test_a_background_of_traced_numbers():
    """The image is linear in the background, with the transmittance as its factor."""
    gaussians = as_gaussians(SCENE, "float32")
    camera = as_camera(SCENE, "float32")

    def total(red):
        return jnp.sum(render_image(gaussians, camera, background=[red, 0.0, 0.0]).color)

    transmittance = 1 - render_image(gaussians, camera).alpha
    np.testing.assert_allclose(jax.grad(total)(0.5), jnp.sum(transmittance), rtol=1e-5)


def test_mistakes_are_named():
    gaussians = as_gaussians(SCENE, "float32")
    camera = as_camera(SCENE, "float32")
    features = jnp.asarray(some_features(8, 5), jnp.float32)
    for given, words in (
        ({"features": features[:7]}, r"features must be \[8, D\]; got \[7, 5\]"),
        ({"features": jnp.zeros((8, 5), jnp.int32)}, "features must be floats; got int32"),
        ({"features": features[:, :0]}, r"features must be float32 as the means are, D >= 1; got float32\[8, 0\]"),
        ({"features": features, "background": (0, 0, 0)}, r"background must be \[5\]; got \[3\]"),
    ):
        with pytest.raises(ValueError, match=words):
            render_image(gaussians, camera, **given)

    @pytree
    class Odd(Appearance):
        def shade(self, numbers, values, u, v):
            return None

    with pytest.raises(ValueError, match=r"Odd\.shade must return \(residual, factor\): .*; it returned None"):
        render_appearance(gaussians, camera, Odd(features=features))
