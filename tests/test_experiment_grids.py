"""Grids of experiments name the runs that they should, with keys of what decides a result."""

import dataclasses
import itertools
import pathlib
import re
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from experiment_records import CELL, record, result
from lab import tables
from lab.cli import EXPERIMENTS, Lab, argument_parser
from lab.fingerprint import fingerprint
from lab.grid import Method, has_scale, read_grid, splats_in
from lab.grid_file import GRIDS, SCALES, Block
from lab.jobs import Folders, Job
from lab.scenes import SceneAt, chosen_scenes, few_views, from_random_points, own_scene
from lab.timing import TrainingTime
from run import chosen, experiments, main, parse_arguments
from test_data_transforms import write_blender

import a2tg_jax as a2tg
from a2tg_jax import Term
from a2tg_jax.base.config_json import flatten_config

LARGE_SCALES = ("full", "full_size", "half_size", "long", "paper160")
NEED_CHOICES = (("claims", "claims"), ("confirmation", "claims"))
"""Grids, at a scale, of which some methods are chosen for each scene by other runs."""
NAMES = sorted(path.stem for path in GRIDS.glob("*.toml") if path.stem not in ("methods", "scales"))


@pytest.mark.parametrize(
    ("name", "scale"),
    [
        pytest.param(name, scale, marks=pytest.mark.long if scale in LARGE_SCALES else ())
        for name, scale in itertools.product(NAMES, SCALES)
        if has_scale(name, scale) and (name, scale) not in NEED_CHOICES
    ],
)
def test_every_grid_names_runs_that_can_be_trained(name, scale):
    grid = read_grid(name, scale)
    first = {job.key: job for job in grid.jobs({})}
    assert grid.cells and first
    for job in first.values():
        job.system.check()
    finished = {key: record(mb=job.system.densify.cap * 290e-6) for key, job in first.items()}
    runs = list(grid.runs(finished))
    places = [(run.cell, run.label) for run in runs]
    methods = dict.fromkeys((grid.reference, *grid.methods))
    at_equal_number = sum((method.most or 10**9) >= cell.gaussians for cell in grid.cells for method in methods)
    assert len(set(places)) == len(places) == at_equal_number + len(grid.cells) * len(grid.at_equal_bytes)


def test_choices_are_made_on_validation_views(tmp_path):
    """No run for choosing holds test views, nor is it taken for a run that does, and its pages say so."""
    final = next(read_grid("fixed_memory", "smoke").jobs({}))
    choosing = next(read_grid("fixed_memory", "smoke", validation=True).jobs({}))
    assert choosing == dataclasses.replace(final, validation=True) and choosing.key != final.key
    assert choosing.start is None or choosing.start.validation
    folders = Folders(tmp_path, tmp_path)
    whole, scene = folders.load_scene(final), folders.load_scene(choosing)
    assert [view.name for view in scene.test] == [view.name for view in whole.train[::8]]
    assert {view.name for view in (*scene.train, *scene.test)} == {view.name for view in whole.train}
    lab = Lab(argument_parser("").parse_args(["--scale", "smoke", "--validation", "--out", str(tmp_path)]))
    assert lab.grid("fixed_memory").validation
    lab.write("page", "# Title\n")
    assert "validation views" in (tmp_path / "page.md").read_text()
    named = Lab(argument_parser("").parse_args(["--scale", "smoke", "--validation", "--tables-only"]))
    assert named.out.name == "smoke-validation"


def test_every_grid_belongs_to_an_experiment_that_says_what_it_shows():
    known = experiments()
    assert {name for experiment in known.values() for name in experiment.grids} == set(NAMES)
    assert all(experiment.summary.endswith(".") for experiment in known.values())


def test_methods_of_a_cell_differ_in_what_their_names_say_only():
    grid = read_grid("ablation", "small")
    cell = next(cell for cell in grid.cells if cell.scene.label == "fox")
    jobs = {run.method.label: run.job for run in grid.runs({}) if run.cell == cell}
    own, square = (flatten_config(jobs[label].system) for label in ("A²TG", "w/o anisotropy"))
    assert {name for name in own if own[name] != square[name]} == {"texture.anisotropic"}
    starts = {jobs[label].start.key for label in ("A²TG", "Textured Gaussians*", "2DGS*-MCMC", "w/o anisotropy")}
    assert starts == {jobs["2DGS*-MCMC, first stage"].key}, "the first stage is trained once"


@pytest.mark.long
def test_anisotropy_acts_at_the_smoke_scale():
    """Only a Gaussian that is elongated and thin gets a texture that is not square."""
    grid = read_grid("ablation", "smoke")
    scene = a2tg.synthetic_scene(num_views=4, width=104, height=78, num_points=500)
    sizes = a2tg.fit(scene, grid.reference_job(grid.cells[0]).system).model.textures.sizes
    assert (sizes[:, 0] != sizes[:, 1]).sum() > 10


@pytest.mark.parametrize("mb", [0.9, 1.504544, 20.0])
@pytest.mark.parametrize("floats", [58, 85, 122, 1081])
def test_equal_bytes_are_no_more_and_less_by_a_splat_at_most(mb, floats):
    num = splats_in(mb, Method("any", "any", floats=floats))
    assert num * floats * 4 <= mb * 1e6 + 0.5 < (num + 1) * floats * 4 + 1


def test_a_method_whose_gaussians_differ_in_size_fills_the_bytes_of_the_reference_as_its_budget():
    grid = read_grid("fixed_memory", "long", scenes=["fox"])
    finished = {grid.reference_job(grid.cells[0]).key: record(mb=0.7123)}
    (run,) = (run for run in grid.runs(finished) if run.method.label == "Bytewise, Gaussian kernels")
    assert run.equal == "bytes" and run.job.system.memory_budget == 0.7123
    assert run.cell.budget is None, "it stays in the cell of the others"


def test_a_rehearsal_runs_every_method_once_and_keeps_to_itself():
    whole, short = read_grid("fixed_memory", "full"), read_grid("fixed_memory", "full", rehearsal=True)
    (cell,) = short.cells
    assert cell == dataclasses.replace(whole.cells[0], iterations=(300, 300))
    assert short.methods == whole.methods and short.at_equal_bytes == whole.at_equal_bytes
    lab = Lab(argument_parser("").parse_args(["--scale", "full", "--rehearsal", "--tables-only"]))
    assert lab.out.parts[-3:] == ("runs", "results", "full-rehearsal") and len(lab.grid("fixed_memory").cells) == 1


def test_all_experiments_of_a_scale_are_those_whose_grids_have_it():
    known = experiments()
    names = {found.name for found in chosen(known, parse_arguments(known, ["all", "--scale", "long"]))}
    assert {"fixed_memory", "ablation"} <= names < set(known)
    everywhere = {found.name for found in chosen(known, parse_arguments(known, ["all", "--scale", "smoke"]))}
    assert everywhere == set(known)


@pytest.mark.parametrize("name", ["paper_degree_3", "paper_degree_0"])
def test_the_papers_size_runs_in_the_order_of_the_protocol(name):
    whole, half = (read_grid(name, scale) for scale in ("full_size", "half_size"))
    sizes = [(cell.gaussians, cell.scene.path) for cell in whole.cells]
    assert sizes == list(itertools.product((100_000, 300_000), ("snowmiku", "herz_jesus_p25", "fox")))
    assert sizes == [(cell.gaussians, cell.scene.path) for cell in half.cells]
    assert {(cell.scene.downscale, cell.iterations) for cell in whole.cells} == {(1, (10_000, 10_000))}
    assert {(cell.scene.downscale, cell.iterations) for cell in half.cells} == {(2, (10_000, 10_000))}
    assert not {cell.scene.label for cell in whole.cells} & {cell.scene.label for cell in half.cells}
    first = next(whole.jobs({}))
    runs = list(whole.runs({first.key: record(mb=31.5)}))[:5]
    systems = ["a2tg", "gaussians-2d-mcmc", "gaussians-2d-mcmc", "textured-gaussians", "bytewise"]
    assert [run.job.system.name for run in runs] == systems
    assert {(run.job.scene, run.job.system.tile_size) for run in runs} == {("snowmiku", 16)}
    assert [run.job.all_iterations for run in runs][1:3] == [(10_000, 10_000), (10_000,)]
    assert {run.job.system.sh_degree for run in runs[:4]} == {int(name[-1])}
    assert runs[4].job.system.memory_budget == 31.5, "its Gaussians differ in size"


def test_scenes_are_chosen():
    labels = lambda **wanted: {cell.scene.label for cell in read_grid("ablation", "small", **wanted).cells}  # noqa: E731
    assert labels() == {"fox", "herz_jesus_p25", "lego", "snowmiku"}
    assert labels(scenes=["lego"]) == {"lego"}
    assert labels(scenes=["built-in"]) == {"built-in"}, "what is asked for comes before what a grid has"
    with pytest.raises(ValueError, match="no scene 'dog' at this scale; there are"):
        labels(scenes=["dog"])


def test_scenes_of_ones_own_take_the_place_of_the_scales(tmp_path):
    (tmp_path / "garden").mkdir()
    own = own_scene(tmp_path / "garden", 4)
    grid = read_grid("fixed_memory", "small", own=(own,))
    assert {cell.scene for cell in grid.cells} == {SceneAt("garden", (tmp_path / "garden").as_posix(), 4)}
    assert Folders(pathlib.Path("scenes"), tmp_path).scenes / own.path == tmp_path / "garden"
    lab = Lab(argument_parser("").parse_args(["--scene", str(tmp_path / "garden"), "--out", str(tmp_path / "out")]))
    assert lab.is_partial and {cell.scene.label for cell in lab.grid("fixed_memory").cells} == {"garden"}
    with pytest.raises(ValueError, match="no scene folder"):
        own_scene(tmp_path / "nowhere", 1)
    with pytest.raises(ValueError, match="at least 1"):
        own_scene(tmp_path / "garden", 0)
    other = tmp_path / "other" / "garden"
    other.mkdir(parents=True)
    words = ["--out", str(tmp_path / "out"), *2 * ["--scene", str(tmp_path / "garden")]]
    assert len(Lab(argument_parser("").parse_args(words)).own_scenes) == 1
    lab = Lab(argument_parser("").parse_args([*words, "--scene", str(other)]))
    with pytest.raises(ValueError, match="two folders of --scene are called garden"):
        lab.grid("fixed_memory")


OWN_GRID = """
title = "Mine"
table = "gains"
reference = "bytewise"
methods = ["2DGS*-MCMC"]

[variants]
"bytewise" = { system = "bytewise" }

[small]
budgets = [0.3]

[small.scenes]
"mine" = { path = "captures/garden", downscale = 4, options.background = "white" }
"""


def own_grid(tmp_path, text=OWN_GRID):
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_a_grid_file_of_ones_own_names_scenes_and_table(tmp_path):
    grid = read_grid(own_grid(tmp_path), "small")
    (cell,) = grid.cells
    options = {"background": "white"}
    place = (tmp_path / "captures" / "garden").resolve().as_posix()
    assert (grid.name, grid.table, cell.scene) == ("mine", "gains", SceneAt("mine", place, 4, options=options))
    job = next(grid.jobs({}))
    assert job.system.background == "white" and job.key.startswith("garden-4-")
    assert [method.label for method in grid.methods] == ["2DGS*-MCMC"], "a reference among the variants is one method"


OWN_SYSTEM = """
import dataclasses

import a2tg_jax as a2tg


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plain(a2tg.System):
    stage1_iterations: int = 7
    stage2_iterations: int = 0
    sharpness: float = 1.0
    densify: a2tg.Mcmc = a2tg.Mcmc(cap=5_000)
    name = "plain"

    def stages(self):
        events = (a2tg.Noise(), self.densify)
        losses = self.loss.terms()
        return (a2tg.Stage("plain", a2tg.Appearance(), events, losses, self.rates, self.stage1_iterations, 0.0),)


class Short(Plain):
    @classmethod
    def presets(cls):
        return {"paper": cls(), "quick": cls(sharpness=2.0)}
"""


def test_a_custom_system_needs_the_preset_of_the_scale(tmp_path, monkeypatch):
    (tmp_path / "own_systems.py").write_text(OWN_SYSTEM, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)

    def system_of(name, preset=""):
        text = OWN_GRID.replace('system = "bytewise"', f'system = "own_systems:{name}"')
        grid = read_grid(own_grid(tmp_path, text.replace("budgets = [0.3]", f"gaussians = [400]\n{preset}")), "small")
        return next(grid.jobs({})).system

    with pytest.raises(ValueError, match="plain has the presets paper; got 'quick'"):
        system_of("Plain")
    plain, short = system_of("Plain", 'preset = "paper"'), system_of("Short")
    assert (plain.sharpness, short.sharpness) == (1.0, 2.0)
    assert plain.stage1_iterations == short.stage1_iterations == 2_000
    assert plain.densify.cap == short.densify.cap == 400


@pytest.mark.parametrize(
    "before, after, words",
    [
        ("gains", "gain", "table must be one of quality, gains, choices"),
        ("2DGS*-MCMC", "2DGS-MCMC", r"no method '2DGS-MCMC'; did you mean 2DGS\*-MCMC"),
        ("budgets", "budget", "mine.toml: small.budget is an unknown key; did you mean budgets"),
        ("budgets = [0.3]", "seeds = [1]", "needs gaussians, budgets or bytes_per_pixel"),
        ("budgets = [0.3]", "blocks = [{ budget = [0.3] }]", r"small.blocks\[0\].budget is an unknown key"),
        ("[small.scenes]", "[smal]\n[small.scenes]", "mine.toml: smal is an unknown key; did you mean small"),
        ("path =", "place =", "small.scenes.'mine'.place is an unknown key; it has path, downscale"),
        ("downscale = 4", "downscale = 0", "small.scenes.'mine'.downscale must be at least 1; got 0"),
        ("downscale = 4", "downscale = 0.5", "small.scenes.'mine'.downscale must be int; got 0.5"),
        ('options.background = "white"', "options = 3", "small.scenes.'mine'.options must be dict; got 3"),
        ('"mine" = {', '"other" = 3\n"mine" = {', "small.scenes.'other' must be a table; got 3"),
        ("[small]", "[full]", r"no table of --scale small, \[small\]; it has \[full\]"),
        ("title = ", "titel = ", "mine.toml: titel is an unknown key; did you mean title"),
        ('title = "Mine"', "", "mine.toml: title is missing$"),
        ('reference = "bytewise"', "reference = 3", "mine.toml: reference must be str; got 3"),
        ('["2DGS*-MCMC"]', "[[1]]", r"mine.toml: methods must be list of str; got \[\[1\]\]"),
        ("system = ", "sytem = ", "variants.'bytewise'.sytem is an unknown key; did you mean system"),
        ('system = "bytewise"', "system = 3", r"variants.'bytewise'.system must be str \| None; got 3"),
        ('{ system = "bytewise" }', "3", "variants.'bytewise' must be a table; got 3"),
        ('system = "bytewise"', 'system = "bytewise", options = 3', "variants.'bytewise'.options must be dict; got 3"),
        ('system = "bytewise"', 'system = "bytewise", floats = 0', "variants.'bytewise'.floats must be at least 1"),
        ("budgets = [0.3]", "budgets = 0.3", r"small.budgets must be list of float \| None; got 0.3"),
        ("budgets = [0.3]", "budgets = [nan]", "small.budgets must be at least 1e-06; got nan"),
        ("budgets = [0.3]", "budgets = [0.3]\ngaussians = [9]", "small has gaussians and budgets: leave one out"),
        ("budgets = [0.3]", "gaussians = []", "small.gaussians must not be empty"),
        ("[small]", "[small]\niterations = [60]", r"small.iterations must be list of 2 int \| None; got \[60\]"),
        ("[small]", "[small]\niterations = [60, -40]", "small.iterations must be at least 0; got -40"),
        ('system = "bytewise"', 'like = "A2TG"', "mine.toml: 'bytewise' is like 'A2TG', which is no method above it"),
        ("budgets = [0.3]", "budgets = [0.3", "mine.toml: is not valid TOML: Unclosed array"),
    ],
)
def test_mistakes_in_a_grid_file_are_reported(tmp_path, before, after, words):
    text = OWN_GRID.replace(before, after)
    if before == "[small]":
        text = text.replace("[small.scenes]", "[full.scenes]")
    with pytest.raises(ValueError, match=words):
        read_grid(own_grid(tmp_path, text), "small")


@pytest.mark.parametrize(("only", "labels"), [(None, ["a", "b"]), ((), []), (("b",), ["b"])])
def test_a_block_has_all_scenes_or_those_that_it_names(only, labels):
    scenes = {label: SceneAt(label, label) for label in "ab"}
    assert [scene.label for scene in chosen_scenes(scenes, Block(only=only), None, "mine.toml")] == labels


def test_tables_of_a_budget_show_the_gaussians_of_the_runs():
    cell = dataclasses.replace(CELL, gaussians=0, budget=0.3)
    runs = [result("own", 21.0), result("other", 20.0)]
    runs = [tables.Result(dataclasses.replace(one.run, cell=cell), one.record) for one in runs]
    assert "1,000 (5.00 a pixel)" in tables.gains_table(runs, "own", ["other"])
    assert "| other | 1,000 | 1.00 | 20.00 / .800 / .200 | 21.00 | 1 |" in tables.figures_table(runs)
    larger = dataclasses.replace(cell, budget=0.6)
    richer = [tables.Result(dataclasses.replace(one.run, cell=larger), one.record) for one in runs]
    assert "fox, 0.3 MB: dB · LPIPS | fox, 0.6 MB" in tables.choices_table([*runs, *richer], "own")


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["fixed_memor"], "no experiment 'fixed_memor'; did you mean fixed_memory?"),
        (["fixed_memory", "--scale", "smal"], "no --scale smal; did you mean small?"),
        (["efficiency", "--only", "dog"], "no scene 'dog'"),
        (["efficiency", "--scale", "small", "--scenes", "nowhere"], "nowhere"),
        (["fixed_memory", "--only", "legoo"], "no scene 'legoo' at this scale; did you mean lego?"),
        (["nowhere/mine.toml"], "no grid file nowhere/mine.toml"),
        (["fixed_memory", "--plan", "--jobs", "0"], "--jobs must be at least 1; got 0"),
        (
            ["fixed_memory", "--plan", "--memory-gb", "nan"],
            "--memory-gb must be a finite number larger than 0; got nan",
        ),
        (["fixed_memory", "--plan", "--minutes", "0"], "--minutes must be a finite number larger than 0; got 0.0"),
        (["fixed_memory", "--minutes", "9", "--cluster", "slurm"], "--minutes has no effect on jobs of --cluster"),
        (["fixed_memory", "--plan", "--downscale", "2"], "--downscale is that of --scene: add --scene"),
        (["fixed_memory", "--plan", "--scene", ".", "--downscale", "0"], "--downscale must be at least 1; got 0"),
        (["fixed_memory", "--plan", "--scene", ".", "--only", "fox"], "--only chooses scenes of the scale"),
        (["fixed_memory", "--plan", "--cluster-parameter", "mem_gb=3"], "--cluster-parameter needs --cluster"),
        (["fixed_memory", "--cluster", "slurm", "--cluster-parameter", "mem_gb"], "wants NAME=VALUE; got 'mem_gb'"),
        (
            ["fixed_memory", "--only", "fox", "lego"],
            "no experiment 'lego'; if it is a scene, repeat the option: --only lego",
        ),
    ],
)
def test_misspelt_names_are_one_line_and_exit_code_2(arguments, words, capsys, tmp_path):
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--out", str(tmp_path), "--work", str(tmp_path)])
    printed = capsys.readouterr().err
    assert ended.value.code == 2 and words in printed and printed.count("\n") == 1


@pytest.mark.parametrize(
    "options, words",
    [
        ("options.rates.means = -1.0", "mine.toml: 'bytewise': rates.means must be at least 0; got -1.0"),
        ("options.rates = 3", "mine.toml: 'bytewise' options.rates must hold the fields of"),
    ],
)
def test_a_plan_refuses_options_that_training_refuses(tmp_path, options, words, capsys):
    text = OWN_GRID.replace('system = "bytewise"', f'system = "bytewise", {options}')
    with pytest.raises(SystemExit) as ended:
        main([own_grid(tmp_path, text), "--plan", "--work", str(tmp_path), "--out", str(tmp_path)])
    assert ended.value.code == 2 and words in capsys.readouterr().err


def test_names_may_follow_options_that_can_be_repeated():
    args = parse_arguments(experiments(), ["--only", "fox", "fixed_memory", "--only", "lego", "claims"])
    assert (args.only, args.names) == (["fox", "lego"], ["fixed_memory", "claims"])


@pytest.mark.parametrize(
    "text, words", [("[1]", "records.json must hold an object"), ('{"a": [1]}', "records.json: 'a' must be an object")]
)
def test_damaged_records_are_reported(tmp_path, text, words, capsys):
    (tmp_path / "records.json").write_text(text)
    with pytest.raises(SystemExit) as ended:
        main(["fixed_memory", "--scale", "smoke", "--plan", "--work", str(tmp_path), "--out", str(tmp_path)])
    assert ended.value.code == 2 and words in capsys.readouterr().err


def test_a_block_sets_budgets_in_place_of_gaussians(tmp_path):
    text = OWN_GRID.replace("budgets = [0.3]", "gaussians = [900]\nblocks = [{ budgets = [0.3] }, { seeds = [1] }]")
    cells = read_grid(own_grid(tmp_path, text), "small").cells
    assert [(cell.gaussians, cell.budget, cell.seed) for cell in cells] == [(0, 0.3, 0), (900, None, 1)]


def test_a_grid_file_may_not_take_the_tables_of_an_experiment(tmp_path, capsys):
    path = tmp_path / "fixed_memory.toml"
    path.write_text(OWN_GRID, encoding="utf-8")
    with pytest.raises(SystemExit):
        main([str(path)])
    assert "rename the file" in capsys.readouterr().err


def test_experiments_and_grid_files_are_not_mixed_in_one_folder(tmp_path, capsys):
    given = ["fixed_memory", own_grid(tmp_path), "--tables-only", "--work", str(tmp_path / "work")]
    with pytest.raises(SystemExit) as ended:
        main(given)
    assert ended.value.code == 2 and "call them one after another" in capsys.readouterr().err
    assert len(chosen(experiments(), parse_arguments(experiments(), [*given, "--out", str(tmp_path)]))) == 2


def test_smoke_and_grid_files_leave_the_committed_results_alone(tmp_path):
    args = parse_arguments(experiments(), [own_grid(tmp_path), "--work", str(tmp_path)])
    assert Lab(args).out == EXPERIMENTS.parent / "runs" / "results" / "small"
    args = parse_arguments(experiments(), ["fixed_memory", "--scale", "smoke", "--work", str(tmp_path)])
    assert Lab(args).out == EXPERIMENTS.parent / "runs" / "results" / "smoke"


def test_a_scale_may_have_fewer_methods():
    small, smoke = (read_grid("fixed_number", scale) for scale in ("small", "smoke"))
    assert len(small.methods) == 10 and [one.label for one in smoke.methods] == [
        small.methods[4].label,
        small.methods[9].label,
    ]


def test_the_grid_of_the_documentation_can_be_read(tmp_path):
    page = (EXPERIMENTS.parent / "docs" / "sweeps.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    grid = read_grid(own_grid(tmp_path, text), "small")
    assert (len(grid.cells), grid.table, grid.cells[0].scene.path) == (1, "choices", "synthetic")
    rates = [run.job.system.texel_rate for run in grid.runs({})]
    assert rates == [a2tg.A2tg.preset("quick").texel_rate, 2.5e-3, 5e-3]


def test_the_smoke_scale_has_few_runs():
    """It takes minutes on two cores, where each run is mostly compilation."""
    jobs: set[str] = set()
    for name in NAMES:
        for job in read_grid(name, "smoke").jobs({}):
            jobs |= {job.key, *([job.start.key] if job.start else [])}
    assert len(jobs) <= 36


def test_placed_methods_have_the_weight_and_the_new_gaussians_of_bytewise():
    """In the first stage, up to the number that fills the bytes, and while others are pruned or grow."""
    grid = read_grid("choose_plain", "claims", scenes=["fox"], validation=True)
    runs = [run for run in grid.runs({}) if run.cell == grid.cells[0]]
    placed = [run.job.system for run in runs if run.label.endswith(", placed")]
    assert len(placed) == 2 and len(runs) == 4
    for system in placed:
        first, last = system.stages()
        place = first.events[-1]
        assert isinstance(place, a2tg.PlaceByError) and place.times(first.iterations)
        assert place.cap == int(0.3e6) // (4 * 13)
        weights = [
            [term.weight for term in stage.losses if getattr(term, "name", "") == "opacity"] for stage in (first, last)
        ]
        assert weights == [[0.01], []]


def test_a_fingerprint_is_of_what_decides_the_result():
    quick = a2tg.A2tg.preset("quick")
    other = dataclasses.replace(quick, texture=dataclasses.replace(quick.texture, fraction=0.5))
    assert fingerprint(quick, 0) == fingerprint(other, 0), "textures come later"
    assert fingerprint(quick, 1) != fingerprint(other, 1)
    plain = a2tg.find_system("gaussians-2d-mcmc").preset("quick", stage1_iterations=quick.stage1_iterations)
    assert fingerprint(dataclasses.replace(quick, kernel_rate=None), 0) == fingerprint(plain, 0)
    assert fingerprint(quick, 0) != fingerprint(dataclasses.replace(quick, seed=1), 0)
    # Records from before the extent keep their keys; another extent has another.
    usual = a2tg.A2tg()
    narrow = dataclasses.replace(usual, lookup=a2tg.TextureOptions(extent=1.5))
    assert "extent" not in fingerprint(usual, 1) and fingerprint(usual, 1) != fingerprint(narrow, 1)


KEYS = """
import sys
sys.path.insert(0, {folder!r})
from lab.grid import read_grid
print(*[job.key for name in {names} for job in read_grid(name, "small").jobs({{}})])
"""


@pytest.mark.long
def test_keys_are_the_same_in_every_process():
    """And so are fingerprints, of which they are made."""
    names = [name for name in NAMES if has_scale(name, "small")]
    script = KEYS.format(folder=str(EXPERIMENTS), names=names)
    printed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert printed == [job.key for name in names for job in read_grid(name, "small").jobs({})]


def test_functions_without_a_name_have_no_fingerprint():
    class Nameless(a2tg.A2tg):
        def stages(self):
            first, second = super().stages()
            return dataclasses.replace(first, losses=(Term(lambda *_: 0.0),)), second

    with pytest.raises(ValueError, match="make it a function of a module"):
        fingerprint(Nameless(), 0)


def test_bytes_for_each_pixel_are_a_budget_or_a_number_of_gaussians():
    grid = read_grid("degree_0", "protocol160", scenes=["fox"])
    (job,) = (job for job in grid.jobs({}) if job.system.seed == 1)
    assert grid.cells[0].budget == pytest.approx(60 * 90 * 160 / 1e6)
    assert job.system.memory_budget is None and job.system.densify.cap == int(0.864e6) // (4 * 25)
    mb = 0.71
    plain = [run for run in grid.runs({job.key: record(mb=mb)}) if run.equal == "bytes"]
    assert [run.job.system.memory_budget for run in plain] == [mb, mb]


def test_a_method_of_equal_time_has_the_iterations_that_fill_the_time_of_the_reference():
    grid = read_grid("claims", "smoke")
    reference, plain, _ = grid.jobs({})
    found = {job.key: record(training_seconds=seconds) for job, seconds in ((reference, 12.0), (plain, 4.0))}
    found |= {job.start.key: record(training_seconds=seconds) for job, seconds in ((reference, 6.0), (plain, 2.0))}
    (run,) = (run for run in grid.runs(found) if run.equal)
    assert run.label == "2DGS*-MCMC, degree 0, placed, equal time" and run.job.all_iterations == (90, 60)


@pytest.mark.parametrize(("num", "kept", "scored"), [(25, 20, 5), (67, 21, 12)])
def test_few_views_are_folds_of_small_captures_and_parts_of_others(num, kept, scored):
    scene = a2tg.synthetic_scene(num_views=num, width=8, height=8, num_points=20)
    folds = [few_views(scene, fold) for fold in range(5)]
    assert {(len(fold.train), len(fold.test)) for fold in folds} == {(kept, scored)}
    for fold in folds:
        assert not {view.name for view in fold.train} & {view.name for view in fold.test}
    if num < 30:
        assert len({view.name for fold in folds for view in fold.test}) == num


def test_training_time_leaves_compilation_out():
    """A function that is compiled within the block, and one that is not."""

    @jax.jit
    def slow_to_compile(values):
        for _ in range(400):
            values = jnp.sin(values) * 1.01
        return values

    values = jnp.zeros(8)
    start = time.process_time()
    with TrainingTime(earlier=100.0) as training:
        slow_to_compile(values).block_until_ready()
        whole = time.process_time() - start
        begun = time.process_time()
        while time.process_time() - begun < 0.3:
            pass
    assert 0.3 <= training.seconds - 100.0 < 0.3 + 0.5 * whole


def test_a_random_start_is_grey_points_in_the_cube_of_an_object(tmp_path):
    """As the library made them until November 2026; another key tells the runs apart."""
    write_blender(tmp_path)
    found = from_random_points(a2tg.load_scene(tmp_path))
    original = found.transform.inverse().apply(found.points)
    assert original.shape == (10_000, 3)
    np.testing.assert_allclose(np.ptp(original, axis=0), np.ptp(original[:, 0]), rtol=2e-3)
    np.testing.assert_allclose(found.colors, 128 / 255, atol=1e-6)
    job = Job("lego", 2, a2tg.Gaussians2d(), 0)
    random = dataclasses.replace(job, random_start=True)
    assert random.key != job.key != dataclasses.replace(job, fold=1).key


def test_a_plan_needs_no_photographs(tmp_path, capsys):
    """The scenes of the paper are 20 GB."""
    places = ["--scenes", str(tmp_path / "nowhere"), "--work", str(tmp_path), "--out", str(tmp_path)]
    main(["ablation", "--scale", "full", "--plan", *places])
    printed = capsys.readouterr().out
    assert "Mip-NeRF 360/garden" in printed and "since not all scenes are below --scenes" in printed
