"""Random displacements of the Gaussians in each step."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_models import some_gaussians
from toy_system import Toy

import a2tg_jax as a2tg
from a2tg_jax.finish.tuning import _tuning
from a2tg_jax.results.plan import fingerprint
from a2tg_jax.training import step
from a2tg_jax.training.jitter import STREAM, jittered
from a2tg_jax.training.loop import StageRun
from a2tg_jax.training.registry import SYSTEMS, find_system, with_changes
from a2tg_jax.training.start import initial_model

SMALL = {"initial_gaussians": 60, "densify": a2tg.McmcConfig(cap=60), "stage1_iterations": 8}


@pytest.fixture(scope="module")
def scene():
    return a2tg.synthetic_scene(num_views=6, width=24, height=18, num_points=80)


def test_displacements_are_normal_and_as_large_as_the_share_of_the_size():
    log_scales = np.log(np.tile([[0.2, 0.05], [4.0, 1.0]], (4000, 1)))
    some = some_gaussians()
    rows = np.arange(8000) % some.num
    gaussians = dataclasses.replace(some[rows], log_scales=jnp.asarray(log_scales, jnp.float32))
    found = jittered(jax.random.key(3), gaussians, 0.25)
    moved = np.asarray(found.means - gaussians.means) / np.tile([[0.1], [2.0]], (4000, 1))
    np.testing.assert_allclose(moved.mean(axis=0), 0.0, atol=0.02)
    np.testing.assert_allclose(np.cov(moved.T), 0.25**2 * np.eye(3), atol=0.003)
    for name in ("quats", "log_scales", "logit_opacities", "sh"):
        assert getattr(found, name) is getattr(gaussians, name)


def test_displacements_are_of_one_iteration_only():
    gaussians, key = some_gaussians(), jax.random.key(5)
    first, again, other = (jittered(jax.random.fold_in(key, at), gaussians, 0.1).means for at in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (np.asarray(first) != np.asarray(other)).all()


def test_a_step_takes_the_gradient_where_the_gaussians_are_moved_to(scene):
    """It is the step of a model at the displaced means; Adam then changes the means themselves."""
    system = a2tg.Gaussians2dMcmc(**SMALL, jitter=0.3)
    run = StageRun(scene, system, 0, initial_model(scene, system))
    settings, stage, clock, state, photographs, views, scale, key, *rows = run.arguments(1)
    assert stage.jitter == 0.3
    displaced = jittered(jax.random.fold_in(key, 1), state.model.gaussians, 0.3)
    moved = dataclasses.replace(state, model=dataclasses.replace(state.model, gaussians=displaced))
    attempt = jax.jit(step.attempt, static_argnums=0)
    others = photographs, views, scale, key, *rows
    found = attempt(settings, stage, clock, state, *others)
    wanted = attempt(settings, dataclasses.replace(stage, jitter=0.0), clock, moved, *others)
    assert float(found.views.loss[0]) == pytest.approx(float(wanted.views.loss[0]), rel=1e-6)
    for own, other in zip(jax.tree.leaves(found.grads), jax.tree.leaves(wanted.grads), strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-5, atol=1e-8)
    before, after, elsewhere = (x.model.gaussians.means[: state.model.num] for x in (state, found.state, wanted.state))
    assert np.abs(after - before).max() < 0.1 * np.abs(elsewhere - before).max()
    run.photographs.close()


def test_runs_with_displacements_resume_bit_for_bit(scene, tmp_path):
    system = a2tg.Gaussians2dMcmc(**SMALL, jitter=0.2)

    def keep(checkpoint):
        a2tg.save_checkpoint(tmp_path / f"{checkpoint.iteration}.npz", checkpoint)

    whole = a2tg.fit(scene, system, progress=False, on_checkpoint=keep, checkpoint_every=3)
    resumed = a2tg.fit(scene, system, progress=False, resume=a2tg.load_checkpoint(tmp_path / "3.npz"))
    plain = a2tg.fit(scene, dataclasses.replace(system, jitter=0.0), progress=False)
    means, again, others = (np.asarray(result.model.gaussians.means) for result in (whole, resumed, plain))
    np.testing.assert_array_equal(means, again)
    assert (means != others).any()


def test_its_random_numbers_are_no_others():
    """Backgrounds and events have the keys that the iteration's key is split into."""
    key = jax.random.key(5)
    own = jax.random.key_data(jax.random.fold_in(key, STREAM))
    for num in range(1, 12):
        assert (np.asarray(own) != np.asarray(jax.random.key_data(jax.random.split(key, num)))).any(axis=1).all()


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_system_displaces_in_its_first_stage_only(name):
    system = with_changes(find_system(name), {"jitter": 0.1}, "test")
    first, *others = system.stages()
    assert first.jitter == 0.1 and all(stage.jitter == 0 for stage in others)


def test_tuning_for_a_file_has_none():
    system = a2tg.Gaussians2dMcmc(**SMALL, jitter=0.2)
    assert _tuning(system, system.stages()[-1]).stages()[0].jitter == 0


def test_what_was_trained_without_it_is_the_same_training():
    none, some = (with_changes(find_system("gaussians-2d-mcmc"), {"jitter": share}, "test") for share in (0.0, 0.1))
    assert "jitter" not in fingerprint(none, 0)
    assert fingerprint(none, 0) != fingerprint(some, 0)


@pytest.mark.parametrize("share", [-0.1, 1.5])
def test_a_share_that_is_none_is_refused(share):
    with pytest.raises(ValueError, match=rf"jitter must lie in 0\.\.1; got {share}"):
        a2tg.A2tg(jitter=share).check()
    stage = dataclasses.replace(a2tg.A2tg().stages()[0], jitter=share)
    with pytest.raises(ValueError, match=rf"jitter must lie in 0\.\.1; that of the stage 'gaussians' is {share}"):
        stage.check()


def test_a_system_that_does_not_displace_refuses_the_option():
    with pytest.raises(ValueError, match=r"jitter is 0\.1, but no stage of Toy displaces .*: compose its"):
        Toy(jitter=0.1).check()
