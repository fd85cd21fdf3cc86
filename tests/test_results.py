"""Run folders, summaries, pictures, figures and the smooth path, each without training."""

import dataclasses
import json
import re
import shlex
import tomllib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from run_folders import create_run

from a2tg_jax.adapt import Upscale
from a2tg_jax.cli import main as cli
from a2tg_jax.core.camera_paths import smooth_path
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.gaussians import init_from_points
from a2tg_jax.data import View, synthetic_scene, view_image
from a2tg_jax.data.scene import origin_of_scene
from a2tg_jax.io.model_file import save_model
from a2tg_jax.mcmc import Mcmc
from a2tg_jax.measure.evaluation import Evaluation, ViewMetrics, evaluate
from a2tg_jax.measure.metrics import psnr
from a2tg_jax.model import Model
from a2tg_jax.render import render_image
from a2tg_jax.results.figures import curves_figure, level_colors, save_figure, sizes_figure
from a2tg_jax.results.folder import OLD, RunFolder, check_free, drop_old, open_run, set_aside
from a2tg_jax.results.history import read_history, write_history
from a2tg_jax.results.images import error_picture, largest_gain, side_by_side, to_uint8
from a2tg_jax.results.record import (
    RunRecord,
    SceneSource,
    contradictions,
    plan_run,
    read_record,
    read_run_file,
    repeating_command,
    write_record,
)
from a2tg_jax.results.report import (
    ModelResult,
    RunResult,
    bytes_compared,
    metrics_json,
    minutes,
    per_view_json,
    summary_text,
)
from a2tg_jax.results.run_evaluation import check_held_out, evaluate_run
from a2tg_jax.results.run_training import RunOptions, train_run
from a2tg_jax.systems.a2tg import A2tg
from a2tg_jax.systems.baselines import BBSplat, Gaussians2d, Gaussians2dMcmc, TexturedGaussians
from a2tg_jax.systems.bytewise import Bytewise
from a2tg_jax.training import History, LearningRates, find_system, like

RECORD = RunRecord(SceneSource("/scenes/a b", downscale=2), "a2tg", A2tg.preset("quick"), ("gaussians-2d-mcmc",))
NAMES = ["a2tg-gaussians", "a2tg-textures", "gaussians-2d-mcmc-continued"]


def some_result(record: RunRecord = RECORD) -> RunResult:
    def measured(psnr: float, texels: int) -> ModelResult:
        views = (ViewMetrics("a<b.png", psnr, 0.5, 0.25, 9.0), ViewMetrics("c.png", psnr + 2, 0.7, 0.75, 7.0))
        found = Evaluation(views, "alex", 20.0, ())
        num_bytes = 23_200 + 16 * texels
        return ModelResult({"test": found, "train": found}, 100, texels, num_bytes, num_bytes, 0, 62.0)

    models = dict(zip(NAMES, (measured(20, 0), measured(23, 300), measured(22, 0)), strict=True))
    return RunResult("scene", record, record.plan, models)


def some_history(stage: int = 1, num: int = 60) -> History:
    steps = np.arange(1, num + 1)
    ones = np.ones(num)
    return History(stage * np.ones(num, int), steps, 1 / steps, 20 + np.log(steps), 5 * steps, 0.1 * ones, 0.5 * steps)


def circle(num: int) -> list[Camera]:
    """Cameras on a circle of radius 2 about the origin, looking at it, y down along -z of the world."""
    cameras = []
    for angle in np.linspace(0, 2 * np.pi, num, endpoint=False):
        center = 2 * np.array([np.cos(angle), np.sin(angle), 0])
        z, y = -center / 2, np.array([0, 0, -1.0])
        rotation = np.stack([np.cross(y, z), y, z])
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ center
        K = jnp.asarray([[50, 0, 20], [0, 50, 15], [0, 0, 1]], jnp.float32)
        cameras.append(Camera(jnp.asarray(viewmat, jnp.float32), K, 40, 30))
    return cameras


# Evaluation


def test_evaluation_measures_the_render():
    cameras, background = circle(3), (0.2, 0.4, 0.6)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    gaussians = init_from_points(points, points + 0.5)
    images = [np.asarray(render_image(gaussians, camera, background=background).color) for camera in cameras]
    views = [View(f"{i}.png", camera, to_uint8(1 - images[i])) for i, camera in enumerate(cameras)]
    found = evaluate(views, gaussians, background=background, num_renders=2)
    for i, measured in enumerate(found.per_view):
        target = jnp.asarray(view_image(views[i]))
        assert measured.psnr == pytest.approx(float(psnr(jnp.asarray(images[i]), target)), rel=1e-4)
        assert measured.lpips is None
    np.testing.assert_allclose(np.stack(found.renders), to_uint8(np.stack(images[:2])), atol=1)
    assert found.psnr == pytest.approx(np.mean([view.psnr for view in found.per_view]))
    assert found[1:].per_view == found.per_view[1:] and found.frames_per_second > 0
    with pytest.raises(ValueError, match="no views"):
        evaluate((), gaussians)


# Names


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("/photos/fox", "fox"),
        ("/photos/Kitchen/Scene", "Kitchen/Scene"),
        ("/photos/kitchen/colmap/dense", "kitchen/colmap/dense"),
        ("/photos/kitchen/scene/transforms.json", "kitchen/scene"),
        ("/data/scene", "scene"),
        ("synthetic", "synthetic"),
    ],
)
def test_a_scene_is_named_by_what_tells_it_from_others(path, name):
    assert SceneSource(path).name == name


# Folders


def test_existing_folder_is_refused(tmp_path):
    run = create_run(tmp_path / "run")
    run.own(run.report).touch()
    with pytest.raises(FileExistsError, match=r"is not empty; add --resume .* --overwrite"):
        create_run(tmp_path / "run")
    (tmp_path / "photo.jpg").touch()
    for overwrite in (False, True):
        with pytest.raises(FileExistsError, match="is not empty and not a run folder"):
            check_free(tmp_path, overwrite=overwrite)
    with pytest.raises(FileExistsError, match="is a file"):
        check_free(tmp_path / "photo.jpg", overwrite=True)


def test_folder_of_a_run_that_never_began_is_free(tmp_path):
    write_record(create_run(tmp_path / "run"), RECORD)
    create_run(tmp_path / "run")


def test_overwrite_deletes_only_what_runs_write(tmp_path):
    run = create_run(tmp_path / "run")
    write_record(run, RECORD)
    own = [run.model(NAMES[0]), run.history(NAMES[1]), run.checkpoint(NAMES[0], 5), run.report, run.test / "a.png"]
    foreign = [
        tmp_path / "outside.txt",
        run.path / "notes.txt",
        run.test / "mine.png",
        run.path / "models" / "mine.npz",
    ]
    for path in [*map(run.own, own), *foreign]:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    with open(run.marker, "a", encoding="utf-8") as file:
        file.write("../outside.txt\n\nmodels\n")
    set_aside(run)
    assert RunFolder(run.path / OLD).model(NAMES[0]).is_file()
    drop_old(run)
    left = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert sorted(left) == sorted([*foreign, run.marker])


def test_a_scene_is_never_overwritten(tmp_path):
    """A Blender scene has folders that runs have too."""
    photographs = [tmp_path / split / "r_0.png" for split in ("train", "test", "models", "figures")]
    for path in [*photographs, tmp_path / "transforms_train.json", tmp_path / "run.toml"]:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    with pytest.raises(FileExistsError, match="not a run folder"):
        check_free(tmp_path, overwrite=True)
    assert all(path.is_file() for path in photographs)


def test_open_run_wants_a_run(tmp_path):
    with pytest.raises(FileNotFoundError, match="is not a run folder"):
        open_run(tmp_path)


def test_newest_checkpoints_are_kept(tmp_path):
    """Those of a stage whose name begins alike are another's."""
    run = create_run(tmp_path)
    kept = [run.checkpoint("a-b", 7), run.checkpoint("a", 999_999), run.checkpoint("a", 1_000_000)]
    for path in [*kept, *(run.checkpoint("a", iteration) for iteration in (20, 100, 1000, 3))]:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    run.drop_old_checkpoints("a")
    assert [*run.checkpoints("a-b"), *run.checkpoints("a")] == kept
    assert sorted(kept[0].parent.iterdir()) == sorted(kept)


# Records


def test_record_round_trip(tmp_path):
    run = create_run(tmp_path)
    write_record(run, RECORD)
    assert read_record(run) == RECORD


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scene = {", r"run\.toml: is not valid TOML"),
        ('system = "a2tg"', r"run\.toml: scene is missing"),
        ('scene = "a"\nscenes = "b"', r"run\.toml: scenes is an unknown key; did you mean scene\?"),
        ("scene = 3", r"run\.toml: scene must be str; got 3"),
        ('scene = "a"\ncompare = [1]', r"run\.toml: compare must be list of str; got \[1\]"),
        (
            'scene = "a"\n[options.texture]\ncaps = 4',
            r"run\.toml: options\.texture\.caps is an unknown key; did you mean cap\?",
        ),
        ('scene = "a"\n[options]\nseed = 0.5', r"run\.toml: options\.seed must be int; got 0\.5"),
        ('scene = "a"\n[options]\ntexture = 1', r"run\.toml: options\.texture must hold the fields of Upscale"),
        ('scene = "a"\n[options.texture]\nat = ["1"]', r"run\.toml: options\.texture\.at must be"),
        (
            'scene = "a"\n[options.texture]\naxes = "both"',
            r"options\.texture\.axes must be one of paper, authors",
        ),
        ('scene = "a"\nsystem = "b2tg"', "there is no system 'b2tg'; the systems are a2tg, "),
        ('scene = "a"\npreset = "fast"', "a2tg has the presets paper, .*; got 'fast'"),
    ],
)
def test_wrong_record_is_one_clear_line(tmp_path, text, message):
    run = create_run(tmp_path)
    run.record.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_record(run)


def test_a_run_that_this_version_refuses_may_be_of_another(tmp_path, capsys):
    run = create_run(tmp_path)
    write_record(run, RECORD)
    run.record.write_text(run.record.read_text().replace("initial_opacity = 0.5", "initial_opacity = 3.0"))
    assert cli.main(["train", "--out", str(tmp_path), "--resume"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "run.toml: initial_opacity must be above 0 and below 1; got 3.0" in line
    assert "if another version than a2tg-jax" in line


def test_configuration_file_says_a_part(tmp_path):
    run = create_run(tmp_path / "run")
    run.record.write_text('scene = "../fox"\npreset = "quick"\n[options.texture]\nk_a = 9\nat = [0.25, 0.5]\n')
    record = read_record(run)
    assert record.scene == SceneSource(str(tmp_path / "fox"))
    assert (record.options.stage1_iterations, record.options.densify.cap) == (2_000, 10_000)
    assert (record.options.texture.k_a, record.options.texture.at) == (9.0, (0.25, 0.5))
    assert all(isinstance(number, float) for number in (record.options.texture.k_a, *record.options.texture.at))


@pytest.mark.parametrize("scene", ["../fox", "synthetic"])
def test_paths_in_a_configuration_file_start_from_its_folder(tmp_path, monkeypatch, scene):
    (tmp_path / "files").mkdir()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    for given in ("splats/fox.ply", str(tmp_path / "files/splats/fox.ply")):
        (tmp_path / "files/mine.toml").write_text(f'scene = "{scene}"\ninit = "{given}"\n')
        file = read_run_file(Path("../files/mine.toml"))
        assert file.init == str(tmp_path / "files/splats/fox.ply")
        assert file.scene.path == ("synthetic" if scene == "synthetic" else str(tmp_path / "fox"))


@pytest.mark.parametrize(
    ("name", "system", "compare", "preset"),
    [
        ("a2tg", A2tg.preset("quick"), ("gaussians-2d-mcmc", "textured-gaussians"), "quick"),
        ("a2tg", A2tg.preset("quick"), (), None),
        ("a2tg", A2tg(), (), "smoke"),
        (
            "a2tg",
            A2tg(
                texture=Upscale(select="budget", at=(0.1, 0.5), budget_mb=3.5),
                densify=Mcmc(cap=7),
                initial_gaussians=50,
                background="white",
                rates=LearningRates(quats=float("inf")),
            ),
            (),
            None,
        ),
        ("gaussians-2d", Gaussians2d(seed=5), ("gaussians-2d-mcmc",), None),
    ],
)
def test_command_repeats_the_run(tmp_path, name, system, compare, preset):
    """run.toml holds every number, so that other defaults, or a preset, change nothing; None where a preset is not."""
    record = RunRecord(SceneSource(str(tmp_path / "a b"), downscale=4), name, system, compare, preset)
    run = create_run(tmp_path / "run c")
    write_record(run, record)
    assert tomllib.loads(run.record.read_text())["options"]["stage1_iterations"] == system.stage1_iterations
    a2tg, command, *arguments = shlex.split(repeating_command(run))
    again = cli.parsed(command, arguments)
    assert (a2tg, again.record, again.out) == ("a2tg", record, tmp_path / "run c-again")
    assert again.record.systems == record.systems


def test_record_names_the_options_that_a_budget_replaces(tmp_path):
    for name, budget in (("with", 1.5), ("without", None)):
        run = create_run(tmp_path / name)
        write_record(
            run, dataclasses.replace(RECORD, options=dataclasses.replace(RECORD.options, memory_budget=budget))
        )
        note = "# options.memory_budget decides instead of options.densify.cap\n"
        assert (note in run.record.read_text()) == (budget is not None)


def test_contradictions_are_named():
    larger = dataclasses.replace(RECORD.options.texture, cap=8)
    changed = dataclasses.replace(RECORD.options, seed=3, texture=larger)
    asked = dataclasses.replace(RECORD, scene=SceneSource("/scenes/a b", downscale=4), options=changed)
    assert contradictions(asked, RECORD) == ["downscale", "seed", "texture.cap"]
    assert contradictions(RECORD, RECORD) == []
    assert "system" in contradictions(dataclasses.replace(RECORD, system="gaussians-2d", options=Gaussians2d()), RECORD)


# Plans


def test_shared_stages_are_trained_once():
    main = A2tg.preset("quick")
    kinds = {"baseline": Gaussians2dMcmc, "fixed": TexturedGaussians, "density": Gaussians2d}
    plan = plan_run({"main": main, **{label: like(kind, main) for label, kind in kinds.items()}})
    assert plan.names == (
        "main-gaussians", "main-textures", "baseline-continued", "fixed-textures", "density-gaussians",
        "density-continued",
    )  # fmt: skip
    assert plan.chains["fixed"] == ("main-gaussians", "fixed-textures")
    assert [planned.start for planned in plan.stages][1:4] == ["main-gaussians"] * 3
    assert plan.first_iteration("density-continued") == 2_000


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 1},
        {"batch_size": 2},
        {"initial_opacity": 0.2},
        {"background": "white"},
        {"stage1_iterations": 7},
        {"rates": LearningRates(sh_rest=1.0)},
        {"densify": Mcmc(cap=9)},
    ],
)
def test_stages_that_differ_are_not_shared(change):
    main = A2tg()
    assert len(plan_run({"a": main, "b": main}).stages) == 2
    assert len(plan_run({"a": main, "b": dataclasses.replace(main, **change)}).stages) == 4


def test_compared_systems_take_the_options(tmp_path, monkeypatch):
    (tmp_path / "variants_of_mine.py").write_text(
        "from a2tg_jax import A2tg\nfrom a2tg_jax.adapt import Upscale\n"
        "SQUARE = A2tg(texture=Upscale(anisotropic=False))\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    record = dataclasses.replace(RECORD, compare=("variants_of_mine:SQUARE", "textured-gaussians"))
    square, fixed = list(record.systems.values())[1:]
    assert list(record.systems) == ["a2tg", "SQUARE", "textured-gaussians"]
    square_textures = dataclasses.replace(RECORD.options.texture, anisotropic=False)
    assert square == dataclasses.replace(RECORD.options, texture=square_textures)
    assert (fixed.stage1_iterations, fixed.densify.cap) == (2_000, 10_000)
    assert dataclasses.replace(RECORD, compare=("bbsplat",)).systems["bbsplat"].billboard == BBSplat().billboard
    of_preset = dataclasses.replace(RECORD, compare=("bbsplat",), preset="quick").systems["bbsplat"]
    assert of_preset.billboard == BBSplat.preset("quick").billboard != BBSplat().billboard
    assert of_preset.densify.cap == RECORD.options.densify.cap
    with pytest.raises(ValueError, match="would be called 'a2tg'"):
        dataclasses.replace(RECORD, compare=("a2tg",)).check()


class TestComparedOptions:
    """Options of compared systems that the main one lacks are kept, too."""

    record = dataclasses.replace(RECORD, compare=("bytewise", "gaussians-2d-mcmc"), preset="quick")

    def test_they_stay_when_defaults_change(self, tmp_path, monkeypatch):
        before = self.record.systems["bytewise"]
        assert before.exponents.least != 0.123
        run = create_run(tmp_path)
        write_record(run, self.record)
        exponents = dataclasses.replace(before.exponents, least=0.123)
        presets = {"quick": dataclasses.replace(before, exponents=exponents)}
        monkeypatch.setattr(type(before), "presets", classmethod(lambda _: presets))
        assert self.record.systems["bytewise"].exponents.least == 0.123
        assert read_record(run).systems["bytewise"] == before
        again = cli.parsed("train", ["--config", str(run.record), "--out", "again", "--seed", "3"]).record
        assert again.systems["bytewise"] == dataclasses.replace(before, seed=3)

    def test_they_take_the_place_of_the_main_systems(self, tmp_path):
        """Plain Gaussians of degree 0 beside A²TG of degree 3, whatever flags say of the main system."""
        other = {"bytewise": {"seed": 9, "rates": {"means": 0.5}}, "gaussians-2d-mcmc": {"sh_degree": 0}}
        record = dataclasses.replace(self.record, compare_options=other)
        run = create_run(tmp_path)
        write_record(run, record)
        assert read_record(run).systems == record.systems
        again = cli.parsed("train", ["--config", str(run.record), "--out", "again", "--sh-degree", "2"]).record.systems
        bytewise = again["bytewise"]
        assert (bytewise.seed, bytewise.rates.means, bytewise.sh_degree) == (9, 0.5, 2)
        assert (again["a2tg"].sh_degree, again["gaussians-2d-mcmc"].sh_degree) == (2, 0)

    def test_those_of_the_main_system_are_not_repeated(self, tmp_path):
        run = create_run(tmp_path)
        write_record(run, self.record)
        table = tomllib.loads(run.record.read_text())["compare_options"]
        assert set(table) == set(self.record.compare)
        assert "least" in table["bytewise"]["exponents"] and "texel_rate" not in table["bytewise"]

    def test_a_file_may_set_them(self, tmp_path):
        file = tmp_path / "mine.toml"
        text = 'scene = "synthetic"\ncompare = ["bytewise"]\n[compare_options.bytewise.exponents]\nleast = 0.5\n'
        file.write_text(text)
        said = cli.parsed("train", ["--config", str(file), "--out", "run", "--seed", "3"]).record
        assert said.systems["bytewise"].exponents.least == 0.5 and said.systems["bytewise"].seed == 3
        for preset in ("smoke", "paper"):
            other = cli.parsed("train", ["--config", str(file), "--out", "run", "--preset", preset]).record
            assert other.systems["bytewise"].exponents == Bytewise.preset(preset).exponents
        file.write_text(text.replace('compare = ["bytewise"]', ""))
        added = cli.parsed("train", ["--config", str(file), "--out", "run", "--compare", "bytewise"]).record
        added.check()
        assert added.systems["bytewise"].exponents.least == 0.5
        with pytest.raises(ValueError, match=r"bytewise: the run does not compare this system: add it"):
            cli.parsed("train", ["--config", str(file), "--out", "run"]).record.check()

    @pytest.mark.parametrize(
        ("table", "message"),
        [
            ("[compare_options.bytewise]\nexponents.leas = 1.0", r"bytewise\.exponents\.leas is an unknown key"),
            ("[compare_options.bytewise]\nexponents.least = []", r"bytewise\.exponents\.least must be float; got \[\]"),
            ("compare_options.bytewise = 3", r"compare_options\.bytewise must be a table of options; got 3"),
        ],
    )
    def test_others_are_refused(self, tmp_path, table, message):
        file = tmp_path / "mine.toml"
        file.write_text(f'scene = "synthetic"\ncompare = ["bytewise"]\n{table}\n')
        with pytest.raises(ValueError, match=message):
            cli.parsed("train", ["--config", str(file), "--out", "run"]).record.check()

    def test_a_resumed_run_takes_every_option_from_its_folder(self, tmp_path, capsys):
        run = create_run(tmp_path / "run")
        write_record(run, dataclasses.replace(self.record, scene=SceneSource("synthetic"), compare=("bytewise",)))
        resumed = ["--out", str(run.path), "--resume"]
        assert cli.parsed("train", resumed).resumed(run) == read_record(run)
        cli.parsed("train", [*resumed, "--compare", "gaussians-2d-mcmc", "--on-nan", "restore"]).resumed(run)
        again = read_record(run)
        assert (again.compare, again.on_nan) == (("bytewise", "gaussians-2d-mcmc"), "restore")
        assert cli.main(["train", "--config", str(run.record), *resumed]) == 2
        assert "--resume takes every option from the run folder: leave out --config" in capsys.readouterr().err

    def test_systems_of_ones_own_with_options_of_another_type(self, tmp_path, monkeypatch):
        """`details` of the main system is a number, in bytewise a group."""
        (tmp_path / "with_details.py").write_text(
            "import dataclasses\nfrom a2tg_jax import Gaussians2dMcmc\n"
            "@dataclasses.dataclass(frozen=True, kw_only=True)\n"
            "class Main(Gaussians2dMcmc):\n    details: float = 1.0\n"
        )
        monkeypatch.syspath_prepend(tmp_path)
        kind = type(find_system("with_details:Main"))
        record = RunRecord(
            SceneSource("synthetic"), "with_details:Main", kind(stage2_iterations=9), ("bytewise",), "quick"
        )
        run = create_run(tmp_path / "run")
        write_record(run, record)
        assert set(tomllib.loads(run.record.read_text())["compare_options"]["bytewise"]["details"]) > {"at", "cap"}
        assert read_record(run).systems == record.systems


# Summaries


def test_gains_are_over_the_compared_systems():
    result = some_result()
    assert result.main == "a2tg-textures" and result.before == ["a2tg-gaussians"]
    assert result.gains == pytest.approx({"gaussians-2d-mcmc-continued": 1.0})
    unfinished = dataclasses.replace(result, models={NAMES[0]: result.models[NAMES[0]]})
    assert (unfinished.main, unfinished.before, unfinished.gains) == ("a2tg-gaussians", [], {})


def test_metrics_hold_means_of_the_views():
    metrics = json.loads(json.dumps(metrics_json(some_result())))
    assert metrics["models"]["a2tg-textures"]["test"] == {
        "psnr": 24.0,
        "ssim": 0.6,
        "lpips": 0.5,
        "flat_psnr": 8.0,
        "views": 2,
    }
    assert metrics["lpips_network"] == "alex"
    assert metrics["models"]["a2tg-textures"]["num_bytes"] == 28_000
    assert metrics["gains_db"] == {"gaussians-2d-mcmc-continued": 1.0}
    assert per_view_json(some_result())["a2tg-gaussians"]["train"]["c.png"]["psnr"] == 22


def test_summary_has_a_column_for_each_model():
    lines = summary_text(some_result(), 80).splitlines()
    assert re.split(r"\s{2,}", lines[0])[1:] == NAMES
    assert lines[1].split() == ["test", "PSNR", "(dB)", "21.00", "24.00", "23.00"]
    compared = "with 1.2 times its bytes (0.03 MB and 0.02 MB)"
    assert lines[-1] == f"a2tg-textures: +1.00 dB over gaussians-2d-mcmc-continued, {compared}"


@pytest.mark.parametrize(
    ("own", "other", "expected"),
    [
        (330_000, 220_000, "with 1.5 times its bytes (0.33 MB and 0.22 MB)"),
        (500_000, 1_000_000, "with 0.50 times its bytes (0.50 MB and 1.00 MB)"),
        (1_020_000, 1_000_000, "with 1.02 times its bytes (1.02 MB and 1.00 MB)"),
        (1_010_000, 1_000_000, "at equal bytes (1.01 MB)"),
        (990_000, 1_000_000, "at equal bytes (0.99 MB)"),
        (0, 0, "at equal bytes (0.00 MB)"),
    ],
)
def test_gains_name_the_bytes_that_they_cost(own, other, expected):
    result = some_result()
    sizes = {"a2tg-textures": own, "gaussians-2d-mcmc-continued": other}
    models = {
        name: dataclasses.replace(measured, num_bytes=sizes.get(name, 1)) for name, measured in result.models.items()
    }
    result = dataclasses.replace(result, models=models)
    assert bytes_compared(result, "gaussians-2d-mcmc-continued") == expected
    assert (
        summary_text(result).splitlines()[-1] == f"a2tg-textures: +1.00 dB over gaussians-2d-mcmc-continued, {expected}"
    )


def test_the_summary_says_how_much_of_its_budget_a_model_takes():
    system = dataclasses.replace(RECORD.options, memory_budget="28.1kB")
    text = summary_text(some_result(dataclasses.replace(RECORD, options=system)))
    assert (
        "a2tg-textures takes 28,000 bytes of its budget of 28,100 (99.64 %)" in text
        and "budget" not in summary_text(some_result())
    )


def test_summary_fits_the_terminal():
    wide, narrow = (summary_text(some_result(), width).splitlines() for width in (80, 48))
    table = narrow[: len(narrow) - 2]
    assert max(map(len, table)) <= 48 and table.count("") == 1
    assert sum(line.count("dB)") for line in table) == 2 * sum(line.count("dB)") for line in wide)
    assert narrow[-2:] == wide[-2:]


def test_published_bytes_stand_beside_other_counts():
    result = some_result()
    assert "published" not in summary_text(result)
    counted = dataclasses.replace(result.models[NAMES[1]], num_published_bytes=20_000)
    text = summary_text(dataclasses.replace(result, models={**result.models, NAMES[1]: counted}))
    assert re.search(r"as published \(MB\) +0\.02\n", text)


def test_durations():
    assert [minutes(seconds) for seconds in (4.4, 65, 3720)] == ["4 s", "1 min 5 s", "1 h 2 min"]


def test_history_round_trip(tmp_path):
    write_history(tmp_path / "h.csv", some_history())
    for x, y in zip(
        dataclasses.astuple(read_history(tmp_path / "h.csv")), dataclasses.astuple(some_history()), strict=True
    ):
        np.testing.assert_array_equal(x, y)
    (tmp_path / "h.csv").write_text("a,b\n")
    with pytest.raises(ValueError, match="has the columns a, b"):
        read_history(tmp_path / "h.csv")


def test_loss_terms_are_columns_of_a_history(tmp_path):
    """Of two stages, one has a term that the other has not; files without terms are read as ever."""
    one = some_history(num=2).with_point(1, 3, 0.3, 20.0, 5, 0.1, 2.0, l1=0.25, roughness=0.05)
    both = one.followed_by(some_history(num=1).with_point(2, 2, 0.2, 20.0, 5, 0.1, 2.0, l1=0.2))
    write_history(tmp_path / "h.csv", both)
    found = read_history(tmp_path / "h.csv")
    np.testing.assert_array_equal(found.terms["l1"], [np.nan, np.nan, 0.25, np.nan, 0.2])
    np.testing.assert_array_equal(found.terms["roughness"], [np.nan, np.nan, 0.05, np.nan, np.nan])
    first, *_, last = (tmp_path / "h.csv").read_text().splitlines()
    assert first.endswith(",seconds,loss_l1,loss_roughness") and last.endswith(",2.0,0.2,nan")
    for columns in ("loss_l1,loss_l1", "roughness"):
        (tmp_path / "h.csv").write_text(f"{','.join(some_history().to_dict())},{columns}\n")
        with pytest.raises(ValueError, match=r"has a column twice: loss_l1|has the columns stage"):
            read_history(tmp_path / "h.csv")


# Pictures


def test_views_of_the_training_are_not_scored_as_held_out(tmp_path):
    scene = synthetic_scene(num_views=4, width=8, height=6, num_points=9)
    grown = dataclasses.replace(scene, train=scene.train[1:], test=(*scene.test, scene.train[0]))
    run = create_run(tmp_path / "run")
    write_record(run, RunRecord(SceneSource("synthetic"), "a2tg", A2tg.preset("smoke")))
    gaussians = init_from_points(scene.points, scene.colors)
    save_model(run.model("a2tg-gaussians"), Model(gaussians, origin=origin_of_scene(scene)))
    told = rf"a2tg-gaussians.npz was trained on 1 view that synthetic now holds out, such as {scene.train[0].name}"
    with pytest.raises(ValueError, match=told):
        evaluate_run(run, grown)
    with pytest.raises(ValueError, match=told):
        train_run(run, grown, RunOptions())
    check_held_out(Model(gaussians, origin=origin_of_scene(grown)), scene, run.path)
    check_held_out(Model(gaussians), grown, run.path)


def test_largest_gain_finds_the_square():
    target = np.full((40, 60, 3), 100, np.uint8)
    before, after = target.copy(), target.copy()
    before[23:33, 41:51] = 250
    assert largest_gain(target, before, after) == np.s_[23:33, 41:51]


def test_largest_gain_leaves_out_where_both_fail():
    target = np.full((40, 60, 3), 100, np.uint8)
    before, after = target.copy(), target.copy()
    before[23:33, 41:51], before[5:15, 5:15], after[5:15, 5:15] = 150, 255, 200
    assert largest_gain(target, before, after)[0].start == 23
    after[:] = 200
    rows, columns = largest_gain(target, before, after)
    assert rows.stop - rows.start == columns.stop - columns.start == 10


def test_pictures_are_rounded_clipped_and_brightened():
    assert to_uint8(np.array([[[-1.0, 0.5, 2.0]]])).tolist() == [[[0, 128, 255]]]
    difference = error_picture(np.array([[[10, 0, 200]]], np.uint8), np.array([[[0, 5, 0]]], np.uint8))
    assert difference.tolist() == [[[40, 20, 255]]]


def test_side_by_side_puts_images_in_a_row():
    images = [np.full((30, 40, 3), shade, np.uint8) for shade in (50, 150)]
    sheet = np.asarray(side_by_side(images, ["photograph", "render"]))
    assert sheet.shape[1] == 2 * 240 + 6, "small images are enlarged"
    assert sheet[-1, 0, 0] == 50 and sheet[-1, -1, 0] == 150


def test_colors_of_levels_differ():
    colors = level_colors(5)
    assert colors.shape == (5, 3) and len(np.unique(colors, axis=0)) == 5
    assert level_colors(1).shape == (1, 3)


def test_figures_are_written(tmp_path):
    histories = {NAMES[0]: some_history(1), NAMES[1]: some_history(2), NAMES[2]: some_history(2)}
    starts = {NAMES[0]: 0, NAMES[1]: 60, NAMES[2]: 60}
    sizes = np.array([(1, 1), (1, 4), (4, 2), (1, 1), (8, 8)])
    for index, figure in enumerate([curves_figure(histories, starts), sizes_figure(sizes)]):
        save_figure(tmp_path / f"{index}.png", figure)
        assert (tmp_path / f"{index}.png").stat().st_size > 1000


# The path


def test_path_is_smooth_and_stays_near_the_cameras():
    path = smooth_path(circle(12), 60)
    viewmats = np.stack([np.asarray(camera.viewmat, np.float64) for camera in path])
    rotations = viewmats[:, :3, :3]
    centers = -np.einsum("nji,nj->ni", rotations, viewmats[:, :3, 3])
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (60, 3, 3)), atol=1e-6
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-6)
    assert np.all(np.abs(np.linalg.norm(centers, axis=1) - 1.8) < 0.3)
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 1.1 * steps.min()
    towards = np.einsum("ni,ni->n", rotations[:, 2], -centers / np.linalg.norm(centers, axis=1, keepdims=True))
    assert towards.min() > 0.95


def test_path_wants_two_cameras():
    with pytest.raises(ValueError, match="two cameras"):
        smooth_path(circle(1), 10)
