"""Training end to end on a tiny scene: traces, resumption, reproduction, overflow, budgets, refusals."""

import dataclasses

import jax
import numpy as np
import pytest

from a2tg_jax import TextureConfig, TrainConfig, fit, fit_stage2, load_checkpoint, save_checkpoint, synthetic_scene
from a2tg_jax.config import DensifyConfig, LearningRates
from a2tg_jax.step import initial_state, jitted_step
from a2tg_jax.training import _allocate, _Stage

CONFIG = TrainConfig(
    stage1_iterations=24,
    stage2_iterations=20,
    initial_gaussians=100,
    densify=DensifyConfig(cap=110),
    texture=TextureConfig(upscale_at=(0.3, 0.6)),
    seed=3,
)
NUM_EVENTS = 2


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene(num_views=8, width=40, height=30, num_points=150)


@pytest.fixture(scope="module")
def trained(scene):
    """A whole run, its checkpoints, and how many traces it took."""
    checkpoints = []

    def keep(checkpoint):
        # The loop donates the state's buffers to the next step.
        checkpoints.append(dataclasses.replace(checkpoint, state=jax.tree.map(np.array, checkpoint.state)))

    before = jitted_step()._cache_size()
    result = fit(scene, CONFIG, on_checkpoint=keep, checkpoint_every=8, progress=False)
    return result, checkpoints, jitted_step()._cache_size() - before


def assert_same(a, b):
    jax.tree.map(np.testing.assert_array_equal, (a.gaussians, a.textures), (b.gaussians, b.textures))


def test_one_trace_per_stage_and_upscaling(trained):
    result, _, num_traces = trained
    assert num_traces == 1 + 1 + NUM_EVENTS + result.num_regrown


def test_both_stages_improve_and_grow(trained):
    result, _, _ = trained
    history = result.history
    assert history.stage.tolist() == [1] * 3 + [2] * 2
    assert np.isfinite(history.loss).all()
    assert history.loss[-1] < history.loss[0]
    assert result.gaussians.num == 110
    assert result.layout.num_texels > 110


def test_texels_stay_where_they_belong(trained):
    result, _, _ = trained
    for bucket in result.textures.buckets:
        alpha = np.asarray(bucket)[..., 3]
        assert alpha.min() >= 0 and alpha.max() <= 1


@pytest.mark.parametrize("which", [0, 1, -2])
def test_resumed_run_is_the_same(scene, trained, tmp_path, which):
    result, checkpoints, _ = trained
    save_checkpoint(tmp_path / "checkpoint.npz", checkpoints[which])
    resumed = fit(scene, CONFIG, resume=load_checkpoint(tmp_path / "checkpoint.npz"), progress=False)
    assert_same(resumed, result)


def test_what_is_passed_in_stays_usable(scene, trained):
    result, checkpoints, _ = trained
    again = fit_stage2(scene, result.stage1, CONFIG, progress=False)
    assert_same(again, result)
    jax.tree.map(np.testing.assert_array_equal, again.stage1, result.stage1)
    for _ in range(2):
        assert_same(fit(scene, CONFIG, resume=checkpoints[-2], progress=False), result)


def test_same_seed_same_result(scene, trained):
    assert_same(fit(scene, CONFIG, progress=False), trained[0])


def test_checkpoint_of_another_configuration_is_refused(scene, trained):
    other = dataclasses.replace(CONFIG, seed=4)
    with pytest.raises(ValueError, match="another configuration"):
        fit(scene, other, resume=trained[1][0], progress=False)


def test_overflow_loses_nothing(scene):
    def one_step(capacity):
        gaussians, num = _allocate(scene, CONFIG)
        stage = _Stage(scene, CONFIG, 1, initial_state(gaussians, num, None, False), None, None)
        if capacity is not None:
            stage.capacities[scene.train[0].image.shape[:2]] = capacity
        stage.step(1)
        return stage

    small, ample = one_step(64), one_step(None)
    assert (small.num_regrown, ample.num_regrown) == (1, 0)
    jax.tree.map(np.testing.assert_array_equal, small.state, ample.state)


def test_infinite_learning_rate_is_said_and_harms_nothing(scene, trained):
    config = dataclasses.replace(CONFIG, rates=LearningRates(quats=float("inf")))
    gaussians, num = _allocate(scene, config)
    stage = _Stage(scene, config, 1, initial_state(gaussians, num, None, False), None, None)
    kept = jax.tree.map(np.array, stage.state)
    with pytest.raises(ValueError, match=r"not finite at iteration 1 of stage 1, view \S+"):
        stage.step(1)
    jax.tree.map(np.testing.assert_array_equal, stage.state, kept)


def test_memory_budget_holds(scene, trained):
    num = trained[0].stage1.num
    budget = (248 * num + 16 * 50) / 1e6
    texture = dataclasses.replace(CONFIG.texture, select="budget", budget_mb=budget)
    result = fit_stage2(scene, trained[0].stage1, dataclasses.replace(CONFIG, texture=texture), progress=False)
    assert result.history.megabytes.max() <= budget
    assert result.layout.num_texels > num


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"texture": TextureConfig(select="budget", budget_mb=0.001)}, "budget_mb is 0.001"),
        ({"texture": TextureConfig(select="budget")}, "budget_mb must say"),
        ({"texture": TextureConfig(cap=32)}, "texture.cap"),
        ({"texture": TextureConfig(upscale_at=(0.5, 0.2))}, "upscale_at"),
        ({"batch_size": 0}, "batch_size"),
        ({"sh_degree": 4}, "sh_degree"),
    ],
)
def test_impossible_configurations_are_refused(scene, trained, change, message):
    with pytest.raises(ValueError, match=message):
        fit_stage2(scene, trained[0].stage1, dataclasses.replace(CONFIG, **change), progress=False)


def test_batches_of_several_views(scene, trained):
    config = dataclasses.replace(CONFIG, batch_size=2, stage2_iterations=3, texture=TextureConfig(is_enabled=False))
    result = fit_stage2(scene, trained[0].stage1, config, progress=False)
    assert np.isfinite(result.history.loss).all()
    assert result.textures is None
