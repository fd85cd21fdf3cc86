"""Training end to end on a tiny scene: traces, resumption, reproduction, overflow, budgets, refusals."""

import dataclasses
import resource

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bits import bits_of
from compiled_programs import compiled_programs
from kept_checkpoints import fit_keeping_checkpoints
from own_process import passes_in_its_own_process
from small_models import with_row

from a2tg_jax import (
    A2tg,
    Appearance,
    Change,
    Checkpoint,
    CloneSplitPrune,
    Gaussians2d,
    Gaussians2dMcmc,
    Interrupted,
    LossConfig,
    Mcmc,
    RenderSettings,
    Session,
    Stage,
    StepEvent,
    Term,
    Texture,
    Upscale,
    allocate_appearance,
    fit,
    fit_stage,
    like,
    load_checkpoint,
    pytree,
    save_checkpoint,
    ssim,
    synthetic_scene,
    view_image,
)
from a2tg_jax.core.table import Layout
from a2tg_jax.training import loop
from a2tg_jax.training.loop import StageRun
from a2tg_jax.training.start import initial_model, padded
from a2tg_jax.training.step import jitted_step

CONFIG = A2tg(
    stage1_iterations=24,
    stage2_iterations=20,
    initial_gaussians=100,
    densify=Mcmc(cap=110),
    texture=Upscale(at=(0.3, 0.6)),
    seed=3,
)
NUM_EVENTS = 2


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene(num_views=8, width=40, height=30, num_points=150)


@pytest.fixture(scope="module")
def trained(scene):
    """A whole run, its checkpoints, and how many traces it took."""
    jitted_step().clear_cache()
    with compiled_programs("train_step") as programs:
        result, checkpoints = fit_keeping_checkpoints(scene, CONFIG)
    return result, checkpoints, len(programs)


def assert_same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a.model, b.model)


def test_both_stages_improve_and_grow(trained):
    result, _, num_traces = trained
    assert num_traces == 1 + 1 + NUM_EVENTS + result.num_regrown
    history = result.history
    assert history.stage.tolist() == [1] * 3 + [2] * 2
    assert np.isfinite(history.loss).all()
    assert history.loss[-1] < history.loss[0]
    assert result.model.num == 110
    assert result.model.textures.num_texels > 110
    for bucket in result.model.textures.buckets:
        alpha = np.asarray(bucket)[..., 3]
        assert alpha.min() >= 0 and alpha.max() <= 1


@pytest.mark.parametrize("place", [None, pytest.param(0, marks=pytest.mark.long), 1, -2])
def test_a_second_or_resumed_run_is_the_same(scene, trained, tmp_path, place):
    result, checkpoints, _ = trained
    resume = None
    if place is not None:
        save_checkpoint(tmp_path / "checkpoint.npz", checkpoints[place])
        resume = load_checkpoint(tmp_path / "checkpoint.npz")
    assert_same(fit(scene, CONFIG, resume=resume), result)


@pytest.mark.long
def test_what_ran_before_in_the_process_changes_nothing(scene, trained):
    """Runs in between leave larger tile lists, other buckets of textures, other programs, another seed's orders."""
    before = trained[0]
    texture = Upscale(at=(0.5,), cap=8, fraction=0.9)
    other = fit(scene, dataclasses.replace(CONFIG, densify=Mcmc(cap=150), texture=texture, seed=4))
    fit(scene, Gaussians2d(stage1_iterations=20, densify=CloneSplitPrune(cap=200), batch_size=2))
    again = fit(scene, CONFIG)
    assert bits_of(again.model) == bits_of(before.model)
    jax.tree.map(np.testing.assert_array_equal, again.stages[0].model, before.stages[0].model)
    np.testing.assert_array_equal(again.history.loss, before.history.loss)
    assert bits_of(other.model) != bits_of(before.model)


@pytest.mark.long
@pytest.mark.parametrize(("calls", "stage"), [(17, 0), (40, 1)])
def test_a_stop_between_any_two_steps_changes_nothing(scene, trained, tmp_path, calls, stage):
    left = iter(range(calls))
    kept = []

    def keep(checkpoint):
        kept.append((checkpoint.stage, checkpoint.iteration))
        save_checkpoint(tmp_path / "checkpoint.npz", checkpoint)

    rows = []
    with pytest.raises(Interrupted, match=f"of stage {stage + 1}; the model is error.checkpoint.model") as stopped:
        is_stopped = lambda: next(left, None) is None  # noqa: E731
        fit(scene, CONFIG, on_checkpoint=keep, on_log=rows.append, is_stopped=is_stopped)
    assert kept[-1][0] == stage and 0 < kept[-1][1] < 20 and kept[-1][1] % 10
    saved = load_checkpoint(tmp_path / "checkpoint.npz")
    history = stopped.value.checkpoint.history.to_dict()
    jax.tree.map(np.testing.assert_array_equal, stopped.value.checkpoint.model, saved.model)
    last = [row for row in rows if row["stage"] == stage + 1]
    assert {name: [row[name] for row in last] for name in history} == jax.tree.map(list, history)
    assert_same(fit(scene, CONFIG, resume=load_checkpoint(tmp_path / "checkpoint.npz")), trained[0])


@pytest.mark.long
def test_shapes_of_earlier_runs_change_nothing(scene, tmp_path, request):
    """Textures grow in buckets with the room of another run's textures, one of them for a size that nobody has here."""
    if passes_in_its_own_process(request):
        return
    system = dataclasses.replace(CONFIG, sh_degree=0, texture=Upscale(at=(0.5,)))
    start = initial_model(scene, system)
    whole = fit_stage(scene, system, 1, start)
    textures = whole.model.textures
    session = Session()
    capacities = (*(len(bucket) + 2 for bucket in textures.buckets), 1)
    session.layouts.add(Layout((*textures.bucket_sizes, (5, 5)), capacities))
    path = tmp_path / "checkpoint.npz"
    rooms = []

    def keep(checkpoint):
        if checkpoint.iteration == 16:
            save_checkpoint(path, checkpoint)
            rooms.append(tuple(map(len, checkpoint.state.model.textures.buckets)))

    assert_same(fit_stage(scene, system, 1, start, on_checkpoint=keep, checkpoint_every=8, session=session), whole)
    assert rooms == [capacities]
    assert_same(fit_stage(scene, system, 1, resume=load_checkpoint(path), session=session), whole)


@pytree
class Places(StepEvent):
    """Gathers a number of every row, made of Gaussians and places of textures."""

    def init(self, model):
        return jnp.stack([model.textures.row, jnp.arange(model.gaussians.num, dtype=jnp.int32)])

    def apply(self, now, model, moments, state):
        return Change(model, moments, state)


@dataclasses.dataclass(frozen=True, kw_only=True)
class WithPlaces(A2tg):
    def stages(self):
        first, second = super().stages()
        return first, dataclasses.replace(second, events=(Places(), *second.events))


def test_custom_events_find_all_rows_when_read_again(scene, trained, tmp_path):
    system = like(WithPlaces, CONFIG)
    run = StageRun(scene, system, 1, trained[0].stages[0].model)
    save_checkpoint(tmp_path / "checkpoint.npz", Checkpoint(system, 1, run.state, run.history))
    again = load_checkpoint(tmp_path / "checkpoint.npz", WithPlaces)
    assert again.system == system
    jax.tree.map(np.testing.assert_array_equal, again.state, run.state)


def test_rows_that_do_not_exist_are_not_trained(scene, trained):
    first = trained[0].stages[0].model
    padded_first = dataclasses.replace(first, num_live=jnp.int32(60))
    run = StageRun(scene, CONFIG, 1, padded_first)
    assert run.model.num == 60 == run.state.model.gaussians.num


def test_rows_are_not_added_to_textures_of_another_size(trained):
    start = trained[0].stages[0].model
    template = Appearance(texture=Texture(start=(2, 2)))
    single = allocate_appearance(Appearance(texture=Texture()), jax.random.key(0), start.gaussians).textures
    appearance = template.with_textures(single)
    stage = Stage("more", template, (Mcmc(500),), (), CONFIG.rates, 3_000)
    with pytest.raises(ValueError, match=r"stage 'more' would add Gaussians .* whose textures or degrees have grown"):
        padded(dataclasses.replace(start, appearance=appearance), stage, CONFIG)


def test_what_is_passed_in_stays_usable(scene, trained):
    result, checkpoints, _ = trained
    first = result.stages[0].model
    before = jax.tree.map(np.array, first)
    assert_same(fit_stage(scene, CONFIG, 1, first), result)
    jax.tree.map(np.testing.assert_array_equal, first, before)
    for _ in range(2):
        assert_same(fit(scene, CONFIG, resume=checkpoints[-2]), result)


@pytest.mark.long
def test_events_that_the_host_decides_are_those_of_the_step(scene, trained, monkeypatch):
    """GPUs have one program for each pattern of due events, two in the first stage. The numbers stay the same.

    They are compared up to the first event and one step beyond, before the programs' rounding has grown.
    """

    def states():
        run = StageRun(scene, CONFIG, 0, initial_model(scene, CONFIG))
        due = min(times[0] for times in run.stage.times if len(times) < run.stage.iterations)
        for iteration in range(1, due + 2):
            run.steps(iteration, iteration)
            yield run.state.model

    decided_inside = [jax.tree.map(np.array, model) for model in states()]
    monkeypatch.setattr(loop, "are_events_decided_by_host", lambda state: True)
    with compiled_programs("train_step") as programs:
        for own, other in zip(states(), decided_inside, strict=True):
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), own, other)
    assert len(programs) == 2
    numbers = [int(model.live_count) for model in decided_inside]
    assert len(set(numbers)) == 2 and numbers[-1] == numbers[-2] > numbers[-3]


def test_overflow_loses_nothing(scene):
    def one_step(capacity):
        run = StageRun(scene, CONFIG, 0, initial_model(scene, CONFIG))
        if capacity is not None:
            run.capacities[scene.train[0].picture.size] = capacity
        taken = run.steps(1, 1)
        return run, len(taken) or len(run.steps(1, 1))

    (small, num_small), (ample, num_ample) = one_step(64), one_step(None)
    assert (num_small, num_ample) == (1, 1)
    assert (small.num_regrown, ample.num_regrown) == (1, 0)
    jax.tree.map(np.testing.assert_array_equal, small.state, ample.state)


def test_a_budget_that_the_model_exceeds_is_refused(scene, trained):
    system = dataclasses.replace(CONFIG, texture=Upscale(select="budget", budget_mb=0.001))
    message = r"stage 'textures': Upscale\.apply: .*budget of 0.001 MB is below the 0.027 MB"
    with pytest.raises(ValueError, match=message):
        fit_stage(scene, system, 1, trained[0].stages[0].model)


def with_picture(view, picture):
    return dataclasses.replace(view, picture=picture)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"train": lambda views: ()}, "at least one view"),
        ({"train": lambda views: (with_picture(views[0], views[0].image / 255),)}, r"uint8 .*got float64"),
        ({"train": lambda views: (with_picture(views[0], views[0].image[1:]),)}, r"uint8 \[29, 40, 3\]"),
        ({"points": lambda points: points * np.nan}, "must be finite"),
        ({"colors": lambda colors: colors * np.nan}, "must be finite"),
    ],
)
def test_damaged_scenes_are_refused(scene, change, message):
    with pytest.raises(ValueError, match=message):
        changed = {name: function(getattr(scene, name)) for name, function in change.items()}
        fit(dataclasses.replace(scene, **changed), CONFIG)


def test_wrong_arguments_of_fit_are_refused(scene, trained):
    checkpoint = trained[1][-1]
    with pytest.raises(ValueError, match=rf"another configuration \(seed {CONFIG.seed}, not 4\): resume"):
        fit(scene, dataclasses.replace(CONFIG, seed=4), resume=checkpoint)
    with pytest.raises(ValueError, match=r"another configuration \(A2tg, not Gaussians2dMcmc\)"):
        fit(scene, Gaussians2dMcmc(stage1_iterations=4), resume=checkpoint)
    with pytest.raises(ValueError, match="checkpoint_every must be an int, at least 1; got 0"):
        fit(scene, CONFIG, checkpoint_every=0)
    with pytest.raises(
        ValueError, match=r"^progress must be None, or a class such as a2tg_jax\.ProgressBar; got True$"
    ):
        fit(scene, CONFIG, progress=True)
    with pytest.raises(ValueError, match=r"index must be in 0\.\.1"):
        fit_stage(scene, CONFIG, 2)


@pytest.mark.long
def test_views_of_two_sizes(scene):
    """More views a batch than there are of a size, and a cap below the requested Gaussians."""
    larger = synthetic_scene(num_views=8, width=48, height=30, num_points=150).train
    mixed = dataclasses.replace(scene, train=(scene.train[0], larger[1], scene.train[2]))
    config = Gaussians2dMcmc(stage1_iterations=6, batch_size=3, initial_gaussians=100, densify=Mcmc(cap=40))
    result = fit(mixed, config)
    assert result.model.num == 40 and np.isfinite(result.history.loss).all()


def test_a_full_disk_leaves_the_older_checkpoint(trained, tmp_path):
    """The size that the operating system lets a file have is used up in the middle of writing."""
    path, (older, newer) = tmp_path / "checkpoint.npz", trained[1][:2]
    save_checkpoint(path, older)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(OSError):
            save_checkpoint(path, newer)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [entry.name for entry in tmp_path.iterdir()] == ["checkpoint.npz"]
    assert load_checkpoint(path).iteration == older.iteration


def roughness(model, target, output):
    return jnp.mean(jnp.abs(jnp.diff(output.color, axis=0)))


def test_the_history_has_the_loss_by_term(scene):
    """The terms sum up to the loss, and are what plain functions give; of two lambdas, both are there."""
    own = Term(roughness, 0.1), Term(lambda *_: 0.5), Term(lambda *_: 0.25)
    losses = (*LossConfig(opacity_weight=0.01).terms(), *own)

    class Own(Gaussians2dMcmc):
        def stages(self):
            (stage, *others) = super().stages()
            return (dataclasses.replace(stage, losses=losses), *others)

    logged = []
    system = Own(stage1_iterations=11, stage2_iterations=0, initial_gaussians=60, densify=Mcmc(cap=60))
    history = fit(scene, system, on_log=logged.append).history
    names = ["l1", "ssim", "opacity", "roughness", "lambda", "lambda_5"]
    assert set(history.terms) == {*names} and len(history.loss) == 2
    np.testing.assert_allclose(sum(history.terms[name] for name in names), history.loss, rtol=1e-6)
    np.testing.assert_array_equal(history.terms["lambda"], 0.5)
    np.testing.assert_array_equal(history.terms["lambda_5"], 0.25)
    assert logged[1]["loss_roughness"] == history.to_dict()["loss_roughness"][1] > 0
    start = initial_model(scene, system)
    first = fit_stage(scene, dataclasses.replace(system, stage1_iterations=1), 0, start).history
    np.testing.assert_allclose(first.terms["opacity"], [0.01 * np.mean(start.gaussians.opacities)], rtol=1e-5)
    (view,) = [view for view in scene.train if abs(_l1(start, view) * 0.8 - first.terms["l1"][0]) < 1e-6]
    similarity = ssim(start.render(view.camera).color, view_image(view, (0, 0, 0)))
    np.testing.assert_allclose(first.terms["ssim"], [0.2 * (1 - similarity)], rtol=1e-4)


def _l1(model, view):
    settings = RenderSettings(sh_degree=0)
    return float(jnp.mean(jnp.abs(model.render(view.camera, settings=settings).color - view_image(view, (0, 0, 0)))))


def test_a_checkpoint_keeps_the_loss_by_term(trained, tmp_path):
    """A row without a term has NaN."""
    kept = trained[1][1]
    save_checkpoint(tmp_path / "c.npz", kept)
    found = load_checkpoint(tmp_path / "c.npz").history
    assert set(found.terms) == {"l1", "ssim"} and len(found.loss)
    np.testing.assert_array_equal(found.terms["ssim"], kept.history.terms["ssim"])
    longer = with_row(found, 1, 99, 0.3, 20.0, 5, 0.1, 9.0, depth=0.25)
    np.testing.assert_array_equal(longer.terms["depth"], [*[np.nan] * len(found.loss), 0.25])
    assert np.isnan(longer.terms["l1"][-1])
