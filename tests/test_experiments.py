"""The experiments: grids name the runs that they should, a queue trains each once, tables say what is so."""

import concurrent.futures
import csv
import dataclasses
import itertools
import json
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import time

import efficiency
import equal_bytes
import numpy as np
import polish
import pytest
import shrink
import summary
import upscale_gains
from lab import pages, queue, spreadsheet, tables, versions
from lab.cli import EXPERIMENTS, Lab, argument_parser
from lab.figures import figures_table
from lab.grid import GRIDS, Cell, Grid, Method, Run, has_scale, read_grid, splats_in
from lab.interrupts import interruptible
from lab.jobs import Folders, Job, _load_checkpoint, model_bytes
from lab.plan import Machine, duration, finished_pace, plan_of
from lab.progress import Progress
from lab.scenes import SceneAt, own_scene
from lab.stages import stages_of
from run import chosen, experiments, main, parse_arguments

import a2tg_jax as a2tg
from a2tg_jax.io.config_json import flatten_config
from a2tg_jax.results.plan import fingerprint
from a2tg_jax.training import fit_stage
from a2tg_jax.training.terms import Term

NAMES = sorted(path.stem for path in GRIDS.glob("*.toml") if path.stem not in ("methods", "scales"))
SCALES = ("full", "small", "smoke")
LONG = sorted(name for name in NAMES if has_scale(name, "long"))
"""Grids of the paper's length on small photographs."""


def record(psnr=25.0, mb=1.0, num=1_000, **others):
    figures = {"ssim": 0.8, "lpips": 0.2, "pixels": [20, 10], "stage": "gaussians", "downscale": 2, "ms_per_step": 10.0}
    figures["train_psnr"] = psnr + 1
    return {"psnr": psnr, "mb": mb, "num": num, **figures, **others}


# Grids


@pytest.mark.parametrize(("name", "scale"), [*itertools.product(NAMES, SCALES), *((name, "long") for name in LONG)])
def test_every_grid_names_runs_that_can_be_trained(name, scale):
    grid = read_grid(name, scale)
    first = {job.key: job for job in grid.jobs({})}
    assert grid.cells and first
    for job in first.values():
        job.system.check()
    finished = {key: record(mb=job.system.densify.cap * 290e-6) for key, job in first.items()}
    runs = list(grid.runs(finished))
    places = [(run.cell, run.method.label, run.is_at_equal_bytes) for run in runs]
    methods = dict.fromkeys((grid.reference, *grid.methods))
    at_equal_number = sum((method.most or 10**9) >= cell.gaussians for cell in grid.cells for method in methods)
    assert len(set(places)) == len(places) == at_equal_number + len(grid.cells) * len(grid.at_equal_bytes)


def test_choices_are_made_on_validation_views(tmp_path):
    """No run for choosing holds test views, nor is it taken for a run that does, and its pages say so."""
    final = next(read_grid("claim", "smoke").jobs({}))
    choosing = next(read_grid("claim", "smoke", validation=True).jobs({}))
    assert choosing == dataclasses.replace(final, validation=True) and choosing.key != final.key
    assert choosing.start is None or choosing.start.validation
    folders = Folders(tmp_path, tmp_path)
    whole, scene = folders.load_scene(final), folders.load_scene(choosing)
    assert [view.name for view in scene.test] == [view.name for view in whole.train[::8]]
    assert {view.name for view in (*scene.train, *scene.test)} == {view.name for view in whole.train}
    lab = Lab(argument_parser("").parse_args(["--scale", "smoke", "--validation", "--out", str(tmp_path)]))
    assert lab.grid("claim").validation
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


@pytest.mark.parametrize("mb", [0.9, 1.504544, 20.0])
@pytest.mark.parametrize("floats", [58, 85, 122, 1081])
def test_equal_bytes_are_no_more_and_less_by_a_splat_at_most(mb, floats):
    num = splats_in(mb, Method("any", "any", floats=floats))
    assert num * floats * 4 <= mb * 1e6 + 0.5 < (num + 1) * floats * 4 + 1


def test_a_method_whose_gaussians_differ_in_size_fills_the_bytes_of_the_reference_as_its_budget():
    grid = read_grid("fixed_memory", "long", scenes=["fox"])
    finished = {grid.reference_job(grid.cells[0]).key: record(mb=0.7123)}
    (run,) = (run for run in grid.runs(finished) if run.method.label == "Bytewise, Gaussian kernels")
    assert run.is_at_equal_bytes and run.job.system.memory_budget == 0.7123
    assert run.cell.budget is None, "it stays in the cell of the others"


def test_a_rehearsal_runs_every_method_once_and_keeps_to_itself():
    whole, short = read_grid("fixed_memory", "full"), read_grid("fixed_memory", "full", rehearsal=True)
    (cell,) = short.cells
    assert cell == dataclasses.replace(whole.cells[0], iterations=(300, 300))
    assert short.methods == whole.methods and short.at_equal_bytes == whole.at_equal_bytes
    lab = Lab(argument_parser("").parse_args(["--scale", "full", "--rehearsal", "--tables-only"]))
    assert lab.out.parts[-3:] == ("runs", "results", "full-rehearsal") and len(lab.grid("claim").cells) == 1


def test_all_experiments_of_a_scale_are_those_whose_grids_have_it():
    known = experiments()
    names = {found.name for found in chosen(known, parse_arguments(known, ["all", "--scale", "long"]))}
    assert {"fixed_memory", "ablation"} <= names < set(known)
    assert len(chosen(known, parse_arguments(known, ["all"]))) == len(known)


def test_scenes_are_chosen_and_held_out():
    labels = lambda **wanted: {cell.scene.label for cell in read_grid("claim", "small", **wanted).cells}  # noqa: E731
    assert labels() == {"fox", "herz_jesus_p25", "lego", "snowmiku"}
    assert labels(held_out=False) == labels() - {"snowmiku"}
    assert labels(scenes=["lego"]) == {"lego"}
    assert labels(scenes=["built-in"]) == {"built-in"}, "what is asked for comes before what a grid has"
    assert "snowmiku" not in {cell.scene.label for cell in read_grid("defaults", "small").cells}
    with pytest.raises(ValueError, match="no scene 'dog' at this scale; there are"):
        labels(scenes=["dog"])


def test_scenes_of_ones_own_take_the_place_of_the_scales(tmp_path):
    (tmp_path / "garden").mkdir()
    own = own_scene(tmp_path / "garden", 4)
    grid = read_grid("claim", "small", own=(own,))
    assert {cell.scene for cell in grid.cells} == {SceneAt("garden", (tmp_path / "garden").as_posix(), 4)}
    assert Folders(pathlib.Path("scenes"), tmp_path).scenes / own.path == tmp_path / "garden"
    lab = Lab(argument_parser("").parse_args(["--scene", str(tmp_path / "garden"), "--out", str(tmp_path / "out")]))
    assert lab.is_partial and {cell.scene.label for cell in lab.grid("claim").cells} == {"garden"}
    with pytest.raises(ValueError, match="no scene folder"):
        own_scene(tmp_path / "nowhere", 1)
    with pytest.raises(ValueError, match="at least 1"):
        own_scene(tmp_path / "garden", 0)


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


@pytest.mark.parametrize(
    "before, after, words",
    [
        ("gains", "gain", "table must be one of quality, gains, choices"),
        ("2DGS*-MCMC", "2DGS-MCMC", r"no method '2DGS-MCMC'; did you mean 2DGS\*-MCMC"),
        ("budgets", "budget", "needs gaussians or budgets"),
        ("path =", "folder =", "'folder', which is none of path"),
        ("downscale = 4", "downscale = 0.5", "must be at least 1; got 0.5"),
        ("[small]", "[full]", r"no table of --scale small, \[small\]; it has \[full\]"),
        ("title = ", "titel = ", "no entry 'title'"),
        ("system = ", "sytem = ", "'sytem', which is none of like, system"),
        ('system = "bytewise"', 'like = "A2TG"', "like 'A2TG', which is no method"),
        ("budgets = [0.3]", "budgets = [0.3", "mine.toml: Unclosed array"),
    ],
)
def test_mistakes_in_a_grid_file_are_told(tmp_path, before, after, words):
    text = OWN_GRID.replace(before, after)
    if before == "[small]":
        text = text.replace("[small.scenes]", "[full.scenes]")
    with pytest.raises(ValueError, match=words):
        read_grid(own_grid(tmp_path, text), "small")


def test_tables_of_a_budget_show_the_gaussians_of_the_runs():
    cell = dataclasses.replace(CELL, gaussians=0, budget=0.3)
    runs = [result("own", 21.0), result("other", 20.0)]
    runs = [tables.Result(dataclasses.replace(one.run, cell=cell), one.record) for one in runs]
    assert "1,000 (5.00 a pixel)" in tables.gains_table(runs, "own", ["other"])
    assert "| other | 1,000 | 1.00 | 20.00 / .800 / .200 | 21.00 | 1 |" in figures_table(runs)
    larger = dataclasses.replace(cell, budget=0.6)
    richer = [tables.Result(dataclasses.replace(one.run, cell=larger), one.record) for one in runs]
    assert "fox, 0.3 MB: dB · LPIPS | fox, 0.6 MB" in tables.choices_table([*runs, *richer], "own")


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["clam"], "no experiment 'clam'; did you mean claim?"),
        (["claim", "--scale", "smal"], "no --scale smal; did you mean small?"),
        (["claim", "--only", "legoo"], "no scene 'legoo' at this scale; did you mean lego?"),
        (["nowhere/mine.toml"], "no grid file nowhere/mine.toml"),
        (["claim", "--plan", "--scenes", "nowhere"], "no folder --scenes nowhere"),
    ],
)
def test_misspelt_names_are_one_line_and_exit_code_2(arguments, words, capsys, tmp_path):
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--out", str(tmp_path), "--work", str(tmp_path)])
    told = capsys.readouterr().err
    assert ended.value.code == 2 and words in told and told.count("\n") == 1


def test_a_grid_file_may_not_take_the_tables_of_an_experiment(tmp_path, capsys):
    path = tmp_path / "claim.toml"
    path.write_text(OWN_GRID, encoding="utf-8")
    with pytest.raises(SystemExit):
        main([str(path)])
    assert "rename the file" in capsys.readouterr().err


def test_experiments_and_grid_files_are_not_mixed_in_one_folder(tmp_path, capsys):
    given = ["claim", own_grid(tmp_path), "--tables-only", "--work", str(tmp_path / "work")]
    with pytest.raises(SystemExit) as ended:
        main(given)
    assert ended.value.code == 2 and "call them one after another" in capsys.readouterr().err
    assert len(chosen(experiments(), parse_arguments(experiments(), [*given, "--out", str(tmp_path)]))) == 2


def test_smoke_and_grid_files_leave_the_committed_results_alone(tmp_path):
    args = parse_arguments(experiments(), [own_grid(tmp_path), "--work", str(tmp_path)])
    assert Lab(args).out == EXPERIMENTS.parent / "runs" / "results" / "small"
    args = parse_arguments(experiments(), ["claim", "--scale", "smoke", "--work", str(tmp_path)])
    assert Lab(args).out == EXPERIMENTS.parent / "runs" / "results" / "smoke"


def test_a_scale_may_have_fewer_methods():
    small, smoke = (read_grid("defaults", scale) for scale in ("small", "smoke"))
    assert len(small.methods) > 10 and [method.label for method in smoke.methods] == small_ends(small.methods)


def small_ends(methods):
    """The first and the last label."""
    return [methods[0].label, methods[-1].label]


def test_the_grid_of_the_documentation_can_be_read(tmp_path):
    page = (EXPERIMENTS.parent / "docs" / "sweeps.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    grid = read_grid(own_grid(tmp_path, text), "small")
    assert (len(grid.cells), grid.table, grid.cells[0].scene.path) == (1, "choices", "synthetic")
    rates = [run.job.system.texture.rate for run in grid.runs({})]
    assert rates == [a2tg.A2tg.preset("quick").texture.rate, 2.5e-3, 5e-3]


def test_the_smoke_scale_has_few_runs():
    """It takes minutes on two cores, where each run is mostly compilation."""
    jobs: set[str] = set()
    for name in NAMES:
        for job in read_grid(name, "smoke").jobs({}):
            jobs |= {job.key, *([job.start.key] if job.start else [])}
    assert len(jobs) <= 24


def test_a_fingerprint_is_of_what_decides_the_result():
    quick = a2tg.A2tg.preset("quick")
    other = dataclasses.replace(quick, texture=dataclasses.replace(quick.texture, fraction=0.5))
    assert fingerprint(quick, 0) == fingerprint(other, 0), "textures come later"
    assert fingerprint(quick, 1) != fingerprint(other, 1)
    assert fingerprint(quick, 0) == fingerprint(a2tg.find_system("gaussians-2d-mcmc").preset("quick"), 0)
    assert fingerprint(quick, 0) != fingerprint(dataclasses.replace(quick, seed=1), 0)
    code = (
        "import a2tg_jax as a; from a2tg_jax.results.plan import fingerprint as f; print(f(a.A2tg.preset('quick'), 1))"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert told.strip() == fingerprint(quick, 1), "another process says the same"


KEYS = """
import sys
sys.path.insert(0, {folder!r})
from lab.grid import read_grid
print(*[job.key for name in {names} for job in read_grid(name, "small").jobs({{}})])
"""


def test_keys_are_the_same_in_every_process():
    script = KEYS.format(folder=str(EXPERIMENTS), names=NAMES)
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert told == [job.key for name in NAMES for job in read_grid(name, "small").jobs({})]


def test_functions_without_a_name_have_no_fingerprint():
    class Nameless(a2tg.A2tg):
        def stages(self):
            first, second = super().stages()
            return dataclasses.replace(first, losses=(Term(lambda *_: 0.0),)), second

    with pytest.raises(ValueError, match="make it a function of a module"):
        fingerprint(Nameless(), 0)


def test_a_stage_stopped_under_one_system_goes_on_under_another(tmp_path):
    scene = a2tg.synthetic_scene(num_views=3, width=24, height=16, num_points=30)
    plain, textured = (a2tg.find_system(name).preset("smoke") for name in ("gaussians-2d-mcmc", "textured-gaussians"))
    plain, textured = (dataclasses.replace(system, stage1_iterations=4) for system in (plain, textured))
    path = tmp_path / "checkpoint.npz"
    stopped = lambda checkpoint: checkpoint.iteration == 2 and a2tg.save_checkpoint(path, checkpoint)  # noqa: E731
    fit_stage(scene, plain, 0, on_checkpoint=stopped, checkpoint_every=2, progress=False)
    resumed = _load_checkpoint(path, Job("synthetic", 1, textured, 0))
    assert fit_stage(scene, textured, 0, resume=resumed, progress=False).model.num > 0
    with pytest.raises(ValueError, match="made with other numbers"):
        _load_checkpoint(path, Job("synthetic", 1, dataclasses.replace(textured, seed=5), 0))


# The queue


@dataclasses.dataclass(frozen=True)
class FakeJob:
    """Needs of a job, as the queue sees them."""

    key: str
    start: "FakeJob | None" = None


class FakePool:
    """Runs jobs at once, or fails them; writes down in which order."""

    def __init__(self, folders, slots=2, memory=np.inf, outcomes=None):
        self.slots, self.memory, self.folders = slots, memory, folders
        self.outcomes, self.order, self.most = outcomes or {}, [], 0
        self.running, self.failures, self.record = [], [], record()

    def is_death(self, error):
        return isinstance(error, concurrent.futures.BrokenExecutor)

    def submit(self, job, folders):
        self.order.append(job.key)
        handle = concurrent.futures.Future()
        self.running = [other for other in self.running if not other.collected] + [handle]
        self.most = max(self.most, len(self.running))
        handle.collected = False
        result = handle.result

        def collect():
            handle.collected = True
            return result()

        handle.result = collect
        outcome = self.outcomes.get(job.key, [])
        error = outcome.pop(0) if outcome else None
        if error is not None:
            handle.set_exception(error)
        else:
            path = folders.model(job)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
            handle.set_result(self.record)
        return handle


@pytest.fixture
def folders(tmp_path, monkeypatch):
    monkeypatch.setattr(queue, "estimated_bytes", lambda job: 1.0)
    return Folders(tmp_path, tmp_path)


FIRST = FakeJob("first")
CHAIN = [FakeJob("second", FIRST), FakeJob("other", FIRST), FakeJob("alone")]


def run_queue(pool, folders, records, jobs=CHAIN):
    return queue.run_all(
        lambda records: iter(jobs), folders, pool, records, lambda job, record: None, pool.failures.append
    )


def test_each_job_runs_once_and_after_its_start(folders):
    pool, records = FakePool(folders), {}
    assert run_queue(pool, folders, records) == []
    assert sorted(pool.order) == ["alone", "first", "other", "second"] and pool.order.index("first") < 2
    assert set(records) == set(pool.order)
    again = FakePool(folders)
    assert run_queue(again, folders, records) == [] and again.order == [], "a finished run is never run again"


def test_a_start_whose_model_is_gone_is_made_again_where_it_is_needed(folders):
    pool = FakePool(folders)
    run_queue(pool, folders, {"first": record(), "second": record()})
    assert sorted(pool.order) == ["alone", "first", "other"]


def test_what_fails_is_told_and_takes_down_only_what_needs_it(folders):
    pool, records = FakePool(folders, outcomes={"first": [ValueError("no such scene")]}), {}
    (failure,) = run_queue(pool, folders, records)
    assert failure.job.key == "first" and "no such scene" in failure.reason and set(records) == {"alone"}
    assert pool.failures == [failure], "told at once"


def test_what_was_measured_without_lpips_is_measured_again_where_it_is_wanted(folders):
    finished = {job.key: record(lpips_network=None) for job in [*CHAIN, FIRST]}
    wanted = dataclasses.replace(folders, lpips_network="alex")
    assert run_queue(FakePool(folders), folders, dict(finished)) == []
    pool = FakePool(wanted)
    pool.record = record(lpips_network="alex")
    run_queue(pool, wanted, {**finished, "alone": pool.record})
    assert {"second", "other"} <= set(pool.order) and "alone" not in pool.order


def test_a_process_that_dies_is_tried_once_more(folders):
    died = concurrent.futures.BrokenExecutor("killed")
    pool, records = FakePool(folders, outcomes={"alone": [died]}), {}
    assert run_queue(pool, folders, records) == [] and pool.order.count("alone") == 2 and "alone" in records
    (failure,) = run_queue(FakePool(folders, outcomes={"alone": [died, died]}), folders, {}, [FakeJob("alone")])
    assert "died twice" in failure.reason


def test_a_neighbour_of_one_that_dies_is_not_blamed(folders):
    """Two that ran together are tried alone."""
    died = concurrent.futures.BrokenExecutor("killed")
    jobs = [FakeJob("guilty"), FakeJob("innocent"), FakeJob("third")]
    pool = FakePool(folders, outcomes={"guilty": [died, died], "innocent": [died]})
    records = {}
    (failure,) = run_queue(pool, folders, records, jobs)
    assert failure.job.key == "guilty" and set(records) == {"innocent", "third"}


def test_a_job_that_leaves_no_model_has_failed(folders):
    pool = FakePool(folders)
    lost = FakeJob("lost")
    submit = pool.submit

    def forget(job, folders):
        handle = submit(job, folders)
        folders.model(job).unlink()
        return handle

    pool.submit = forget
    (failure,) = run_queue(pool, folders, {}, [lost])
    assert "left no model" in failure.reason


@pytest.mark.parametrize("memory, most", [(np.inf, 2), (1.5, 1), (0.1, 1)])
def test_jobs_run_beside_each_other_within_slots_and_memory(folders, memory, most):
    pool = FakePool(folders, memory=memory)
    run_queue(pool, folders, {}, [FakeJob(str(index)) for index in range(5)])
    assert pool.most == most


def test_what_is_wanted_is_asked_again_after_every_job(folders):
    def ask(records):
        yield FIRST
        if "first" in records:
            yield FakeJob("follows")

    pool, records = FakePool(folders), {}
    queue.run_all(ask, folders, pool, records, lambda job, record: None, pool.failures.append)
    assert pool.order == ["first", "follows"]


def test_an_estimate_of_memory_grows_with_splats_and_what_they_show():
    job = next(read_grid("claim", "full").jobs({}))
    small = dataclasses.replace(job, system=next(read_grid("claim", "smoke").jobs({})).system)
    assert queue.BASE_BYTES < queue.estimated_bytes(small) < queue.estimated_bytes(job)
    plain, billboards = (a2tg.find_system(name).preset("quick") for name in ("gaussians-2d-mcmc", "bbsplat"))
    assert model_bytes(plain) == plain.densify.cap * 58 * 4
    assert model_bytes(billboards) >= billboards.densify.cap * 1081 * 4, "pictures of 16×16 RGBA texels"


# End to end


def call(name, *arguments, **options):
    command = [sys.executable, str(EXPERIMENTS / "run.py"), name, "--scale", "smoke", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **options)


def _processes():
    """(state, parent) of every process, by number."""
    found = {}
    for path in pathlib.Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent = path.read_text().rpartition(")")[2].split()[:2]
        except (FileNotFoundError, ProcessLookupError):
            continue
        found[int(path.parent.name)] = state, int(parent)
    return found


def _is_alive(pid):
    """Whether a process still runs; one that nobody has waited for does not."""
    return _processes().get(pid, ("Z", 0))[0] != "Z"


@pytest.mark.skipif(not pathlib.Path("/proc/self/stat").is_file(), reason="needs /proc to see processes")
def test_an_experiment_is_killed_goes_on_and_is_not_run_again(tmp_path):
    """The claim on the built-in scene, at a tiny scale."""
    out, work = tmp_path / "out", tmp_path / "work"
    process = call("claim", "--out", out, "--work", work, "--jobs", 2)
    deadline = time.monotonic() + 300
    while not (out / "records.json").is_file() and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.1)
    workers = [pid for pid, (_, parent) in _processes().items() if parent == process.pid]
    process.kill()
    process.communicate()
    while any(map(_is_alive, workers)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert len(workers) >= 2 and not any(map(_is_alive, workers)), "nobody goes on alone"
    before = json.loads((out / "records.json").read_text())
    assert 1 <= len(before) < 8
    done = call("claim", "--out", out, "--work", work, "--jobs", 2)
    told, _ = done.communicate(timeout=600)
    assert done.returncode == 0, told
    after = json.loads((out / "records.json").read_text())
    assert len(after) == 8 and {key: after[key] for key in before} == before
    assert not list((work / "checkpoints").glob("*.npz")), "what is finished needs none"
    own = [row for row in after.values() if row["stage"] == "textures" and row["system"] == "a2tg"]
    (own,) = [row for row in own if "single_rate" not in row["options"]["texture"]]
    last = [row for row in after.values() if row["stage"] != "gaussians" and row["num"] != 400]
    assert len(last) == 2 and all(0.99 * own["mb"] < row["mb"] <= own["mb"] for row in last)
    assert "against 2DGS*-MCMC, equal bytes" in (out / "claim.md").read_text()
    again = call("claim", "--out", out, "--work", work)
    told, _ = again.communicate(timeout=120)
    assert again.returncode == 0 and ".npz" not in told and " dB;" not in told


def test_submitit_sends_jobs_out(tmp_path):
    """By its executor for processes of this machine."""
    pytest.importorskip("submitit")
    out, work = tmp_path / "out", tmp_path / "work"
    process = call(
        "efficiency", "--out", out, "--work", work, "--cluster", "local", "--cluster-parameter", "timeout_min=10"
    )
    told, _ = process.communicate(timeout=600)
    assert process.returncode == 0, told
    assert len(json.loads((out / "records.json").read_text())) == 2
    assert list((work / "submitit").iterdir())


def test_a_preempted_job_is_queued_again(tmp_path):
    submitit = pytest.importorskip("submitit")
    job, folders = Job("synthetic", 2, a2tg.A2tg(), 0), Folders(tmp_path, tmp_path)
    again = submitit.core.utils.DelayedSubmission(queue.Elsewhere(), job, folders)._checkpoint_function()
    again.dump(tmp_path / "again.pickle")
    read = submitit.core.utils.DelayedSubmission.load(tmp_path / "again.pickle")
    assert isinstance(read.function, queue.Elsewhere) and read.args == (job, folders)


def test_errors_of_jobs_are_one_line():
    trace = "Job (task=0) failed with trace:\n----\nTraceback (most recent call last):\nValueError: no scene\n----"
    assert queue.told_error(RuntimeError(trace)) == "ValueError: no scene"
    assert queue.told_error(ValueError("one\nand two")) == "ValueError: one and two"


@pytest.mark.parametrize(
    "arguments, words",
    [(["--only", "dog"], "no scene 'dog'"), (["--scale", "small", "--scenes", "nowhere"], "nowhere")],
)
def test_what_cannot_be_run_is_an_error_that_says_what(arguments, words, tmp_path):
    command = [sys.executable, str(EXPERIMENTS / "run.py"), "efficiency", "--out", str(tmp_path)]
    done = subprocess.run(
        [*command, "--work", str(tmp_path / "w"), *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2 and words in done.stderr and "Traceback" not in done.stderr


# Tables


CELL = Cell(SceneAt("fox", "fox", 2), 100, 0, (10, 10))
GRID = Grid("x", "X", "small", "quick", (CELL,), Method("own", "a2tg"), (), ())


def result(label, psnr, seed=0, equal=False, **others):
    job = Job("fox", 2, a2tg.A2tg(), 0)
    run = Run(Method(label, "a2tg"), dataclasses.replace(CELL, seed=seed), equal, job)
    return tables.Result(run, record(psnr, **others))


def test_gains_have_the_verdict_that_seeds_allow():
    gains = [(25.3, 25.0), (25.5, 25.1)]
    results = [result("own", a, seed) for seed, (a, _) in enumerate(gains)]
    results += [result("other", b, seed, equal=True) for seed, (_, b) in enumerate(gains)]
    others = ["other" + tables.EQUAL_BYTES]
    assert tables.seed_spread(results, "own", others) == pytest.approx(0.1)
    text = tables.gains_table(results, "own", others)
    assert "+0.35 (above)" in text and "0.50 a pixel" in text and "differ by 0.10 dB" in text
    assert tables.verdict([0.05, -0.01], 0.1) == "undecided"
    assert tables.verdict([-0.3], 0.1) == "below"


def test_the_best_plain_method_is_that_of_each_cell_which_has_all():
    first, second = summary.PLAIN_METHODS
    results = [result(first, 20.0), result(second, 21.0), result(first, 24.0, 1), result(second, 23.0, 1)]
    results += [result(first, 30.0, 2), result(summary.BYTEWISE, 22.0), result(summary.BYTEWISE, 26.0, 1)]
    best = summary.best_plain(results)
    assert [(one.run.cell.seed, one["psnr"]) for one in best] == [(0, 21), (1, 24)]
    assert {one.label for one in best} == {summary.BEST}
    told = summary.bytes_table([dataclasses.replace(one, run=with_budget(one.run, 0.3)) for one in results])
    assert "Bytewise less the best plain method: fox | +1.50" in told
    assert "less MCMC of degree 0: mean** | +2.00" in told


def with_budget(run: Run, megabytes: float) -> Run:
    return dataclasses.replace(run, cell=dataclasses.replace(run.cell, budget=megabytes))


def test_quality_is_averaged_over_seeds_and_what_is_missing_is_a_dash():
    text = tables.quality_tables(GRID, [result("own", 20.0), result("own", 22.0, 1), result("other", 30.0, lpips=None)])
    assert "| own | 30,000 | 1,000 | 21.00 / .800 / .200 · 1.00 (+331 %) | 21.00 / .800 / .200 · 1.00 |" in text
    assert "30.00 / .800 / – · 1.00 (+331 %) |" in text


def at(scene, label, psnr, seed=0, **others):
    found = result(label, psnr, seed, **others)
    cell = dataclasses.replace(found.run.cell, scene=SceneAt(scene, scene, 2))
    return tables.Result(dataclasses.replace(found.run, cell=cell), found.record)


def test_a_mean_counts_each_scene_once_however_many_seeds_it_has():
    results = [at("a", "own", 20.0), at("a", "own", 22.0, 1), at("b", "own", 31.0)]
    results += [at("a", "other", 19.0), at("a", "other", 20.0, 1), at("b", "other", 31.0)]
    assert tables.mean(results[:3], "psnr") == 26.0
    assert tables.gains_by_scene(results, "own", "other", "psnr") == {"a": 1.5, "b": 0.0}


def test_an_interval_over_scenes_is_that_of_students_t():
    """The half-width of four values is 3.182 standard errors, as tables of t say."""
    found = tables.over_scenes([1.0, 2.0, 3.0, 6.0])
    error = np.sqrt(14 / 3 / 4)
    assert found.mean == 3.0 and found.half_width == pytest.approx(3.18245 * error, rel=1e-5)
    assert found.told(2) == "+3.00 ± 3.44" and 0.05 < found.p_value < 0.1, "0 is inside the interval"
    assert tables.over_scenes([2.0, 2.1, 1.9]).p_value < 0.001
    alone = tables.over_scenes([2.0])
    assert alone.told(2) == "+2.00" and np.isnan(alone.p_value)
    assert np.isnan(tables.over_scenes([]).mean) and tables.over_scenes([1.0, np.nan]).told(2) == tables.MISSING


def test_lpips_without_weights_is_a_dash_in_every_table():
    results = [at(scene, label, 20.0, lpips=None) for scene in "ab" for label in ("own", "other")]
    texts = [tables.gains_table(results, "own", ["other"]), tables.choices_table(results, "own")]
    texts += [equal_bytes.told_gain(results, "own", "other"), tables.quality_tables(GRID, results)]
    for text in texts:
        assert "nan" not in text
        assert f"· {tables.MISSING}" in text or f"/ {tables.MISSING}" in text


def test_figures_that_are_missing_are_dashes_in_pages_of_models():
    nan = float("nan")
    figures = {"psnr": 20.0, "lpips": nan, "train": 21.0}
    assert polish._told(figures, figures) == "+0.00 · – · +0.00"
    sizes = {"bytes": 1000, "texels": 10, "psnr": 20.0, "lpips": None}
    assert shrink._told(sizes, {**sizes, "lpips": 0.1}).endswith(": +0.00 · –")
    group = {"criterion": "paper", "train": nan, "scores": {}}
    assert upscale_gains._quarters({"groups": [group]}, "paper") == tables.MISSING


def test_short_times_are_not_zero():
    times = {"fps": 10.0, "ms_per_step": [12.0, 10.0], "iterations": [60, 40], "machine": "cpu"}
    assert efficiency._row(result("own", 20.0), times)[-2] == "0.02"
    assert efficiency._row(result("own", 20.0), {**times, "iterations": [6000, 4000]})[-2] == "1.9"
    assert duration(59) == "a minute"


def test_finished_runs_are_rows_of_a_spreadsheet():
    text = spreadsheet.rows_text([("claim", result("own, equal", 25.0, lpips=None))])
    header, row = csv.reader(text.splitlines())
    found = dict(zip(header, row, strict=True))
    assert (found["grid"], found["scene"], found["method"], found["psnr"]) == ("claim", "fox", "own, equal", "25.0")
    assert found["lpips"] == found["budget_mb"] == "" and (found["size"], found["gaussians"]) == ("100", "1000")
    text = spreadsheet.rows_text([("claim", result("own", 25.123456789, seconds=3.14159, ms_per_step=float("nan")))])
    assert ",25.1235," in text and ",3.1," in text and "num" not in header


def test_ctrl_c_is_one_line_and_says_how_to_continue(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["run.py", "claim", "--scenes", "my scenes"])
    with pytest.raises(SystemExit) as ended, interruptible():
        raise KeyboardInterrupt
    told = capsys.readouterr().err.strip()
    assert ended.value.code == 130 and told.count("\n") == 0
    assert told.endswith("run.py claim --scenes 'my scenes'")


def test_sigterm_ends_as_ctrl_c_does(capsys):
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as ended, interruptible():
        signal.raise_signal(signal.SIGTERM)
    told = capsys.readouterr().err.strip()
    assert ended.value.code == 143 and told.count("\n") == 0 and "terminated; what is finished is kept" in told
    assert signal.getsignal(signal.SIGTERM) == before


def test_records_of_an_earlier_version_are_told_and_trained_again_on_request(tmp_path):
    old, new = record(system="bytewise"), record(system="bytewise", version=a2tg.Bytewise.version)
    assert versions.told([old, new, old]) == "2 of bytewise (version 1, now 2)"
    assert versions.told([new, record(system="a2tg"), record(system="nowhere:Gone", version=3)]) == ""
    (tmp_path / "records.json").write_text(json.dumps({"old": old, "new": new}), encoding="utf-8")
    given = ["claim", "--out", str(tmp_path), "--work", str(tmp_path / "work")]
    assert set(Lab(parse_arguments(experiments(), given)).records) == {"old", "new"}
    assert set(Lab(parse_arguments(experiments(), [*given, "--renew"])).records) == {"new"}


def test_pages_say_which_rows_are_from_before(tmp_path, capsys):
    shutil.copy(EXPERIMENTS / "results" / "small" / "records.json", tmp_path)
    main(["equal_bytes", "claim", "--tables-only", "--out", str(tmp_path), "--work", str(tmp_path / "work")])
    assert "--renew trains them again" in capsys.readouterr().out
    last = (tmp_path / "equal_bytes.md").read_text(encoding="utf-8").splitlines()[-1]
    assert re.match(r"\*Runs from before: [1-9]\d* of bytewise \(version 1, now 2\)", last)
    assert "from before" not in (tmp_path / "claim.md").read_text(encoding="utf-8")


def test_a_second_sigterm_ends_at_once():
    code = (
        "import signal\n"
        "from lab.interrupts import interruptible\n"
        "with interruptible():\n"
        "    try:\n"
        "        signal.raise_signal(signal.SIGTERM)\n"
        "    finally:\n"
        "        signal.raise_signal(signal.SIGTERM)\n"
        "        print('it went on')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=EXPERIMENTS, capture_output=True, text=True, check=False)
    assert done.returncode == 143 and done.stdout == "" and done.stderr.count("what is finished is kept") == 1


def test_processes_begin_without_ctrl_c():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with queue._interrupts_ignored():
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_experiments_and_benchmarks_have_one_writer_of_tables():
    folders = (EXPERIMENTS, EXPERIMENTS.parent / "benchmarks")
    writers = [path for folder in folders for path in folder.rglob("*.py") if "---" in path.read_text(encoding="utf-8")]
    assert [path.name for path in writers] == ["markdown.py"]
    assert tables.markdown(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |\n"


def test_choices_are_compared_with_the_default():
    results = [result("own", 20.0), result("own", 21.0, 1), result("variant", 20.25, lpips=0.19)]
    text = tables.choices_table([*results, result("variant", 20.75, 1)], "own")
    assert "| variant | +0.00 · -0.005 | +0.00 · -0.005 | 1.00 |" in text


def test_without_a_second_seed_nothing_is_said_to_be_above():
    text = tables.gains_table([result("own", 21.0), result("other", 20.0)], "own", ["other"])
    assert "| +1.00 · +0.000 · +1.00 |" in text and "No cell has two seeds" in text


def test_columns_are_data_sets_and_what_is_missing_in_one_is_told():
    """A mean over all of them counts each once, as the paper does."""
    scenes = [SceneAt(label, label, 1) for label in ("A/x", "A/y", "B/z")]
    cells = [dataclasses.replace(CELL, scene=scene) for scene in scenes]
    method = Method("own", "a2tg")
    results = [
        tables.Result(Run(method, cell, False, Job(cell.scene.path, 1, a2tg.A2tg(), 0)), record(psnr))
        for cell, psnr in zip(cells, (20.0, 22.0, 30.0), strict=True)
    ]
    grid = Grid("x", "X", "small", "quick", tuple(cells), method, (), ())
    text = tables.quality_tables(grid, results)
    assert "1.00 (+331 %) | 30.00 / .800 / .200 · 1.00 (+331 %) | 25.50 / .800 / .200 · 1.00 |" in text
    other = dataclasses.replace(results[0], run=dataclasses.replace(results[0].run, method=Method("other", "a2tg")))
    assert "20.00 / .800 / .200 · 1.00 (+331 %) (1 of 2 scenes) | – | – |" in tables.quality_tables(
        grid, [*results, other]
    )


def test_a_page_shows_the_tables_that_it_names(tmp_path, monkeypatch):
    """The page in place, the appendix from its text."""
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "x.md").write_text("# Title\n\n## Part\n\n| a |\n")
    for name in ("PAGE", "TEXT", "APPENDIX"):
        monkeypatch.setattr(pages, name, tmp_path / f"{name}.md")
    before = "Before.\n\n<!-- results/x.md -->\nold\n<!-- end -->\n\nAfter.\n"
    pages.PAGE.write_text(before)
    pages.TEXT.write_text(before)
    pages.refresh(tmp_path)
    wanted = "Before.\n\n<!-- results/x.md -->\n\n### Part\n\n| a |\n\n<!-- end -->\n\nAfter.\n"
    assert pages.PAGE.read_text() == pages.APPENDIX.read_text() == wanted == pages.with_tables(wanted, tmp_path)
    assert pages.TEXT.read_text() == before and pages.names(wanted) == ["results/x.md"]


UNCOMMITTED = ("quick_preset", "plain", "rates")
"""Experiments whose runs are not among the committed ones."""


def test_the_documented_results_are_those_of_the_committed_records(tmp_path):
    """Both pages show the committed tables, and every table made of records is made anew."""
    shown = set()
    for page, text in pages.pages().items():
        assert page.read_text(encoding="utf-8") == text, f"{page} is old: python experiments/run.py appendix"
        shown |= {pathlib.Path(name).name for name in pages.names(text)}
    made_from_models = {
        "decomposition", "efficiency", "equal_bytes_speed", "on_disk", "polish", "shrink", "upscale_gains",
        "comparison_pictures",
    }  # fmt: skip
    committed = EXPERIMENTS / "results" / "small"
    shutil.copy(committed / "records.json", tmp_path)
    arguments = ["--tables-only", "--out", str(tmp_path), "--work", str(tmp_path / "none")]
    lab = Lab(argument_parser("").parse_args(arguments))
    for name, experiment in experiments().items():
        if name not in made_from_models and name not in UNCOMMITTED:
            lab.present(experiment, [lab.grid(grid) for grid in experiment.grids])
    made = {path.name for path in tmp_path.glob("*.md")}
    assert shown == made | {f"{name}.md" for name in made_from_models} - {"comparison_pictures.md"}
    unshown = {path.name for path in committed.glob("*.md")} - shown
    assert unshown <= {"quick_preset.md"}, "a table is on no page"
    for name in made:
        assert (tmp_path / name).read_text() == (committed / name).read_text(), name


def test_every_picture_on_a_page_is_committed_and_every_committed_one_is_on_a_page():
    folder = EXPERIMENTS / "results" / "small"
    texts = "".join(path.read_text(encoding="utf-8") for path in pages.pages())
    shown = set(re.findall(r"\(\.\./experiments/results/small/([\w-]+\.png)\)", texts))
    assert shown and all((folder / name).is_file() for name in shown)
    listed = subprocess.run(["git", "ls-files", "."], cwd=folder, capture_output=True, text=True, check=False)
    if listed.returncode == 0:
        assert shown == {name for name in listed.stdout.split() if name.endswith(".png")}


def test_the_plan_counts_what_is_left(tmp_path):
    """It counts runs at equal bytes before the bytes are known, and estimates CPUs by the cost of a step."""
    grid, folders = read_grid("claim", "smoke"), Folders(tmp_path, tmp_path)
    here = Machine(jobs=2, memory=8e9, has_gpu=False)
    everything = plan_of([grid], {}, folders, here)
    assert "| built-in 1/2 | 400 | 0 | 30+20 | 0 of 6 | all |" in everything
    assert "8 of 8 stages are left" in everything and "rough figure of CPUs" in everything
    assert "on this machine, 2 at a time, with compilation" in everything and "Disk: about" in everything
    assert "8.00 GB may be used" in everything
    (row,) = re.findall(r"\| built-in 1/2, A²TG, stage gaussians, [^|]+\| ([\d.]+) \| ([\d.]+) GB \|", everything)
    assert 0 < float(row[0]) < 0.1 and float(row[1]) >= 4
    on_gpu = plan_of([grid], {}, folders, dataclasses.replace(here, has_gpu=True))
    assert "the paper's program on its GPU" in on_gpu and "compilation" not in on_gpu
    first = next(grid.jobs({}))
    rest = plan_of([grid], {first.key: record(), first.start.key: record()}, folders, here)
    assert "1 of 6 | 2DGS*-MCMC; A²TG, as quick has it; 2DGS*-MCMC, equal bytes;" in rest
    assert "the steps of finished stages" in rest
    mb = model_bytes(first.system) / 1e6
    finished = {key: record(mb=mb) for key in stages_of([grid], {})}
    assert "| 6 of 6 | – |" in plan_of([grid], finished, folders, here)
    assert [duration(seconds) for seconds in (150, 3600, 9000)] == ["2 minutes", "1.0 hours", "2.5 hours"]
    assert finished_pace(first, {"x": record(stage="textures", num=400)}) == pytest.approx(0.01)


def test_progress_names_stages_in_words(tmp_path, capsys):
    grid = read_grid("claim", "smoke")
    records = {}
    progress = Progress([grid], records, tmp_path / "log.txt")
    progress.begin(2)
    job = next(grid.jobs({}))
    progress.start(job.start)
    progress.done(job.start, record(seconds=3.0))
    records[job.key] = record(mb=0.1)
    last = list(grid.jobs(records))[-1]
    progress.start(last)
    progress.failed(queue.Failure(last, "no room"))
    told = capsys.readouterr().out.splitlines()
    assert told[0] == f"8 stages to train, 2 at a time at most; log: {tmp_path / 'log.txt'}"
    assert told[1] == "1 of 8 start: built-in 1/2, A²TG, stage gaussians, 400 Gaussians, seed 0"
    assert told[2].startswith("1 of 8 done: built-in 1/2, A²TG, ") and "25.00 dB" in told[2]
    assert told[3].startswith("2 of 8 start: built-in 1/2, Textured Gaussians*, stage textures, bytes of 400 Gaussians")
    assert told[4].startswith("2 of 8 FAILED: ") and told[4].endswith(": no room")
    log = (tmp_path / "log.txt").read_text(encoding="utf-8").splitlines()
    assert len(log) == 5 and all(line.endswith(shown) for line, shown in zip(log, told, strict=True))


def test_arguments_have_defaults():
    args = argument_parser("").parse_args([])
    assert args.scale == "small" and args.scenes == pathlib.Path("scenes") and not args.tables_only
