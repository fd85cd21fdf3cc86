"""Experiments as a user calls them: killed, continued, planned."""

import dataclasses
import json
import pathlib
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from experiment_records import record
from lab import queue, versions
from lab.cli import EXPERIMENTS, Lab, argument_parser
from lab.grid import read_grid
from lab.jobs import TIMES, Folders, Job, milliseconds, model_bytes, run_job
from lab.plan import Machine, duration, finished_pace, missing_text, plan_of
from lab.progress import Progress
from lab.stages import stages_of
from run import experiments, interruptible, main, parse_arguments

import a2tg_jax as a2tg
from a2tg_jax import fit_stage

SMALL = {"sh_degree": 0, "loss": {"ssim_weight": 0.0}}
"""Less to compile."""


def test_a_stage_stopped_under_one_system_continues_under_another(tmp_path, monkeypatch):
    """From a checkpoint whose time was not kept, and to the same model, bit for bit."""
    scene = a2tg.synthetic_scene(num_views=3, width=24, height=16, num_points=30)
    monkeypatch.setattr(Folders, "load_scene", lambda self, job: scene)
    plain = a2tg.find_system("gaussians-2d-mcmc").preset("smoke", **SMALL, stage1_iterations=4)
    textured = a2tg.find_system("textured-gaussians").preset("smoke", **SMALL, stage1_iterations=4)
    job = Job("synthetic", 1, textured, 0)
    assert job.key == dataclasses.replace(job, system=plain).key
    folders = Folders(tmp_path, tmp_path)
    kept = folders.files.checkpoint(job.key, 2)
    stopped = lambda checkpoint: checkpoint.iteration == 2 and a2tg.save_checkpoint(kept, checkpoint)  # noqa: E731
    whole = fit_stage(scene, plain, 0, on_checkpoint=stopped, checkpoint_every=2).model
    record = run_job(job, folders)
    assert record["training_seconds"] is None, "the time up to the checkpoint is not known"
    np.testing.assert_array_equal(a2tg.load_model(folders.model(job)).gaussians.means, whole.gaussians.means)
    assert not [*kept.parent.iterdir()]
    other = Job("synthetic", 1, dataclasses.replace(textured, seed=5), 0)
    fit_stage(scene, plain, 0, on_checkpoint=stopped, checkpoint_every=2)
    kept.replace(folders.files.checkpoint(other.key, 2))
    with pytest.raises(ValueError, match="made with another seed"):
        run_job(other, folders)


def test_the_checkpoint_before_a_damaged_one_continues_a_stage(tmp_path, monkeypatch):
    scene = a2tg.synthetic_scene(num_views=3, width=24, height=16, num_points=30)
    monkeypatch.setattr(Folders, "load_scene", lambda self, job: scene)
    job = Job("synthetic", 1, a2tg.find_system("gaussians-2d-mcmc").preset("smoke", **SMALL, stage1_iterations=4), 0)
    folders = Folders(tmp_path, tmp_path)
    files = folders.files
    keep = lambda checkpoint: a2tg.save_checkpoint(files.checkpoint(job.key, checkpoint.iteration), checkpoint)  # noqa: E731
    whole = fit_stage(scene, job.system, 0, on_checkpoint=keep, checkpoint_every=2).model
    newest = files.checkpoints(job.key)[-1]
    newest.write_bytes(newest.read_bytes()[:1000])
    with pytest.warns(UserWarning, match="training continues from .*-0000000002.npz"):
        run_job(job, folders)
    np.testing.assert_array_equal(a2tg.load_model(folders.model(job)).gaussians.means, whole.gaussians.means)
    assert not [*newest.parent.iterdir()]


class AfterQuestions:
    """A time that has come when it has been compared a number of times."""

    def __init__(self, num):
        self.left = num

    def __le__(self, now):
        self.left -= 1
        return self.left < 0


def test_a_stage_stops_at_its_time_and_is_timed_only_if_it_ran_alone(tmp_path, monkeypatch):
    scene = a2tg.synthetic_scene(num_views=3, width=24, height=16, num_points=30)
    monkeypatch.setattr(Folders, "load_scene", lambda self, job: scene)
    system = a2tg.find_system("gaussians-2d-mcmc").preset("smoke", **SMALL, stage1_iterations=20, stage2_iterations=0)
    job, folders = Job("synthetic", 1, system, 0), Folders(tmp_path, tmp_path)
    assert run_job(job, folders, stop_at=time.monotonic()) is None
    assert not folders.files.checkpoints(job.key), "the beginning needs none"
    assert run_job(job, folders, stop_at=AfterQuestions(1)) is None
    assert json.loads(folders.time_so_far(job).read_text()) >= 0
    assert folders.files.checkpoints(job.key) and not folders.model(job).is_file() and not folders.record(job).is_file()
    folders.time_so_far(job).write_text("1000000.0")
    alone = run_job(job, folders)
    assert 1e6 < alone["training_seconds"] < 1e6 + 600 and not folders.time_so_far(job).exists()
    assert alone["alone"] and alone["device"] and all(alone[name] is not None for name in TIMES)
    assert not folders.files.checkpoints(job.key)
    again = dataclasses.replace(job, system=dataclasses.replace(system, seed=1))
    folders.shared(again).parent.mkdir()
    folders.shared(again).touch()
    shared = run_job(again, folders)
    assert not shared["alone"] and [shared[name] for name in TIMES] == [None] * 4 and shared["psnr"] > 0
    assert shared.keys() == alone.keys() and json.loads(folders.record(again).read_text()) == shared
    folders.shared(job).touch()
    measured = run_job(job, folders)
    assert measured == {**alone, "fps": None}, "measured again beside others: the time of its training stays"


def test_after_the_time_limit_what_is_left_is_named(tmp_path, capsys):
    given = ["fixed_memory", "--scale", "smoke", "--out", str(tmp_path), "--work", str(tmp_path), "--minutes", "1e-6"]
    main(given)
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == (
        "the time limit of 1e-06 minutes is over: 6 of 6 stages are left, first built-in 1/2, A²TG, stage gaussians, "
        "400 Gaussians, seed 0; the same command continues, --plan lists them"
    )
    main([*given, "--tables-only"])
    assert "time limit" not in capsys.readouterr().out


def test_models_that_nothing_left_starts_from_can_be_dropped(tmp_path):
    grid, folders = read_grid("fixed_memory", "smoke"), Folders(tmp_path, tmp_path)
    lab = Lab(parse_arguments(experiments(), ["fixed_memory", "--scale", "smoke", "--work", str(tmp_path)]))
    first = next(grid.jobs({}))
    lab.records = {first.start.key: record()}
    path, start = folders.model(first), folders.model(first.start)
    path.parent.mkdir()
    other = path.with_name("other.npz")
    for one in (path, start, other):
        one.touch()
    lab._drop_models([grid])
    assert start.is_file(), "the second stage needs it"
    lab.records[first.key] = record()
    lab._drop_models([grid])
    assert [*path.parent.iterdir()] == [other], "models of other sweeps stay"
    path.touch()
    lab.folders = dataclasses.replace(lab.folders, lpips_network="alex")
    lab._drop_models([grid])
    assert path.is_file(), "LPIPS is to be measured on it"


def call(name, *arguments, **options):
    command = [sys.executable, str(EXPERIMENTS / "run.py"), str(name), "--scale", "smoke", *map(str, arguments)]
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


EQUAL_BYTES = """
title = "Equal bytes"
reference = "A²TG, one growth"
at_equal_bytes = ["2DGS*-MCMC, first stage"]

[variants]
"A²TG, one growth" = { like = "A²TG", options.texture.at = [0.5] }

[smoke]
gaussians = [400]
"""


@pytest.mark.long
@pytest.mark.skipif(not pathlib.Path("/proc/self/stat").is_file(), reason="needs /proc to see processes")
def test_an_experiment_is_killed_goes_on_and_is_not_run_again(tmp_path, capsys):
    """Equal bytes on the built-in scene, at a tiny scale: two stages of A²TG, and one of Gaussians in its bytes."""
    out, work, grid = tmp_path / "out", tmp_path / "work", tmp_path / "equal.toml"
    grid.write_text(EQUAL_BYTES, encoding="utf-8")
    process = call(grid, "--out", out, "--work", work, "--jobs", 2)
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
    assert 1 <= len(before) < 3
    done = call(grid, "--out", out, "--work", work, "--jobs", 2)
    printed, _ = done.communicate(timeout=600)
    assert done.returncode == 0, printed
    after = json.loads((out / "records.json").read_text())
    assert len(after) == 3 and {key: after[key] for key in before} == before
    assert not list((work / "checkpoints").glob("*.npz")), "what is finished needs none"
    (own,) = [row for row in after.values() if row["stage"] == "textures" and row["system"] == "a2tg"]
    (plain,) = [row for row in after.values() if row["num"] != 400]
    assert 0.99 * own["mb"] < plain["mb"] <= own["mb"]
    assert "| 2DGS*-MCMC, first stage, equal bytes |" in (out / "equal.md").read_text()
    main([str(grid), "--scale", "smoke", "--out", str(out), "--work", str(work)])
    printed = capsys.readouterr().out
    assert "| 2DGS*-MCMC, first stage, equal bytes |" in printed and ".npz" not in printed and " dB;" not in printed


@pytest.mark.long
def test_submitit_sends_jobs_out(tmp_path):
    """By its executor for processes of this machine."""
    pytest.importorskip("submitit")
    out, work, grid = tmp_path / "out", tmp_path / "work", tmp_path / "sent.toml"
    lines = 'title = "Sent"', 'table = "choices"', 'reference = "2DGS*-MCMC, first stage"', "smoke.gaussians = [400]"
    grid.write_text("\n".join(lines), encoding="utf-8")
    process = call(grid, "--out", out, "--work", work, "--cluster", "local", "--cluster-parameter", "timeout_min=10")
    printed, _ = process.communicate(timeout=600)
    assert process.returncode == 0, printed
    assert len(json.loads((out / "records.json").read_text())) == 1 and (out / "sent.md").is_file()
    assert list((work / "submitit").iterdir())


def test_ctrl_c_is_one_line_and_says_how_to_continue(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["run.py", "fixed_memory", "--scenes", "my scenes"])
    with pytest.raises(SystemExit) as ended, interruptible():
        raise KeyboardInterrupt
    printed = capsys.readouterr().err.strip()
    assert ended.value.code == 130 and printed.count("\n") == 0
    assert printed.endswith("run.py fixed_memory --scenes 'my scenes'")


def test_sigterm_ends_as_ctrl_c_does(capsys):
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as ended, interruptible():
        signal.raise_signal(signal.SIGTERM)
    printed = capsys.readouterr().err.strip()
    assert ended.value.code == 143 and printed.count("\n") == 0 and "terminated; what is finished is kept" in printed
    assert signal.getsignal(signal.SIGTERM) == before


def test_records_of_an_earlier_version_are_told_and_trained_again_on_request(tmp_path):
    old, new = record(system="bytewise"), record(system="bytewise", version=a2tg.Bytewise.version)
    assert versions.as_text([old, new, old]) == f"2 of bytewise (version 1, now {a2tg.Bytewise.version})"
    assert versions.as_text([new, record(system="a2tg"), record(system="nowhere:Gone", version=3)]) == ""
    (tmp_path / "records.json").write_text(json.dumps({"old": old, "new": new}), encoding="utf-8")
    given = ["fixed_memory", "--out", str(tmp_path), "--work", str(tmp_path / "work")]
    assert set(Lab(parse_arguments(experiments(), given)).records) == {"old", "new"}
    assert set(Lab(parse_arguments(experiments(), [*given, "--renew"])).records) == {"new"}


def test_a_second_sigterm_ends_at_once():
    code = (
        "import signal\n"
        "from run import interruptible\n"
        "with interruptible():\n"
        "    try:\n"
        "        signal.raise_signal(signal.SIGTERM)\n"
        "    finally:\n"
        "        signal.raise_signal(signal.SIGTERM)\n"
        "        print('it went on')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=EXPERIMENTS, capture_output=True, text=True, check=False)
    assert done.returncode == 143 and done.stdout == "" and done.stderr.count("what is finished is kept") == 1


def test_the_plan_counts_what_is_left(tmp_path):
    """It counts runs at equal bytes before the bytes are known, and estimates CPUs by the cost of a step."""
    grid, folders = read_grid("fixed_memory", "smoke"), Folders(tmp_path, tmp_path)
    here = Machine(jobs=2, memory=8e9, has_gpu=False)
    everything = plan_of([grid], {}, folders, here)
    assert "| built-in 1/2 | 400 | 0 | 30+20 | 0 of 3 | all |" in everything
    assert "6 of 6 stages are left" in everything and "rough figure of CPUs" in everything
    assert "on this machine, 2 at a time, with compilation" in everything and "Disk: about" in everything
    assert "8.00 GB may be used" in everything
    (row,) = re.findall(r"\| built-in 1/2, A²TG, stage gaussians, [^|]+\| ([\d.]+) \| ([\d.]+) GB \|", everything)
    assert 0 < float(row[0]) < 0.1 and float(row[1]) >= 4
    on_gpu = plan_of([grid], {}, folders, dataclasses.replace(here, has_gpu=True))
    assert "the paper's program on its GPU" in on_gpu and "compilation" not in on_gpu
    first = next(grid.jobs({}))
    rest = plan_of([grid], {first.key: record(), first.start.key: record()}, folders, here)
    assert "1 of 3 | 2DGS*-MCMC, equal bytes; Textured Gaussians*, equal bytes" in rest
    assert "the steps of finished stages" in rest
    assert missing_text(grid, {first.key: record(), first.start.key: record()}) == (
        "\n*Not finished: built-in 1/2, 400, seed 0: 2DGS*-MCMC, equal bytes; Textured Gaussians*, equal bytes.*\n"
    )
    mb = model_bytes(first.system) / 1e6
    finished = {key: record(mb=mb) for key in stages_of([grid], {})}
    assert missing_text(grid, finished) == ""
    assert "| 3 of 3 | – |" in plan_of([grid], finished, folders, here)
    assert [duration(seconds) for seconds in (150, 3600, 9000)] == ["2 minutes", "1.0 hours", "2.5 hours"]
    short = record(stage="textures", num=400, ms_per_step=None)
    assert finished_pace(first, {"x": record(stage="textures", num=400), "y": short}) == pytest.approx(0.01)
    assert finished_pace(first, {"y": short}) is milliseconds(a2tg.History.empty()) is None


def test_progress_names_stages_in_words(tmp_path, capsys):
    grid = read_grid("fixed_memory", "smoke")
    records = {}
    progress = Progress([grid], records, tmp_path / "log.txt")
    progress.begin(2)
    job = next(grid.jobs({}))
    progress.start(job.start)
    progress.done(job.start, record(seconds=3.0))
    progress.done(job.start, record(seconds=3.0, ms_per_step=None))
    progress.done(job.start, record(seconds=None, ms_per_step=None))
    records[job.key] = record(mb=0.1)
    last = list(grid.jobs(records))[-1]
    progress.start(last)
    progress.failed(queue.Failure(last, "no room"))
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == f"6 stages to train, 2 at a time at most; log: {tmp_path / 'log.txt'}"
    assert printed[1] == "1 of 6 start: built-in 1/2, A²TG, stage gaussians, 400 Gaussians, seed 0"
    assert printed[2].startswith("1 of 6 done: built-in 1/2, A²TG, ") and "25.00 dB" in printed[2]
    assert printed[2].endswith("; 3 s, 10 ms a step") and printed[3].endswith("; 3 s"), "a short stage has no pace"
    assert printed[4].endswith("25.00 dB"), "a stage beside others has no time"
    assert printed[5].startswith(
        "2 of 6 start: built-in 1/2, Textured Gaussians*, stage textures, bytes of 400 Gaussians"
    )
    assert printed[6].startswith("2 of 6 FAILED: ") and printed[6].endswith(": no room")
    log = (tmp_path / "log.txt").read_text(encoding="utf-8").splitlines()
    assert len(log) == 7 and all(line.endswith(shown) for line, shown in zip(log, printed, strict=True))


def test_arguments_have_defaults():
    args = argument_parser("").parse_args([])
    assert args.scale == "small" and args.scenes == pathlib.Path("scenes") and not args.tables_only
