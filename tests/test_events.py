"""Custom events: rows that they remove, programs that they cause, what made no difference, and their errors."""

import dataclasses
import re
import warnings
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_programs import compiled_programs
from test_model_rows import NUM, rows_of, some_model
from toy_system import Rings

import a2tg_jax as a2tg
from a2tg_jax import adam_init, combine, partition
from a2tg_jax.training import loop
from a2tg_jax.training.cost import forecast_stages
from a2tg_jax.training.reports import StageEffects
from a2tg_jax.training.start import initial_state
from a2tg_jax.training.step import jitted_step


@pytest.fixture(scope="module")
def scene():
    return a2tg.synthetic_scene(num_views=3, width=16, height=16, num_points=50)


@a2tg.pytree
class PruneFaint(a2tg.HostEvent):
    """Removes the faintest five of the Gaussians every fourth iteration, in one of several ways."""

    how: str = a2tg.static(default="rows")
    last: int = a2tg.static(default=20)

    def times(self, num_iterations):
        return tuple(range(4, self.last + 1, 4))

    def apply(self, due, model, moments, state):
        opacities = np.asarray(model.gaussians.opacities)[: model.num]
        is_kept = opacities > np.sort(opacities)[4]
        if self.how == "rows":
            return a2tg.keep_rows(model, moments, state, is_kept)
        if self.how == "all":
            return a2tg.keep_rows(model, moments, state, is_kept | True)
        fewer = model[is_kept]
        if self.how == "model":
            return a2tg.Change(fewer, moments, state)
        chosen = jax.tree.map(lambda x: x[: model.num][is_kept] if x.ndim else x, moments)
        return a2tg.Change(fewer, chosen, state)


@a2tg.pytree
class SeesBackground(a2tg.HostEvent):
    """Notes the background that it is given."""

    seen: ClassVar[list] = []

    def times(self, num_iterations):
        return (1,)

    def apply(self, due, model, moments, state):
        self.seen.append(due.background)
        return a2tg.Change(model, moments, state)


@a2tg.pytree
class SeesStatistics(a2tg.HostEvent):
    """Notes in how many views the Gaussians of all rows were seen, and the number of Gaussians."""

    seen: ClassVar[list] = []

    @property
    def statistic(self):
        return "position"

    def times(self, num_iterations):
        return PruneFaint().times(num_iterations)

    def apply(self, due, model, moments, state):
        self.seen.append((np.asarray(state.views), model.num))
        return a2tg.Change(model, moments, state)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Own(a2tg.System):
    """One stage with the events given."""

    events: Any = ()
    iterations: int = 20
    appearance: Any = a2tg.Appearance()
    appearance_rate: Any = None

    def stages(self):
        losses = a2tg.LossConfig(ssim_weight=0.0).terms()
        rates = self.rates, self.iterations, self.appearance_rate
        return (a2tg.Stage("own", self.appearance, self.events, losses, *rates),)


def fitted(scene, *events, **options):
    return a2tg.fit(scene, Own(events=events, sh_degree=0, **options))


def test_rows_that_stay_come_first_at_the_same_shapes():
    """Gaussians, appearance and moments; the mask may have a place for each row, even for those that do not exist."""
    model = some_model("exponents")
    floats, _ = partition(model)
    moments = dataclasses.replace(adam_init(floats), mu=floats)
    is_kept = np.arange(NUM) % 3 != 1
    change = a2tg.keep_rows(model, moments, (), is_kept)
    wanted = [row for row, kept in zip(rows_of(model), is_kept, strict=True) if kept]
    assert change.model.num == len(wanted) == 8
    assert jax.tree.map(jnp.shape, change.model) == jax.tree.map(jnp.shape, model)
    np.testing.assert_array_equal(rows_of(change.model), wanted)
    moved = combine(change.moments.mu, partition(change.model)[1])
    np.testing.assert_array_equal(rows_of(moved), wanted)
    padded = a2tg.keep_rows(model, moments, (), jnp.asarray([*is_kept, True, True]))
    np.testing.assert_array_equal(padded.rows, change.rows)


@pytest.mark.parametrize(
    ("name", "is_kept", "message"),
    [
        ("plain", np.ones(NUM - 1, bool), r"is_kept must be \[12\]; got \[11\]"),
        ("plain", np.ones(NUM), "is_kept must be bools; got float64"),
        ("plain", True, r"is_kept must be \[12\]; got \[\]"),
        ("plain", np.arange(NUM) == 3, "is_kept must keep at least 2 Gaussians; got 1 of 12"),
        ("bands", np.ones(NUM, bool), "sizes cannot change rows: densify and prune before they grow"),
        ("texture", np.arange(NUM) < 5, "textures of 3 sizes cannot change rows: densify and prune before they grow"),
    ],
)
def test_rows_that_cannot_be_removed_are_refused(name, is_kept, message):
    model = some_model(name)
    with pytest.raises(ValueError, match=message):
        a2tg.keep_rows(model, adam_init(partition(model)[0]), (), is_kept)


def test_statistics_of_removed_gaussians_are_gone(scene):
    """Gaussians that are added later take their rows."""
    SeesStatistics.seen.clear()
    fitted(scene, PruneFaint(), SeesStatistics(), iterations=8)
    assert [num for _, num in SeesStatistics.seen] == [45, 40]
    for views, num in SeesStatistics.seen:
        assert views[:num].any() and not views[num:].any()


@pytest.mark.long
def test_an_event_that_removes_rows_compiles_nothing(scene):
    """With rows of other shapes each time is a program, of which the third warns; the model is the same."""

    def trained(how):
        with compiled_programs("train_step") as programs:
            result = fitted(scene, PruneFaint(how), iterations=22)
        assert result.num_regrown == 0
        return result, len(programs)

    jitted_step().clear_cache()
    kept, num_kept = trained("rows")
    assert num_kept == 1 and kept.model.num == 50 - 5 * 5
    message = (
        r"stage 'own': PruneFaint has changed shapes 3 times, .* it happens 2 times more: keep shapes, by keep_rows\("
    )
    with pytest.warns(UserWarning, match=message) as caught:
        cut, num_cut = trained("moments")
    assert len(caught) == 1 and num_cut == 6
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), kept.model, cut.model)


def test_programs_are_counted_before_and_while_it_trains(scene):
    """An event is expected to cause a program each time until it has happened, and then what it did."""
    event = PruneFaint(last=156)
    system = Own(events=(event,), sh_degree=0, iterations=160)
    assert next(forecast_stages(scene, system)).num_programs == 40
    stage = system.stages()[0]
    state = initial_state(stage, dataclasses.replace(some_model("plain"), num_live=jnp.int32(NUM + 2)))
    arguments = state.model, state.moments, ()
    for how, ahead in (("rows", 0), ("moments", 38)):
        effects = StageEffects(stage, system, num_sizes=1)
        effects.launch(1, 2, 20.0)
        assert effects.programs_ahead(1) == effects.programs_ahead(4) == 39
        effects.apply(0, state, PruneFaint(how).apply(a2tg.Due(), *arguments))
        effects.launch(5, 0 if how == "rows" else 1, 16.0)
        assert effects.programs_ahead(5) == ahead
    assert effects.seconds_a_program == 12.0
    assert StageEffects(stage, system, num_sizes=3).programs_ahead(1) == 3 * 39


@a2tg.pytree
class Late(a2tg.StepEvent):
    def times(self, num_iterations):
        return range(50, 101, 10)

    def apply(self, now, model, moments, state):
        return a2tg.Change(model, moments, state)


@a2tg.pytree
class Summing(a2tg.StepEvent):
    """Adds up the iterations at which it happens, and how often it says that it still does."""

    def times(self, num_iterations):
        return 2, 5, 6

    def init(self, model):
        return jnp.zeros(2, jnp.int32)

    def apply(self, now, model, moments, state):
        return a2tg.Change(model, moments, state + jnp.stack([now.iteration, now.num_left]))


@pytest.mark.parametrize("is_decided_by_host", [False, True])
def test_events_in_the_step_happen_at_any_times(scene, monkeypatch, is_decided_by_host):
    monkeypatch.setattr(loop, "are_events_decided_by_host", lambda state: is_decided_by_host)
    state = fitted(scene, Summing(), iterations=7).checkpoint.state
    np.testing.assert_array_equal(state.events[0], [2 + 5 + 6, 3 + 2 + 1])


@a2tg.pytree
class Early(PruneFaint):
    def times(self, num_iterations):
        return (-1, 0)


def test_events_without_effect_are_warned_of(scene):
    """Each once: those that never happen before the stage, those that changed nothing at its end."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fitted(scene, PruneFaint("all"), Late(), Early())
    assert [str(one.message) for one in caught] == [
        "stage 'own': Late never happens: it is first due at iteration 50 of 20",
        "stage 'own': Early never happens: it is first due at iteration 0 of 20",
        "stage 'own': PruneFaint changed nothing, though it happened 5 times",
    ]


@pytest.mark.long
@pytest.mark.parametrize("given", [{"k_a": 3.0}, {}])
def test_choices_about_anisotropy_that_make_no_difference_are_warned_of(scene, given):
    """Splats of the built-in scene are round after so few iterations. Defaults are nobody's choice."""
    system = a2tg.A2tg(stage2_iterations=8, initial_gaussians=50, texture=a2tg.Upscale(at=(0.5,), **given))
    start = a2tg.Model(a2tg.init_from_points(scene.points, scene.colors))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        a2tg.training.fit_stage(scene, system, 1, start)
    wanted = [f"stage 'textures': texture.{name} made no difference: no Gaussian whose" for name in given]
    assert [str(one.message)[: len(wanted[0])] for one in caught] == wanted


def test_choices_about_anisotropy_that_act_are_used():
    thin, square = a2tg.Upscale(k_a=3.0), np.ones((2, 2), int)
    assert thin._unused(square, np.array([[0.02, 0.005], [0.02, 0.02]])) is None
    assert re.match(r"k_a made no difference", thin._unused(square, np.array([[0.02, 0.01], [0.02, 0.02]])))


@pytest.mark.filterwarnings("ignore:.*changed nothing")
def test_an_event_is_given_the_background_of_training(scene):
    for background in ("white", "black", "random"):
        fitted(scene, SeesBackground(), iterations=2, background=background)
    assert SeesBackground.seen == [(1, 1, 1), (0, 0, 0), (0, 0, 0)]


def test_parameters_learn_by_the_rate_that_is_given(scene):
    """Without one a stage is refused; 0 leaves them as they are."""
    with pytest.raises(ValueError, match="appearance_rate must be the learning rate of the arrays of Rings"):
        fitted(scene, appearance=Rings())
    still, learned = (fitted(scene, appearance=Rings(), appearance_rate=rate, iterations=3).model for rate in (0, 1e-2))
    np.testing.assert_array_equal(still.appearance.rings, np.tile([0, 0, 0, 2.0], (50, 1)))
    assert np.abs(learned.appearance.rings[:, :3]).max() > 1e-2


@a2tg.pytree
class Failing(a2tg.StepEvent):
    """A method raises an error."""

    method: str = a2tg.static(default="apply")

    def times(self, num_iterations):
        if self.method == "times":
            raise ValueError("no times")
        return super().times(num_iterations)

    def apply(self, now, model, moments, state):
        raise ValueError("no Gaussians like these")


@a2tg.pytree
class FailingBetween(PruneFaint):
    def apply(self, due, model, moments, state):
        raise ValueError("no Gaussians like these")


@pytest.mark.parametrize(
    ("event", "message"),
    [
        (Failing(), "Failing.apply: no Gaussians like these"),
        (FailingBetween(), "FailingBetween.apply: no Gaussians like these"),
        (Failing("times"), "Failing.times: no times"),
        (PruneFaint("model"), r"PruneFaint.apply: .*means must be \[45, 3\]; got \[50, 3\].*: keep_rows\(model"),
    ],
)
def test_errors_name_the_event_and_its_method(scene, event, message):
    with pytest.raises(ValueError, match=f"^stage 'own': {message}"):
        fitted(scene, event)
