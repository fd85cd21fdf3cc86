"""Run folders survive everything that ends a process or damages a file."""

import contextlib
import dataclasses
import hashlib
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from run_folders import create_run, some_result

from a2tg_jax import (
    Change,
    DivergedError,
    Gaussians,
    Gaussians2dMcmc,
    LossConfig,
    Mcmc,
    StepEvent,
    fit,
    load_checkpoint,
    load_model,
    pytree,
    save_checkpoint,
    stop_on_signals,
)
from a2tg_jax.base.atomic import replacing, write_whole
from a2tg_jax.base.machine import this_machine
from a2tg_jax.base.regular_files import sha256_of
from a2tg_jax.cli import main as cli
from a2tg_jax.host.errors import error_text
from a2tg_jax.results import compression, run_evaluation, run_training, stage_training
from a2tg_jax.results.folder import OLD, RunFolder, old_run, opened, put_back_old, set_aside
from a2tg_jax.results.model_source import open_source
from a2tg_jax.results.record import RunRecord, SceneSource, read_record, read_run_file, write_record
from a2tg_jax.results.run_training import RunOptions, train_run
from a2tg_jax.training.batches import BatchOrder
from a2tg_jax.training.loop import StageRun

SIZES = {"initial_gaussians": 60, "densify": Mcmc(cap=60), "loss": LossConfig(ssim_weight=0.0)}
SOURCE = SceneSource("synthetic", downscale=6)
RECORD = RunRecord(SOURCE, "gaussians-2d-mcmc", Gaussians2dMcmc(stage1_iterations=20, **SIZES))
NAME = "gaussians-2d-mcmc-gaussians"
QUIET = RunOptions(progress=False)
TRAIN = [
    *("train", "synthetic", "--system", "gaussians-2d-mcmc", "--downscale", "6", "--stage1-iterations", "20"),
    *("--initial-gaussians", "60", "--densify.cap", "60", "--loss.ssim-weight", "0"),
]


@pytest.fixture(autouse=True)
def no_signal_is_ignored():
    """nohup ignores SIGHUP, and shells ignore SIGINT in background processes."""
    wanted = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in wanted.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def scene():
    return SOURCE.load()


pytestmark = pytest.mark.usefixtures("untouched_jax")


def filled(path) -> RunFolder:
    """A folder with a few files of a run, and a foreign one."""
    run = create_run(path)
    write_record(run, RECORD)
    for file in (run.model(NAME), run.checkpoint(NAME, 20), run.report):
        file.parent.mkdir(exist_ok=True)
        run.own(file).write_text(f"old {file.name}")
    (run.path / "models" / "mine.txt").write_text("mine")
    return run


def files_of(run: RunFolder) -> dict[str, bytes]:
    """The contents of the files in a folder, except its marker."""
    paths = [path for path in run.path.rglob("*") if path.is_file() and path != run.marker]
    return {path.relative_to(run.path).as_posix(): path.read_bytes() for path in paths}


def saving_until(*iterations, noted=None):
    """A `save_checkpoint` that stops the training after checkpoints of these iterations."""

    def save_and_stop(path, checkpoint):
        save_checkpoint(path, checkpoint)
        if noted is not None:
            noted.append((checkpoint.iteration, checkpoint.num_restored))
        if checkpoint.iteration in iterations:
            raise KeyboardInterrupt

    return save_and_stop


def raising(error):
    def fail(*arguments, **options):
        raise error

    return fail


# Files


def test_files_are_on_the_disk_before_they_are_renamed(tmp_path, monkeypatch):
    done = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda number: (done.append("flush"), fsync(number)))
    monkeypatch.setattr(os, "replace", lambda *paths: (done.append("rename"), replace(*paths)))
    write_whole(tmp_path / "file", "whole")
    assert done == ["flush", "rename", "flush"] and (tmp_path / "file").read_text() == "whole"


def test_left_over_partial_files_are_deleted_and_others_stay(tmp_path):
    """A partial file may belong to a living process, or to a killed one whose number another process has."""
    run = filled(tmp_path / "run")
    left = run.checkpoint(NAME, 20).with_name(f".{run.checkpoint(NAME, 20).name}.123.partial")
    others = [run.path / ".notes.txt.123.partial", run.path / "models" / ".mine.npz.1.partial"]
    for path in (left, *others):
        path.write_text("half")
    with opened(run.path):
        assert not left.exists() and all(path.is_file() for path in others)
    folder = tmp_path / "files"
    folder.mkdir()
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    names = (
        f"a.npz.{os.getppid()}", f"a.npz.{os.getpid()}0", f"a.npz.{ended.pid}", f"a.npz.{ended.pid}@{platform.node()}",
        f"a.npz.{ended.pid}@another", "a.npz.txt.1",
    )  # fmt: skip
    young, old, _, _, elsewhere, other = paths = [folder / f".{name}.partial" for name in names]
    for path in paths:
        path.touch()
    for path in (old, other):
        os.utime(path, (0, 0))
    with replacing(folder / "a.npz") as temporary:
        temporary.touch()
    assert {path.name for path in folder.iterdir()} == {"a.npz", young.name, elsewhere.name, other.name}


@pytest.mark.parametrize("name", ["iterdir", "unlink"])
def test_partial_files_that_cannot_be_deleted_are_ignored(tmp_path, monkeypatch, name):
    """A partial file may belong to another user, or be in a folder that cannot be listed."""
    partial = tmp_path / ".a.npz.1.partial"
    partial.touch()
    os.utime(partial, (0, 0))
    unlink = Path.unlink

    def refuse(path=None, **_):
        if name == "unlink" and path != partial:
            return unlink(path, **_)
        raise PermissionError(13, "Operation not permitted")

    with monkeypatch.context() as patch:
        patch.setattr(Path, name, refuse)
        for _ in range(2):
            with replacing(tmp_path / "a.npz") as temporary:
                temporary.touch()
    assert {path.name for path in tmp_path.iterdir()} >= {"a.npz"}


@pytest.mark.parametrize("filename", ["/", b"x.npz", None, "/no/such/folder/x.npz", Path("x.npz")])
def test_a_full_disk_is_one_line_whatever_the_file(monkeypatch, filename):
    def disk_usage(folder):
        if free is None:
            raise OSError(5, "Input/output error")
        return SimpleNamespace(free=free)

    monkeypatch.setattr(shutil, "disk_usage", disk_usage)
    states = {0: "full, 0.0 MB are free", 1 << 40: "full or has no inodes left, 1099511.6 MB are free", None: "full"}
    for free, state in states.items():  # noqa: B007 - `disk_usage` reads it
        start = f"{filename}: the disk is {state}" if isinstance(filename, str | Path) else "the disk is full"
        text = error_text(OSError(28, "No space left on device", filename), "")
        assert text == f"{start}: make room, or write to another disk"
        # As by shutil, which copies the first file to the second.
        copied = error_text(OSError(28, "No space left on device", "source.jpg", None, filename), "")
        assert copied == (text if filename else f"source.jpg: the disk is {state}: make room, or write to another disk")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="/dev/full is Linux's")
@pytest.mark.parametrize("is_ours", [True, False])
def test_the_error_of_a_full_disk_names_the_file(tmp_path, monkeypatch, capsys, is_ours):
    def write(self):
        writing = replacing(tmp_path / "x.npz") if is_ours else contextlib.nullcontext()
        with writing, open("/dev/full", "wb", buffering=0) as file:
            file.write(b"x")

    monkeypatch.setattr(cli.command_class("info"), "run", write)
    assert cli.main(["info", "."]) == 2
    where = rf"{tmp_path / 'x.npz'}: the disk is full( or has no inodes left)?, \d+\.\d MB are free"
    printed = where if is_ours else "the disk is full"
    error = capsys.readouterr().err
    assert re.fullmatch(f"a2tg: error: {printed}: make room, or write to another disk\n", error)


# Two processes


def test_a_second_process_is_refused_and_a_killed_one_holds_nothing(tmp_path, capsys):
    run = filled(tmp_path / "run")
    lock = (
        "import sys\nfrom a2tg_jax.base.operating_system import try_lock\n"
        "file = open(sys.argv[1], 'a')\nprint(try_lock(file.fileno()), flush=True)\ninput()"
    )
    command = [sys.executable, "-c", lock, str(run.marker)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"True\n"
    for command in (["eval", str(run.path)], ["train", "--out", str(run.path), "--resume"]):
        assert cli.main(command) == 2
        assert "another process is training or measuring" in capsys.readouterr().err
    process.kill()
    process.communicate()
    with opened(run.path):
        assert run.report.is_file()


# Replacement


def test_the_old_run_waits_until_the_new_one_has_its_report(tmp_path, capsys):
    out = tmp_path / "run"
    old = files_of(filled(out))
    assert cli.main([*TRAIN, "--out", str(out), "--overwrite"]) == 0
    run = RunFolder(out)
    assert old_run(run) is None and run.report.read_text() != "old report.html"
    assert (out / "models" / "mine.txt").read_text() == "mine"
    assert load_model(run.model(NAME)).num == 60 and not run.checkpoints(NAME)
    assert set(old) - set(files_of(run)) == {f"checkpoints/{NAME}-0000000020.npz"}


@pytest.mark.parametrize("error", [pytest.param(ValueError("no room"), marks=pytest.mark.long), KeyboardInterrupt()])
def test_a_run_without_a_checkpoint_replaces_nothing(tmp_path, monkeypatch, capsys, error):
    run = filled(tmp_path / "run")
    before = files_of(run)
    monkeypatch.setattr(run_training, "fit_stage", raising(error))
    assert cli.main([*TRAIN, "--out", str(run.path), "--overwrite"]) in (2, 130)
    assert files_of(run) == before
    assert f"the run that was in {run.path} is untouched" in capsys.readouterr().err


@pytest.mark.long
def test_a_replacement_that_was_stopped_keeps_the_old_run_and_continues(tmp_path, monkeypatch, capsys):
    run = filled(tmp_path / "run")
    with monkeypatch.context() as patch:
        patch.setattr(stage_training, "save_checkpoint", saving_until(4))
        assert cli.main([*TRAIN, "--seed", "5", "--out", str(run.path), "--overwrite"]) == 130
    printed = capsys.readouterr().err
    assert f"{NAME}-0000000004.npz; " in printed
    assert f"; continue with: a2tg train --out {run.path} --resume" in printed
    kept = old_run(run)
    assert kept is not None and kept.report.read_text() == "old report.html" and read_record(kept) == RECORD
    assert cli.main(["info", str(run.path)]) == 0
    assert f"kept in {kept.path}" in capsys.readouterr().out
    assert cli.main(["train", "--out", str(run.path), "--resume"]) == 0
    assert old_run(run) is None and read_record(run).options.seed == 5


def test_a_process_killed_while_it_sets_a_run_aside_loses_nothing(tmp_path, monkeypatch):
    """Killed after any of its renamings; the next process puts all of it back."""
    replace = os.replace
    for after in range(7):
        run = filled(tmp_path / f"run-{after}")
        before, left = files_of(run), iter(range(after))

        def rename(*paths, left=left):
            if next(left, None) is None:
                raise SystemExit
            replace(*paths)

        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", rename)
            with contextlib.suppress(SystemExit):
                set_aside(run)
        put_back_old(run)
        assert files_of(run) == before, after


def test_an_unfinished_replacement_never_costs_the_finished_run(tmp_path):
    run = filled(tmp_path / "run")
    set_aside(run)
    write_record(run, dataclasses.replace(RECORD, preset="quick"))
    set_aside(run)
    assert RunFolder(run.path / OLD).report.read_text() == "old report.html" and not run.record.exists()


# Before training


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("scene/run", "overlap: choose an output folder"),
        (".", "overlap: choose an output folder"),
        ("scene-run", "has no sparse model"),
    ],
)
def test_the_run_folder_and_the_scene_must_not_overlap(tmp_path, monkeypatch, capsys, out, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene").mkdir()
    assert cli.main(["train", "scene", "--out", out]) == 2
    assert message in capsys.readouterr().err


def test_a_full_disk_is_seen_before_training(tmp_path, monkeypatch, capsys):
    usage = shutil.disk_usage(tmp_path)._replace(free=50_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    assert cli.main([*TRAIN, "--out", str(tmp_path / "run")]) == 2
    assert "for models and checkpoints, but the disk has 50.0 kB" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


# Checkpoints


@pytest.fixture(scope="module")
def stopped(scene, tmp_path_factory):
    """A run with two checkpoints, stopped at iteration 8, and what it would have become."""
    folder = tmp_path_factory.mktemp("stopped")
    for name, function in (("whole", save_checkpoint), ("run", saving_until(8))):
        run = create_run(folder / name)
        write_record(run, RECORD)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(stage_training, "save_checkpoint", function)
            with contextlib.suppress(KeyboardInterrupt):
                train_run(run, scene, QUIET)
    return RunFolder(folder / "run"), load_model(RunFolder(folder / "whole").model(NAME))


def assert_same(run, whole):
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        found, wanted = (getattr(model.gaussians, name) for model in (load_model(run.model(NAME)), whole))
        np.testing.assert_array_equal(found, wanted)


def test_the_checkpoint_before_a_damaged_one_is_used_with_a_warning(scene, stopped, tmp_path):
    run, whole = RunFolder(shutil.copytree(stopped[0].path, tmp_path / "run")), stopped[1]
    *_, older, newest = run.checkpoints(NAME)
    newest.write_bytes(newest.read_bytes()[:1000])
    with pytest.warns(UserWarning, match=rf"is damaged.* continues from {older.name}"):
        train_run(run, scene, QUIET)
    assert_same(run, whole)
    assert not list((run.path / "checkpoints").glob("*"))


def test_training_does_not_restart_if_all_checkpoints_are_damaged(scene, stopped, tmp_path):
    run = RunFolder(shutil.copytree(stopped[0].path, tmp_path / "run"))
    for path in run.checkpoints(NAME):
        path.write_bytes(b"")
    with pytest.raises(ValueError, match=rf"there is no other checkpoint: delete it to train {NAME} from its begin"):
        train_run(run, scene, QUIET)
    assert run.checkpoints(NAME)


def test_a_change_of_threads_is_a_warning(scene, stopped, tmp_path, monkeypatch):
    run = RunFolder(shutil.copytree(stopped[0].path, tmp_path / "run"))
    threads = this_machine().threads
    monkeypatch.setenv("A2TG_NUM_THREADS", str(threads + 1))
    with pytest.warns(UserWarning, match=rf"there are {threads + 1} threads and were {threads} \(A2TG_NUM_THREADS="):
        train_run(run, scene, QUIET)


# LPIPS


@pytest.mark.long
def test_lpips_is_kept_while_the_models_are_the_same(scene, stopped, tmp_path, monkeypatch):
    run = RunFolder(shutil.copytree(stopped[0].path, tmp_path / "run"))
    train_run(run, scene, QUIET)
    run_evaluation.evaluate_run(run, scene)
    metrics, per_view = (json.loads(path.read_text()) for path in (run.metrics, run.per_view))
    assert metrics["models"][NAME]["sha256"] == hashlib.sha256(run.model(NAME).read_bytes()).hexdigest()
    metrics["lpips_network"] = "alex"
    for split in per_view[NAME].values():
        for view in split.values():
            view["lpips"] = 0.25
    run.metrics.write_text(json.dumps(metrics))
    run.per_view.write_text(json.dumps(per_view))
    result = run_evaluation.evaluate_run(run, scene)
    assert result.models[NAME].shown.lpips == 0.25 and result.is_lpips_kept and result.lpips_network == "alex"
    assert json.loads(run.metrics.read_text())["models"][NAME]["test"]["lpips"] == 0.25
    with open(run.model(NAME), "ab") as file:
        file.write(b"\0")
    assert run_evaluation.evaluate_run(run, scene).lpips_network is None


# Divergence


@pytree
class Trap(StepEvent):
    """After iteration 12, everything is NaN, if the view was seen whose camera has this x."""

    x: float = 0.0
    tolerance: float = 1e-4

    @property
    def observes(self):
        return True

    def init(self, model):
        return jnp.zeros(())

    def observe(self, state, model, seen):
        return seen.cameras.viewmat[0, 0, 0]

    def apply(self, now, model, moments, state):
        is_bad = (now.iteration == 12) & (jnp.abs(state - self.x) < self.tolerance)
        means = jnp.where(is_bad, jnp.nan, model.gaussians.means)
        gaussians = dataclasses.replace(model.gaussians, means=means)
        return Change(dataclasses.replace(model, gaussians=gaussians), moments, state)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trapped(Gaussians2dMcmc):
    trap: Trap = Trap()

    def stages(self):
        (stage,) = super().stages()
        return (dataclasses.replace(stage, events=(*stage.events, self.trap)),)


def trapped_run(scene, folder, on_nan, tolerance=1e-4) -> RunFolder:
    """A run that diverges with the first order of its views."""
    view = scene.train[BatchOrder(scene.train, 1, RECORD.options.seed * 2 + 1).indices(12)[0]]
    x = float(np.asarray(view.camera.viewmat)[0, 0])
    system = Trapped(stage1_iterations=20, trap=Trap(x, tolerance), **SIZES)
    run = create_run(folder)
    write_record(run, dataclasses.replace(RECORD, system=f"{__name__}:Trapped", options=system, on_nan=on_nan))
    return run


TRAPPED = "Trapped-gaussians"


def test_the_state_before_a_divergence_is_a_file(scene, tmp_path):
    run = trapped_run(scene, tmp_path / "run", "stop")
    with pytest.raises(ValueError, match=r"not finite at iteration 12 .*means is not finite in 60 of 60.*`on_nan`"):
        train_run(run, scene, QUIET)
    kept = load_checkpoint(run.diverged(TRAPPED, 11), Trapped)
    assert kept.iteration == 11 and np.isfinite(kept.model.gaussians.means).all()
    assert run.checkpoints(TRAPPED)[-1] == run.checkpoint(TRAPPED, 10)


def test_restoring_takes_another_order_and_resuming_repeats_it(scene, tmp_path, monkeypatch):
    run = trapped_run(scene, tmp_path / "run", "restore")
    with pytest.warns(UserWarning, match=r"restarts from iteration 10 with the views in another order \(1 of 5"):
        train_run(run, scene, QUIET)
    other, numbers = trapped_run(scene, tmp_path / "other", "restore"), []
    with monkeypatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        patch.setattr(stage_training, "save_checkpoint", saving_until(8, 14, noted=numbers))
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                train_run(other, scene, QUIET)
    train_run(other, scene, QUIET)
    assert numbers[-1] == (14, 1) and numbers[3] == (8, 0)
    for name in ("means", "sh"):
        first, second = (getattr(load_model(r.model(TRAPPED)).gaussians, name) for r in (run, other))
        np.testing.assert_array_equal(first, second)


@pytest.mark.long
def test_restoring_has_an_end(scene, tmp_path):
    run = trapped_run(scene, tmp_path / "run", "restore", tolerance=10.0)
    words = "was restored 5 times already"
    with pytest.warns(UserWarning), pytest.raises(ValueError, match=words) as raised:
        train_run(run, scene, QUIET)
    assert isinstance(raised.value.__cause__, DivergedError)


# Signals


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGUSR1, 128 + signal.SIGUSR1)]
)
def test_a_signal_outside_training_ends_with_one_line(monkeypatch, capsys, number, code):
    monkeypatch.setattr(cli.command_class("info"), "run", lambda self: os.kill(os.getpid(), number))
    before = signal.getsignal(number)
    assert cli.main(["info", "."]) == code
    assert capsys.readouterr().err == "a2tg: interrupted\n" and signal.getsignal(number) == before


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.long)]
)
def test_a_signal_in_training_keeps_its_state(scene, stopped, tmp_path, monkeypatch, capsys, number, code):
    launch, out = StageRun._launch, tmp_path / "run"

    def launch_and_signal(self, iteration):
        if iteration == 7 and not list(out.glob("models/*")):
            os.kill(os.getpid(), number)
        return launch(self, iteration)

    with monkeypatch.context() as patch:
        patch.setattr(StageRun, "_launch", launch_and_signal)
        assert cli.main([*TRAIN, "--out", str(out)]) == code
    run = RunFolder(out)
    printed = capsys.readouterr().err.splitlines()[-1]
    assert printed == (
        f"a2tg: interrupted; the last checkpoint is {run.checkpoint(NAME, 7)}; "
        f"show it with: a2tg view {out} --model {NAME}; continue with: a2tg train --out {out} --resume "
        "(add --finish-now to finish soon)"
    )
    train_run(run, scene, QUIET)
    assert_same(run, stopped[1])


def test_a_second_signal_ends_the_program_at_once():
    with pytest.raises(KeyboardInterrupt) as raised, stop_on_signals() as is_asked:
        assert not is_asked()
        os.kill(os.getpid(), signal.SIGINT)
        assert is_asked()
        os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("it went on")
    assert raised.value.exit_code == 143


def test_errors_of_training_come_with_advice(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(stage_training, "save_checkpoint", raising(OSError(28, "No space left on device")))
    assert cli.main([*TRAIN, "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    printed = "the disk is full: make room, or write to another disk"
    how = f"continue with: a2tg train --out {tmp_path / 'run'} --resume"
    assert error.endswith(f"{printed}; there is no checkpoint yet; {how}")


LACKS = {
    "not enough memory (RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes.): ": jax.errors.JaxRuntimeError(
        "RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes."
    ),
    "not enough memory (Unable to allocate 9 B): ": MemoryError("Unable to allocate 9 B"),
    "not enough memory: ": MemoryError(),
}


def test_a_lack_of_memory_in_training_comes_with_advice(tmp_path, monkeypatch, capsys):
    printed = next(iter(LACKS))
    monkeypatch.setattr(run_training, "fit_stage", raising(LACKS[printed]))
    assert cli.main([*TRAIN, "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith(
        f"a2tg: error: {printed}close other programs, or start another run with a larger --downscale"
    )
    assert error.endswith(f"there is no checkpoint yet; continue with: a2tg train --out {tmp_path / 'run'} --resume")


@pytest.mark.parametrize(("name", "advice"), [("render", "lower --size or --supersample"), ("info", "close other")])
def test_a_lack_of_memory_outside_training_is_one_line(name, advice, monkeypatch, capsys):
    for printed, error in LACKS.items():
        monkeypatch.setattr(cli.command_class(name), "run", raising(error))
        assert cli.main([name, "."]) == 2
        assert f"a2tg: error: {printed}{advice}" in capsys.readouterr().err


def test_an_internal_error_is_not_reported_as_a_mistake_of_the_user(monkeypatch):
    monkeypatch.setattr(cli.command_class("info"), "run", raising(jax.errors.JaxRuntimeError("INTERNAL: a bug")))
    with pytest.raises(jax.errors.JaxRuntimeError, match="a bug"):
        cli.main(["info", "."])


def test_a_run_with_a_file_budget_ends_with_its_file(tmp_path, monkeypatch, capsys):
    """If the program is killed before, the resumed run writes it, once. Without a file the run is finished, too."""
    asked = []

    def compress(path, out, options, *, scene, progress, on_note):
        asked.append((path, options.file_budget, options.tune_iterations, progress))
        if len(asked) == 1:
            raise KeyboardInterrupt
        if len(asked) == 2:
            raise ValueError("file_budget must be larger")
        run.model(NAME).with_suffix(".a2tgz").touch()
        return "the file"

    monkeypatch.setattr(run_training, "evaluate_run", lambda *_, **__: some_result())
    monkeypatch.setattr(run_training, "compress", compress)
    run = RunFolder(tmp_path / "run")
    assert cli.main([*TRAIN, "--out", str(run.path), "--quiet", "--file-budget", "60kB"]) == 130
    assert f"continue with: a2tg train --out {run.path} --resume" in capsys.readouterr().err
    resuming = ["train", "--out", str(run.path), "--resume", "--quiet"]
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert cli.main(resuming) == 0
    printed = capsys.readouterr()
    assert "the file\n" not in printed.out
    assert (
        f"no file was written: file_budget must be larger; to try another size: a2tg compress {run.path}" in printed.err
    )
    assert cli.main([*resuming, "--file-budget", "0.06MB"]) == 0 and "the file\n" in capsys.readouterr().out
    assert cli.main(resuming) == 0 and "the file\n" not in capsys.readouterr().out
    assert asked == [(run.path, 0.06, 1000, False)] * 3
    assert read_record(run).options.budget_bytes == 420_000 >= load_model(run.model(NAME)).num_bytes > 417_000
    assert cli.main([*resuming, "--file-budget", "3kB"]) == 2
    assert f"a2tg compress {run.path} --file-budget 0.003MB --tune-iterations 1000" in capsys.readouterr().err


@pytest.mark.long
def test_the_file_of_a_file_budget(tmp_path, monkeypatch, capsys):
    ladder = {"means": (8, 12), "log_scales": (4, 8), "sh_0": (4, 8), "sh_rest": (2, 4)}
    monkeypatch.setattr(compression, "TUNED_LADDER", ladder)
    monkeypatch.setattr(run_training, "ITERATIONS", 10)
    run = RunFolder(tmp_path / "run")
    assert cli.main([*TRAIN, "--out", str(run.path), "--quiet", "--file-budget", "40kB"]) == 0
    size, printed = run.model(NAME).with_suffix(".a2tgz").stat().st_size, capsys.readouterr()
    assert 10_000 < size <= 40_000 and "tuning" not in printed.err and " on disk" in printed.out
    assert "compressed (gaussians-2d-mcmc-gaussians.a2tgz)" in printed.out
    other = ["train", "synthetic", "--system", "supergaussians", "--out", str(tmp_path / "other")]
    assert cli.main([*other, "--file-budget", "6kB"]) == 2
    assert "the file of file_budget holds Gaussians" in capsys.readouterr().err


def test_a_file_budget_goes_with_a_memory_budget(tmp_path):
    run = create_run(tmp_path / "run")
    record = dataclasses.replace(RECORD, file_budget="70 kB").budgeted()
    assert (record.file_bytes, record.options.memory_budget) == (70_000, 0.49)
    write_record(run, record)
    assert "\nmemory_budget" not in run.record.read_text() and read_record(run) == record
    # Another one in its place: the memory follows, unless it was given.
    for budget, expected in ((None, 210_000), (0.1, 100_000)):
        given = dataclasses.replace(RECORD, options=dataclasses.replace(RECORD.options, memory_budget=budget))
        write_record(run, dataclasses.replace(given, file_budget="70kB").budgeted())
        again = dataclasses.replace(read_run_file(run.record), file_budget=0.03).budgeted()
        assert again.options.budget_bytes == expected
    with pytest.raises(ValueError, match="file_budget must be a number of MB"):
        dataclasses.replace(record, file_budget="nine")


def assert_same_bits(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_a_finished_run_is_trained_on(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(run_training, "evaluate_run", lambda *_, **__: some_result())
    run = RunFolder(tmp_path / "run")
    assert cli.main([*TRAIN, "--out", str(run.path), "--quiet"]) == 0
    before, resuming = run.model(NAME).read_bytes(), ["train", "--out", str(run.path), "--resume", "--quiet"]
    capsys.readouterr()
    assert cli.main(resuming) == 0
    advice = f"{run.path} is finished; to train it on: a2tg train --out {run.path} --resume --more 2000\n"
    assert advice in capsys.readouterr().out
    for _ in range(2):
        assert cli.main([*resuming, "--more", "4"]) == 0
        assert advice not in capsys.readouterr().out
    names = [NAME, "gaussians-2d-mcmc-more", "gaussians-2d-mcmc-more-2"]
    assert read_record(run).plan.main == tuple(names) and read_record(run).options.more == (4, 4)
    models = [load_model(run.model(name)) for name in names]
    assert run.model(NAME).read_bytes() == before and len({model.num for model in models}) == 1
    assert not np.array_equal(models[1].sh, models[2].sh)
    # The same bits as in one run, and as in Python.
    at_once = RunFolder(tmp_path / "at-once")
    assert cli.main([*TRAIN, "--more", "4", "4", "--out", str(at_once.path), "--quiet"]) == 0
    assert_same_bits(load_model(at_once.model(names[2])), models[2])
    result = fit(SOURCE.load(), read_record(run).options)
    assert_same_bits(result.model, models[2])
    run.model(names[2]).unlink()
    assert cli.main([*resuming, "--more", "4"]) == 2
    assert "--more trains a finished run on: first finish this one with a2tg train" in capsys.readouterr().err
    assert cli.main(resuming) == 0 and run.model(names[2]).is_file()
    assert_same_bits(load_model(run.model(names[2])), models[2])
    # A process that was killed between writing the model and keeping its state.
    end = run.checkpoint(names[2], 4)
    end.parent.mkdir(exist_ok=True)
    run.state(names[2]).rename(end)
    assert cli.main([*resuming, "--more", "4"]) == 0 and run.state(names[2]).is_file() and not end.exists()
    # Runs of earlier versions kept no state.
    last = read_record(run).plan.main[-1]
    run.model(last).unlink()
    run.state(names[2]).unlink()
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert cli.main(resuming) == 0
    assert f"a2tg: warning: {last} continues {names[2]} without Adam's moments" in capsys.readouterr().err
    run.model(last).unlink()
    run.state(names[2]).write_bytes(b"damaged")
    assert cli.main(resuming) == 2
    assert "delete it to train gaussians-2d-mcmc-more-3 without Adam's moments" in capsys.readouterr().err


MORE = "gaussians-2d-mcmc-more"


def test_further_training_that_is_interrupted_keeps_the_finished_model(tmp_path, monkeypatch, capsys):
    """Commands take it by default, and say so; the interruption changes nothing of what comes out."""
    monkeypatch.setattr(run_training, "evaluate_run", lambda *_, **__: some_result())
    run, whole = RunFolder(tmp_path / "run"), RunFolder(tmp_path / "whole")
    assert cli.main([*TRAIN, "--out", str(run.path), "--quiet"]) == 0
    shutil.copytree(run.path, whole.path)
    more = ["train", "--out", str(run.path), "--resume", "--quiet"]
    assert cli.main([*more[:2], str(whole.path), *more[3:], "--more", "9"]) == 0
    with monkeypatch.context() as patch:
        patch.setattr(stage_training, "save_checkpoint", saving_until(6))
        assert cli.main([*more, "--more", "9"]) == 130
    assert f"show it with: a2tg view {run.path} --model {MORE}; continue with" in capsys.readouterr().err
    with pytest.warns(UserWarning, match=f"{MORE} is not finished: this is {NAME}, the last finished model; `model`"):
        assert open_source(run.path).path == run.model(NAME)
    with pytest.warns(UserWarning, match=f"{MORE} is not finished: this is its checkpoint after iteration 6 of 9"):
        further = open_source(run.path, MORE)
    assert_same_bits(further.model, load_checkpoint(run.checkpoint(MORE, 6)).model_in(SOURCE.load()))
    assert cli.main(["info", str(run.path)]) == 0
    printed = capsys.readouterr().out
    assert re.search(rf"{MORE} +after iteration 6 of 9; 60 Gaussians", printed)
    assert f"shown    {NAME}, unless" in printed
    assert cli.main(more) == 0
    assert_same_bits(load_model(run.model(MORE)), load_model(whole.model(MORE)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert open_source(run.path).path == run.model(MORE)


@pytest.mark.filterwarnings("default:.*is not finished")
def test_a_checkpoint_is_a_model_for_every_command(scene, stopped, tmp_path, capsys):
    run = RunFolder(shutil.copytree(stopped[0].path, tmp_path / "run"))
    newest = run.checkpoints(NAME)[-1]
    checkpoint = load_checkpoint(newest)
    note = f"{NAME} is not finished: this is its checkpoint after iteration {checkpoint.iteration} of 20"
    with pytest.warns(UserWarning, match=note):
        source = open_source(run.path)
    assert source.path == newest and source.note == note
    for field in dataclasses.fields(Gaussians):
        shown, kept = (getattr(model.gaussians, field.name) for model in (source.model, checkpoint.model))
        np.testing.assert_array_equal(shown, kept)
    assert source.model.origin.names == scene.origin.names and source.load_scene().name == scene.name
    commands = {
        "render": ["--path", "test", "--size", "16x12", "--out", "frames"],
        "export": ["--web", "page.html"],
        "convert": ["scene.ply"],
        "edit": ["--out", "edited.npz", "--background", "white"],
        "eval": [],
    }
    for name, options in commands.items():
        words = [str(tmp_path / word) if Path(word).suffix or word == "frames" else word for word in options]
        assert cli.main([name, str(run.path), *words]) == 0
        assert note in "".join(capsys.readouterr())
    assert len(list((tmp_path / "frames").glob("*.png"))) == len(scene.test)
    assert (tmp_path / "page.html").is_file() and (tmp_path / "scene.ply").is_file()
    assert load_model(tmp_path / "edited.npz").background == (1.0, 1.0, 1.0)
    assert note in run.report.read_text() and list(json.loads(run.metrics.read_text())["models"]) == [NAME]
    # Afterwards the training continues as if nothing had been looked at.
    train_run(run, scene, QUIET)
    assert_same(run, stopped[1])


def test_a_checkpoint_by_its_own_path_says_which_folder_to_give(stopped, tmp_path, capsys):
    run = stopped[0]
    newest = run.checkpoints(NAME)[-1]
    page = ["--web", str(tmp_path / "page")]
    for words in (["view"], ["render"], ["info"], ["eval"], ["export", *page]):
        assert cli.main([words[0], str(newest), *words[1:]]) == 2
        error = capsys.readouterr().err
        assert f"give its run folder, {run.path}\n" in error or f"is in the run folder {run.path}; give" in error
        assert cli.main([words[0], str(newest.parent), *words[1:]]) == 2
        assert f"is in the run folder {run.path}; give that folder" in capsys.readouterr().err


def test_an_older_checkpoint_is_shown_if_the_newest_is_damaged(stopped, tmp_path):
    run = RunFolder(shutil.copytree(stopped[0].path, tmp_path / "run"))
    *oldest, older, newest = run.checkpoints(NAME)
    newest.write_bytes(newest.read_bytes()[:100])
    with pytest.warns(UserWarning) as caught:
        shown = open_source(run.path).model
    assert any(f"{newest.name}: " in str(one.message) and older.name in str(one.message) for one in caught)
    assert_same_bits(shown, load_checkpoint(older).model_in(SOURCE.load()))
    with pytest.warns(UserWarning, match=rf"{newest.name}: .*; {older.name} is taken instead"):
        result = run_evaluation.evaluate_run(run)
    assert result.models[NAME].sha256 == sha256_of(older)
    assert result.models[NAME].seconds == load_checkpoint(older).history.last_seconds
    for path in (*oldest, older):
        path.unlink()
    with pytest.raises(ValueError, match=newest.name):
        open_source(run.path)


def test_a_checkpoint_needs_the_cameras_of_its_scene(stopped, tmp_path):
    run = RunFolder(shutil.copytree(stopped[0].path, tmp_path / "run"))
    write_record(run, dataclasses.replace(read_record(run), scene=SceneSource(str(tmp_path / "nowhere"))))
    with pytest.raises(FileNotFoundError, match="no cameras, and the scene that has them is missing"):
        open_source(run.path)


def test_the_next_stage_needs_the_views_of_the_one_before(tmp_path):
    run, scene = create_run(tmp_path / "run"), SOURCE.load()
    record = dataclasses.replace(RECORD, options=dataclasses.replace(RECORD.options, stage2_iterations=5))
    write_record(run, record)
    train_run(run, scene, QUIET)
    run.model(record.plan.main[1]).unlink()
    first, *others = scene.train
    fewer = dataclasses.replace(scene, train=tuple(others))
    difference = f"{len(others) + 1} views, and the scene has {len(others)} to train on: {first.name} missing; restore"
    with pytest.raises(ValueError, match=f"{NAME}.npz was trained on {difference}"):
        train_run(run, fewer, QUIET)
    train_run(run, scene, QUIET)
