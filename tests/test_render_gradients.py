"""Gradients of the renderer against central differences of the oracle, and finite gradients on degenerate scenes."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from oracle import DEFAULT_RULES, OFFICIAL, Float, Rules, Scene
from scenes_random import (
    CAPACITY,
    as_camera,
    as_gaussians,
    as_settings,
    as_textures,
    draw_scene,
    draw_smooth_scene,
)

from a2tg_jax import (
    Camera,
    Gaussians,
    RenderSettings,
    Textures,
    combine,
    partition,
    plan_render,
    render_image,
    texture_arrays,
    textures_from_arrays,
)

EPSILON = 3e-6
"""Step of the central differences: losses of about 50 round off to 50·1e-16/ε = 2e-9, and steps of 1e-6 and 1e-5 were
seen to give the same quotients to 2e-6 of the largest."""
CLEARANCE = 1e-3
"""Relative distance of every decision and kink from its threshold: hundreds of steps, so that none is crossed."""
SMOOTH_SEEDS = [53, 161]
"""Scenes found to keep that clearance under the default rules and under the official ones."""
FIELDS = ("color", "alpha", "depth", "normal")
LEAVES = ["means", "quats", "log_scales", "logit_opacities", "sh", "viewmat", "K", "background"]


class Inputs(NamedTuple):
    """Everything that the image can be differentiated by."""

    gaussians: Gaussians
    textures: Textures | None
    viewmat: jax.Array
    K: jax.Array
    background: jax.Array


def as_inputs(scene: Scene, dtype: str) -> tuple[Inputs, Inputs]:
    """The scene's differentiable inputs, and the places of its textures."""
    textures = as_textures(scene, dtype)
    camera = as_camera(scene, dtype)
    background = jnp.asarray(scene.background, dtype)
    return partition(Inputs(as_gaussians(scene, dtype), textures, camera.viewmat, camera.K, background))


def draw_weights(scene: Scene) -> dict[str, Float]:
    """Fixed random weights of every channel of every output."""
    rng = np.random.default_rng(0)
    shape = (scene.height, scene.width)
    channels = {"color": (3,), "alpha": (), "depth": (), "normal": (3,)}
    return {name: rng.normal(size=(*shape, *channels[name])) for name in FIELDS}


@functools.cache
def jitted_gradient(settings: RenderSettings) -> Callable[..., Any]:
    """The loss and its gradient as a function of (inputs, places, weights) and the static image size."""

    def loss(inputs: Inputs, places: Inputs, weights: dict[str, jax.Array], size: tuple[int, int]):
        return weighted_sum(combine(inputs, places), weights, size, settings)

    return jax.jit(jax.value_and_grad(loss), static_argnums=3)


def weighted_sum(inputs: Inputs, weights, size: tuple[int, int], settings) -> jax.Array:
    """The weighted sum of all outputs."""
    camera = Camera(inputs.viewmat, inputs.K, *size)
    output = render_image(inputs.gaussians, camera, inputs.textures, background=inputs.background, settings=settings)
    return sum(jnp.sum(getattr(output, name) * weight) for name, weight in weights.items())


def package_gradient(scene: Scene, dtype: str, settings: RenderSettings) -> tuple[jax.Array, Inputs]:
    """The loss and its gradient, under jit."""
    inputs, places = as_inputs(scene, dtype)
    weights = {name: jnp.asarray(weight, dtype) for name, weight in draw_weights(scene).items()}
    settings = dataclasses.replace(settings, capacity=CAPACITY)
    loss, gradient = jitted_gradient(settings)(inputs, places, weights, (scene.width, scene.height))
    return loss, combine(gradient, places)


def oracle_loss(scene: Scene, rules: Rules, name: str, texels: list[Float] | None = None) -> Callable[[Float], float]:
    """The same weighted sum of the oracle's outputs, as a function of one field of the scene.

    `texels` replace the lookups where given. Only the layers of splats whose own values changed are made anew.
    """
    weights, base = draw_weights(scene), getattr(scene, name)
    layers = oracle.splat_layers(scene, rules, texels)

    def loss(value: Float | list[Float]) -> float:
        moved = scene._replace(**{name: value})
        is_splatwise = name not in ("viewmat", "K", "background")
        if name == "textures" and rules.alpha == "global-maximum":
            is_splatwise = largest_alpha(value) == largest_alpha(base)
        changed = [i for i in range(len(layers)) if not is_splatwise or np.any(value[i] != base[i])]
        fresh = list(layers)
        for i in changed:
            fresh[i] = oracle.splat_layer(moved, i, rules, None if texels is None else texels[i])
        image = oracle.composite(fresh, moved.background)
        return sum(np.sum(getattr(image, field) * weight) for field, weight in weights.items())

    return loss


def largest_alpha(textures: list[Float]) -> float:
    return max(texture[..., 3].max() for texture in textures)


def differences(value: Float, loss: Callable[[Float], float]) -> Float:
    """Central difference quotient of `loss` by every entry of `value`, one at a time."""
    gradient = np.zeros_like(value)
    for index in np.ndindex(value.shape):
        ends = []
        for step in (EPSILON, -EPSILON):
            moved = value.copy()
            moved[index] += step
            ends.append(loss(moved))
        gradient[index] = (ends[0] - ends[1]) / (2 * EPSILON)
    return gradient


def assert_gradients_close(gradient: Any, expected: Float, name: str):
    """Agreement to 1e-5 of the leaf's largest entry."""
    scale = abs(expected).max()
    assert scale > 1e-3, f"{name} has no gradient to compare"
    np.testing.assert_allclose(np.asarray(gradient) / scale, expected / scale, atol=1e-5, rtol=0, err_msg=name)


def smooth_scene(seed: int, rules: Rules) -> Scene:
    """A scene whose every pixel keeps clear of thresholds and kinks, and in which every splat shows."""
    scene = draw_smooth_scene(seed)
    image = oracle.render(scene, rules)
    assert min(image.margin.min(), image.kink.min()) > CLEARANCE
    rgb = np.concatenate([texture[..., :3].ravel() for texture in scene.textures])
    assert min(abs(rgb).min(), abs(rgb - 1).min()) > 10 * EPSILON
    assert (image.weights > 0).any(axis=(1, 2)).all()
    return scene


def leaf_of(gradient: Inputs, name: str) -> jax.Array:
    """The gradient of one leaf by its name in the oracle's scene."""
    return getattr(gradient, name) if hasattr(gradient, name) else getattr(gradient.gaussians, name)


def assert_leaves_match(gradient: Inputs, scene: Scene, rules: Rules, texels: list[Float] | None = None):
    """Every leaf but the textures, by differences with the given lookups or, without them, with lookups that move."""
    for name in LEAVES:
        expected = differences(getattr(scene, name), oracle_loss(scene, rules, name, texels))
        assert_gradients_close(leaf_of(gradient, name), expected, name)


def assert_textures_match(gradient: Inputs, scene: Scene, rules: Rules):
    """Every texel of every texture, by differences."""
    loss = oracle_loss(scene, rules, "textures")
    for i, found in enumerate(texture_arrays(gradient.textures)):

        def loss_of_one(texture: Float, i: int = i) -> float:
            return loss([*scene.textures[:i], texture, *scene.textures[i + 1 :]])

        assert_gradients_close(found, differences(scene.textures[i], loss_of_one), f"texture {i}")


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("compositor", ["native", "xla"])
@pytest.mark.parametrize("seed", SMOOTH_SEEDS)
def test_every_leaf_against_differences(seed, compositor):
    scene = smooth_scene(seed, DEFAULT_RULES)
    _, gradient = package_gradient(scene, "float64", RenderSettings(compositor=compositor))
    assert_leaves_match(gradient, scene, DEFAULT_RULES)
    assert_textures_match(gradient, scene, DEFAULT_RULES)


@pytest.mark.usefixtures("x64")
def test_official_gradients_stop_at_the_lookup():
    """The official preset has the gradient with what the lookups gave held fixed."""
    scene = smooth_scene(SMOOTH_SEEDS[0], OFFICIAL)
    texels = [layer.texel for layer in oracle.splat_layers(scene, OFFICIAL)]
    _, gradient = package_gradient(scene, "float64", RenderSettings.official())
    assert_leaves_match(gradient, scene, OFFICIAL, texels)
    assert_textures_match(gradient, scene, OFFICIAL)


@pytest.mark.usefixtures("x64")
def test_gradients_without_textures_against_differences():
    scene = smooth_scene(SMOOTH_SEEDS[0], DEFAULT_RULES)._replace(textures=None)
    _, gradient = package_gradient(scene, "float64", RenderSettings())
    assert_leaves_match(gradient, scene, DEFAULT_RULES)


@pytest.mark.usefixtures("x64")
def test_gradients_do_not_depend_on_tiles():
    """Nor on who composites how many at once; the last row of the viewmat and the buckets' padding have none."""
    scene = draw_scene(3)
    _, expected = package_gradient(scene, "float64", as_settings(tile_size=32))
    np.testing.assert_array_equal(expected.viewmat[3], 0)
    for settings in (as_settings(), as_settings(compositor="xla"), as_settings(compositor="xla", tile_batch=0)):
        _, gradient = package_gradient(scene, "float64", settings)
        for one, other in zip(jax.tree.leaves(expected), jax.tree.leaves(gradient), strict=True):
            np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-9 * abs(np.asarray(one)).max())

    repacked = textures_from_arrays(texture_arrays(expected.textures))
    for bucket, without_padding in zip(expected.textures.buckets, repacked.buckets, strict=True):
        np.testing.assert_allclose(np.sum(abs(bucket[..., :3])), np.sum(abs(without_padding[..., :3])))


@pytest.mark.usefixtures("x64")
def test_an_eager_gradient_is_the_planned_one():
    scene = draw_smooth_scene(SMOOTH_SEEDS[0])
    inputs, places = as_inputs(scene, "float64")
    weights = {name: jnp.asarray(weight) for name, weight in draw_weights(scene).items()}

    def loss(inputs: Inputs) -> jax.Array:
        return weighted_sum(combine(inputs, places), weights, (scene.width, scene.height), RenderSettings())

    eager = jax.grad(loss)(inputs)
    planned = plan_render(inputs.gaussians, [as_camera(scene, "float64")], as_textures(scene, "float64"))
    _, jitted = jitted_gradient(planned)(inputs, places, weights, (scene.width, scene.height))
    for one, other in zip(jax.tree.leaves(eager), jax.tree.leaves(jitted), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-9 * abs(np.asarray(one)).max())


@pytest.mark.usefixtures("x64")
def test_float32_gradients_are_those_of_float64():
    """To 1e-3 of the largest entry: float32 carries about 1e-7 through a few thousand sums and divisions."""
    scene = smooth_scene(SMOOTH_SEEDS[1], DEFAULT_RULES)
    (_, exact), (_, rounded) = (package_gradient(scene, dtype, RenderSettings()) for dtype in ("float64", "float32"))
    floats, _ = zip(partition(exact), partition(rounded), strict=True)
    for one, other in zip(*map(jax.tree.leaves, floats), strict=True):
        assert other.dtype == jnp.float32
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-3 * abs(np.asarray(one)).max())


def degenerate_scene() -> Scene:
    """A random scene some of whose splats have no rotation, no extent, no or full opacity, or sit on the camera."""
    scene = draw_scene(11)
    camera_center = -scene.viewmat[:3, :3].T @ scene.viewmat[:3, 3]
    scene.quats[0] = 0
    scene.means[1] = camera_center
    scene.means[2] = camera_center + scene.viewmat[0, :3]
    scene.means[3] = camera_center + 0.2 * scene.viewmat[2, :3]
    scene.log_scales[4] = [-30, -30]
    scene.log_scales[5] = [15, 15]
    scene.log_scales[6] = [10, -20]
    scene.logit_opacities[7:11] = [-100, -30, 30, 100]
    scene.means[12] = camera_center + 1e6 * scene.viewmat[2, :3]
    scene.textures[13][...] = 0
    return scene


@pytest.mark.parametrize("settings", [RenderSettings(), RenderSettings.official()], ids=["default", "official"])
@pytest.mark.parametrize("draw", [lambda: draw_scene(8), degenerate_scene], ids=["random", "degenerate"])
def test_values_and_gradients_are_finite(draw, settings):
    value, gradient = package_gradient(draw(), "float32", settings)
    assert np.isfinite(value)
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        np.testing.assert_array_equal(np.isfinite(leaf), True, err_msg=jax.tree_util.keystr(path))
