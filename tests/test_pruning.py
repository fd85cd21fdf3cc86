"""Which Gaussians are pruned, that all of a Gaussian moves along, and that training goes on with the others."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from bits import bits_of
from kept_checkpoints import fit_keeping_checkpoints
from scenes_random import as_camera, as_gaussians, draw_scene
from test_splitting import some_state
from test_view_dependence import banded

import a2tg_jax as a2tg
from a2tg_jax import Due, Model, Prune, SplitByGradient, View, adam_init, partition
from a2tg_jax.densify.pruning import shown_in
from a2tg_jax.training.loop import StageRun
from a2tg_jax.training.start import initial_model


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("seed", [0, 3])
def test_weights_are_those_of_the_oracle(seed):
    scene = draw_scene(seed)._replace(textures=None)
    expected = oracle.render(scene).weights.sum(axis=(1, 2))
    model = Model(as_gaussians(scene, "float64"))
    camera = as_camera(scene, "float64")
    once = shown_in(model, Due(views=[seen_from(camera)])).weights
    np.testing.assert_allclose(once, expected, rtol=1e-9, atol=1e-9)
    assert (expected > 1).sum() > 3
    # Pixels that a mask leaves out do not count, in one view of two.
    mask = np.random.default_rng(seed).random((scene.height, scene.width)) < 0.5
    masked = shown_in(model, Due(views=[seen_from(camera, mask), seen_from(camera)])).weights
    shown = (oracle.render(scene).weights * mask).sum(axis=(1, 2))
    np.testing.assert_allclose(masked, shown + expected, rtol=1e-9, atol=1e-9)


@pytest.mark.long
@pytest.mark.usefixtures("x64")
def test_weights_are_summed_over_views_of_any_size():
    float32 = Model(some_state()[0].gaussians), a2tg.synthetic_scene(num_views=3, width=24, height=16).train[0].camera
    model, camera = jax.tree.map(lambda x: jnp.asarray(x, float), float32)
    views = [seen_from(one) for one in (camera, dataclasses.replace(camera, width=20, height=10), camera)]
    parts = [shown_in(model, Due(views=[view])).weights for view in views]
    np.testing.assert_allclose(shown_in(model, Due(views=views)).weights, sum(parts), rtol=1e-12)
    with pytest.raises(ValueError, match="at least one view"):
        _ = shown_in(model, Due(views=[]))
    assert shown_in(Model(model.gaussians[:0]), Due(views=views)).weights.shape == (0,)


def seen_from(camera, mask=None) -> View:
    """A view whose photograph does not matter."""
    return View("black.png", camera, np.zeros((camera.height, camera.width, 3), np.uint8), mask)


def pruned(event: Prune):
    """What an event makes of a model with rows to spare, whose moments are the rows' numbers."""
    model, _, statistics = some_state()
    camera = a2tg.synthetic_scene(num_views=3, width=24, height=16).train[0].camera
    moments = adam_init(partition(model)[0])
    numbers = jnp.arange(model.gaussians.num, dtype=jnp.float32)
    by_row = lambda x: jnp.broadcast_to(numbers.reshape(-1, *[1] * (x.ndim - 1)), x.shape)  # noqa: E731
    mu = jax.tree.map(by_row, moments.mu)
    nu = jax.tree.map(lambda x: 2 * by_row(x), moments.nu)
    moments = dataclasses.replace(moments, mu=mu, nu=nu)
    change = event.apply(Due(views=[seen_from(camera)]), model, moments, ())
    return model, camera, statistics, change


def test_those_that_show_least_go_and_all_of_a_gaussian_moves_along():
    model, camera, statistics, change = pruned(Prune(share=0.9))
    weights = shown_in(model, Due(views=[seen_from(camera)])).weights
    left = int(change.model.num_live)
    assert left == model.num - round(0.9 * model.num)
    kept = change.rows[:left]
    gone = change.rows[left : model.num]
    assert weights[kept].min() >= weights[gone].max() > 0
    np.testing.assert_array_equal(change.rows[model.num :], np.arange(model.num, model.gaussians.num))
    assert (np.diff(kept) > 0).all()
    assert sorted(change.rows) == list(range(model.gaussians.num))
    for name in ("means", "sh", "logit_opacities"):
        old, new = (np.asarray(getattr(one.gaussians, name)) for one in (model, change.model))
        np.testing.assert_array_equal(new, old[change.rows])
    np.testing.assert_array_equal(change.moments.mu.gaussians.quats[:, 0], change.rows)
    np.testing.assert_array_equal(change.moments.nu.gaussians.means[:, 2], 2 * change.rows)
    moved = SplitByGradient(400).gather(statistics, change.rows)
    np.testing.assert_array_equal(moved.gradients.total, np.asarray(statistics.gradients.total)[change.rows])
    np.testing.assert_array_equal(moved.pixels, np.asarray(statistics.pixels)[change.rows])


def test_a_number_is_kept():
    assert pruned(Prune(keep=120))[-1].model.num == 120
    model, _, _, change = pruned(Prune(keep=1_000))
    assert change.model.num == model.num


def test_degrees_stay_with_their_gaussians():
    model, _, camera = banded(0)
    with pytest.raises(ValueError, match="prune before"):
        Prune().apply(Due(views=[seen_from(camera)]), model, adam_init(partition(model)[0]), ())


def test_times_must_exist():
    for at in ((0.5, 0.2), (0.0,), (0.5, 1.1)):
        with pytest.raises(ValueError, match="above 0, up to 1"):
            Prune(at=at).times(100)
    assert Prune(at=(0.5, 1.0)).times(100) == (50, 100)


def test_impossible_numbers_are_refused_before_training():
    stage = a2tg.Gaussians2dMcmc.preset("smoke").stages()[0]
    for event, message in (
        (Prune(share=1.0), r"Prune\.share must be at least 0 and below 1; got 1.0$"),
        (Prune(share=-0.1), r"Prune\.share must be"),
        (Prune(keep=40.0), r"Prune\.keep must be int \| None; got 40\.0$"),
        (Prune(keep=1), r"Prune\.keep must be at least 2; got 1$"),
    ):
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(stage, events=(event,)).check()


def test_two_gaussians_are_left_at_least():
    """Pruning 0.993 of 300 Gaussians leaves 2. Pruning 0.997 would leave 1, so none is pruned."""
    assert pruned(Prune(share=0.993))[-1].model.num == 2
    with pytest.warns(UserWarning, match=r"^nothing is pruned, because 1 of 300 .* needs 2: lower the share$"):
        assert pruned(Prune(share=0.997))[-1].model.num == 300


def test_what_has_no_row_for_each_gaussian_does_not_move_by_itself():
    with pytest.raises(ValueError, match=r"SplitByGradient has gathered an array \[3\], .* override gather"):
        SplitByGradient(10).gather(jnp.arange(3.0), np.arange(5))


@pytest.fixture(scope="module")
def scene():
    return a2tg.synthetic_scene(num_views=4, width=24, height=16, num_points=120)


SYSTEM = dataclasses.replace(
    a2tg.Bytewise.preset("smoke"),
    stage1_iterations=200,
    stage2_iterations=10,
    memory_budget="30kB",
    initial_gaussians=None,
    prune=Prune(share=0.4, at=(0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)),
)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:training does not learn")  # 40 % of the Gaussians go at each pruning.
def test_others_grow_where_some_were_pruned(scene):
    """Up to the cap again, within the bytes, and down to what is kept at the end; after a checkpoint, too."""
    result, checkpoints = fit_keeping_checkpoints(scene, SYSTEM, every=70)
    numbers = result.stages[0].history.num_gaussians
    assert (np.diff(numbers) < 0).any() and numbers.max() == 30_000 // 56
    assert result.history.megabytes.max() <= 0.03
    assert result.stages[0].model.num == 30_000 * 90 // 100 // 56
    assert 0.995 * 30_000 <= result.model.num_bytes <= 30_000
    assert [int(one.state.iteration) for one in checkpoints[:2]] == [70, 140]
    again = a2tg.fit(scene, SYSTEM, resume=checkpoints[1])
    assert bits_of(again.model) == bits_of(result.model)


@pytest.mark.long
@pytest.mark.parametrize("name", ["gaussians-2d", "gaussians-2d-mcmc"])
def test_plain_systems_prune_and_grow_again(scene, name):
    system = a2tg.find_system(name).preset("smoke")
    system = dataclasses.replace(
        system, stage1_iterations=200, memory_budget="30kB", initial_gaussians=None, sh_degree=0,
        prune=Prune(share=0.3, at=(0.2, 0.3)),
    )  # fmt: skip
    assert not any(isinstance(event, Prune) for event in a2tg.find_system(name).stages()[0].events)
    result = a2tg.fit(scene, system)
    numbers = result.history.num_gaussians
    assert (np.diff(numbers) < 0).any() and result.model.num == 30_000 // 52


def test_times_after_the_last_growth_are_refused():
    with pytest.raises(
        ValueError, match=r"prune.at must hold a fraction before the last growth, .* of 30,000; got \(0.6"
    ):
        dataclasses.replace(a2tg.Gaussians2d(), prune=Prune(share=0.3, at=(0.6, 0.7))).check()
    dataclasses.replace(a2tg.Gaussians2dMcmc(), prune=Prune(share=0.3, at=(0.6, 0.7))).check()
    # The last growth comes halfway through a long stage, but at iteration 90 of 200.
    pruning = {"prune": {"share": 0.5, "at": (0.49,)}}
    message = r"^prune\.at must hold a fraction before the last growth, .* 90 of 200; got \(0\.49,\): lower the first"
    with pytest.raises(ValueError, match=message):
        a2tg.Gaussians2d.preset("smoke", stage1_iterations=200, **pruning).check()
    a2tg.Gaussians2d.preset("smoke", stage1_iterations=30_000, **pruning).check()


def test_default_times_suit_short_stages():
    """Some have no growth, and then no pruning."""
    for iterations in (1, 10, 11, 12, 30, 60, 100):
        a2tg.Bytewise.preset("smoke", stage1_iterations=iterations).check()


@pytest.mark.long
def test_what_other_events_have_gathered_follows(scene):
    system = dataclasses.replace(SYSTEM, place=a2tg.PlaceByError(share=0.0))  # New Gaussians have gathered nothing.
    run = StageRun(scene, system, 0, initial_model(scene, system))
    first = system.stages()[0].events[2].times(200)[0]
    run.steps(1, first)
    totals = {tuple(mean): total for mean, total in zip(*gathered(run), strict=True)}
    assert len(set(totals.values())) > 20
    num = run.model.num
    run.apply_events(first)
    assert run.model.num < num
    means, moved = gathered(run)
    assert [totals[tuple(mean)] for mean in means] == list(moved)


def gathered(run: StageRun) -> tuple[np.ndarray, np.ndarray]:
    """Where the Gaussians are, and what was gathered of each."""
    num = run.model.num
    return np.asarray(run.state.model.gaussians.means)[:num], np.asarray(run.state.events[1].gradients.total)[:num]
