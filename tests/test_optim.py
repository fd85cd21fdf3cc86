"""Adam against a float64 numpy loop; the schedule at its ends; rates of a stage that cools down."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_models import some_gaussians

import a2tg_jax as a2tg
from a2tg_jax import adam_init, adam_update, exponential_decay
from a2tg_jax.training.start import initial_state
from a2tg_jax.training.step import optimized


def oracle_adam(param, grads, rate, b1=0.9, b2=0.999, eps=1e-15):
    """Adam step by step, as Kingma & Ba write it."""
    m = np.zeros_like(param)
    v = np.zeros_like(param)
    for step, grad in enumerate(grads, start=1):
        m = b1 * m + (1 - b1) * grad
        v = b2 * v + (1 - b2) * grad**2
        param = param - rate * (m / (1 - b1**step)) / (np.sqrt(v / (1 - b2**step)) + eps)
    return param


def random_problem(seed=0, steps=50):
    """Parameters, a list of gradients of widely differing size, and rates per field, one an array."""
    rng = np.random.default_rng(seed)
    shapes = {"means": (5, 3), "sh": (5, 16, 3), "opacity": (5,)}
    params = {name: rng.normal(size=shape) for name, shape in shapes.items()}
    draw = lambda shape: rng.normal(size=shape) * 10.0 ** rng.uniform(-6, 1, shape)  # noqa: E731
    grads = [{name: draw(shape) for name, shape in shapes.items()} for _ in range(steps)]
    rates = {"means": 1e-3, "sh": np.where(np.arange(16) == 0, 2.5e-3, 1.25e-4).reshape(1, 16, 1), "opacity": 0.05}
    return params, grads, rates


def run(params, grads, rates, dtype):
    """Updates with everything in `dtype`, jitted."""
    params = jax.tree.map(lambda x: jnp.asarray(x, dtype), params)
    update = jax.jit(adam_update)
    state = adam_init(params)
    for grad in grads:
        params, state = update(params, jax.tree.map(lambda x: jnp.asarray(x, dtype), grad), state, rates)
    return params, state


@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(jnp.float64, {"rtol": 1e-12, "atol": 1e-14}), (jnp.float32, {"rtol": 1e-5, "atol": 5e-6})]
)
def test_fifty_steps_equal_the_oracle(x64, dtype, tolerance):
    params, grads, rates = random_problem()
    found, state = run(params, grads, rates, dtype)
    assert state.count == 50
    for name, param in params.items():
        assert found[name].dtype == dtype
        wanted = oracle_adam(param, [grad[name] for grad in grads], rates[name])
        np.testing.assert_allclose(found[name], wanted, **tolerance)


def test_first_step_moves_by_the_rate():
    """m̂/√v̂ is ±1 at the first step: a bias correction that lost digits would show here."""
    params, state = adam_update(jnp.zeros(3), jnp.asarray([1e-8, -3.0, 0.0]), adam_init(jnp.zeros(3)), 0.25)
    np.testing.assert_allclose(params, [-0.25, 0.25, 0.0], rtol=1e-6)
    assert state.count == 1


def test_without_decay_the_present_gradient_alone_counts():
    params = jnp.zeros(2)
    state = adam_init(jnp.zeros(2))
    for grads in ([4.0, -3.0], [5.0, -1.0]):
        params, state = adam_update(params, jnp.asarray(grads), state, 0.1, b1=0.0, b2=0.0)
    np.testing.assert_allclose(params, [-0.2, 0.2], rtol=1e-6)


def test_one_rate_may_be_of_a_subtree():
    params = {"a": jnp.ones(2), "b": {"c": jnp.ones(3), "d": jnp.ones(1)}}
    result = adam_update(params, params, adam_init(params), {"a": 0.0, "b": 0.5})
    assert result._fields == ("params", "state")
    np.testing.assert_array_equal(result.params["a"], params["a"])
    for leaf in result.params["b"].values():
        np.testing.assert_allclose(leaf, 0.5, rtol=1e-6)


def test_traced_rates_do_not_retrace():
    traces = []
    update = jax.jit(lambda params, state, rate: traces.append(None) or adam_update(params, params, state, rate))
    params = jnp.ones(2)
    state = adam_init(jnp.ones(2))
    for iteration in range(1, 4):
        params, state = update(params, state, exponential_decay(1e-2, 0.01, iteration, 3))
    assert len(traces) == 1


def test_decay_is_log_linear_and_then_constant():
    for decay in (exponential_decay, jax.jit(exponential_decay, static_argnums=(0, 1, 3))):
        for iteration, factor in ((0, 1.0), (50, 0.1), (100, 0.01), (150, 0.01)):
            np.testing.assert_allclose(decay(2.0, 0.01, iteration, 100), 2.0 * factor, rtol=1e-6)


(STAGE,) = a2tg.Gaussians2dMcmc(sh_degree=0, rates=a2tg.LearningRates(means=1e-3)).stages()
COOLING = dataclasses.replace(STAGE, cools_down=True)


@pytest.mark.parametrize(("progress", "factor"), [(0.0, 1.0), (0.5, 0.55), (1.0, 0.1)])
def test_all_rates_of_a_cooling_stage_fall_linearly(progress, factor):
    """Adam's first step is as long as the rate, whatever the gradient."""
    rates = {"one": 0.5, "whole": 2, "array": jnp.asarray([[2e-3], [1e-3]])}
    found = COOLING.cooled(rates, jnp.float32(progress))
    jax.tree.map(lambda new, old: np.testing.assert_allclose(new, np.asarray(old) * factor, rtol=1e-5), found, rates)
    assert STAGE.cooled(rates, jnp.float32(progress)) is rates
    model = a2tg.Model(some_gaussians())
    grads = jax.tree.map(lambda x: jnp.full_like(x, 3.0), (model.gaussians, model.appearance))
    moved, _ = optimized(COOLING, initial_state(COOLING, model), grads, jnp.float32(1e-3), jnp.float32(progress))
    for name, rate, rtol in (("means", 1e-3, 1e-2), ("logit_opacities", 5e-2, 1e-3)):
        step = getattr(moved.gaussians, name) - getattr(model.gaussians, name)
        np.testing.assert_allclose(step, -rate * factor, rtol=rtol)
