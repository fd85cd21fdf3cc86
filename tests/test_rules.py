"""The protocol of appearance rules: numbers of each splat, largest alpha, low-pass filter, what rules may not do."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracle_rules
import pytest
from oracle import DEFAULT_RULES
from scenes_random import as_camera, as_gaussians, draw_scene, draw_smooth_scene
from test_oracle import EDGE_ON, hand_scene
from test_render import errors
from test_render_gradients import CLEARANCE, assert_gradients_close, differences, draw_weights

from a2tg_jax import Camera, RenderSettings, render_appearance
from a2tg_jax.appearance import PlainRule
from a2tg_jax.numerics import normalize


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class GlossyRule(PlainRule):
    """A highlight about an axis of each splat's own, and the falloff (1 + ρ/2k)^(−k) with a k of its own."""

    colors: jax.Array
    axes: jax.Array
    log_exponents: jax.Array
    has_low_pass: bool = dataclasses.field(default=True, metadata={"static": True})

    def numbers(self, gaussians, camera):
        direction = normalize(gaussians.means - camera.center[None])
        lobe = jnp.exp(3 * (jnp.sum(direction * normalize(self.axes), axis=1) - 1))
        return jnp.concatenate([self.colors * lobe[:, None], jnp.exp(self.log_exponents)[:, None]], axis=1)

    def shade(self, numbers, values, u, v):
        return (numbers[0], numbers[1] * u, numbers[2] * v * v), None

    def falloff(self, numbers, rho):
        return jnp.exp(-numbers[3] * jnp.log(1 + rho / (2 * numbers[3])))

    def cutoff(self, opacities):
        exponents = jnp.exp(self.log_exponents)
        return 2 * exponents * (jnp.exp(jnp.log(255 * opacities) / exponents) - 1)


def glossy_params(num: int, dtype="float64") -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    params = {
        "colors": rng.normal(scale=0.3, size=(num, 3)),
        "axes": rng.normal(size=(num, 3)),
        "log_exponents": rng.uniform(0.5, 2, num),
    }
    return {name: np.asarray(value, np.float32).astype(dtype) for name, value in params.items()}


def glossy_rule(params: dict, **static) -> GlossyRule:
    return GlossyRule(**jax.tree.map(jnp.asarray, params), **static)


def rendered(scene, rule, compositor="auto", dtype="float64"):
    background = jnp.asarray(scene.background, dtype)
    camera, settings = as_camera(scene, dtype), RenderSettings(compositor=compositor)
    return render_appearance(as_gaussians(scene, dtype), camera, rule, background=background, settings=settings)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("compositor", ["native", "xla"])
@pytest.mark.parametrize(("has_low_pass", "max_alpha"), [(True, 0.99), (False, 0.7)])
def test_numbers_that_depend_on_the_view(compositor, has_low_pass, max_alpha):
    scene = draw_scene(4)
    params = glossy_params(len(scene.means))
    show = functools.partial(oracle_rules.glossy, has_low_pass=has_low_pass)
    expected = oracle_rules.render_rule(scene, params, show, DEFAULT_RULES._replace(max_alpha=max_alpha))
    assert expected.margin.min() > 1e-9
    rule = glossy_rule(params, has_low_pass=has_low_pass, max_alpha=max_alpha)
    output = rendered(scene, rule, compositor)
    for name, error in errors(output, expected, np.full(expected.alpha.shape, True)).items():
        assert error.max() < 1e-9, name


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("compositor", ["native", "xla"])
@pytest.mark.parametrize("has_low_pass", [True, False])
def test_gradients_of_numbers_against_differences(compositor, has_low_pass):
    scene = draw_smooth_scene(53)
    params, weights = glossy_params(len(scene.means)), draw_weights(scene)
    show = functools.partial(oracle_rules.glossy, has_low_pass=has_low_pass)
    image = oracle_rules.render_rule(scene, params, show)
    assert min(image.margin.min(), image.kink.min()) > CLEARANCE

    def loss(params, gaussians, viewmat):
        camera = Camera(viewmat, jnp.asarray(scene.K), scene.width, scene.height)
        rule = glossy_rule(params, has_low_pass=has_low_pass)
        settings = RenderSettings(compositor=compositor)
        output = render_appearance(gaussians, camera, rule, background=jnp.asarray(scene.background), settings=settings)
        return sum(jnp.sum(getattr(output, name) * jnp.asarray(weight)) for name, weight in weights.items())

    def expected_loss(scene, params):
        image = oracle_rules.render_rule(scene, params, show)
        return sum(np.sum(getattr(image, name) * weight) for name, weight in weights.items())

    found = jax.grad(loss, argnums=(0, 1, 2))(params, as_gaussians(scene, "float64"), jnp.asarray(scene.viewmat))
    for name in params:
        expected = differences(params[name], lambda value, name=name: expected_loss(scene, params | {name: value}))
        assert_gradients_close(found[0][name], expected, name)
    leaves = {name: getattr(found[1], name) for name in ("means", "quats", "log_scales", "logit_opacities")}
    for name, gradient in (leaves | {"viewmat": found[2]}).items():
        moved = lambda value, name=name: expected_loss(scene._replace(**{name: value}), params)  # noqa: E731
        assert_gradients_close(gradient, differences(getattr(scene, name), moved), name)


@pytest.mark.parametrize("has_low_pass", [True, False])
def test_pallas_kernels_take_numbers(has_low_pass):
    scene = draw_scene(4, num=16, width=19, height=13)

    def loss(params, gaussians, compositor):
        rule = glossy_rule(params, has_low_pass=has_low_pass)
        settings = RenderSettings(compositor=compositor)
        output = render_appearance(gaussians, as_camera(scene, "float32"), rule, settings=settings)
        return jnp.sum(output.color**2), output.color

    differentiate = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)
    inputs = glossy_params(16, "float32"), as_gaussians(scene, "float32")
    wanted, found = (jax.tree.leaves(differentiate(*inputs, compositor)) for compositor in ("xla", "pallas"))
    for a, b in zip(wanted, found, strict=True):
        assert np.isfinite(a).all()
        np.testing.assert_allclose(b, a, rtol=1e-4, atol=2e-5 * float(jnp.abs(a).max()))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class TintedRule(PlainRule):
    """It uses an array where it may not."""

    tints: jax.Array

    def shade(self, numbers, values, u, v):
        return (u * self.tints,) * 3, None


@pytest.mark.parametrize("compositor", ["native", "xla", "pallas"])
def test_arrays_in_elementwise_functions_are_refused(compositor):
    scene = draw_scene(4, num=3, width=8, height=8)
    with pytest.raises(ValueError, match=r"TintedRule\.tints is an array.*numbers\(\)"):
        rendered(scene, TintedRule(tints=jnp.ones(())), compositor, "float32")


def test_numbers_of_another_shape_are_refused():
    scene = draw_scene(4, num=3, width=8, height=8)
    params = glossy_params(3, "float32")

    class Wrong(GlossyRule):
        def numbers(self, gaussians, camera):
            return jnp.zeros(5)

    jax.tree_util.register_dataclass(Wrong)
    with pytest.raises(ValueError, match=r"numbers \[N, K\] of N = 3.*\(5,\)"):
        rendered(scene, Wrong(**jax.tree.map(jnp.asarray, params)), dtype="float32")


def test_a_largest_alpha_of_one_is_refused():
    scene = draw_scene(4, num=3, width=8, height=8)
    with pytest.raises(ValueError, match=r"max_alpha .* is 1\.0"):
        rendered(scene, PlainRule(max_alpha=1.0), dtype="float32")


@pytest.mark.parametrize("compositor", ["native", "xla", "pallas"])
def test_without_a_low_pass_filter_edge_on_splats_show_nothing(compositor):
    scene = hand_scene([[0, 0, 4]], [EDGE_ON], [[0.0, 0.0]], [0.9], [[1, 1, 1]])
    params, settings = glossy_params(1, "float32"), RenderSettings(compositor=compositor)

    def total(gaussians, has_low_pass):
        rule = glossy_rule(params, has_low_pass=has_low_pass)
        return jnp.sum(render_appearance(gaussians, as_camera(scene, "float32"), rule, settings=settings).color)

    gaussians = as_gaussians(scene, "float32")
    assert total(gaussians, True) > 0.5
    value, gradient = jax.value_and_grad(total)(gaussians, False)
    assert value == 0
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0)
