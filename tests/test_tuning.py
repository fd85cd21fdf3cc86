"""Training with rounding: its grids are those of the file, it makes up for rounding, and the loss stays in bounds."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_files import GROUPS, compact_bytes, grids_of, half_turned, model_in
from small_models import numbers_of, origin_of
from small_values import moved_by, some_gaussians
from test_compact import MODELS, SETTINGS, order_of
from test_compaction import SCENE, a_model

import a2tg_jax as a2tg
from a2tg_jax import (
    Appearance,
    CompactChoices,
    DivergedError,
    Exponents,
    Model,
    Scene,
    Trial,
    Tuned,
    allocate_appearance,
    evaluate,
    loss_on_views,
    tune_compact,
)
from a2tg_jax.finish import tuning
from a2tg_jax.finish.compaction import TooLargeError
from a2tg_jax.finish.tuning import (
    TUNED_LADDER,
    GradualRounding,
    GridRounding,
    TunedFiles,
    best_tuned,
    partly_rounded,
    smallest_tuned,
)
from a2tg_jax.results.run_evaluation import refined_views

COARSE = CompactChoices(
    means=14, log_scales=4, quats=4, opacities=3, sh_0=4, sh_rest=3, texels=3, shapes=3, coder="none"
)
SYSTEM = a2tg.find_system("gaussians-2d-mcmc").preset("smoke", sh_degree=0)
FINE = CompactChoices().keeping(dict.fromkeys(GROUPS, 16))
round_to = jax.jit(lambda rounding, model: rounding(model))


def moved(model: Model, size: float = 0.05) -> Model:
    """The model with other numbers, some of them beyond the ends of its grids."""
    rng = np.random.default_rng(3)
    floats, rest = a2tg.partition(model)
    floats = jax.tree.map(lambda x: x + size * jnp.asarray(rng.normal(size=x.shape), x.dtype), floats)
    return a2tg.combine(floats, rest)


def assert_same(found: Model, wanted: Model) -> None:
    for name, values in numbers_of(found).items():
        np.testing.assert_allclose(values, numbers_of(wanted)[name], rtol=2e-5, atol=2e-6, err_msg=name)


@pytest.mark.parametrize(
    "name",
    ["banded, shaped and textured", *(pytest.param(name, marks=pytest.mark.long) for name in ("plain 4", "banded 1"))],
)
def test_training_and_the_file_round_alike(name):
    """Numbers that training has moved beyond the ends of the grids as well."""
    start = half_turned(MODELS[name]())
    grids = grids_of(start, COARSE)
    assert compact_bytes(start, COARSE, grids) == compact_bytes(start, COARSE)
    changed = moved(start)
    rounded = round_to(GridRounding.to(grids, COARSE), changed)
    assert compact_bytes(changed, COARSE, grids) == compact_bytes(rounded, COARSE, grids)
    found = model_in(compact_bytes(rounded, COARSE, grids))
    assert_same(found, rounded[order_of(rounded, found)])
    camera = start.origin.cameras[0]
    images = [np.asarray(one.render(camera, settings=SETTINGS).color) for one in (found, rounded, changed)]
    assert np.abs(images[0] - images[1]).max() < 2e-4 < np.abs(images[1] - images[2]).max()


@pytest.mark.long
@pytest.mark.parametrize("precision", ["float32", "float16"])
def test_groups_kept_as_floats_are_not_rounded(precision):
    start = half_turned(MODELS["banded, shaped and textured"]())
    choices = CompactChoices().keeping(dict.fromkeys(GROUPS, precision))
    grids = grids_of(start, choices)
    assert not grids
    rounded = round_to(GridRounding.to(grids, choices), start)
    assert all(map(np.array_equal, jax.tree.leaves(rounded), jax.tree.leaves(start)))


@pytest.mark.long
def test_numbers_are_rounded_one_after_the_other_and_stay():
    start = half_turned(MODELS["banded, shaped and textured"]())
    rounding = GridRounding.to(grids_of(start, COARSE), COARSE)
    times = GradualRounding(rounding).init(start)
    wanted = round_to(rounding, start)
    jitted = jax.jit(partly_rounded)
    before = np.zeros(0, int)
    for share in (0.0, 0.3, 0.6, 1.0):
        found = jitted(rounding, moved(start, 1e-4), jax.tree.map(lambda time, share=share: time < share, times))
        pairs = zip(jax.tree.leaves(found.gaussians), jax.tree.leaves(wanted.gaussians), strict=True)
        same = np.concatenate([np.isclose(a, b, rtol=1e-5, atol=1e-6).reshape(-1) for a, b in pairs])
        on_grid = np.flatnonzero(same)
        # w of quaternions moves along with their other numbers.
        assert len(np.setdiff1d(before, on_grid)) <= 0.02 * len(same) and abs(same.mean() - share) < 0.15
        before = on_grid
    assert_same(found, round_to(rounding, moved(start, 1e-4)))


@functools.cache
def trained_model() -> Model:
    """A model that has learned; 16 bits round next to nothing."""
    return tune_compact(a_model(), SCENE, SYSTEM, FINE, iterations=2000).model


@functools.cache
def tuned_model(choices: CompactChoices = COARSE) -> Tuned:
    return tune_compact(trained_model(), SCENE, SYSTEM, choices, iterations=300)


@pytest.mark.long
def test_tuning_makes_up_for_rounding():
    """It ends above the same training whose result is rounded afterwards, and below the one without rounding."""
    fine = tuned_model(FINE).model
    loss = loss_on_views(fine, SCENE.train)
    lost = loss(tuned_model().model)
    untuned = loss(model_in(compact_bytes(fine, COARSE)))
    assert untuned > 1 and 0 < lost < 0.8 * untuned
    assert tuned_model().model.origin == fine.origin == a_model().origin


@pytest.mark.long
def test_the_file_holds_the_tuned_model(tmp_path):
    found = tuned_model()
    again = model_in(found.data)
    assert_same(again, found.model[order_of(found.model, again)])
    assert abs(loss_on_views(found.model, SCENE.train)(again)) < 1e-4
    assert_same(round_to(GridRounding.to(found.grids, found.choices), found.model), found.model)
    a2tg.save_compact(tmp_path / "scene.a2tgz", found.model, choices=found.choices, grids=found.grids)
    assert (tmp_path / "scene.a2tgz").read_bytes() == found.data


def test_models_with_textures_are_tuned():
    system = a2tg.find_system("a2tg").preset("smoke", sh_degree=0)
    appearance = allocate_appearance(system.stages()[-1].appearance, jax.random.key(0), a_model().gaussians)
    found = tune_compact(dataclasses.replace(a_model(), appearance=appearance), SCENE, system, COARSE, iterations=2)
    assert found.model.textures is not None and model_in(found.data).num == a_model().num


def shaped_model():
    gaussians = some_gaussians()
    return Model(gaussians, allocate_appearance(Appearance(exponents=Exponents()), jax.random.key(0), gaussians))


@pytest.mark.parametrize(
    ("make", "iterations", "kind", "words"),
    [
        (a_model, 0, ValueError, "iterations must be at least 1; got 0"),
        (
            shaped_model,
            5,
            ValueError,
            "stage of the system, .gaussians., trains, .* it has Gaussians with exponents",
        ),
        (a_model, 3, DivergedError, "stage tuning"),
    ],
)
def test_what_cannot_be_tuned_is_refused(make, iterations, kind, words):
    rates = dataclasses.replace(SYSTEM.rates, log_scales=1e30 if kind is DivergedError else SYSTEM.rates.log_scales)
    with pytest.raises(kind, match=words):
        tune_compact(make(), SCENE, dataclasses.replace(SYSTEM, rates=rates), COARSE, iterations=iterations)


# Corrections

TWISTS = 0.03 * np.random.default_rng(5).normal(size=(len(SCENE.train), 6))
SHIFTS = np.linspace(-0.1, 0.1, len(SCENE.train))
EXPOSURES = np.eye(3, 4) + SHIFTS[:, None, None] * np.array([[3.0, 0, 0, 0.2], [0, 2, 0, 0.2], [0, 0, 3, -0.2]])
CORRECTED = dataclasses.replace(SYSTEM, exposure=True, refine_poses=True)


def misplaced(view, exposure, twist):
    """The view as a camera took it that is exposed so, and whose pose is off by a twist."""
    viewmat = moved_by([*-twist[:3], 0, 0, 0], view.camera.viewmat.at[:3, 3].add(-twist[3:]))
    pixels = np.clip(view.image / 255 @ exposure[:, :3].T + exposure[:, 3], 0, 1)
    camera = dataclasses.replace(view.camera, viewmat=jnp.asarray(viewmat))
    return dataclasses.replace(view, camera=camera, picture=np.round(255 * pixels).astype(np.uint8))


@functools.cache
def corrected() -> tuple[Scene, Model]:
    """A scene of misplaced views, and a model that has learned how they are."""
    views = tuple(map(misplaced, SCENE.train, EXPOSURES, TWISTS))
    origin = origin_of(SCENE)
    num_test = len(SCENE.test)
    learned = {
        "exposure": np.concatenate([EXPOSURES, np.tile(np.eye(3, 4), (num_test, 1, 1))]),
        "pose": np.concatenate([TWISTS, np.zeros((num_test, 6))]),
    }
    origin = dataclasses.replace(origin, corrections=learned)
    return dataclasses.replace(SCENE, train=views), dataclasses.replace(trained_model(), origin=origin)


def corrected_psnr(scene: Scene, model: Model) -> float:
    return evaluate(refined_views(scene.train, model), model, fit_colors=True).psnr


@pytest.mark.long
def test_tuning_keeps_what_was_learned_of_the_photographs():
    """A second tuning too, which starts from the first."""
    scene, model = corrected()
    assert evaluate(scene.train, model).psnr < corrected_psnr(scene, model) - 3
    for _ in range(2):
        tuned = tune_compact(model, scene, CORRECTED, FINE, iterations=100).model
        assert corrected_psnr(scene, tuned) > corrected_psnr(scene, model) - 0.02
        assert tuned.origin == corrected()[1].origin and sorted(tuned.origin.corrections) == ["exposure", "pose"]
        model = tuned


@pytest.mark.long
def test_a_model_without_what_was_learned_of_the_photographs_is_refused():
    """A compact file gives back such a model, which would be trained towards photographs that nothing corrects."""
    scene, model = corrected()
    bare = dataclasses.replace(model, origin=dataclasses.replace(model.origin, corrections={}))
    with pytest.raises(ValueError, match="corrections that training learned, pose and exposure, which a compact file"):
        tune_compact(bare, scene, CORRECTED, FINE, iterations=1)


@pytest.mark.long
def test_corrections_keep_their_rows(monkeypatch):
    found = []
    fit_stage = tuning.fit_stage
    monkeypatch.setattr(tuning, "fit_stage", lambda *a, **options: found.append(fit_stage(*a, **options)) or found[0])
    scene, model = corrected()
    tune_compact(model, scene, CORRECTED, FINE, iterations=5)
    for name, rows in model.origin.corrections.items():
        np.testing.assert_array_equal(found[0].model.origin.corrections[name], rows.astype(np.float32))


# The search


@pytest.mark.parametrize(
    ("losses", "max_loss", "tolerances", "kept"),
    [
        pytest.param((0.05, 0.05, 0.3, 0.05), 0.05, (0.5, 1, 2, 2**0.5), 3, id="doubles until too much is lost"),
        pytest.param((0.2, 0.0, 0.04, 0.3), 0.05, (0.5, 0.5**1.5, 0.5, 0.5**0.5), 2, id="tries again after training"),
        pytest.param((1.5, 3, 2, 1.5), 1.5, (3, 6, 18**0.5, 3), 0, id="begins beyond a large loss"),
        pytest.param((0.0, 1.0, 1.0, 0.0), 0.05, (0.5, 1, 0.5**0.5, 0.5), 0, id="keeps no larger file"),
        pytest.param((0.401,) * 4, 0.4, (0.8, 0.8 * 0.5**0.5, 0.4, 0.4), None, id="keeps nothing beyond the loss"),
        pytest.param((0.0, 0.0, "diverges"), 0.05, (0.5, 1, 2), 1, id="ends where a tuning diverges"),
    ],
)
def test_the_search(monkeypatch, losses, max_loss, tolerances, kept):
    """Its tolerances before tuning, the file it keeps, and the models it starts from, given losses after tuning."""
    tried = []
    started = []

    def within(model, measures, tolerance, trials):
        tried.append(tolerance)
        return Trial(CompactChoices(means=16 - len(tried)), 0, (tolerance,))

    def tune(model, choices, number):
        assert number == len(tried)
        started.append(model)
        if losses[number - 1] == "diverges":
            raise DivergedError("the loss has exploded", None)
        return Tuned(number, choices, {})

    def measured(found, measures):
        return Trial(found.choices, round(1000 / tried[-1]), (losses[len(tried) - 1],))

    monkeypatch.setattr(tuning, "smallest_within", within)
    monkeypatch.setattr(tuning, "_measured", measured)
    found = smallest_tuned("model", [], max_loss, [], tune)
    np.testing.assert_allclose(tried, tolerances)
    assert started == ["model", 1, 2, 3][: len(started)]
    assert found.diverged == ("the loss has exploded" if "diverges" in losses else None)
    assert len(found.tried) == (2 if found.diverged else 4)
    assert found.tuned is None if kept is None else (found.tuned.model, found.chosen) == (kept + 1, found.tried[kept])


def test_the_search_ends_without_choices_and_at_the_coarsest(monkeypatch):
    choices = CompactChoices()

    def tune(*_):
        return Tuned("tuned", choices, {})

    assert smallest_tuned(a_model(), [lambda _: 1.0], 0.05, [], tune) == TunedFiles([])
    monkeypatch.setattr(tuning, "smallest_within", lambda *a: Trial(choices, 0, (0.0,)))
    monkeypatch.setattr(tuning, "_measured", lambda *a: Trial(choices, 7, (0.0,)))
    found = smallest_tuned("model", [], 0.05, [], tune)
    assert len(found.tried) == 1 and found.tuned.model == "tuned"


@pytest.mark.parametrize(
    ("growth", "targets", "kept"),
    [
        pytest.param((1.0,), (990,), 0, id="mostly fits at once"),
        pytest.param((1.05, 1.05), (990, 943), 1, id="is tuned again for fewer bytes"),
        pytest.param((1.5, 1.5), (990, 660), 1, id="grows by half"),
        pytest.param((2.0, "diverges"), (990, 495), None, id="ends where a tuning diverges"),
        pytest.param((9.0, "too coarse"), (990, 110), None, id="ends at the coarsest bits"),
        pytest.param((1.5, 1.6, 1.8, 2.0), (990, 660, 618, 549), None, id="gives up after four"),
    ],
)
def test_the_search_for_a_file_of_given_bytes(monkeypatch, growth, targets, kept):
    """Bytes before tuning, and the file it keeps, given by how much files grow in tuning."""
    asked = []
    started = []

    def within(model, max_bytes, trials):
        assert model == "model"
        asked.append(max_bytes)
        if growth[len(asked) - 1] == "too coarse":
            raise TooLargeError(2000)
        return CompactChoices()

    def tune(model, choices, number):
        started.append(model)
        if growth[number - 1] == "diverges":
            raise DivergedError("the loss has exploded", None)
        return Tuned(number, choices, {})

    monkeypatch.setattr(tuning, "best_within", within)
    sized = lambda found, measures: Trial(found.choices, round(asked[-1] * growth[len(asked) - 1]), (0.0,))  # noqa: E731
    monkeypatch.setattr(tuning, "_measured", sized)
    found = best_tuned("model", [], 1000, [], tune)
    np.testing.assert_allclose(asked, targets, atol=1)
    num_tuned = len(growth) - ("too coarse" in growth)
    assert started == ["model", 1, 2, 3][:num_tuned]
    assert found.diverged == ("the loss has exploded" if "diverges" in growth else None)
    if kept is None:
        assert found.chosen is None and found.tuned is None
    else:
        assert found.chosen.num_bytes <= 1000 and found.tuned.model == kept + 1 == len(found.tried)


def test_coarser_choices_come_first():
    assert set(TUNED_LADDER) == set(GROUPS)
    assert all(list(steps) == sorted(set(steps)) for steps in TUNED_LADDER.values())
