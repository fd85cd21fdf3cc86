"""Gradients of the renderer against differences of the oracle, the statistics of densification, and finite gradients on
degenerate scenes."""

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
    assert_all_close,
    draw_scene,
    draw_smooth_scene,
    quick_then_long,
)

import a2tg_jax as a2tg
from a2tg_jax.rasterize.views import render_traced

EPSILON = 3e-6
"""Step of the central differences: losses of about 50 round off to 50·1e-16/ε = 2e-9, and steps of 1e-6 and 1e-5 were
seen to give the same quotients to 2e-6 of the largest."""
CLEARANCE = 1e-3
"""Relative distance of every decision and kink from its threshold: hundreds of steps, so that none is crossed."""
SMOOTH_SEEDS = [53, 161]
"""Scenes found to keep that clearance under the default rules and under the official ones."""
CHANNELS = {"color": (3,), "alpha": (), "depth": (), "normal": (3,)}
LEAVES = ["means", "quats", "log_scales", "logit_opacities", "sh", "viewmat", "K", "background"]
long = pytest.mark.long


class Inputs(NamedTuple):
    """Everything that the image can be differentiated by."""

    gaussians: a2tg.Gaussians
    textures: a2tg.Textures | None
    viewmat: jax.Array
    K: jax.Array
    background: jax.Array


def as_inputs(scene: Scene, dtype: str) -> tuple[Inputs, Inputs]:
    """The scene's differentiable inputs, and the places of its textures."""
    camera = as_camera(scene, dtype)
    background = jnp.asarray(scene.background, dtype)
    inputs = as_gaussians(scene, dtype), as_textures(scene, dtype), camera.viewmat, camera.K, background
    return a2tg.partition(Inputs(*inputs))


def draw_weights(scene: Scene) -> dict[str, Float]:
    """Fixed random weights of every channel of every output."""
    rng = np.random.default_rng(0)
    return {name: rng.normal(size=(scene.height, scene.width, *shape)) for name, shape in CHANNELS.items()}


def weighted_sum(inputs: Inputs, weights, size: tuple[int, int], settings) -> jax.Array:
    camera = a2tg.Camera(inputs.viewmat, inputs.K, *size)
    output = a2tg.render_image(
        inputs.gaussians, camera, inputs.textures, background=inputs.background, settings=settings
    )
    return sum(jnp.sum(getattr(output, name) * weight) for name, weight in weights.items())


@functools.cache
def jitted_gradient(settings: a2tg.RenderSettings) -> Callable[..., Any]:
    """The loss and its gradient as a function of (inputs, places, weights) and the static image size."""

    def loss(inputs: Inputs, places: Inputs, weights: dict[str, jax.Array], size: tuple[int, int]):
        return weighted_sum(a2tg.combine(inputs, places), weights, size, settings)

    return jax.jit(jax.value_and_grad(loss), static_argnums=3)


def package_gradient(scene: Scene, dtype: str, settings: a2tg.RenderSettings) -> tuple[jax.Array, Inputs]:
    inputs, places = as_inputs(scene, dtype)
    weights = {name: jnp.asarray(weight, dtype) for name, weight in draw_weights(scene).items()}
    settings = dataclasses.replace(settings, capacity=CAPACITY)
    loss, gradient = jitted_gradient(settings)(inputs, places, weights, (scene.width, scene.height))
    return loss, a2tg.combine(gradient, places)


def oracle_loss(scene: Scene, rules: Rules, name: str, texels: list[Float] | None = None) -> Callable[[Float], float]:
    """The same weighted sum of the oracle's outputs, as a function of one field of the scene.

    `texels` replace the lookups where given. Only the layers of splats whose own values changed are computed again.
    """
    weights = draw_weights(scene)
    base = getattr(scene, name)
    layers = oracle.splat_layers(scene, rules, texels)
    largest_alpha = lambda textures: max(texture[..., 3].max() for texture in textures)  # noqa: E731

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


def differences(value: Float, loss: Callable[[Float], float]) -> Float:
    """Central difference quotient of `loss` by every entry of `value`, one at a time."""
    gradient = np.zeros_like(value)
    for index in np.ndindex(value.shape):
        step = np.zeros_like(value)
        step[index] = EPSILON
        gradient[index] = (loss(value + step) - loss(value - step)) / (2 * EPSILON)
    return gradient


def assert_gradients_close(gradient: Any, expected: Float, name: str):
    """Agreement to 1e-5 of the leaf's largest entry."""
    scale = abs(expected).max()
    assert scale > 1e-3, f"{name} has no gradient to compare"
    np.testing.assert_allclose(np.asarray(gradient) / scale, expected / scale, atol=1e-5, rtol=0, err_msg=name)


@functools.cache
def smooth_scene(seed: int, rules: Rules) -> Scene:
    """A scene whose every pixel keeps clear of thresholds and kinks, and in which every splat shows."""
    scene = draw_smooth_scene(seed)
    image = oracle.render(scene, rules)
    assert min(image.margin.min(), image.kink.min()) > CLEARANCE
    rgb = np.concatenate([texture[..., :3].ravel() for texture in scene.textures])
    assert min(abs(rgb).min(), abs(rgb - 1).min()) > 10 * EPSILON
    assert (image.weights > 0).any(axis=(1, 2)).all()
    return scene


def expected_gradient(scene: Scene, rules: Rules, texels: list[Float] | None = None) -> dict[str, Float]:
    """Differences by every leaf, with the given lookups or, without them, with lookups that move; and by each texel."""
    found = {name: differences(getattr(scene, name), oracle_loss(scene, rules, name, texels)) for name in LEAVES}
    if scene.textures is None:
        return found
    loss = oracle_loss(scene, rules, "textures")
    for i, texture in enumerate(scene.textures):

        def loss_of_one(texture: Float, i: int = i) -> float:
            return loss([*scene.textures[:i], texture, *scene.textures[i + 1 :]])

        found[f"texture {i}"] = differences(texture, loss_of_one)
    return found


@functools.cache
def expected_by_default(seed: int) -> dict[str, Float]:
    """Differences of a smooth scene under the default rules, which several tests compare with."""
    return expected_gradient(smooth_scene(seed, DEFAULT_RULES), DEFAULT_RULES)


def assert_leaves_match(gradient: Inputs, expected: dict[str, Float]):
    """Every leaf and every texel."""
    leaves = {**vars(gradient.gaussians), **gradient._asdict()}
    found = {name: leaves[name] for name in LEAVES}
    if gradient.textures is not None:
        found |= {f"texture {i}": texels for i, texels in enumerate(a2tg.texture_arrays(gradient.textures))}
    assert found.keys() == expected.keys()
    for name, own in found.items():
        assert_gradients_close(own, expected[name], name)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    ("seed", "compositor"),
    quick_then_long([(53, "native")], [(161, "native"), (53, "xla"), (161, "xla"), (53, "cuda"), (161, "cuda")]),
)
def test_every_leaf_against_differences(seed, compositor):
    scene = smooth_scene(seed, DEFAULT_RULES)
    _, gradient = package_gradient(scene, "float64", a2tg.RenderSettings(compositor=compositor))
    assert_leaves_match(gradient, expected_by_default(seed))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("compositor", quick_then_long(["native"], ["xla", "cuda"]))
def test_textures_of_another_extent_against_differences(compositor):
    rules = Rules(extent=1.5)
    scene = smooth_scene(SMOOTH_SEEDS[0], rules)
    _, gradient = package_gradient(scene, "float64", as_settings(rules, compositor=compositor))
    assert_leaves_match(gradient, expected_gradient(scene, rules))


@long
@pytest.mark.usefixtures("x64")
def test_official_gradients_stop_at_the_lookup_and_textures_may_be_missing():
    """The official preset has the gradient with what the lookups gave held fixed."""
    scene = smooth_scene(SMOOTH_SEEDS[0], OFFICIAL)
    texels = [layer.texel for layer in oracle.splat_layers(scene, OFFICIAL)]
    _, gradient = package_gradient(scene, "float64", a2tg.RenderSettings.official())
    assert_leaves_match(gradient, expected_gradient(scene, OFFICIAL, texels))
    plain = smooth_scene(SMOOTH_SEEDS[0], DEFAULT_RULES)._replace(textures=None)
    _, gradient = package_gradient(plain, "float64", a2tg.RenderSettings())
    assert_leaves_match(gradient, expected_gradient(plain, DEFAULT_RULES))


@long
@pytest.mark.usefixtures("x64")
def test_gradients_do_not_depend_on_tiles_or_on_how_they_are_called():
    """Nor on who composites how many at once; the last row of the viewmat and the buckets' padding have none."""
    scene = draw_scene(3, num=30, width=23, height=17)
    _, expected = package_gradient(scene, "float64", as_settings(tile_size=32))
    np.testing.assert_array_equal(expected.viewmat[3], 0)
    for settings in (as_settings(), as_settings(compositor="xla"), as_settings(compositor="xla", tile_batch=0)):
        assert_all_close(package_gradient(scene, "float64", settings)[1], expected, 1e-9, 1e-9)
    repacked = a2tg.textures_from_arrays(a2tg.texture_arrays(expected.textures))
    for bucket, without_padding in zip(expected.textures.buckets, repacked.buckets, strict=True):
        np.testing.assert_allclose(np.sum(abs(bucket[..., :3])), np.sum(abs(without_padding[..., :3])))

    inputs, places = as_inputs(scene, "float64")
    weights = {name: jnp.asarray(weight) for name, weight in draw_weights(scene).items()}
    size = scene.width, scene.height
    eager = jax.grad(lambda inputs: weighted_sum(a2tg.combine(inputs, places), weights, size, a2tg.RenderSettings()))(
        inputs
    )
    planned = a2tg.plan_render(inputs.gaussians, [as_camera(scene, "float64")], as_textures(scene, "float64"))
    assert_all_close(jitted_gradient(planned)(inputs, places, weights, size)[1], eager, 1e-9, 1e-9)


@pytest.mark.usefixtures("x64")
def test_float32_gradients_are_those_of_float64():
    """To 1e-3 of the largest entry: float32 carries about 1e-7 through a few thousand sums and divisions."""
    scene = smooth_scene(SMOOTH_SEEDS[1], DEFAULT_RULES)
    settings = a2tg.RenderSettings(compositor="native")
    (_, exact), (_, rounded) = (package_gradient(scene, dtype, settings) for dtype in ("float64", "float32"))
    (exact, _), (rounded, _) = a2tg.partition(exact), a2tg.partition(rounded)
    assert {leaf.dtype for leaf in jax.tree.leaves(rounded)} == {jnp.dtype("float32")}
    assert_all_close(rounded, exact, 0, 1e-3)


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


@pytest.mark.parametrize(
    "settings",
    [a2tg.RenderSettings(), pytest.param(a2tg.RenderSettings.official(), marks=long)],
    ids=["default", "official"],
)
def test_values_and_gradients_are_finite(settings):
    for scene in (draw_scene(8), degenerate_scene()):
        value, gradient = package_gradient(scene, "float32", settings)
        assert np.isfinite(value)
        for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
            np.testing.assert_array_equal(np.isfinite(leaf), True, err_msg=jax.tree_util.keystr(path))


@functools.cache
def jitted_statistic(settings: a2tg.RenderSettings, which: str, size: tuple[int, int]) -> Callable[..., Any]:
    """Gradient at the probe [N, 4] as a function of a2tg.Gaussians, camera, appearance, background and the colour's
    cotangent: the statistic, and the number of pixels composited."""

    def loss(probe, gaussians, viewmat, K, appearance, background, cotangent):
        given = gaussians, a2tg.Camera(viewmat, K, *size), appearance, background, settings
        output, _ = render_traced(*given, has_geometry=False, probe=probe, statistic=which)
        return jnp.sum(output.color * cotangent)

    return jax.jit(jax.grad(loss))


OTHERS = {
    "xla": (DEFAULT_RULES, as_settings(compositor="xla"), [(4, "position"), (4, "screen"), (4, "center")]),
    "xla, all tiles at once": (
        DEFAULT_RULES, as_settings(compositor="xla", tile_size=16, tile_batch=0), [(9, "position")]
    ),
    "official": (OFFICIAL, a2tg.RenderSettings.official(), [(4, "position"), (9, "position")]),
}  # fmt: skip
NATIVE = DEFAULT_RULES, as_settings(), [(4, "position"), (9, "position"), (4, "screen"), (4, "center")]


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    ("rules", "settings", "cases"),
    [pytest.param(*NATIVE, id="native"), *(pytest.param(*each, id=name, marks=long) for name, each in OTHERS.items())],
)
def test_statistics_are_the_closed_forms_of_the_oracle(rules, settings, cases):
    settings = dataclasses.replace(settings, capacity=CAPACITY)
    for seed, which in cases:
        scene = draw_scene(seed)
        cotangent = np.random.default_rng(seed).normal(size=(scene.height, scene.width, 3))
        inputs = Inputs(*(a2tg.combine(*as_inputs(scene, "float64"))))
        gradient = jitted_statistic(settings, which, (scene.width, scene.height))
        appearance = a2tg.Appearance(texture=a2tg.Texture(inputs.textures, options=settings.texture))
        given = inputs.gaussians, inputs.viewmat, inputs.K, appearance, inputs.background, jnp.asarray(cotangent)
        found = np.asarray(gradient(jnp.zeros((len(scene.means), 4)), *given))
        expected = oracle.gradient_statistic(scene, cotangent, rules, which)
        assert np.count_nonzero(expected) > 20
        np.testing.assert_allclose(found[:, :3], expected, rtol=1e-8, atol=1e-10 * expected.max())
        num_pixels = np.count_nonzero(oracle.render(scene, rules).weights, axis=(1, 2))
        np.testing.assert_array_equal(found[:, 3], num_pixels)
