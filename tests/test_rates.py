"""Learning rates that follow the size of large Gaussians, and fall at the end of a system's last stage."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_models import some_gaussians

import a2tg_jax as a2tg
from a2tg_jax.model import Model
from a2tg_jax.results.plan import fingerprint
from a2tg_jax.training import LearningRates
from a2tg_jax.training.rates import excess_sizes
from a2tg_jax.training.registry import SYSTEMS, find_system, with_changes
from a2tg_jax.training.step import initial_state, optimized


def gaussians_of(sizes):
    """Gaussians of these sizes, four times as long as wide."""
    some, sizes = some_gaussians(), np.asarray(sizes)
    log_scales = np.log(np.column_stack([2 * sizes, sizes / 2]))
    return dataclasses.replace(some[: len(sizes)], log_scales=jnp.asarray(log_scales, jnp.float32))


def test_sizes_are_relative_to_the_mean_of_live_rows():
    sizes = excess_sizes(gaussians_of([0.5, 2.0, 1.0, 1e-9]), 3)
    np.testing.assert_allclose(sizes[:3], [1.0, 2.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose(excess_sizes(gaussians_of([1e-4, 1e4, 1.0]), 3), [1.0, 5.0, 1.0], rtol=1e-6)


def test_rates_of_means_follow_a_power_of_the_size():
    model = Model(gaussians_of([0.5, 2.0, 1.0]))
    rates = LearningRates(means_by_size=0.5).of_means(jnp.float32(1e-3), model)
    np.testing.assert_allclose(rates, 1e-3 * np.sqrt([[1.0], [2.0], [1.0]]), rtol=1e-6)
    assert LearningRates().of_means(jnp.float32(1e-3), model).shape == ()


@pytest.mark.parametrize(("progress", "factor"), [(0.0, 1.0), (0.6, 1.0), (0.8, 0.55), (1.0, 0.1)])
def test_all_rates_fall_linearly_in_the_cooldown(progress, factor):
    rates = {"one": 0.5, "whole": 2, "array": jnp.asarray([[2e-3], [1e-3]])}
    found = LearningRates(cooldown=0.4).cooled(rates, jnp.float32(progress))
    jax.tree.map(lambda new, old: np.testing.assert_allclose(new, np.asarray(old) * factor, rtol=1e-5), found, rates)
    assert LearningRates().cooled(rates, jnp.float32(progress)) is rates


@pytest.mark.parametrize("name", SYSTEMS)
def test_systems_cool_down_in_their_last_stage_only(name):
    for changes in ({}, {"stage2_iterations": 0}) if name.startswith("gaussians") else ({},):
        system = with_changes(find_system(name), {"rates": {"cooldown": 0.3}, **changes}, "test")
        *others, last = system.stages()
        assert last.rates.cooldown == 0.3 and all(stage.rates.cooldown == 0 for stage in others)


def test_what_was_trained_without_them_is_the_same_training():
    before, both = (
        with_changes(find_system("gaussians-2d-mcmc"), {"rates": rates}, "test")
        for rates in ({}, {"cooldown": 0.2, "means_by_size": 0.5})
    )
    assert "cooldown" not in fingerprint(before, 0) and "means_by_size" not in fingerprint(before, 0)
    assert fingerprint(before, 0) != fingerprint(both, 0)


def test_a_step_moves_each_gaussian_at_its_own_rate():
    """Adam's first step is as long as the rate, whatever the gradient."""
    system = a2tg.Gaussians2dMcmc(sh_degree=0, rates=LearningRates(means=1e-3, means_by_size=1.0, cooldown=0.5))
    stage, model = system.stages()[0], Model(gaussians_of([0.5, 2.0, 1.0]))
    state = initial_state(stage, model)
    grads = jax.tree.map(lambda x: jnp.full_like(x, 3.0), (model.gaussians, model.params))
    for progress, factor in ((0.0, 1.0), (1.0, 0.1)):
        (moved, _), _ = optimized(stage, state, grads, jnp.float32(1e-3), jnp.float32(progress))
        means, logits = (getattr(moved, name) - getattr(model.gaussians, name) for name in ("means", "logit_opacities"))
        np.testing.assert_allclose(means, np.full((3, 3), -1e-3 * factor) * [[1.0], [2.0], [1.0]], rtol=1e-3)
        np.testing.assert_allclose(logits, -5e-2 * factor, rtol=1e-4)
