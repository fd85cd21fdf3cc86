"""Continued training: further iterations at the rates where a stage ended, and training from a given model."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bits import bits_of
from compiled_programs import compiled_programs

import a2tg_jax as a2tg
from a2tg_jax import Session, fit_stage
from a2tg_jax.training.loop import StageRun
from a2tg_jax.training.step import jitted_step

SCENE = a2tg.synthetic_scene(num_views=6, width=40, height=30, num_points=150)
SMALL = {"sh_degree": 1, "densify": a2tg.Mcmc(cap=110), "initial_gaussians": 100}
SYSTEM = a2tg.Gaussians2dMcmc.preset("smoke", stage1_iterations=150, stage2_iterations=50, **SMALL)
"""Its second stage has no events, so that a step is Adam's alone."""
SESSION = Session()


def fitted(system, **options):
    return a2tg.fit(SCENE, system, session=SESSION, **options)


@pytest.fixture(scope="module")
def result():
    return fitted(SYSTEM)


def test_the_next_step_is_the_one_that_adam_would_have_taken(result):
    """Its formula in float64, with the moments and the count of the checkpoint and the rates at the stage's end."""
    state = result.checkpoint.state
    further = dataclasses.replace(SYSTEM, more=(5,))
    run = StageRun(SCENE, further, 2, result.checkpoint)
    before = jax.device_get(run.state)
    jax.tree.map(np.testing.assert_array_equal, before.moments, state.moments)
    run.steps(1, 1)
    after = jax.device_get(run.state)
    count = int(after.moments.count)
    assert count == int(state.moments.count) + 1 and int(after.iteration) == 1
    rates = SYSTEM.rates
    of_means = rates.means * rates.means_final_factor * SCENE.scale
    named = {"means": of_means, "log_scales": rates.log_scales, "logit_opacities": rates.logit_opacities}
    for name, rate in named.items():
        old, new = (np.asarray(getattr(each.model.gaussians, name), np.float64) for each in (before, after))
        mu, nu = (
            np.asarray(getattr(each.gaussians, name), np.float64) for each in (after.moments.mu, after.moments.nu)
        )
        step = rate * (mu / (1 - 0.9**count)) / (np.sqrt(nu / (1 - 0.999**count)) + 1e-15)
        assert np.abs(step).max() > 0
        np.testing.assert_allclose(new, old - step, rtol=0, atol=1e-5 * np.abs(step).max() + 2e-7 * np.abs(old).max())


def test_pictures_are_never_worse_than_before(result):
    """The step of all further stages, which differ in name only, is compiled once."""
    psnr = [a2tg.evaluate(SCENE.train, result.model).psnr]
    jitted_step().clear_cache()
    with compiled_programs("train_step") as programs:
        for _ in range(3):
            result = result.more(SCENE, 20, session=SESSION)
            psnr.append(a2tg.evaluate(SCENE.train, result.model).psnr)
    assert len(programs) == 1
    assert [stage.name for stage in result.stages] == ["gaussians", "continued", "more", "more-2", "more-3"]
    assert np.all(np.diff(psnr) > 0), psnr
    assert result.history.stage.max() == 5 and result.model.num == 110


def test_every_way_to_go_on_gives_the_same_bits(result, tmp_path):
    system = dataclasses.replace(SYSTEM, more=(24,))
    at_once = fitted(system)
    wanted = bits_of(at_once.model)
    assert bits_of(result.more(SCENE, 24, session=SESSION).model) == wanted
    a2tg.save_checkpoint(tmp_path / "end.npz", result.checkpoint)
    end = a2tg.load_checkpoint(tmp_path / "end.npz")
    assert bits_of(fitted(system, resume=end).model) == wanted
    kept = []
    stopped = iter([False] * 2)
    with pytest.raises(a2tg.Interrupted):
        fitted(system, resume=end, on_checkpoint=kept.append, is_stopped=lambda: next(stopped, True))
    a2tg.save_checkpoint(tmp_path / "middle.npz", kept[-1])
    middle = a2tg.load_checkpoint(tmp_path / "middle.npz")
    assert middle.stage == 2 and 0 < middle.iteration < 24
    assert bits_of(fitted(system, resume=middle).model) == wanted
    # A checkpoint within an earlier stage may be resumed with further stages as well.
    np.testing.assert_array_equal(at_once.stages[1].model.gaussians.means, result.model.gaussians.means)


@pytest.mark.parametrize("name", ["a2tg", pytest.param("bytewise", marks=pytest.mark.long)])
def test_textures_corrections_and_budgets_go_on(name):
    lengths = {"stage1_iterations": 60, "stage2_iterations": 40}
    own = {"memory_budget": "20kB", "exposure": True, "refine_poses": True, **lengths}
    if name == "a2tg":
        own["texture"] = {"at": (0.5,)}  # Each time that textures grow compiles a step.
    system = a2tg.find_system(name).preset("smoke", initial_gaussians=60, **own)
    first = fitted(system)
    further = first.more(SCENE, 30, session=SESSION)
    before, after = first.model, further.model
    assert after.num == before.num and after.num_bytes == before.num_bytes <= 20_000
    if before.textures is not None:
        np.testing.assert_array_equal(after.textures.sizes, before.textures.sizes)
    psnr = [a2tg.evaluate(SCENE.train, fit.model).psnr for fit in (first, further)]
    assert psnr[1] > psnr[0] - 0.05
    states = [fit.checkpoint.state.corrections for fit in (first, further)]
    for old, new in zip(*states, strict=True):
        assert new.moments.count.sum() == old.moments.count.sum() + 30
        assert 0 < np.abs(new.rows - old.rows).max() < 0.1


@a2tg.pytree
class Watcher(a2tg.StepEvent):
    """Keeps the arguments of its last call, and counts its calls."""

    num_keys = 0

    def init(self, model):
        return jnp.zeros(4)

    def apply(self, now, model, moments, state):
        seen = [state[0] + 1, now.iteration, now.num_iterations, now.rate_of_means]
        return a2tg.Change(model, moments, jnp.stack([jnp.asarray(x, jnp.float32) for x in seen]))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Watched(a2tg.Gaussians2dMcmc):
    """One stage, whose rates all fall."""

    def stages(self):
        (stage,) = super().stages()
        return (dataclasses.replace(stage, events=(Watcher(), *stage.events), cools_down=True),)


def test_schedules_and_events_of_every_iteration_stay_at_their_end():
    first = fitted(Watched.preset("smoke", stage1_iterations=20, **SMALL))
    further = first.more(SCENE, 7, session=SESSION)
    (calls, iteration, length, rate), (all_calls, *then) = (
        np.asarray(fit.checkpoint.state.events[0]) for fit in (first, further)
    )
    assert (calls, iteration, length, all_calls) == (20, 20, 20, 27)
    assert then[0] == then[1] == 7
    rates = first.system.rates
    end = 0.1 * rates.means * rates.means_final_factor * SCENE.scale
    # The last iteration of the first training was one before the end.
    assert rate > end and then[2] == pytest.approx(end, rel=1e-5)


def test_what_cannot_go_on_is_refused(result):
    with pytest.raises(ValueError, match="no checkpoint to continue from"):
        a2tg.FitResult(SYSTEM, result.stages).more(SCENE, 5)
    with pytest.raises(ValueError, match=r"^more must be at least 1; got 0"):
        result.more(SCENE, 0)
    longer = dataclasses.replace(SYSTEM, stage2_iterations=60)
    with pytest.raises(ValueError, match=r"another configuration \(stage2_iterations 50, not 60\).*result\.more\("):
        fitted(longer, resume=result.checkpoint)
    further = dataclasses.replace(SYSTEM, more=(5,))
    state = dataclasses.replace(result.checkpoint.state, iteration=np.int32(10))
    with pytest.raises(ValueError, match="iteration 10 of 50 of stage 2, which stage 3 continues: resume that one"):
        fit_stage(SCENE, further, 2, resume=dataclasses.replace(result.checkpoint, state=state))
    (first, *_) = SYSTEM.stages()

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Wrong(a2tg.System):
        def stages(self):
            return (dataclasses.replace(first, continues=True),)

    with pytest.raises(ValueError, match="'gaussians': continues needs a stage before"):
        Wrong().check()


# Training from a given model

START = dataclasses.replace(SYSTEM, stage1_iterations=10, stage2_iterations=0, initial_gaussians=None)


def test_a_system_is_trained_from_a_model_as_its_first_stage(result):
    whole = fitted(START, start=result.model).model
    assert bits_of(whole) == bits_of(fit_stage(SCENE, START, 0, result.model).model)
    assert whole.num == 110


def test_spherical_harmonics_become_those_of_the_options(result):
    higher = dataclasses.replace(START, sh_degree=2)
    assert fitted(higher, start=result.model).model.gaussians.sh.shape == (110, 9, 3)
    with pytest.warns(UserWarning, match="leaves out its spherical harmonics above degree 0"):
        assert fitted(dataclasses.replace(START, sh_degree=0), start=result.model).model.gaussians.sh_degree == 0


def test_options_that_contradict_the_given_model_are_named(result):
    model = result.model
    with pytest.raises(ValueError, match=r"at most 100 Gaussians, for which densify\.cap has room; got 110"):
        fitted(dataclasses.replace(START, densify=a2tg.Mcmc(cap=100)), start=model)
    with pytest.raises(ValueError, match="for which memory_budget has room; got 110: raise memory_budget, or start"):
        fitted(dataclasses.replace(START, memory_budget=0.005), start=model)
    with pytest.warns(UserWarning, match="initial_gaussians of 90 does not apply"):
        fitted(dataclasses.replace(START, initial_gaussians=90), start=model)
    moved = model.transform(a2tg.Similarity(2.0, np.eye(3), np.zeros(3)))
    with pytest.warns(UserWarning, match="made in another world than the scene's"):
        fitted(START, start=moved)
    textured = a2tg.A2tg(stage1_iterations=10, stage2_iterations=10, sh_degree=1, densify=START.densify)
    shown = fit_stage(SCENE, textured, 1, model).model
    with pytest.warns(UserWarning, match="start: stage 'gaussians' leaves out what its splats show besides Gaussians"):
        fitted(START, start=shown)
    with pytest.raises(ValueError, match=r"memory_budget of 0.008 MB has room for"):
        fit_stage(SCENE, dataclasses.replace(textured, memory_budget=0.008), 1, model)


@pytest.mark.parametrize(
    ("wrong", "hint"),
    [
        (lambda fit: fit.model.gaussians, "got Gaussians: use Model"),
        (lambda fit: fit, r"got FitResult: use result\.model, or call result\.more"),
        (lambda fit: fit.stages[0], r"got StageResult: use result\.model"),
        (lambda fit: fit.checkpoint, "got Checkpoint: give it as resume"),
        (lambda fit: "model.npz", r"got str: use load_model\(path\)"),
    ],
)
def test_what_is_no_model_is_refused(result, wrong, hint):
    for fit in (lambda *a, **o: a2tg.fit(*a, **o), lambda scene, system, start: fit_stage(scene, system, 0, start)):
        with pytest.raises(ValueError, match=f"^start must be a Model; {hint}"):
            fit(SCENE, START, start=wrong(result))


def test_an_invalid_model_is_refused_before_training(result):
    model = result.model
    gaussians = model.gaussians

    def changed(**fields):
        return dataclasses.replace(model, gaussians=dataclasses.replace(gaussians, **fields))

    wrong = {
        r"^start\.gaussians\.quats must": changed(quats=gaussians.quats[:5]),
        r"^start\.gaussians\.means must be finite; 1 of 110": changed(means=gaussians.means.at[3].set(jnp.nan)),
        "^start must have at least 2 Gaussians; got 1": model[:1],
        r"^start\.gaussians\.means: no training view sees any": changed(means=gaussians.means + 1e4),
    }
    for message, start in wrong.items():
        with pytest.raises(ValueError, match=message):
            fitted(START, start=start)
    small = a2tg.A2tg(sh_degree=1, densify=START.densify, texture=a2tg.Upscale(select="budget", budget_mb=0.001))
    with pytest.raises(ValueError, match=r"^texture\.budget_mb is 0\.001, but 110 Gaussians"):
        fitted(small, start=model)


def test_a_checkpoint_has_its_own_model(result):
    with pytest.raises(ValueError, match="start and resume are both given"):
        fitted(SYSTEM, start=result.model, resume=result.checkpoint)


@a2tg.pytree
class Growing(a2tg.StepEvent):
    """An event that grows up to a cap, and does not say so otherwise."""

    cap: int = a2tg.static(default=40)
    limited_by = "cap"

    def num_rows(self, num, num_iterations):
        return max(num, self.cap)

    def apply(self, now, model, moments, state):
        return a2tg.Change(model, moments, state)


@dataclasses.dataclass(frozen=True, kw_only=True)
class WithGrowing(a2tg.Gaussians2dMcmc):
    growing: Growing = Growing()

    def stages(self):
        stages = super().stages()
        return tuple(dataclasses.replace(stage, events=(self.growing,)) for stage in stages)


def test_an_event_with_a_cap_caps_the_start():
    system = WithGrowing(stage1_iterations=5, sh_degree=0)
    assert fitted(system).model.num == 40
    smaller = dataclasses.replace(system, growing=Growing(cap=30))
    with pytest.raises(ValueError, match=r"for which growing\.cap has room; got 40"):
        fitted(smaller, start=fitted(system).model)
    two = dataclasses.replace(smaller, stage2_iterations=5)
    with pytest.warns(UserWarning, match=r"begins with 40 Gaussians, more than the growing\.cap of 30: none is added"):
        fit_stage(SCENE, two, 1, fitted(system).model)


# Resuming with another scene


@pytest.fixture(scope="module")
def middle(tmp_path_factory):
    """A checkpoint file within the first stage."""
    path = tmp_path_factory.mktemp("middle") / "checkpoint.npz"

    def keep(checkpoint):
        if checkpoint.iteration == 5:
            a2tg.save_checkpoint(path, checkpoint)

    fitted(START, on_checkpoint=keep, checkpoint_every=5)
    return path


def with_first_view(**changes):
    first, *others = SCENE.train
    return dataclasses.replace(SCENE, train=(dataclasses.replace(first, **changes), *others))


def resumed(scene, path):
    return a2tg.fit(scene, START, resume=a2tg.load_checkpoint(path), session=SESSION).model


def test_other_views_are_named(middle):
    first, second, *_ = SCENE.train
    fewer = dataclasses.replace(SCENE, train=SCENE.train[1:])
    with pytest.raises(ValueError, match=rf"trained on 5 views, and the scene has 4.*: {first.name} missing; resume"):
        resumed(fewer, middle)
    with pytest.raises(ValueError, match=f": {first.name} missing, x.png new; resume with"):
        resumed(with_first_view(name="x.png"), middle)
    turned = dataclasses.replace(SCENE, train=SCENE.train[::-1])
    with pytest.raises(ValueError, match="their order differs"):
        resumed(turned, middle)
    with pytest.raises(ValueError, match=f"with other cameras of {first.name}: resume"):
        resumed(with_first_view(camera=second.camera), middle)


def test_exchanged_photographs_and_masks_are_named(middle):
    first, second, *_ = SCENE.train
    with pytest.warns(UserWarning, match=f"have changed since the checkpoint was made: {first.name}; what"):
        resumed(with_first_view(picture=second.picture), middle)
    mask = np.ones((30, 40), bool)
    mask[0, 0] = False
    with pytest.warns(UserWarning, match=f"have changed since the checkpoint was made: {first.name}; what"):
        resumed(with_first_view(mask=a2tg.Mask.of(mask)), middle)


def test_pixels_are_the_same_wherever_they_are_kept(middle):
    """A copy in memory, and pixels of which nothing is known because nobody has read them."""
    wanted = bits_of(fitted(START).model)
    first = SCENE.train[0]
    assert bits_of(resumed(with_first_view(picture=a2tg.Picture.of(first.picture.read().copy())), middle)) == wanted
    unread = dataclasses.replace(first.picture, checksum=None)
    assert bits_of(resumed(with_first_view(picture=unread), middle)) == wanted


def test_checkpoints_without_a_record_of_the_views_are_resumed(middle, tmp_path):
    """As earlier versions wrote them."""
    kept = dataclasses.replace(a2tg.load_checkpoint(middle), views=None)
    a2tg.save_checkpoint(tmp_path / "old.npz", kept)
    again = a2tg.load_checkpoint(tmp_path / "old.npz")
    assert again.views is None
    assert bits_of(resumed(SCENE, tmp_path / "old.npz")) == bits_of(fitted(START).model)


@pytest.mark.parametrize("name", ["viewmats", "Ks", "sizes", "pixels", "masks"])
def test_a_damaged_record_of_the_views_is_named(middle, tmp_path, name):
    kept = a2tg.load_checkpoint(middle)
    views = dataclasses.replace(kept.views, **{name: getattr(kept.views, name)[1:]})
    a2tg.save_checkpoint(tmp_path / "damaged.npz", dataclasses.replace(kept, views=views))
    with pytest.raises(ValueError, match=rf"damaged\.npz: views\.{name} must"):
        a2tg.load_checkpoint(tmp_path / "damaged.npz")


@pytest.mark.parametrize("call", [lambda: a2tg.fit(SCENE, START), lambda: fit_stage(SCENE, START, 0)])
def test_training_is_not_traced(call):
    with pytest.raises(ValueError, match=r"^fit reads values and compiles its own steps, so it cannot be traced"):
        jax.jit(lambda x: x * call().model.gaussians.means)(2.0)


@pytest.mark.parametrize("kind", [tuple, list, lambda times: times], ids=["tuple", "list", "range"])
def test_events_of_every_iteration_go_on_however_their_times_are_given(kind):
    @a2tg.pytree
    class Always(a2tg.StepEvent):
        def times(self, num_iterations):
            return kind(range(1, num_iterations + 1))

    @a2tg.pytree
    class Nearly(a2tg.StepEvent):
        def times(self, num_iterations):
            return kind(range(1, num_iterations))

    stage = dataclasses.replace(SYSTEM.stages()[0], events=(Always(), Nearly()))
    assert stage.lasting_events == (Always(),)
    assert stage.clock(1).num_left == (None, 149)
