"""Systems as values: those of the library and a toy of one file, trained; what sweeps compile and loops wait for."""

import copy
import dataclasses
import functools
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_fusions import passes_in_its_own_process
from toy_system import Toy

import a2tg_jax as a2tg
from a2tg_jax.core.pytree import num_compiled
from a2tg_jax.io.config_json import changed_config
from a2tg_jax.training import fit_stage, loop
from a2tg_jax.training.batches import BatchOrder, PhotoStore
from a2tg_jax.training.loop import StageRun
from a2tg_jax.training.registry import SYSTEMS, differences, system_from_dict, system_to_dict
from a2tg_jax.training.start import initial_model
from a2tg_jax.training.step import jitted_step

TINY = {"stage1_iterations": 24, "initial_gaussians": 60, "densify": {"cap": 80}}


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
    """A built-in system that trains in no time, with room for all that it wants to add."""
    system = a2tg.find_system(name)
    changes = dict(changes)
    if name in ("gaussians-2d", "supergaussians"):
        changes["densify"] = {"cap": 600, **changes.get("densify", {})}
    if hasattr(system, "stage2_iterations"):
        changes = {"stage2_iterations": 12, **changes}
    return changed_config(system, {**TINY, **changes}, "test")


def assert_same(a, b):
    jax.tree.map(np.testing.assert_array_equal, (a.gaussians, a.appearance), (b.gaussians, b.appearance))


def interrupted_and_resumed(scene, system, path, every: int = 8):
    """The model of a run that was killed after its second checkpoint and went on from the file."""

    class Killed(Exception):
        pass

    count = 0

    def keep(checkpoint):
        nonlocal count
        a2tg.save_checkpoint(path, checkpoint)
        count += 1
        if count == 2:
            raise Killed

    with pytest.raises(Killed):
        a2tg.fit(scene, system, on_checkpoint=keep, checkpoint_every=every, progress=False)
    resume = a2tg.load_checkpoint(path)
    assert resume.iteration == 2 * every
    return a2tg.fit(scene, system, resume=resume, progress=False).model


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_system_trains_resumes_saves_and_renders(scene, tmp_path, name):
    system = tiny(name)
    result = a2tg.fit(scene, system, progress=False)
    history = result.history
    assert np.isfinite(history.loss).all() and history.loss[-1] < history.loss[0]
    assert [stage.name for stage in result.stages] == [stage.name for stage in system.stages()]
    assert_same(interrupted_and_resumed(scene, system, tmp_path / "checkpoint.npz"), result.model)
    a2tg.save_model(tmp_path / "model.npz", result.model)
    loaded = a2tg.load_model(tmp_path / "model.npz")
    view = scene.test[0]
    np.testing.assert_array_equal(loaded.render(view.camera).color, result.model.render(view.camera).color)
    assert result.history.megabytes[-1] == pytest.approx(result.model.num_bytes / 1e6)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", ["a2tg", "gaussians-2d", "supergaussians", "bbsplat"])
def test_training_goes_on_in_the_dtype_of_its_model(scene, tmp_path, name):
    """Also from a checkpoint; nothing falls back to float32, or to float64 where the model is float32."""
    system = tiny(name)
    first = initial_model(scene, system)
    for dtype in (jnp.float64, jnp.float32):
        index = len(system.stages()) - 1
        run = StageRun(scene, system, index, jax.tree.map(lambda x: x.astype(dtype), first))  # noqa: B023
        assert len(run.steps(1, 1)) == 1
        floats = [leaf.dtype for leaf in jax.tree.leaves(run.state) if jnp.issubdtype(leaf.dtype, jnp.floating)]
        assert set(floats) == {jnp.dtype(dtype)}
        a2tg.save_checkpoint(tmp_path / "checkpoint.npz", a2tg.Checkpoint(system, index, run.state, run.history))
        again = a2tg.load_checkpoint(tmp_path / "checkpoint.npz").state
        jax.tree.map(functools.partial(np.testing.assert_array_equal, strict=True), again, run.state)


def test_a_toy_of_one_file_does_all_that_the_others_do(scene, tmp_path):
    system = Toy()
    result = a2tg.fit(scene, system, progress=False)
    rings = np.asarray(result.model.appearance.rings)
    assert np.abs(rings[:, :3]).max() > 1e-3, "the appearance's numbers are trained"
    start = a2tg.fit(scene, dataclasses.replace(system, factor=1.0), progress=False).model.gaussians
    assert result.model.gaussians.log_scales.mean() < start.log_scales.mean() - 0.05, "the event shrinks"
    heavy = a2tg.fit(scene, dataclasses.replace(system, contrast_weight=100.0), progress=False).model
    assert np.square(heavy.appearance.rings[:, :3]).mean() < 0.2 * np.square(rings[:, :3]).mean(), "the term weighs"

    assert_same(interrupted_and_resumed(scene, system, tmp_path / "checkpoint.npz", every=5), result.model)
    a2tg.save_model(tmp_path / "model.npz", result.model)
    loaded = a2tg.load_model(tmp_path / "model.npz")
    assert_same(loaded, result.model)
    assert loaded.num_bytes == 4 * (58 + 4) * loaded.num
    found = a2tg.evaluate(scene.test, loaded)
    assert found.psnr == pytest.approx(a2tg.evaluate(scene.test, result.model).psnr, abs=1e-6)


@pytest.mark.filterwarnings("ignore:stage 'textures'. texture changed nothing")  # Of a share of 0.
def test_textures_of_one_texel_that_do_not_learn_change_nothing(scene):
    """They stay (0, 0, 0, 1), and the Gaussians are those of a stage without textures."""
    plain, textured = tiny("gaussians-2d-mcmc"), tiny("a2tg", texture={"fraction": 0.0}, single_texel_rate=0.0)
    first = fit_stage(scene, plain, 0, progress=False).model
    expected, found = (fit_stage(scene, one, 1, first, progress=False).model for one in (plain, textured))
    (texels,) = found.textures.buckets
    np.testing.assert_array_equal(texels[: found.num], np.broadcast_to([0, 0, 0, 1], (found.num, 1, 1, 4)))
    for a, b in zip(jax.tree.leaves(found.gaussians), jax.tree.leaves(expected.gaussians), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)


def test_textures_that_have_grown_learn_though_those_of_one_texel_do_not(scene):
    system = tiny("a2tg", texture={"fraction": 0.5, "at": [0.5]}, single_texel_rate=0.0)
    model = a2tg.fit(scene, system, progress=False).model
    for (height, width), bucket in zip(model.textures.bucket_sizes, model.textures.buckets, strict=True):
        is_neutral = bool((bucket == jnp.asarray([0, 0, 0, 1], bucket.dtype)[None, None, None]).all())
        assert is_neutral == (height * width == 1)


def test_negative_rates_of_texels_are_refused():
    with pytest.raises(ValueError, match=r"single_texel_rate must be at least 0; got -1"):
        tiny("a2tg", single_texel_rate=-1.0).check()


def test_textured_gaussians_are_a2tg_with_one_size_and_no_events(scene):
    fixed = tiny("textured-gaussians", texture_side=2)
    other = tiny("a2tg")
    first, second = other.stages()
    texture = dataclasses.replace(second.appearance.texture, start=(2, 2))
    appearance = dataclasses.replace(second.appearance, texture=texture)
    textured = dataclasses.replace(second, appearance=appearance, events=())
    as_system = dataclasses.make_dataclass("Fixed", [], bases=(type(other),), frozen=True)
    as_system.stages = lambda self: (first, textured)
    composed = as_system(**{field.name: getattr(other, field.name) for field in dataclasses.fields(other)})
    assert_same(a2tg.fit(scene, fixed, progress=False).model, a2tg.fit(scene, composed, progress=False).model)


def test_without_upscaling_textures_stay_at_one_texel(scene):
    result = a2tg.fit(scene, tiny("a2tg", texture={"cap": 1}), progress=False)
    assert result.model.textures.bucket_sizes == ((1, 1),)


@pytest.mark.filterwarnings("ignore:stage 'textures'. texture.anisotropic made no difference")
@pytest.mark.parametrize("cap", [2, 4, 8, 16])
def test_textures_reach_their_cap(scene, cap):
    """As many upscalings as doublings; the Gaussians that are chosen each time become cap × cap, but for thin ones."""
    texture = {"cap": cap, "fraction": 1.0, "anisotropic": False}
    result = a2tg.fit(scene, tiny("a2tg", texture=texture, initial_gaussians=20, densify={"cap": 20}), progress=False)
    sizes = result.model.textures.sizes
    assert sizes.max() == cap and np.mean(sizes == cap) > 0.8
    assert [round(n / 30_000, 4) for n in a2tg.Upscale(cap=cap).iterations(30_000)] == [
        round(k / 60, 4) for k in range(1, cap.bit_length())
    ]


def test_official_is_a_preset_of_all_options():
    texture = a2tg.A2tg.preset("official").texture
    assert (texture.select, texture.threshold, texture.axes, texture.gradient) == (
        "threshold",
        2e-5,
        "authors",
        "screen",
    )
    lookup = dataclasses.asdict(a2tg.A2tg.preset("official").lookup)
    defaults = dataclasses.asdict(a2tg.TextureOptions())
    assert all(lookup[name] != defaults[name] for name in defaults), "each choice differs from the paper's"
    official = a2tg.A2tg.preset("official")
    assert official.noise_in_stage2 and official.stages()[0].appearance.max_alpha == 0.999


SWEEPS = {
    "seeds": [{"seed": seed} for seed in range(4)],
    "rates": [{"rates": {"means": rate, "sh_rest": rate}} for rate in (1e-4, 2e-4, 5e-4)],
    "loss weights": [{"loss": {"ssim_weight": weight, "scale_weight": weight}} for weight in (0.1, 0.2, 0.3)],
    "schedule ends": [{"stage1_iterations": n, "stage2_iterations": n} for n in (20, 24, 31)],
}


@pytest.mark.parametrize("name, thresholds", [("gaussians-2d", "densify"), ("a2tg", "texture")])
@pytest.mark.parametrize("sweep", [*SWEEPS, "thresholds"])
def test_a_sweep_compiles_each_step_once(scene, sweep, name, thresholds):
    """In a process that has compiled nothing yet."""
    session = a2tg.Session()
    jitted_step().clear_cache()
    if sweep == "thresholds":
        numbers = (2e-4, 3e-4, 4e-4) if thresholds == "densify" else (1e-6, 2e-6, 4e-6)
        select = {"select": "threshold"} if thresholds == "texture" else {}
        variants = [{thresholds: {"threshold": number, **select}} for number in numbers]
    else:
        variants = SWEEPS[sweep]
    counts = []
    for changes in variants:
        before, rooms = num_compiled(jitted_step()), copy.deepcopy(session.capacities)
        merged = dict(changes)
        if name == "a2tg":
            merged["texture"] = {"at": [0.5], **changes.get("texture", {})}
        result = a2tg.fit(scene, tiny(name, **merged), progress=False, session=session)
        # Lists that grow in the middle of a run are compiled anew; a run tells how often that was.
        count = max(0, num_compiled(jitted_step()) - before - result.num_regrown)
        counts.append((count, session.capacities == rooms))
    # So are lists that must be longer from the start, as where a seed puts more splats on the screen.
    again = [count for count, had_room in counts[1:] if had_room]
    assert again and not any(again), f"traces per run, and whether it had room: {counts}"


def test_the_host_waits_once_for_many_steps(scene, monkeypatch):
    waits = []
    monkeypatch.setattr(loop, "read", lambda infos: waits.append(len(infos)) or jax.device_get(infos))
    a2tg.fit(scene, a2tg.Gaussians2dMcmc(stage1_iterations=45, densify=a2tg.Mcmc(cap=60)), progress=False)
    assert waits == [10, 10, 10, 10, 5]


def test_photographs_stay_on_the_device_while_they_fit(scene):
    order = BatchOrder(scene.train, 2, 0)
    everything, nothing = PhotoStore(scene.train, order, 9), PhotoStore(scene.train, order, 9, room=0)
    assert everything.is_resident and not nothing.is_resident
    for iteration in (1, 4, 2, 9):
        images = [
            photographs.of(places).images
            for photographs, places in map(lambda store: store.batch(iteration), (everything, nothing))
        ]
        np.testing.assert_array_equal(*images)
    assert everything.batch(1)[0] is everything.batch(3)[0]
    nothing.close()


@pytest.mark.long
def test_results_do_not_depend_on_where_photographs_are(scene, monkeypatch, request):
    if passes_in_its_own_process(request):
        return
    system = tiny("gaussians-2d-mcmc")
    resident = a2tg.fit(scene, system, progress=False).model
    monkeypatch.setattr(loop, "PhotoStore", lambda *told: PhotoStore(*told, room=0))
    assert_same(a2tg.fit(scene, system, progress=False).model, resident)


def test_gaussians_that_find_no_room_are_counted_and_said(scene):
    system = tiny("gaussians-2d", densify={"cap": 61, "threshold": 1e-9})
    with pytest.warns(UserWarning, match=r"no room for a Gaussian .* raise densify.cap"):
        a2tg.fit(scene, system, progress=False)


def test_a_resumed_training_says_what_found_no_room_before(scene, tmp_path):
    """The resumed part of the stage adds no Gaussians."""
    system = tiny("gaussians-2d", densify={"cap": 61, "threshold": 1e-9})

    def keep(checkpoint):
        a2tg.save_checkpoint(tmp_path / f"{checkpoint.stage}-{checkpoint.iteration}.npz", checkpoint)

    with pytest.warns(UserWarning, match="no room for a Gaussian") as whole:
        a2tg.fit(scene, system, progress=False, on_checkpoint=keep, checkpoint_every=1)
    late = a2tg.load_checkpoint(tmp_path / f"0-{system.stage1_iterations - 1}.npz")
    with pytest.warns(UserWarning, match="no room for a Gaussian") as resumed:
        a2tg.fit(scene, system, progress=False, resume=late)
    assert [str(one.message) for one in whole] == [str(one.message) for one in resumed]


def test_the_cap_of_alphas_is_the_same_in_both_stages():
    system = tiny("textured-gaussians", lookup={"max_alpha": 0.95})
    first, second = (stage.appearance for stage in system.stages())
    assert first.alpha_limit == second.alpha_limit == 0.95


@pytest.mark.parametrize(
    "name, reason",
    [
        ("gaussians-2d-mcmc", "no Gaussian above the death opacity is left"),
        (
            "gaussians-2d",
            "densify: adaptive density control would prune every Gaussian; a lower least_opacity keeps some",
        ),
    ],
)
def test_a_training_without_gaussians_left_tells_what_to_change(scene, name, reason):
    system = tiny(name, initial_opacity=0.001, rates={"logit_opacities": 0.0})
    advice = "check the cameras and points of the scene, or lower rates.logit_opacities"
    with pytest.raises(ValueError, match=rf"^training cannot continue at iteration \d+ .*: {reason}; {advice}$"):
        a2tg.fit(scene, system, progress=False)


@pytest.mark.parametrize("name", SYSTEMS)
def test_options_as_values_of_files_and_back(name):
    system = type(a2tg.find_system(name)).preset("smoke")
    assert system_from_dict(system_to_dict(system), "file") == system
    assert changed_config(a2tg.find_system(name), differences(system), "file") == system


def test_a_file_imports_nothing():
    with pytest.raises(ValueError, match="import its module first"):
        system_from_dict({"name": "antigravity:Fly", "options": {}}, "file")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"texture": {"select": "threshold"}}, "so threshold must say"),
        ({"texture": {"select": "budget"}}, "budget_mb must say"),
        ({"texture": {"cap": 32}}, "texture.cap"),
        ({"texture": {"at": [0.5, 0.2]}}, "at"),
        ({"batch_size": 0}, "batch_size"),
        ({"sh_degree": 4}, "sh_degree"),
        ({"densify": {"cap": 1}}, "densify.cap"),
        ({"initial_opacity": 1.0}, "initial_opacity"),
        ({"stage1_iterations": 0}, "at least 1 iteration"),
    ],
)
def test_impossible_options_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        tiny("a2tg", **changes).check()


def test_unknown_systems_are_named():
    with pytest.raises(ValueError, match="there is no system 'nerf'; the systems are a2tg"):
        a2tg.find_system("nerf")
    with pytest.raises(ValueError, match="cannot be imported"):
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
def test_a_module_that_fails_is_told_of(tmp_path, monkeypatch, text, message):
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


def test_like_leaves_options_of_another_type():
    fields = [("densify", int, 3), ("sh_degree", str, "two")]
    other = dataclasses.make_dataclass("Other", fields, bases=(Toy,), frozen=True)
    like, back = a2tg.like(other, a2tg.A2tg(seed=7)), a2tg.like(a2tg.A2tg, other(seed=7))
    assert (like.seed, like.densify, like.sh_degree) == (7, 3, "two")
    assert (back.seed, back.densify, back.sh_degree) == (7, a2tg.A2tg().densify, 3)


def test_like_takes_options_of_the_same_name():
    main = tiny("a2tg", seed=7, rates={"means": 1e-3})
    other = a2tg.like(a2tg.Gaussians2dMcmc, main)
    assert (other.seed, other.rates, other.densify, other.stage2_iterations) == (7, main.rates, main.densify, 12)
    assert other.stages()[0] == main.stages()[0]


def test_the_opacity_term_acts_on_what_a_billboard_shows(scene):
    """Billboards do not use the Gaussians' opacity: the term fades their pictures."""
    alphas = []
    for weight in (0.0, 0.5):
        system = tiny("bbsplat", loss={"opacity_weight": weight})
        model = a2tg.fit(scene, system, progress=False).model
        alphas.append(float(jnp.mean(model.appearance.opacities(model.gaussians))))
    assert alphas[0] > 1.05 * alphas[1]


def test_gradients_of_a_sweep_are_those_of_its_numbers(scene):
    """A traced weight is the weight: twice the opacity term fades Gaussians more."""
    means = []
    for weight in (0.0, 0.5, 2.0):
        system = tiny("gaussians-2d-mcmc", loss={"opacity_weight": weight}, densify={"cap": 0})
        means.append(float(jnp.mean(a2tg.fit(scene, system, progress=False).model.gaussians.opacities)))
    assert means[0] > means[1] > means[2]
