"""Learning rates of a stage that cools down."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_models import some_gaussians

import a2tg_jax as a2tg
from a2tg_jax.model import Model
from a2tg_jax.training import LearningRates
from a2tg_jax.training.step import initial_state, optimized

(STAGE,) = a2tg.Gaussians2dMcmc(sh_degree=0, rates=LearningRates(means=1e-3)).stages()
COOLING = dataclasses.replace(STAGE, cools_down=True)


@pytest.mark.parametrize(("progress", "factor"), [(0.0, 1.0), (0.5, 0.55), (1.0, 0.1)])
def test_all_rates_fall_linearly(progress, factor):
    rates = {"one": 0.5, "whole": 2, "array": jnp.asarray([[2e-3], [1e-3]])}
    found = COOLING.cooled(rates, jnp.float32(progress))
    jax.tree.map(lambda new, old: np.testing.assert_allclose(new, np.asarray(old) * factor, rtol=1e-5), found, rates)
    assert STAGE.cooled(rates, jnp.float32(progress)) is rates


@pytest.mark.parametrize(("progress", "factor"), [(0.0, 1.0), (1.0, 0.1)])
def test_a_step_follows_them(progress, factor):
    """Adam's first step is as long as the rate, whatever the gradient."""
    model = Model(some_gaussians())
    grads = jax.tree.map(lambda x: jnp.full_like(x, 3.0), (model.gaussians, model.appearance))
    state = initial_state(COOLING, model)
    moved, _ = optimized(COOLING, state, grads, jnp.float32(1e-3), jnp.float32(progress))
    means, logits = (
        getattr(moved.gaussians, name) - getattr(model.gaussians, name) for name in ("means", "logit_opacities")
    )
    np.testing.assert_allclose(means, -1e-3 * factor, rtol=1e-2)
    np.testing.assert_allclose(logits, -5e-2 * factor, rtol=1e-3)
