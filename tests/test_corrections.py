"""Exposures and poses of training views: the exponential map, what the step learns, and that it survives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kept_checkpoints import fit_keeping_checkpoints
from scipy.linalg import expm
from toy_system import Toy

from a2tg_jax import (
    Appearance,
    Camera,
    CloneSplitPrune,
    Corrections,
    Exposure,
    Gaussians2d,
    Gaussians2dMcmc,
    LossConfig,
    Mcmc,
    Origin,
    PoseRefinement,
    Stage,
    System,
    Term,
    adam_init,
    adam_update,
    find_system,
    fit,
    load_checkpoint,
    load_compact,
    load_model,
    save_checkpoint,
    save_compact,
    save_model,
    synthetic_scene,
)
from a2tg_jax.training import SYSTEMS
from a2tg_jax.training.corrections import corrected_origin, initial_corrections, updated

SYSTEM = Gaussians2dMcmc(
    stage1_iterations=24, stage2_iterations=16, initial_gaussians=80, densify=Mcmc(cap=90), exposure=True,
    refine_poses=True, sh_degree=0, loss=LossConfig(ssim_weight=0.0),
)  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene(num_views=7, width=40, height=30, num_points=150)


@pytest.fixture(scope="module")
def trained(scene):
    """A run, and copies of its checkpoints."""
    return fit_keeping_checkpoints(scene, SYSTEM)


def hat(rotvec):
    x, y, z = rotvec
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


AXIS = np.array([0.6, -0.48, 0.64])


def moved(twist, viewmat):
    """The world to camera of a camera that is refined by a twist."""
    return PoseRefinement().camera(twist, Camera(viewmat, jnp.eye(3), 4, 3)).viewmat


def test_the_exponential_map(x64):
    for angle in (0.0, 1e-9, 1e-4, 0.05, 0.0999999, 0.1000001, 1.0, 3.1, 6.0):
        rotation = jax.jit(moved)(jnp.asarray([*(angle * AXIS), 0, 0, 0]), jnp.eye(4))[:3, :3]
        np.testing.assert_allclose(rotation, expm(hat(angle * AXIS)), rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


def test_derivatives_of_a_moved_camera(x64):
    """Forwards, backwards and by central differences, in each coordinate, at 0 and on both sides of the series' end."""
    rng = np.random.default_rng(0)
    viewmat = np.eye(4)
    viewmat[:3] = np.concatenate([expm(hat(rng.normal(size=3))), rng.normal(size=(3, 1))], axis=1)
    weights = rng.normal(size=(4, 4))

    def value(twist):
        return jnp.sum(weights * jnp.sin(moved(twist, jnp.asarray(viewmat))))

    step = 1e-6
    values = jax.jit(jax.vmap(value))
    backwards, forwards, hessian = (jax.jit(of(value)) for of in (jax.grad, jax.jacfwd, jax.hessian))
    for angle in (0.0, 1e-7, 0.0999, 0.1001, 2.0):
        twist = jnp.asarray([*(angle * AXIS), 0.1, -0.2, 0.3])
        ahead, behind = (values(twist[None] + sign * step * jnp.eye(6)) for sign in (1, -1))
        np.testing.assert_allclose(backwards(twist), (ahead - behind) / (2 * step), rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(forwards(twist), backwards(twist), rtol=1e-12, atol=1e-13)
        assert np.isfinite(hessian(twist)).all()


def test_no_motion_is_exactly_none():
    viewmat = jnp.asarray(np.random.default_rng(0).normal(size=(4, 4)), jnp.float32)
    np.testing.assert_array_equal(moved(jnp.zeros(6), viewmat), viewmat)
    color = jnp.asarray(np.random.default_rng(1).uniform(size=(5, 4, 3)), jnp.float32)
    np.testing.assert_array_equal(Exposure().color(jnp.eye(3, 4), color), color)


def test_a_turned_camera_stays_where_it_is(scene):
    camera = scene.train[0].camera
    turned = PoseRefinement().camera(jnp.asarray([0.1, 0.2, -0.1, 0, 0, 0]), camera)
    np.testing.assert_allclose(turned.center, camera.center, atol=1e-6)
    shifted = PoseRefinement().camera(jnp.asarray([0, 0, 0, 0.1, 0, 0]), camera)
    np.testing.assert_allclose(np.linalg.norm(shifted.center - camera.center), 0.1, rtol=1e-4)


def test_only_views_that_are_seen_learn(x64):
    """Rows follow Adam as if each were alone; a view that occurs twice is stepped once."""
    correction = PoseRefinement(rate=1e-2, final_factor=1.0)
    (state,) = initial_corrections((correction,), ["a", "b", "c"], None, jnp.float64)
    alone = jnp.zeros(6)
    moments = adam_init(jnp.zeros(6))
    for seed in range(3):
        grad = jnp.asarray(np.random.default_rng(seed).normal(size=(2, 6)))
        state = updated(correction, state, jnp.asarray([1, 1]), grad, jnp.asarray(0.5))
        alone, moments = adam_update(alone, grad.sum(axis=0), moments, 1e-2)
    np.testing.assert_allclose(state.rows[1], alone, rtol=1e-12)
    np.testing.assert_array_equal(state.rows[np.array([0, 2])], 0)
    np.testing.assert_array_equal(state.moments.count, [0, 3, 0])


def test_exposures_change_nothing_on_average(trained):
    rows = trained[1][-1].state.corrections[1].rows
    assert np.abs(rows - np.eye(3, 4)).max() > 1e-3
    np.testing.assert_allclose(rows.mean(axis=0), np.eye(3, 4), atol=1e-6)


@pytest.mark.parametrize("place", [1, pytest.param(-2, marks=pytest.mark.long)])
def test_a_resumed_run_is_the_same(scene, trained, tmp_path, place):
    result, checkpoints = trained
    save_checkpoint(tmp_path / "checkpoint.npz", checkpoints[place])
    resumed = fit(scene, SYSTEM, resume=load_checkpoint(tmp_path / "checkpoint.npz")).model
    jax.tree.map(np.testing.assert_array_equal, resumed, result.model)
    assert resumed.origin == result.model.origin


def test_the_next_stage_continues_what_is_learned(trained):
    result, checkpoints = trained
    first = result.stages[0].model.origin
    begun, learned = (dict(zip(("pose", "exposure"), checkpoints[i].state.corrections, strict=True)) for i in (3, -1))
    for name, rows in first.corrections.items():
        assert checkpoints[3].stage == 1
        assert np.abs(begun[name].rows - rows[: len(begun[name].rows)]).max() < 0.05
        assert np.abs(learned[name].rows - begun[name].rows).max() > 0
    assert sorted(first.corrections) == ["exposure", "pose"]


def test_the_origin_has_the_cameras_as_they_were_refined(scene, trained, tmp_path):
    model = trained[0].model
    poses = model.origin.corrections["pose"]
    for index, view in enumerate((*scene.train, *scene.test)):
        expected = moved(jnp.asarray(poses[index]), view.camera.viewmat)
        np.testing.assert_allclose(model.origin.viewmats[index], expected, atol=1e-7)
    np.testing.assert_array_equal(poses[len(scene.train) :], 0)
    assert np.abs(poses[: len(scene.train)]).min(axis=0).max() > 0

    save_model(tmp_path / "model.npz", model)
    assert load_model(tmp_path / "model.npz").origin == model.origin
    save_compact(tmp_path / "model.a2tgz", model)
    assert load_compact(tmp_path / "model.a2tgz").origin.corrections == {}
    assert model.num_bytes == dataclasses.replace(model, origin=None).num_bytes


def test_cameras_are_made_once_for_all_corrections(scene, monkeypatch):
    calls = []
    cameras = Origin.cameras.fget
    monkeypatch.setattr(Origin, "cameras", property(lambda origin: calls.append(origin) or cameras(origin)))
    names = [view.name for view in scene.train]
    corrections = [PoseRefinement()]
    states = initial_corrections(corrections, names, None, np.float32)
    corrected = corrected_origin(scene.origin, corrections, states)
    np.testing.assert_allclose(corrected.viewmats, scene.origin.viewmats, atol=1e-6)
    assert len(calls) == 1


def test_a_loss_term_of_the_same_name_as_their_penalties_is_recorded(scene):
    def corrections(model, target, output):
        return jnp.mean(jnp.abs(output.color - target.image))

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Own(System):
        def stages(self):
            return (Stage("own", Appearance(), (), (Term(corrections),), self.rates, 10, None, self.corrections_of()),)

    history = fit(scene, Own(sh_degree=0, exposure=True, corrections=Corrections(exposure_kind="grid"))).history
    assert set(history.terms) == {"corrections", "corrections_1"}
    np.testing.assert_allclose(sum(history.terms.values()), history.loss, rtol=1e-6)
    assert history.terms["corrections_1"] > 100 * history.terms["corrections"]


def test_a_checkpoint_of_another_number_of_views_is_refused(scene, trained):
    fewer = dataclasses.replace(scene, train=scene.train[1:])
    with pytest.raises(ValueError, match="corrections of 6 training views, but the scene has 5"):
        fit(fewer, SYSTEM, resume=trained[1][0])


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_system_has_them_and_none_has_by_default(name):
    system = dataclasses.replace(find_system(name), stage2_iterations=5)
    assert all(stage.corrections == () for stage in system.stages())
    learning = dataclasses.replace(system, exposure=True, refine_poses=True)
    assert [tuple(each.name for each in stage.corrections) for stage in learning.stages()] == [("pose", "exposure")] * 2


@pytest.mark.long
def test_batches_of_another_system_learn_them(scene):
    sizes = {
        "stage1_iterations": 4,
        "stage2_iterations": 0,
        "initial_gaussians": 40,
        "densify": CloneSplitPrune(cap=60),
    }
    system = Gaussians2d(**sizes, exposure=True, batch_size=2)
    origin = fit(scene, system).model.origin
    assert np.abs(origin.corrections["exposure"][: len(scene.train)] - np.eye(3, 4)).max() > 1e-3


def test_a_system_that_does_not_learn_them_is_refused(scene):
    with pytest.raises(ValueError, match="refine_poses is on, but no stage of Toy learns it"):
        fit(scene, Toy(refine_poses=True))
    with pytest.raises(ValueError, match=r"corrections.pose.rate must be at least 0"):
        corrections = dataclasses.replace(SYSTEM.corrections, pose=PoseRefinement(rate=-1.0))
        dataclasses.replace(SYSTEM, corrections=corrections).check()
    stage = dataclasses.replace(SYSTEM.stages()[0], corrections=(Exposure(), Exposure()))
    with pytest.raises(ValueError, match="corrections of 'gaussians' must have different names"):
        stage.check()
