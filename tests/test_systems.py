"""Systems as values: those of the library and a toy of one file, trained; what sweeps compile and loops wait for."""

import copy
import dataclasses
import functools
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_programs import compiled_programs
from small_models import some_model
from toy_system import Toy

import a2tg_jax as a2tg
from a2tg_jax import adam_init, combine, fit_stage, partition
from a2tg_jax.training import SYSTEMS
from a2tg_jax.training.batches import BatchOrder, PhotoStore
from a2tg_jax.training.loop import StageRun
from a2tg_jax.training.options import own_options
from a2tg_jax.training.registry import system_from_dict, system_to_dict
from a2tg_jax.training.start import initial_model
from a2tg_jax.training.step import jitted_step

BUDGETS = {
    "gaussians-2d": "18.6kB",
    "gaussians-2d-mcmc": "18.6kB",
    "textured-gaussians": "39.1kB",
    "supergaussians": "27.3kB",
    "bbsplat": "346kB",
    "a2tg": "31kB",
}
"""Room for 80 Gaussians, such that what is less than one more is less than half a percent; for more with textures of
several sizes. `bytewise` has a budget in `test_bytewise`."""
TINY = {"stage1_iterations": 24, "initial_gaussians": 60, "densify": {"cap": 80}}


def by_system(*names):
    """Parameters of a test of several systems, of which one runs without --long."""
    return [name if name == "gaussians-2d" else pytest.param(name, marks=pytest.mark.long) for name in names]


@pytest.fixture(scope="module")
def scene():
    return a2tg.synthetic_scene(num_views=8, width=40, height=30, num_points=150)


OWN = """
import dataclasses
import a2tg_jax as a2tg

@dataclasses.dataclass(frozen=True, kw_only=True)
class Own(a2tg.System):
    {options}

    def stages(self):
        return tuple(a2tg.Stage(name, a2tg.Appearance(), (), self.loss.terms(), self.rates, 5) for name in {names})
"""


def tiny(name: str, **changes):
    """A built-in system that trains in no time, with room for all that it would add."""
    system = a2tg.find_system(name)
    changes = dict(changes)
    if name in ("gaussians-2d", "supergaussians"):
        changes["densify"] = {"cap": 600, **changes.get("densify", {})}
    if hasattr(system, "stage2_iterations"):
        changes = {"stage2_iterations": 12, **changes}
    return system.preset("paper", **{**TINY, **changes})


def assert_same(a, b):
    jax.tree.map(np.testing.assert_array_equal, (a.gaussians, a.appearance), (b.gaussians, b.appearance))


def check_run(scene, system, folder, every: int = 8):
    """Train a system, resume it from the file of its second checkpoint, and write and read its model."""
    path = folder / "checkpoint.npz"
    num_saved = 0

    def keep(checkpoint):
        nonlocal num_saved
        num_saved += 1
        if num_saved == 2:
            a2tg.save_checkpoint(path, checkpoint)

    result = a2tg.fit(scene, system, on_checkpoint=keep, checkpoint_every=every)
    resume = a2tg.load_checkpoint(path)
    assert resume.iteration == 2 * every
    assert_same(a2tg.fit(scene, system, resume=resume).model, result.model)
    a2tg.save_model(folder / "model.npz", result.model)
    loaded = a2tg.load_model(folder / "model.npz")
    view = scene.test[0]
    assert_same(loaded, result.model)
    np.testing.assert_array_equal(loaded.render(view.camera).color, result.model.render(view.camera).color)
    assert result.history.megabytes[-1] == pytest.approx(loaded.num_bytes / 1e6)
    return result


@pytest.mark.parametrize("name", by_system(*SYSTEMS))
def test_every_system_trains_resumes_saves_and_renders(scene, tmp_path, name):
    system = tiny(name, memory_budget=BUDGETS.get(name))
    result = check_run(scene, system, tmp_path)
    history = result.history
    if system.memory_budget is not None:
        assert history.megabytes.max() <= system.memory_budget
        assert 0.995 * system.budget_bytes <= result.model.num_bytes <= system.budget_bytes
    assert np.isfinite(history.loss).all() and history.loss[-1] < history.loss[0]
    assert [stage.name for stage in result.stages] == [stage.name for stage in system.stages()]


@pytest.mark.long
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", ["a2tg", "gaussians-2d"])
def test_training_keeps_the_dtype_of_its_model(scene, tmp_path, name):
    """Also from a checkpoint; nothing falls back to float32, or to float64 where the model is float32."""
    system = tiny(name)
    first = initial_model(scene, system)
    index = len(system.stages()) - 1
    for dtype in (jnp.float64, jnp.float32):
        run = StageRun(scene, system, index, jax.tree.map(lambda x: x.astype(dtype), first))  # noqa: B023
        assert len(run.steps(1, 1)) == 1
        floats = [leaf.dtype for leaf in jax.tree.leaves(run.state) if jnp.issubdtype(leaf.dtype, jnp.floating)]
        assert set(floats) == {jnp.dtype(dtype)}
        a2tg.save_checkpoint(tmp_path / "checkpoint.npz", a2tg.Checkpoint(system, index, run.state, run.history))
        again = a2tg.load_checkpoint(tmp_path / "checkpoint.npz").state
        jax.tree.map(functools.partial(np.testing.assert_array_equal, strict=True), again, run.state)


def test_a_toy_of_one_file_does_all_that_the_others_do(scene, tmp_path):
    system = Toy()
    result = check_run(scene, system, tmp_path, every=5)
    rings = np.asarray(result.model.appearance.rings)
    assert np.abs(rings[:, :3]).max() > 1e-3, "the appearance's numbers are trained"
    start = a2tg.fit(scene, dataclasses.replace(system, factor=1.0)).model.gaussians
    assert result.model.gaussians.log_scales.mean() < start.log_scales.mean() - 0.05, "the event shrinks"
    heavy = a2tg.fit(scene, dataclasses.replace(system, contrast_weight=100.0)).model
    assert np.square(heavy.appearance.rings[:, :3]).mean() < 0.2 * np.square(rings[:, :3]).mean(), "the term weighs"
    assert result.model.num_bytes == 4 * (58 + 4) * result.model.num


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:stage 'textures'. texture changed nothing")  # Of a share of 0.
def test_textures_of_one_texel_that_do_not_learn_change_nothing(scene):
    """They stay (0, 0, 0, 1), and the Gaussians are those of a stage without textures."""
    plain = tiny("gaussians-2d-mcmc")
    textured = tiny("a2tg", texture={"fraction": 0.0}, single_texel_rate=0.0)
    first = fit_stage(scene, plain, 0).model
    expected, found = (fit_stage(scene, one, 1, first).model for one in (plain, textured))
    (texels,) = found.textures.buckets
    np.testing.assert_array_equal(texels[: found.num], np.broadcast_to([0, 0, 0, 1], (found.num, 1, 1, 4)))
    for a, b in zip(jax.tree.leaves(found.gaussians), jax.tree.leaves(expected.gaussians), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)


@pytest.mark.long
def test_textures_that_have_grown_learn_though_those_of_one_texel_do_not(scene):
    system = tiny("a2tg", texture={"fraction": 0.5, "at": [0.5]}, single_texel_rate=0.0)
    model = a2tg.fit(scene, system).model
    for (height, width), bucket in zip(model.textures.bucket_sizes, model.textures.buckets, strict=True):
        is_neutral = bool((bucket == jnp.asarray([0, 0, 0, 1], bucket.dtype)[None, None, None]).all())
        assert is_neutral == (height * width == 1)


@pytest.mark.long
@pytest.mark.parametrize("more", [(), (5,)])
def test_textures_may_begin_empty_and_kernels_have_shapes(scene, tmp_path, more):
    """Within a budget of which textures get a share; resumed, saved and read as every system."""
    textures = {"empty_textures": True, "texture_share": 0.25, "texture": {"moments": "copied"}}
    changes = textures | {"memory_budget": "20.8kB", "kernel_rate": 0.1, "noise_in_stage2": True, "more": more}
    system = tiny("a2tg", sh_degree=2, **changes)
    result = check_run(scene, system, tmp_path)
    first = result.stages[0].model
    assert first.num_bytes / system.budget_bytes == pytest.approx(0.75, abs=0.01)
    assert first.num_bytes == 4 * (37 + 1) * first.num
    assert result.history.megabytes.max() <= system.memory_budget
    assert 0.995 * system.budget_bytes <= result.model.num_bytes
    sizes, counts = np.unique(result.model.textures.sizes, axis=0, return_counts=True)
    assert (sizes[0] == 0).all() and counts[0] > 5 and not (sizes == 1).all(axis=1).any()
    assert np.unique(result.model.appearance.shapes).size > 10, "kernels learn"


def test_textured_gaussians_are_a2tg_with_one_size_and_no_events():
    fixed = tiny("textured-gaussians", texture_side=2)
    other = tiny("a2tg")
    first, second = other.stages()
    appearance = dataclasses.replace(
        second.appearance, texture=dataclasses.replace(second.appearance.texture, start=(2, 2))
    )
    textured = dataclasses.replace(second, appearance=appearance, events=(), appearance_rate=other.texel_rate)
    assert fixed.stages() == (first, textured)


@pytest.mark.parametrize("cap", [1, 2, 4, 8, 16])
def test_textures_reach_their_cap(cap):
    """As many upscalings as doublings; those that are chosen each time become cap × cap."""
    event = a2tg.Upscale(cap=cap, fraction=1.0, anisotropic=False)
    times = event.times(30_000)
    assert times == tuple(500 * (index + 1) for index in range(cap.bit_length() - 1))
    model = dataclasses.replace(some_model(), num_live=jnp.int32(12))
    moments = adam_init(partition(model)[0])
    for index in range(len(times)):
        seen = event.init(model).observe(jnp.arange(12.0), jnp.ones(12, bool))
        model, moments, *_ = event.apply(a2tg.Due(index + 1, len(times)), model, moments, seen)
    np.testing.assert_array_equal(model.textures.sizes[1:], cap)


def test_official_is_a_preset_of_all_options():
    official = a2tg.A2tg.preset("official")
    found = dataclasses.asdict(official.texture)
    wanted = {"select": "threshold", "threshold": 2e-5, "axes": "authors", "gradient": "screen"}
    assert {name: found[name] for name in wanted} == wanted
    lookup = dataclasses.asdict(official.lookup)
    defaults = dataclasses.asdict(a2tg.TextureOptions())
    same = [name for name in defaults if lookup[name] == defaults[name]]
    assert same == ["extent"], "each other choice differs from the paper's"
    assert official.noise_in_stage2 and official.stages()[0].appearance.max_alpha == 0.999
    first, second = (stage.appearance for stage in tiny("textured-gaussians", lookup={"max_alpha": 0.95}).stages())
    assert first.alpha_limit == second.alpha_limit == 0.95


def test_the_host_waits_once_for_many_steps(scene, monkeypatch):
    waits = []
    device_get = jax.device_get

    def noted(value):
        if isinstance(value, list):  # What steps return; cameras, which are arrays, are read before training.
            waits.append(len(value))
        return device_get(value)

    monkeypatch.setattr(jax, "device_get", noted)
    a2tg.fit(scene, a2tg.Gaussians2dMcmc(stage1_iterations=25, densify=a2tg.Mcmc(cap=60)))
    assert waits == [10, 10, 5]


def test_photographs_stay_on_the_device_while_they_fit(scene):
    order = BatchOrder(scene.train, 2, 0)
    everything = PhotoStore(scene.train, order, 9)
    nothing = PhotoStore(scene.train, order, 9, room=0)
    assert everything.is_resident and not nothing.is_resident
    for iteration in (1, 4, 2, 9):
        batches = [store.batch(iteration) for store in (everything, nothing)]
        np.testing.assert_array_equal(*(photographs.of(places).images for photographs, places in batches))
    assert everything.batch(1)[0] is everything.batch(3)[0]
    nothing.close()


@pytest.mark.long
def test_gaussians_that_find_no_room_are_counted_and_reported(scene, tmp_path):
    """Also after resuming late, when no further Gaussians are added."""
    system = tiny("gaussians-2d", densify={"cap": 61, "threshold": 1e-9})

    def keep(checkpoint):
        if checkpoint.stage == 0 and checkpoint.iteration == system.stage1_iterations - 1:
            a2tg.save_checkpoint(tmp_path / "late.npz", checkpoint)

    with pytest.warns(UserWarning, match=r"no room for a Gaussian .* raise densify.cap") as whole:
        a2tg.fit(scene, system, on_checkpoint=keep, checkpoint_every=1)
    with pytest.warns(UserWarning, match="no room for a Gaussian") as resumed:
        a2tg.fit(scene, system, resume=a2tg.load_checkpoint(tmp_path / "late.npz"))
    assert [str(one.message) for one in whole] == [str(one.message) for one in resumed]


@pytest.mark.parametrize(
    "name, reason",
    [
        pytest.param("gaussians-2d-mcmc", "no Gaussian above the death opacity is left", marks=pytest.mark.long),
        ("gaussians-2d", "adaptive density control would prune every Gaussian; a lower least_opacity keeps some"),
    ],
)
def test_a_training_without_gaussians_left_says_what_to_change(scene, name, reason):
    system = tiny(name, initial_opacity=0.001, rates={"logit_opacities": 0.0})
    advice = "check the cameras and points of the scene, or lower rates.logit_opacities"
    with pytest.raises(ValueError, match=rf"^training cannot continue at iteration \d+ .*: .*{reason}; {advice}$"):
        a2tg.fit(scene, system)


@pytest.mark.parametrize("name", SYSTEMS)
def test_options_as_values_of_files_and_back(name):
    system = type(a2tg.find_system(name)).preset("smoke")
    assert system_from_dict(system_to_dict(system), "file") == system
    assert system.preset("paper", **own_options(system, type(system)())) == system


def test_a_file_imports_nothing():
    with pytest.raises(ValueError, match="import its module first"):
        system_from_dict({"name": "antigravity:Fly", "options": {}}, "file")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"texture": {"select": "threshold"}}, "so it needs threshold"),
        ({"texture": {"select": "budget"}}, "so it needs budget_mb"),
        ({"texture": {"cap": 32}}, "texture.cap"),
        ({"texture": {"at": [0.5, 0.2]}}, "at"),
        ({"texture": {"fraction": 2.0}}, "texture.fraction must be at least 0 and at most 1; got 2.0"),
        ({"batch_size": 0}, "batch_size"),
        ({"sh_degree": 4}, "sh_degree"),
        ({"densify": {"cap": 1}}, "densify.cap"),
        ({"initial_opacity": 1.0}, "initial_opacity"),
        ({"stage1_iterations": 0}, "at least 1 iteration"),
        ({"stage1_iterations": 2**31}, r"fewer than 2\^31; 'gaussians' has 2147483648"),
        ({"seed": -1}, "seed must be an int, 0 to 2147483647; got -1"),
        ({"tile_size": 0}, "tile_size must be at least 1 and at most 64; got 0"),
        ({"single_texel_rate": -1.0}, "single_texel_rate must be at least 0; got -1"),
        ({"kernel_rate": -1.0}, "kernel_rate must be at least 0; got -1"),
        ({"texture_share": 1.0}, "texture_share must be at least 0 and below 1; got 1"),
        ({"empty_textures": True, "texture": {"cap": 1}}, "texture.cap must be at least 2; got 1"),
        (
            {"empty_textures": True, "single_texel_rate": 0.1},
            "single_texel_rate has no effect with empty_textures, .*: leave it out; got 0.1",
        ),
        (
            {"empty_textures": True, "lookup": {"initial_rgb": 0.1}},
            "lookup.initial_rgb has no effect with empty_textures, .*: leave it out; got 0.1",
        ),
        ({"rates": {"means": float("nan")}}, "rates.means must be a finite number; got nan"),
        ({"rates": {"quats": -1.0}}, "rates.quats must be at least 0; got -1.0"),
        ({"rates": {"means_final_factor": 0.0}}, "rates.means_final_factor must be above 0"),
        ({"loss": {"ssim_weight": 2.0}}, "loss.ssim_weight must be at most 1; got 2.0"),
    ],
)
def test_impossible_options_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        tiny("a2tg", **changes).check()


def test_unknown_systems_are_named():
    with pytest.raises(ValueError, match="there is no system 'nerf'; the systems are a2tg"):
        a2tg.find_system("nerf")
    with pytest.raises(ValueError, match=r"cannot be imported: .*: install it, add its folder to PYTHONPATH, or start"):
        a2tg.find_system("no_such_module:X")
    with pytest.raises(ValueError, match="is no system"):
        a2tg.find_system("toy_system:Rings")
    assert a2tg.find_system("toy_system:Toy") == Toy()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Own2 = 1", "has no attribute 'Own'; did you mean Own2"),
        ("def f(:", "cannot be imported: SyntaxError: "),
        ("1 / 0", "cannot be imported: ZeroDivisionError: division by zero"),
        (OWN.format(options="x: int", names=("a",)), "every option of the system .* must have a default"),
    ],
)
def test_errors_of_a_module_are_reported(tmp_path, monkeypatch, text, message):
    (tmp_path / "failing.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "failing", raising=False)
    with pytest.raises(ValueError, match=message):
        a2tg.find_system("failing:Own")


@pytest.mark.parametrize(("names", "message"), [(("a", "a"), "different names; got a, a"), (("a/b",), "got 'a/b'")])
def test_names_of_stages_are_those_of_files(names, message):
    defined = {}
    exec(OWN.format(options="x: int = 1", names=names), defined)
    with pytest.raises(ValueError, match=message):
        defined["Own"]().check()


def test_like_takes_options_of_the_same_name_and_type():
    main = tiny("a2tg", seed=7, rates={"means": 1e-3})
    other = a2tg.like(a2tg.Gaussians2dMcmc, main)
    assert (other.seed, other.rates, other.densify, other.stage2_iterations) == (7, main.rates, main.densify, 12)
    assert other.stages()[0] == main.stages()[0]
    fields = [("densify", int, 3), ("sh_degree", str, "two")]
    kind = dataclasses.make_dataclass("Other", fields, bases=(Toy,), frozen=True)
    like = a2tg.like(kind, a2tg.A2tg(seed=7))
    back = a2tg.like(a2tg.A2tg, kind(seed=7))
    assert (like.seed, like.densify, like.sh_degree) == (7, 3, "two")
    assert (back.seed, back.densify, back.sh_degree) == (7, a2tg.A2tg().densify, 3)


def test_the_opacity_term_acts_on_what_a_billboard_shows():
    """Billboards do not use the Gaussians' opacity: the term fades their pictures."""
    model = dataclasses.replace(some_model(tiny("bbsplat", sh_degree=0)), num_live=jnp.int32(12))
    floats, rest = partition(model)
    _, opacity = a2tg.LossConfig(opacity_weight=1.0).terms()
    slopes = jax.grad(lambda floats: opacity(combine(floats, rest), None, None))(floats)
    assert not np.asarray(slopes.gaussians.logit_opacities).any()
    assert sum(float(jnp.sum(leaf)) for leaf in jax.tree.leaves(slopes.appearance)) > 0


VARIANTS = [
    {},
    {"seed": 1},
    {"rates": {"means": 2e-4, "sh_rest": 2e-4}},
    {"loss": {"ssim_weight": 0.1, "scale_weight": 0.1}},
    {"loss": {"ssim_weight": 0.3, "scale_weight": 5.0}},
    {"stage1_iterations": 20, "stage2_iterations": 20},
]


@pytest.mark.long
@pytest.mark.parametrize(
    "name, event, thresholds",
    [
        ("gaussians-2d", "densify", [{"threshold": number} for number in (3e-4, 4e-4)]),
        ("a2tg", "texture", [{"threshold": number, "select": "threshold"} for number in (1e-6, 4e-6)]),
    ],
)
def test_a_sweep_compiles_each_step_once(scene, name, event, thresholds):
    """In a process that has compiled nothing yet: it comes last in this file, since it drops what others compiled. A
    traced weight is the weight: large scales cost more."""
    session = a2tg.Session()
    counts = []
    scales = []
    jitted_step().clear_cache()
    fixed: dict = {"loss": {"scale_weight": 0.01}}
    if name == "a2tg":
        fixed["texture"] = {"at": [0.5]}
    for changes in [*VARIANTS, *({event: threshold} for threshold in thresholds)]:
        rooms = copy.deepcopy(session.room)
        merged = {key: {**fixed.get(key, {}), **changes.get(key, {})} for key in ("loss", "texture")}
        merged = {**changes, **{key: value for key, value in merged.items() if value}}
        with compiled_programs("train_step") as programs:
            result = a2tg.fit(scene, tiny(name, **merged), session=session)
        # Lists that grow in the middle of a run are compiled again; a run records how often that was.
        count = max(0, len(programs) - result.num_regrown)
        counts.append((count, session.room == rooms))
        scales.append(float(jnp.mean(result.stages[0].model.gaussians.scales)))
    # So are lists that must be longer from the start, as where a seed puts more splats on the screen. The events of
    # another rule (select) are another program.
    chosen = counts[1:] if name != "a2tg" else [*counts[1 : len(VARIANTS)], *counts[len(VARIANTS) + 1 :]]
    again = [count for count, had_room in chosen if had_room]
    assert len(again) > 3 and not any(again), f"traces per run, and whether it had room: {counts}"
    assert scales[3] > scales[4]
