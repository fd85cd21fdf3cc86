"""The system that spends bytes where they pay: what its options lead to, and which it refuses before training."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_programs import compiled_programs
from small_models import numbers_of
from small_values import some_gaussians

import a2tg_jax as a2tg
from a2tg_jax import (
    AdaptDegrees,
    Appearance,
    Bands,
    Bytewise,
    Exponents,
    HostEvent,
    LimitExponents,
    LossConfig,
    Model,
    Texture,
    Upscale,
    allocate_appearance,
    load_checkpoint,
    save_checkpoint,
)
from a2tg_jax.results.record import RunRecord, SceneSource
from a2tg_jax.training.start import initial_model, padded
from a2tg_jax.training.step import jitted_step


@pytest.fixture(scope="module")
def scene():
    return a2tg.synthetic_scene(num_views=4, width=24, height=16, num_points=120)


def smoke(**changes) -> Bytewise:
    short = {"stage1_iterations": 60, "stage2_iterations": 20, "memory_budget": "40kB", "initial_gaussians": None}
    short["loss"] = {"ssim_weight": 0.0}  # Less to compile.
    return Bytewise.preset("smoke", **{**short, **changes})


SHARES = {"view_dependence_share": 0.1, "texture_share": 0.05}
"""One first stage is compiled for all that have the same."""


@pytest.mark.parametrize("preset", ["paper", "quick", "smoke"])
def test_presets_can_be_trained(preset):
    Bytewise.preset(preset).check()


@pytest.mark.long
@pytest.mark.parametrize("base_degree, shares", [(1, (0.2, 0.0)), (2, (0.0, 0.1))])
def test_every_mix_fills_its_bytes(scene, base_degree, shares):
    """Both shares at once have a test below."""
    view, texture = shares
    system = smoke(base_degree=base_degree, view_dependence_share=view, texture_share=texture)
    result = a2tg.fit(scene, system)
    model = result.model
    assert result.history.megabytes.max() <= 0.04
    assert 0.995 * 40_000 <= model.num_bytes <= 40_000
    degrees = model.degrees
    assert degrees.min() == base_degree and (degrees.max() > base_degree) == (view > 0)
    assert (model.textures is not None) == (texture > 0)
    if texture:
        assert 0 < (model.textures.sizes > 0).any(axis=1).sum() < model.num


def assert_same(model, other):
    """Padding may differ."""
    arrays = [numbers_of(one) for one in (model, other)]
    assert arrays[0].keys() == arrays[1].keys()
    for name, array in arrays[0].items():
        np.testing.assert_array_equal(array, arrays[1][name], err_msg=name)


@pytest.fixture(scope="module")
def before_details(scene):
    """A system, and the model of its first stage."""
    changes = {"view_dependence": {"at": (0.1,)}, "details": {"at": (0.2, 0.3)}}
    system = smoke(stage2_iterations=30, texture_share=0.02, view_dependence_share=0.1, **changes)
    return system, a2tg.fit_stage(scene, system, 0).model


@pytest.mark.long
def test_details_have_their_room_before_they_come(scene, before_details, monkeypatch):
    """The second stage compiles one step for each capacity of the tile lists. Without room it compiles one after each
    event, and the model is the same. Degrees and textures fill all bytes."""
    system, first = before_details

    def details():
        with compiled_programs("train_step") as programs:
            result = a2tg.fit_stage(scene, system, 1, first)
        assert result.history.megabytes.max() <= 0.04
        return result.model, len(programs) - result.num_regrown

    jitted_step().clear_cache()
    model, num_steps = details()
    assert num_steps == 1
    for event in (AdaptDegrees, Upscale):
        monkeypatch.setattr(event, "with_room", HostEvent.with_room)
    other, num_steps = details()
    assert num_steps > 3
    assert_same(model, other)
    assert 0.995 * 40_000 <= model.num_bytes <= 40_000
    assert model.degrees.min() == 0 < model.degrees.max()
    assert 0 < (model.textures.sizes > 0).any(axis=1).sum() < model.num
    assert model.num_padding_bytes < 0.05 * model.num_bytes, "a finished model holds no room"


@pytest.mark.long
def test_a_resumed_stage_has_its_room_again(scene, before_details, tmp_path):
    """A checkpoint holds no room. Training that resumes from it compiles one step and ends as if never stopped."""
    system, first = before_details
    stops = []

    def keep(checkpoint):
        save_checkpoint(tmp_path / f"{checkpoint.iteration}.npz", checkpoint)
        stops.append(load_checkpoint(tmp_path / f"{checkpoint.iteration}.npz"))

    whole = a2tg.fit_stage(scene, system, 1, first, on_checkpoint=keep, checkpoint_every=4)
    for stop in stops[:2]:
        with compiled_programs("train_step") as programs:
            rest = a2tg.fit_stage(scene, system, 1, resume=stop)
        assert len(programs) - rest.num_regrown <= 1, stop.iteration
        assert_same(rest.model, whole.model)


def test_the_highest_degree_is_kept():
    degrees, *_ = smoke(sh_degree=1, **SHARES).stages()[1].events
    assert degrees.highest == 1


@pytest.mark.long
def test_shapes_of_kernels_are_trained_in_both_stages_and_counted(scene, tmp_path):
    system = smoke(kernel_rate=0.02, **SHARES)
    first = a2tg.fit_stage(scene, system, 0).model
    before = np.asarray(first.appearance.shapes)
    assert before.std() > 0.02 and before.max() > 0 > before.min()
    resting = a2tg.fit_stage(scene, dataclasses.replace(system, kernel_rate=1e-9), 1, first)
    after = resting.model.appearance.shapes
    np.testing.assert_allclose(after, before, atol=1e-6, err_msg="the second stage continues the first one's shapes")
    result = a2tg.fit_stage(scene, system, 1, first)
    model = result.model
    assert np.median(np.abs(np.asarray(model.appearance.shapes) - before)) > 0.01
    assert result.history.megabytes.max() <= 0.04 and 0.995 * 40_000 <= model.num_bytes <= 40_000
    assert first.num == 0.85 * 40_000 // (52 + 4)
    a2tg.save_model(tmp_path / "model.npz", model)
    camera = scene.test[0].camera
    again = a2tg.load_model(tmp_path / "model.npz").render(camera).color
    np.testing.assert_array_equal(again, model.render(camera).color)


def test_without_a_budget_the_cap_says_how_many_bytes():
    system = Bytewise.preset("quick", texture_share=0.02)
    degrees, textures, _ = system.stages()[1].events
    assert isinstance(degrees, AdaptDegrees) and isinstance(textures, Upscale)
    assert textures.budget_mb == pytest.approx(56e-6 * system.densify.cap)
    assert degrees.budget_mb == pytest.approx((1 - system.texture_share) * textures.budget_mb)


def test_gaussians_fade_in_the_first_stage_only():
    system = Bytewise(loss=LossConfig(opacity_weight=0.02))
    weights = [[term.weight for term in stage.losses[1:]] for stage in system.stages()]
    assert system.fading_weight == 0.01 and np.allclose(weights, [[0.03], [0.02]])
    assert [len(stage.losses) for stage in Bytewise().stages()] == [2, 1]
    assert [len(stage.losses) for stage in Bytewise(fading_weight=0.0).stages()] == [1, 1]


@pytest.mark.parametrize("limit", [{"densify": {"cap": 1_000}}, {"memory_budget": "56kB"}])
@pytest.mark.parametrize(("shares", "most"), [((0.1, 0.02), 980), ((0.0, 0.02), 1_000), ((0.1, 0.0), 1_000)])
def test_given_gaussians_must_leave_bytes_for_details(limit, shares, most):
    """A Gaussian takes 56 bytes. Degrees must leave the share of textures; textures take the rest."""
    changes = {"view_dependence_share": shares[0], "texture_share": shares[1]}
    system = Bytewise.preset("quick", **changes, **limit)
    system.check_given_number(most)
    for event in system.stages()[1].events[:-1]:
        assert 1e6 * event.budget_mb >= 56 * most
    name = "densify.cap" if "densify" in limit else "memory_budget"
    with pytest.raises(ValueError, match=rf"^{name} .*has room for {most:,} .* and {most + 1:,} are given: raise it"):
        system.check_given_number(most + 1)

    Bytewise.preset("quick", view_dependence_share=0.0, texture_share=0.0).check_given_number(100_000)


def compared(name, other, preset="quick"):
    """A system in a run that compares it with another."""
    record = RunRecord(SceneSource("synthetic"), "other", other, (name,), preset)
    return record.systems[name]


def test_compared_with_another_system_it_keeps_its_degrees():
    system = compared("bytewise", a2tg.A2tg.preset("quick"))
    assert system.initial_sh_degree == 0 and system.sh_degree == 3
    # Plain Gaussians of degree 0 are the strongest at equal bytes, and those that it begins with.
    plain = compared("gaussians-2d-mcmc", Bytewise.preset("quick"))
    assert (plain.initial_sh_degree, plain.densify.cap) == (0, Bytewise.preset("quick").densify.cap)
    assert compared("gaussians-2d-mcmc", a2tg.A2tg.preset("quick")).initial_sh_degree == 3


def test_compared_with_a2tg_both_keep_their_kernels_and_shares():
    """Options of the same names, which mean nothing for the other."""
    own = Bytewise.preset("quick")
    textured = a2tg.A2tg.preset("quick", kernel_rate=0.02, texture_share=0.3)
    system = compared("bytewise", textured)
    assert (system.kernel_rate, system.texture_share) == (own.kernel_rate, own.texture_share)
    system = compared("a2tg", own)
    assert (system.kernel_rate, system.texture_share) == (0.01, 0.25), "its own of quick"
    system = compared("a2tg", own, preset=None)
    assert (system.kernel_rate, system.texture_share) == (None, None)


@pytest.mark.long
def test_the_least_exponent_reaches_both_stages(scene):
    system = smoke(kernel_rate=1.0, exponents={"least": 0.8}, **SHARES)
    model = a2tg.fit(scene, system).model
    exponents = np.exp(np.tanh(model.appearance.shapes))[: model.num]
    np.testing.assert_allclose(exponents.min(), 0.8, rtol=1e-5)
    assert exponents.max() > 1


def some_model(template, shapes):
    gaussians = some_gaussians()
    appearance = allocate_appearance(template, jax.random.key(0), gaussians)
    return Model(gaussians, appearance.with_shapes(shapes))


def test_exponents_are_limited_whatever_other_parts_there_are():
    shapes = jnp.linspace(-20.0, 20.0, some_gaussians().num)
    whole = Appearance(texture=Texture(start=(2, 3)), exponents=Exponents(), bands=Bands())
    for template in (Appearance(exponents=Exponents()), whole):
        limit = jax.jit(lambda model: LimitExponents(0.6).apply(None, model, None, ()).model)
        limited = limit(some_model(template, shapes))
        exponents = np.exp(np.tanh(limited.appearance.shapes))
        np.testing.assert_allclose(exponents, np.maximum(np.exp(np.tanh(shapes)), 0.6), rtol=1e-6)


def test_a_limit_below_all_exponents_changes_none_and_needs_exponents():
    shapes = jnp.linspace(-20.0, 20.0, some_gaussians().num)
    model = some_model(Appearance(exponents=Exponents()), shapes)
    for least in (0.0, 0.3, 0.36):
        limited = LimitExponents(least).apply(None, model, None, ()).model
        np.testing.assert_allclose(np.exp(np.tanh(limited.appearance.shapes)), np.exp(np.tanh(shapes)), rtol=1e-6)
    with pytest.raises(ValueError, match="LimitExponents needs kernels with exponents"):
        LimitExponents().apply(None, Model(some_gaussians()), None, ())


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"exponents": {"least": 1.2}}, "exponents.least must be at least 0 and at most 1; got 1.2"),
        ({"texture_share": 0.5, "view_dependence_share": 0.5}, "must leave bytes for Gaussians"),
        ({"texture_share": 1.5}, "texture_share must be at least 0 and at most 1; got 1.5"),
        ({"view_dependence_share": -0.1}, "view_dependence_share must be .*; got -0.1"),
        ({"fading_weight": -1.0}, "fading_weight must be at least 0"),
        ({"texel_rate": -1.0}, "texel_rate must be at least 0"),
        ({"kernel_rate": -1.0}, "kernel_rate must be at least 0"),
        ({"details": {"cap": 32}}, "details.cap must be at least 1 and at most 16; got 32"),
        ({"details": {"cap": 8}}, "details has no effect while texture_share is 0"),
        ({"texture_share": 0.1, "details": {"cap": 1}}, r"^details\.cap must be at least 2; got 1$"),
        ({"details": {"select": "fraction", "fraction": 0.5}}, r"^details\.fraction must stay 0\.25, .*; got 0\.5"),
        ({"view_dependence": {"budget_mb": 2.0}}, r"^view_dependence\.budget_mb must stay 0\.0, .*; got 2\.0"),
        ({"view_dependence": {"idle": -1.0}}, "view_dependence.idle must be at least 0"),
        ({"sh_degree": 4}, "sh_degree must be at least 0 and at most 3"),
        ({"base_degree": 2, "sh_degree": 1}, "base_degree must be at least 0 and at most 1; got 2"),
        ({"base_degree": 3}, "view_dependence_share must be 0 where all Gaussians have the highest degree, 3"),
        ({"details": {"at": [0.5, 0.2]}}, "details.at must be ascending"),
        ({"texture_share": 0.1, "details": {"at": []}}, "details.at must hold fractions"),
        ({"prune": {"share": 1.0}}, "prune.share must be at least 0 and below 1; got 1.0"),
        ({"prune": {"at": [0.5, 0.83]}}, "prune.at must hold fractions up to 0.8, .* lower the last"),
        ({"prune": {"at": []}}, "prune.at must hold fractions"),
        (
            {"texture_share": 0.1, "view_dependence": {"at": [0.5]}},
            "view_dependence.at must be over when textures begin",
        ),
        ({"memory_budget": None, "densify": {"cap": 2}}, "densify.cap must leave room for 2 Gaussians"),
        ({"memory_budget": "0.05kB"}, "has room for 0 Gaussians"),
        ({"memory_budget": "0.115kB"}, "memory_budget must leave room for 2 Gaussians"),
    ],
)
def test_what_cannot_be_trained_is_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        smoke(**changes).check()


def test_the_authors_alpha_can_be_had_without_any_texture(scene):
    """All textures are empty at first, and no alpha is the largest."""
    system = smoke(**SHARES, lookup={"alpha": "global-maximum", "rgb": "unit"})
    model = padded(initial_model(scene, system), system.stages()[1], system)
    assert not model.textures.num_texels
    assert np.isfinite(model.render(scene.test[0].camera).color).all()
