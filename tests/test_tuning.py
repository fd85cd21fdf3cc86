"""Training with rounding: its grids are those of the file, it makes up for rounding, and the loss stays in bounds."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_values import some_gaussians
from test_compact import MODELS, SETTINGS, every_model, order_of
from test_compaction import SCENE, a_model

import a2tg_jax as a2tg
from a2tg_jax.appearance import Appearance, Exponents, allocate_appearance, files
from a2tg_jax.core.cameras import moved_viewmat
from a2tg_jax.data import Scene
from a2tg_jax.data.scene import origin_of_scene
from a2tg_jax.finish import tuning
from a2tg_jax.finish.compaction import Trial, loss_on_views
from a2tg_jax.finish.tuning import (
    MOST_TUNINGS,
    TUNED_LADDER,
    GradualRounding,
    GridRounding,
    Tuned,
    TunedFiles,
    partly_rounded,
    smallest_tuned,
    tune_compact,
)
from a2tg_jax.io.compact import GROUPS, CompactChoices, decode_model, encode_model, grids_of, half_turned
from a2tg_jax.measure.evaluation import evaluate
from a2tg_jax.model import Model
from a2tg_jax.results.run_evaluation import refined_views
from a2tg_jax.training import DivergedError, Stage
from a2tg_jax.training.corrections import Correction, Exposure, PoseRefinement, exposed

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


def arrays_of(model: Model) -> dict[str, np.ndarray]:
    own = {field.name: getattr(model.gaussians, field.name) for field in dataclasses.fields(model.gaussians)}
    shown = files.arrays_of(model.appearance, model.gaussians.sh_degree)
    return {name: np.asarray(x) for name, x in (own | shown).items()}


def assert_same(found: Model, wanted: Model) -> None:
    for name, values in arrays_of(found).items():
        np.testing.assert_allclose(values, arrays_of(wanted)[name], rtol=2e-5, atol=2e-6, err_msg=name)


@every_model
def test_training_and_the_file_round_alike(name):
    """Also numbers that training has moved, beyond the ends of the grids too."""
    start = half_turned(MODELS[name]())
    grids = grids_of(start, COARSE)
    changed = moved(start)
    rounded = round_to(GridRounding.to(grids, COARSE), changed)
    assert encode_model(changed, COARSE, grids) == encode_model(rounded, COARSE, grids)
    found = decode_model(encode_model(rounded, COARSE, grids))
    assert_same(found, rounded[order_of(rounded, found)])
    camera = start.origin.cameras[0]
    images = [np.asarray(one.render(camera, settings=SETTINGS).color) for one in (found, rounded, changed)]
    assert np.abs(images[0] - images[1]).max() < 2e-4 < np.abs(images[1] - images[2]).max()


def test_own_grids_are_those_of_a_file_without():
    start = half_turned(MODELS["banded, shaped and textured"]())
    assert encode_model(start, COARSE, grids_of(start, COARSE)) == encode_model(start, COARSE)


@pytest.mark.parametrize("precision", ["float32", "float16"])
def test_groups_kept_as_floats_are_not_rounded(precision):
    start = half_turned(MODELS["banded, shaped and textured"]())
    choices = CompactChoices().keeping(dict.fromkeys(GROUPS, precision))
    grids = grids_of(start, choices)
    assert not grids
    rounded = GridRounding.to(grids, choices)(start)
    assert all(map(np.array_equal, jax.tree.leaves(rounded), jax.tree.leaves(start)))


def test_numbers_are_rounded_one_after_the_other_and_stay():
    start = half_turned(MODELS["banded, shaped and textured"]())
    rounding = GridRounding.to(grids_of(start, COARSE), COARSE)
    event = GradualRounding(rounding)
    times = event.init(start)
    wanted = round_to(rounding, start)
    before: set[int] = set()
    for share in (0.0, 0.3, 0.6, 1.0):
        is_rounded = jax.tree.map(lambda time, share=share: time < share, times)
        found = jax.jit(partly_rounded)(rounding, moved(start, 1e-4), is_rounded)
        same = jnp.concatenate(
            [
                jnp.isclose(a, b, rtol=1e-5, atol=1e-6).reshape(-1)
                for a, b in zip(jax.tree.leaves(found.gaussians), jax.tree.leaves(wanted.gaussians), strict=True)
            ]
        )
        on_grid = set(np.flatnonzero(same).tolist())
        assert len(before - on_grid) <= 0.02 * len(same)  # w of quaternions moves along with their other numbers.
        assert abs(len(on_grid) / len(same) - share) < 0.15
        before = on_grid
    assert_same(found, round_to(rounding, moved(start, 1e-4)))


@functools.cache
def trained_model() -> Model:
    """A model that has learned; 16 bits round next to nothing."""
    return tune_compact(a_model(), SCENE, SYSTEM, FINE, iterations=2000).model


@functools.cache
def tuned_model(choices: CompactChoices = COARSE) -> Tuned:
    return tune_compact(trained_model(), SCENE, SYSTEM, choices, iterations=600)


def test_tuning_makes_up_for_rounding():
    """It ends above the same training whose result is rounded afterwards, and below the one without rounding."""
    fine = tuned_model(FINE).model
    loss = loss_on_views(fine, SCENE.train)
    lost, untuned = loss(tuned_model().model), loss(decode_model(encode_model(fine, COARSE)))
    assert untuned > 1 and 0 < lost < 0.8 * untuned
    assert tuned_model().model.origin == fine.origin == a_model().origin


def test_the_file_holds_the_tuned_model():
    found = tuned_model()
    again = decode_model(found.data)
    assert_same(again, found.model[order_of(found.model, again)])
    loss = loss_on_views(found.model, SCENE.train)
    assert abs(loss(again)) < 1e-4
    rounded = round_to(GridRounding.to(found.grids, found.choices), found.model)
    assert_same(rounded, found.model)


def test_save_compact_writes_the_tuned_model(tmp_path):
    found = tuned_model()
    a2tg.save_compact(tmp_path / "scene.a2tgz", found.model, choices=found.choices, grids=found.grids)
    assert (tmp_path / "scene.a2tgz").read_bytes() == found.data


def test_a_diverged_tuning_is_an_error():
    spoiled = dataclasses.replace(SYSTEM, rates=dataclasses.replace(SYSTEM.rates, log_scales=1e30))
    with pytest.raises(DivergedError, match="stage tuning"):
        tune_compact(a_model(), SCENE, spoiled, COARSE, iterations=3)


def test_models_with_textures_are_tuned():
    system = a2tg.find_system("a2tg").preset("smoke", sh_degree=0)
    appearance = allocate_appearance(system.stages()[-1].appearance, jax.random.key(0), a_model().gaussians)
    found = tune_compact(dataclasses.replace(a_model(), appearance=appearance), SCENE, system, COARSE, iterations=2)
    assert found.model.textures is not None and decode_model(found.data).num == a_model().num


@pytest.mark.parametrize(
    ("model", "iterations", "words"),
    [
        (a_model(), 0, "iterations must be at least 1; got 0"),
        (
            Model(
                some_gaussians(),
                allocate_appearance(Appearance(exponents=Exponents()), jax.random.key(0), some_gaussians()),
            ),
            5,
            "model must show what the last stage of the system, .gaussians., trains, .* shows Gaussians with exponents",
        ),
    ],
)
def test_what_cannot_be_tuned_is_refused(model, iterations, words):
    with pytest.raises(ValueError, match=words):
        tune_compact(model, SCENE, SYSTEM, COARSE, iterations=iterations)


# Corrections

TWISTS = 0.03 * np.random.default_rng(5).normal(size=(len(SCENE.train), 6))
SHIFTS = np.linspace(-0.1, 0.1, len(SCENE.train))
EXPOSURES = np.eye(3, 4) + SHIFTS[:, None, None] * np.array([[3.0, 0, 0, 0.2], [0, 2, 0, 0.2], [0, 0, 3, -0.2]])
CORRECTED = dataclasses.replace(SYSTEM, exposure=True, refine_poses=True)


@dataclasses.dataclass(frozen=True)
class CorrectedStage(a2tg.training.System):
    """A system of one stage."""

    stage: Stage = dataclasses.field(default_factory=lambda: CORRECTED.stages()[-1])

    def stages(self):
        return (self.stage,)


@a2tg.pytree
class OwnExposure(Correction):
    """An exposure whose rate is no field."""

    name = "exposure"
    neutral = np.eye(3, 4)

    def learning_rate(self, progress):
        return 0.1 + 0 * progress

    def color(self, row, color):
        return exposed(row, color)


def misplaced(view, exposure, twist):
    """The view as a camera took it that is exposed so, and whose pose is off by a twist."""
    viewmat = moved_viewmat(jnp.asarray([*-twist[:3], 0, 0, 0]), view.camera.viewmat.at[:3, 3].add(-twist[3:]))
    pixels = np.clip(exposed(jnp.asarray(exposure), jnp.asarray(view.image / 255)), 0, 1)
    camera = dataclasses.replace(view.camera, viewmat=viewmat.astype(np.float32))
    return dataclasses.replace(view, camera=camera, picture=np.round(255 * pixels).astype(np.uint8))


@functools.cache
def corrected() -> tuple[Scene, Model]:
    """A scene of misplaced views, and a model that has learned how they are."""
    views = tuple(map(misplaced, SCENE.train, EXPOSURES, TWISTS))
    origin, num_test = origin_of_scene(SCENE), len(SCENE.test)
    learned = {
        "exposure": np.concatenate([EXPOSURES, np.tile(np.eye(3, 4), (num_test, 1, 1))]),
        "pose": np.concatenate([TWISTS, np.zeros((num_test, 6))]),
    }
    origin = dataclasses.replace(origin, corrections=learned)
    return dataclasses.replace(SCENE, train=views), dataclasses.replace(trained_model(), origin=origin)


def corrected_psnr(scene: Scene, model: Model) -> float:
    return evaluate(refined_views(scene.train, model), model, fit_colors=True).psnr


def test_tuning_keeps_what_was_learned_of_the_photographs():
    """A second tuning too, which starts from the first."""
    scene, model = corrected()
    assert evaluate(scene.train, model).psnr < corrected_psnr(scene, model) - 3
    for _ in range(2):
        tuned = tune_compact(model, scene, CORRECTED, FINE, iterations=100).model
        assert corrected_psnr(scene, tuned) > corrected_psnr(scene, model) - 0.02
        assert tuned.origin == corrected()[1].origin and sorted(tuned.origin.corrections) == ["exposure", "pose"]
        model = tuned


def test_a_model_without_what_was_learned_of_the_photographs_is_refused():
    """A compact file gives back such a model, which would be trained towards photographs that nothing corrects."""
    scene, model = corrected()
    bare = dataclasses.replace(model, origin=dataclasses.replace(model.origin, corrections={}))
    with pytest.raises(ValueError, match="corrections that training learned, pose and exposure, which a compact file"):
        tune_compact(bare, scene, CORRECTED, FINE, iterations=1)


@pytest.mark.parametrize("kind", [OwnExposure, Exposure])
def test_corrections_stay_as_they_are(monkeypatch, kind):
    """Corrections keep their rows while a model is tuned, also those of a user's class without a field `rate`."""
    found, fit_stage = [], tuning.fit_stage

    def fit_and_keep(*arguments, **options):
        found.append(fit_stage(*arguments, **options))
        return found[-1]

    monkeypatch.setattr(tuning, "fit_stage", fit_and_keep)
    scene, model = corrected()
    stage = dataclasses.replace(CORRECTED.stages()[-1], corrections=(PoseRefinement(), kind()))
    tune_compact(model, scene, CorrectedStage(stage=stage), FINE, iterations=5)
    (result,) = found
    for name, rows in model.origin.corrections.items():
        np.testing.assert_array_equal(result.model.origin.corrections[name], rows.astype(np.float32))


# The search


def search(monkeypatch, loss_after, max_loss=0.05):
    """Tolerances tried, what was found and the models started from, if tuning changes a loss so."""
    tolerances, started = [], []

    def within(model, losses, tolerance, trials):
        tolerances.append(tolerance)
        return Trial(CompactChoices(means=max(16 - len(tolerances), 1)), 0, (tolerance,))

    def tune(model, choices, number):
        assert number == len(tolerances)
        started.append(model)
        return Tuned(f"after {tolerances[-1]:.2f}", choices, {})

    def measured(found, losses):
        return Trial(found.choices, round(1000 / tolerances[-1]), (loss_after(tolerances[-1]),))

    monkeypatch.setattr(tuning, "smallest_within", within)
    monkeypatch.setattr(tuning, "_measured", measured)
    return tolerances, smallest_tuned("model", [], max_loss, [], tune), started


def test_the_search_doubles_the_tolerance_until_too_much_is_lost(monkeypatch):
    tolerances, found, started = search(monkeypatch, lambda before: 0.05 if before <= 1.5 else 0.3)
    np.testing.assert_allclose(tolerances, [0.5, 1, 2, 2**0.5])
    assert found.tuned.model == "after 1.41" and found.chosen == found.tried[-1] and len(found.tried) == MOST_TUNINGS
    assert started == ["model", "after 0.50", "after 1.00", "after 2.00"]


def test_what_was_too_much_is_tried_again_after_more_training(monkeypatch):
    left = iter([0.2, 0.0, 0.04, 0.3])
    tolerances, found, _ = search(monkeypatch, lambda before: next(left))
    np.testing.assert_allclose(tolerances, [0.5, 0.5**1.5, 0.5, 0.5**0.5])
    assert found.tuned.model == "after 0.50" and found.chosen == found.tried[2]


def test_the_search_begins_beyond_a_large_loss(monkeypatch):
    tolerances, found, _ = search(monkeypatch, lambda before: before / 2, max_loss=1.5)
    np.testing.assert_allclose(tolerances, [3, 6, 18**0.5, 3])
    assert found.tuned.model == "after 3.00"


def test_a_larger_file_is_not_kept(monkeypatch):
    losses = iter([0.0, 1.0, 1.0, 0.0])
    _, found, _ = search(monkeypatch, lambda before: next(losses))
    assert found.chosen == found.tried[0] and found.tuned.model == "after 0.50"


def test_a_search_in_which_nothing_stays_within_keeps_nothing(monkeypatch):
    tolerances, found, _ = search(monkeypatch, lambda before: 0.401, max_loss=0.4)
    np.testing.assert_allclose(tolerances, [0.8, 0.8 * 0.5**0.5, 0.4, 0.4])
    assert found.chosen is None and found.tuned is None and len(found.tried) == MOST_TUNINGS


def diverged_in(number):
    """A tuning function for the search that diverges in one of its tunings."""

    def tune(model, choices, now):
        if now == number:
            raise DivergedError("the loss has exploded", None)
        return Tuned(f"after {now}", choices, {})

    return tune


def test_a_tuning_that_diverges_ends_the_search(monkeypatch):
    bits = iter([9, 8, 7])
    monkeypatch.setattr(tuning, "smallest_within", lambda *a: Trial(CompactChoices(means=next(bits)), 0, (0.0,)))
    monkeypatch.setattr(tuning, "_measured", lambda found, _: Trial(found.choices, found.choices.means, (0.0,)))
    found = smallest_tuned("model", [], 0.05, [], diverged_in(3))
    assert found.diverged == "the loss has exploded" and len(found.tried) == 2
    assert found.tuned.model == "after 2" and found.chosen.num_bytes == 8


def test_a_search_without_choices_to_start_from_is_empty():
    assert smallest_tuned(a_model(), [lambda _: 1.0], 0.05, [], diverged_in(1)) == TunedFiles([])


def test_the_search_ends_at_the_coarsest_choices(monkeypatch):
    choices = CompactChoices()
    monkeypatch.setattr(tuning, "smallest_within", lambda *a: Trial(choices, 0, (0.0,)))
    monkeypatch.setattr(tuning, "_measured", lambda *a: Trial(choices, 7, (0.0,)))
    found = smallest_tuned("model", [], 0.05, [], lambda *a: Tuned("tuned", choices, {}))
    assert len(found.tried) == 1 and found.tuned.model == "tuned"


def test_coarser_choices_come_first():
    assert all(list(steps) == sorted(steps) for steps in TUNED_LADDER.values())
    assert all(len(set(steps)) == len(steps) for steps in TUNED_LADDER.values())
    assert set(TUNED_LADDER) == set(GROUPS)
