"""Adam against a float64 numpy loop; the schedule at its ends."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from a2tg_jax.core.optim import OptStep, adam_init, adam_update, exponential_decay


def oracle_adam(param, grads, rate, b1=0.9, b2=0.999, eps=1e-15):
    """Adam step by step, as Kingma & Ba write it."""
    m, v = np.zeros_like(param), np.zeros_like(param)
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


def test_fifty_steps_equal_the_oracle_in_float64(x64):
    params, grads, rates = random_problem()
    got, state = run(params, grads, rates, jnp.float64)
    assert state.count == 50
    for name, param in params.items():
        wanted = oracle_adam(param, [grad[name] for grad in grads], rates[name])
        np.testing.assert_allclose(got[name], wanted, rtol=1e-12, atol=1e-14)


def test_fifty_steps_are_close_in_float32():
    params, grads, rates = random_problem()
    got, _ = run(params, grads, rates, jnp.float32)
    for name, param in params.items():
        assert got[name].dtype == jnp.float32
        wanted = oracle_adam(param, [grad[name] for grad in grads], rates[name])
        np.testing.assert_allclose(got[name], wanted, rtol=1e-5, atol=5e-6)


def test_first_step_moves_by_the_rate():
    """m̂/√v̂ is ±1 at the first step: a bias correction that lost digits would show here."""
    params, state = adam_update(jnp.zeros(3), jnp.asarray([1e-8, -3.0, 0.0]), adam_init(jnp.zeros(3)), 0.25)
    np.testing.assert_allclose(params, [-0.25, 0.25, 0.0], rtol=1e-6)
    assert state.count == 1


def test_without_decay_the_present_gradient_alone_counts():
    state = adam_init(jnp.zeros(2))
    params, state = adam_update(jnp.zeros(2), jnp.asarray([4.0, -3.0]), state, 0.1, b1=0.0, b2=0.0)
    params, _ = adam_update(params, jnp.asarray([5.0, -1.0]), state, 0.1, b1=0.0, b2=0.0)
    np.testing.assert_allclose(params, [-0.2, 0.2], rtol=1e-6)


def test_one_rate_may_stand_for_a_subtree():
    params = {"a": jnp.ones(2), "b": {"c": jnp.ones(3), "d": jnp.ones(1)}}
    result = adam_update(params, params, adam_init(params), {"a": 0.0, "b": 0.5})
    assert isinstance(result, OptStep)
    np.testing.assert_array_equal(result.params["a"], params["a"])
    np.testing.assert_allclose(result.params["b"]["c"], 0.5, rtol=1e-6)
    np.testing.assert_allclose(result.params["b"]["d"], 0.5, rtol=1e-6)


def test_traced_rates_do_not_retrace():
    traces = []

    def update(params, state, rate):
        traces.append(None)
        return adam_update(params, params, state, rate)

    update = jax.jit(update)
    params = jnp.ones(2)
    state = adam_init(params)
    for iteration in range(1, 4):
        params, state = update(params, state, exponential_decay(1e-2, 0.01, iteration, 3))
    assert len(traces) == 1


@pytest.mark.parametrize("iteration, factor", [(0, 1.0), (50, 0.1), (100, 0.01), (150, 0.01)])
def test_decay_is_log_linear_and_then_constant(iteration, factor):
    for decay in (exponential_decay, jax.jit(exponential_decay, static_argnums=(0, 1, 3))):
        np.testing.assert_allclose(decay(2.0, 0.01, iteration, 100), 2.0 * factor, rtol=1e-6)


def test_importing_is_silent():
    subprocess.run([sys.executable, "-W", "error", "-c", "import a2tg_jax.core.optim"], check=True)
