"""Appearances other than textures against the oracle: one made up here, movable kernels, exponents and billboards."""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import oracle_appearances
import pytest
from oracle import DEFAULT_RULES
from scenes_random import as_camera, as_gaussians, draw_scene, draw_smooth_scene
from small_models import billboards, movable_kernels
from test_oracle import EDGE_ON, hand_scene
from test_render import errors
from test_render_gradients import CLEARANCE, assert_gradients_close, differences, draw_weights

from a2tg_jax import (
    Appearance,
    Camera,
    Exponents,
    RenderSettings,
    allocate_textures,
    pytree,
    render_appearance,
    shared,
    static,
)
from a2tg_jax.rasterize.views import render_traced

SIDE = 4
"""Of the billboards."""


@pytree(kw_only=True)
class Glossy(Appearance):
    """A highlight about an axis of each splat's own, and the falloff (1 + ρ/2k)^(−k) with a k of its own."""

    colors: jax.Array
    axes: jax.Array
    log_exponents: jax.Array
    has_low_pass: bool = static(default=True)

    def numbers(self, gaussians, camera):
        toward = gaussians.means - camera.center[None]
        lengths = jnp.linalg.norm(toward, axis=1) * jnp.linalg.norm(self.axes, axis=1)
        lobe = jnp.exp(3 * (jnp.sum(toward * self.axes, axis=1) / lengths - 1))
        return jnp.concatenate([self.colors * lobe[:, None], jnp.exp(self.log_exponents)[:, None]], axis=1)

    def shade(self, numbers, values, u, v):
        return (numbers[0], numbers[1] * u, numbers[2] * v * v), None

    def falloff(self, numbers, rho):
        return jnp.exp(-numbers[3] * jnp.log(1 + rho / (2 * numbers[3])))

    def cutoff(self, opacities):
        exponents = jnp.exp(self.log_exponents)
        return 2 * exponents * (jnp.exp(jnp.log(255 * opacities) / exponents) - 1)


@pytree(kw_only=True)
class Painted(Appearance):
    """A small network of the place and of a code per splat, which all splats share, multiplies and adds to colours."""

    codes: jax.Array
    first: jax.Array = shared()
    """[3, 3] weights of u, v and the code."""
    last: jax.Array = shared()
    """[3, 3] weights of the colours."""

    def numbers(self, gaussians, camera):
        weights = jnp.concatenate([self.first.reshape(-1), self.last.reshape(-1)])
        return jnp.concatenate([self.codes[:, None], jnp.broadcast_to(weights, (gaussians.num, 18))], axis=1)

    def shade(self, numbers, values, u, v):
        code, *weights = numbers
        first = weights[:9]
        last = weights[9:]
        neurons = [jnp.tanh(first[i] * u + first[i + 1] * v + first[i + 2] * code) for i in (0, 3, 6)]
        outputs = [sum(last[3 * i + color] * neuron for i, neuron in enumerate(neurons)) for color in range(3)]
        return (outputs[0],) * 3, None, tuple(1 + output for output in outputs)


def random_arrays(kind: str, num: int, dtype="float64") -> dict[str, np.ndarray]:
    """Arrays of an appearance. Numbers are of float32, so that both precisions start from the same ones."""
    rng = np.random.default_rng(1)
    arrays = {
        "glossy": lambda: {
            "colors": rng.normal(scale=0.3, size=(num, 3)), "axes": rng.normal(size=(num, 3)),
            "log_exponents": rng.uniform(0.5, 2, num),
        },
        "movable": lambda: {
            "centers": rng.normal(size=(num, 4, 2)), "sharpness": rng.uniform(0.05, 1, (num, 4)),
            "logit_opacities": rng.uniform(-1, 2, (num, 4)), "colors": rng.normal(scale=0.4, size=(num, 4, 3)),
        },
        "painted": lambda: {
            "codes": rng.normal(size=num), "first": rng.normal(size=(3, 3)), "last": rng.normal(size=(3, 3)),
        },
        "shaped": lambda: {"shapes": rng.normal(scale=1.5, size=num)},
        "billboard": lambda: {
            "alphas": rng.uniform(0.1, 0.9, (num, SIDE, SIDE, 1)), "rgb": rng.normal(size=(num, SIDE, SIDE, 3))
        },
    }[kind]()  # fmt: skip
    if kind == "billboard":
        arrays = {"texels": np.concatenate([arrays["rgb"], arrays["alphas"]], axis=-1)}
    return {name: np.asarray(values, np.float32).astype(dtype) for name, values in arrays.items()}


def glossy(arrays: dict, **options) -> Glossy:
    return Glossy(**jax.tree.map(jnp.asarray, arrays), **options)


def painted(arrays: dict) -> Painted:
    return Painted(**jax.tree.map(jnp.asarray, arrays))


def movable(arrays: dict) -> Appearance:
    return movable_kernels(**jax.tree.map(jnp.asarray, arrays))


def shaped(arrays: dict) -> Appearance:
    return Appearance(exponents=Exponents(jnp.asarray(arrays["shapes"])))


def pictured(arrays: dict) -> Appearance:
    texels = jnp.asarray(arrays["texels"])
    empty = allocate_textures(np.full((len(texels), 2), SIDE), dtype=texels.dtype)
    filled = empty.buckets[0].at[: len(texels)].set(texels)
    return billboards(pictures=dataclasses.replace(empty, buckets=(filled,)), side=SIDE)


class Case(NamedTuple):
    """An appearance, and the oracle's."""

    kind: str
    appearance: Callable[[dict], Appearance]
    is_gaussian_opaque: bool  # Whether the Gaussian's own opacity counts.
    smooth_seed: int  # Of a scene that keeps clear of thresholds and kinks.
    max_alpha: float = 0.99
    options: dict = {}  # noqa: RUF012 - of the oracle

    def arrays(self, scene, dtype="float64"):
        return random_arrays(self.kind, len(scene.means), dtype)


CASES = {
    "glossy": Case("glossy", glossy, True, 53),
    "glossy, no low-pass filter": Case(
        "glossy", functools.partial(glossy, has_low_pass=False, max_alpha=0.7), True, 1, 0.7, {"has_low_pass": False}
    ),
    "painted": Case("painted", painted, True, 53),
    "shaped": Case("shaped", shaped, True, 53),
    "movable kernels": Case("movable", movable, False, 1),
    "billboards": Case("billboard", pictured, False, 0),
}
FAST = ("movable kernels", "painted")
"""The cases whose gradients the default tests compare."""
some_long = [pytest.param(name, marks=[] if name in FAST else pytest.mark.long) for name in CASES]


def rendered(scene, appearance, compositor="auto", dtype="float64"):
    background = jnp.asarray(scene.background, dtype)
    camera = as_camera(scene, dtype)
    settings = RenderSettings(compositor=compositor)
    return render_appearance(as_gaussians(scene, dtype), camera, appearance, background=background, settings=settings)


def expected_image(case: Case, scene, arrays) -> oracle.Image:
    rules = DEFAULT_RULES._replace(max_alpha=case.max_alpha)
    show = functools.partial(getattr(oracle_appearances, case.kind), **case.options)
    return oracle_appearances.render_appearance(scene, arrays, show, rules)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("compositor", ["native", pytest.param("xla", marks=pytest.mark.long)])
@pytest.mark.parametrize("name", CASES)
def test_float64(name, compositor):
    case = CASES[name]
    scene = draw_scene(4)
    arrays = case.arrays(scene)
    expected = expected_image(case, scene, arrays)
    assert expected.margin.min() > 1e-9 and expected.alpha.max() > 0.9
    output = rendered(scene, case.appearance(arrays), compositor)
    for name, error in errors(output, expected, np.full(expected.alpha.shape, True)).items():
        assert error.max() < 1e-9, name


@pytest.mark.parametrize("name", some_long)
def test_float32(name):
    """As the textures' test of float32."""
    case = CASES[name]
    scene = draw_scene(4)
    expected = expected_image(case, scene, case.arrays(scene))
    is_compared = expected.margin > 1e-4
    assert is_compared.mean() > 0.95
    output = rendered(scene, case.appearance(case.arrays(scene, "float32")), dtype="float32")
    for name, error in errors(output, expected, is_compared).items():
        assert np.mean(error < 1e-5) >= 0.99, name
        assert np.mean(error < 3e-4) >= 0.999, name


@functools.cache
def expected_gradients(name: str):
    """The oracle's gradients by differences: of the appearance, of the Gaussians, and of the camera, on which the
    numbers may depend."""
    case = CASES[name]
    scene = draw_smooth_scene(case.smooth_seed)
    arrays = case.arrays(scene)
    weights = draw_weights(scene)
    image = expected_image(case, scene, arrays)
    assert min(image.margin.min(), image.kink.min()) > CLEARANCE

    def loss(scene, arrays):
        image = expected_image(case, scene, arrays)
        return sum(np.sum(getattr(image, name) * weight) for name, weight in weights.items())

    leaves = ["means", "quats", "log_scales", "viewmat", *["logit_opacities"] * case.is_gaussian_opaque]
    return (
        {leaf: differences(own, lambda x, leaf=leaf: loss(scene, arrays | {leaf: x})) for leaf, own in arrays.items()},
        {leaf: differences(getattr(scene, leaf), lambda x, leaf=leaf: loss(scene._replace(**{leaf: x}), arrays))
         for leaf in leaves},
    )  # fmt: skip


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("compositor", ["native", pytest.param("xla", marks=pytest.mark.long)])
@pytest.mark.parametrize("name", some_long)
def test_every_leaf_against_differences(name, compositor):
    case = CASES[name]
    scene = draw_smooth_scene(case.smooth_seed)
    weights = draw_weights(scene)
    background = jnp.asarray(scene.background)

    def loss(arrays, gaussians, viewmat):
        camera = Camera(viewmat, jnp.asarray(scene.K), scene.width, scene.height)
        options = {"background": background, "settings": RenderSettings(compositor=compositor)}
        output = render_appearance(gaussians, camera, case.appearance(arrays), **options)
        return sum(jnp.sum(getattr(output, name) * jnp.asarray(weight)) for name, weight in weights.items())

    inputs = case.arrays(scene), as_gaussians(scene, "float64"), jnp.asarray(scene.viewmat)
    of_arrays, of_gaussians, of_viewmat = jax.grad(loss, argnums=(0, 1, 2))(*inputs)
    expected, others = expected_gradients(name)
    for leaf, gradient in expected.items():
        assert_gradients_close(of_arrays[leaf], gradient, leaf)
    for leaf, gradient in others.items():
        assert_gradients_close(of_viewmat if leaf == "viewmat" else getattr(of_gaussians, leaf), gradient, leaf)
    if not case.is_gaussian_opaque:
        np.testing.assert_array_equal(of_gaussians.logit_opacities, 0)


@pytest.mark.usefixtures("gpu_kernels")
@pytest.mark.parametrize(
    "name", ["movable kernels", *(pytest.param(own, marks=pytest.mark.long) for own in ("billboards", "painted"))]
)
def test_gpu_kernels_are_those_of_xla(name):
    # In this scene no splat is seen so edge-on that v² would leave float32 three digits.
    case = CASES[name]
    scene = draw_scene(1, num=16, width=19, height=13)

    def loss(arrays, gaussians, compositor):
        settings = RenderSettings(compositor=compositor)
        output = render_appearance(gaussians, as_camera(scene, "float32"), case.appearance(arrays), settings=settings)
        return jnp.sum(output.color**2), output.color

    differentiate = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)
    inputs = case.arrays(scene, "float32"), as_gaussians(scene, "float32")
    wanted, found = (jax.tree.leaves(differentiate(*inputs, compositor)) for compositor in ("xla", "cuda"))
    for a, b in zip(wanted, found, strict=True):
        assert np.isfinite(a).all()
        np.testing.assert_allclose(b, a, rtol=1e-4, atol=2e-5 * float(jnp.abs(a).max()))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("compositor", ["native", pytest.param("xla", marks=pytest.mark.long)])
def test_the_statistic_takes_the_way_of_the_falloff(compositor):
    """At one pixel, of splats whose mean does nothing else, it is the size of the gradient; none, for billboards."""
    scene = draw_smooth_scene(53)
    scene = scene._replace(width=1, height=1, K=scene.K * np.array([[1, 1, 0.06], [1, 1, 0.06], [1, 1, 1]]))
    arrays = random_arrays("glossy", len(scene.means))
    arrays["colors"][:] = 0
    settings = RenderSettings(compositor=compositor, capacity=1024, sh_degree=0)
    camera = as_camera(scene, "float64")
    background = jnp.zeros(3)

    def loss(gaussians, probe, appearance):
        output, _ = render_traced(gaussians, camera, appearance, background, settings, has_geometry=False, probe=probe)
        return jnp.sum(output.color)

    differentiate = jax.jit(jax.grad(loss, argnums=(0, 1)))
    gaussians = as_gaussians(scene, "float64")
    probe = jnp.zeros((len(scene.means), 4))
    by_mean, statistic = differentiate(gaussians, probe, glossy(arrays))
    assert jnp.max(jnp.abs(by_mean.means)) > 1e-2
    np.testing.assert_allclose(statistic[:, :3], jnp.abs(by_mean.means), atol=1e-12)
    _, statistic = differentiate(gaussians, probe, pictured(random_arrays("billboard", len(scene.means))))
    np.testing.assert_array_equal(statistic[:, :3], 0)


@pytree(kw_only=True)
class Tinted(Appearance):
    """It uses an array where it may not."""

    tints: jax.Array

    def shade(self, numbers, values, u, v):
        return (u * self.tints,) * 3, None


@pytest.mark.parametrize("compositor", ["native", "xla", "cuda"])
def test_arrays_in_elementwise_functions_are_refused(compositor):
    scene = draw_scene(4, num=3, width=8, height=8)
    with pytest.raises(ValueError, match=r"Tinted\.tints is an array.*numbers\(\)"):
        rendered(scene, Tinted(tints=jnp.ones(())), compositor, "float32")


@pytree(kw_only=True)
class Wrong(Glossy):
    def numbers(self, gaussians, camera):
        return jnp.zeros(5)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Wrong(**random_arrays("glossy", 3, "float32")), r"numbers \[N, K\] of N = 3.*\(5,\)"),
        (lambda: Appearance(max_alpha=1.0), r"max_alpha .* is 1\.0"),
    ],
)
def test_wrong_numbers_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        rendered(draw_scene(4, num=3, width=8, height=8), make(), dtype="float32")


@pytest.mark.long
def test_without_a_low_pass_filter_edge_on_splats_show_nothing():
    scene = hand_scene([[0, 0, 4]], [EDGE_ON], [[0.0, 0.0]], [0.9], [[1, 1, 1]])
    arrays = random_arrays("glossy", 1, "float32")

    def total(gaussians, has_low_pass):
        appearance = glossy(arrays, has_low_pass=has_low_pass)
        return jnp.sum(render_appearance(gaussians, as_camera(scene, "float32"), appearance).color)

    gaussians = as_gaussians(scene, "float32")
    assert total(gaussians, True) > 0.5
    value, gradient = jax.value_and_grad(total)(gaussians, False)
    assert value == 0
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0)
