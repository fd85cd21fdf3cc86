"""Several processes that train together: those of this machine (`on_processes`)."""

import dataclasses
import re
import signal
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from on_processes import SHORT, ended, free_port, pair, started, survivor_of, trainings
from run_folders import create_run
from small_files import write_archive

import a2tg_jax as a2tg
from a2tg_jax import Session, fit_stage, load_model
from a2tg_jax.base.machine import Devices
from a2tg_jax.cli import main as cli
from a2tg_jax.cli.arguments import deciding_options
from a2tg_jax.cli.processes import is_lost
from a2tg_jax.cli.train import train_defaults
from a2tg_jax.results import run_processes
from a2tg_jax.results.commands import resuming_command
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.history import read_history
from a2tg_jax.results.record import RunRecord, SceneSource, read_record, write_record


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*floaters changed nothing")
def test_two_processes_train_as_one(tmp_path):
    """The command line trains two stages, with a pruning and the growth of textures. The first is compared."""
    run = RunFolder(tmp_path / "run")
    ended(trainings(run.path, SHORT, (), ()))
    record = read_record(run)
    assert record.options.batch_size == 2
    first, _ = record.plan.main
    alone = fit_stage(record.scene.load(), record.options, 0)
    np.testing.assert_allclose(read_history(run.history(first)).loss, alone.history.loss, rtol=1e-3)
    assert load_model(run.model(first)).num_bytes == alone.model.num_bytes


@pytest.mark.long
def test_another_seed_than_the_first_process_has_is_refused(tmp_path):
    processes = trainings(tmp_path / "run", SHORT, (), ("--seed", "1"))
    printed = [process.communicate(timeout=240)[1] for process in processes]
    assert all("the processes have different options: start all with the same" in text for text in printed), printed
    assert [process.returncode for process in processes] == [2, 2]


def waiting(what="wait"):
    """Two processes that have met, and shared a step before if that is asked for."""
    processes = pair(["--what", what])
    for process in processes:
        # Gloo also writes there.
        if "met\n" not in iter(process.stdout.readline, ""):
            pytest.fail(str(ended(processes, 10)))
    return processes


@pytest.mark.long
def test_each_process_draws_its_share():
    for process in waiting("share"):
        process.kill()
        process.communicate()


@pytest.mark.parametrize("victim", [0, 1])
def test_a_lost_process_is_noticed(victim):
    """Its partner ends by itself, with the code that docs/command-line.md names, or by JAX, which is a race."""
    took, code, printed = survivor_of(waiting(), victim, signal.SIGKILL, 60)
    assert took < 30 and code in (75, -signal.SIGABRT)
    assert code != 75 or re.search("a2tg: error: another process was lost: .*; go on", printed)


@pytest.mark.long
def test_a_process_that_does_not_come_is_reported():
    """And before, that there is no cluster."""
    code = f"""
import sys
from a2tg_jax.cli import processes
try:
    processes.joined(processes.ProcessPlace("auto", None, None, 60.0), str).__enter__()
except ValueError as error:
    print(error, file=sys.stderr)
processes.JOIN_SECONDS = 1
processes.joined(processes.ProcessPlace("127.0.0.1:{free_port()}", 2, 0, 60.0), str).__enter__()
"""
    alone = started(["-c", code])
    printed = alone.communicate(timeout=120)[1]
    assert "--coordinator auto: no Slurm, Open MPI or Kubernetes was found: give HOST:PORT" in printed
    assert alone.returncode == -signal.SIGABRT and "DEADLINE_EXCEEDED" in printed


def test_the_command_to_go_on_names_devices_and_processes(tmp_path):
    run, path = RunFolder(tmp_path), tmp_path / "checkpoints" / "a2tg-gaussians-0000000001.npz"
    assert resuming_command(run) == f"a2tg train --out {tmp_path} --resume"
    path.parent.mkdir()
    path.write_bytes(b"damaged")
    assert resuming_command(run) == f"a2tg train --out {tmp_path} --resume"
    header = {"format": "a2tg-jax checkpoint", "version": 1, "devices": {"each": 4, "processes": 1}}
    write_archive(path, header, {})
    assert resuming_command(run) == f"a2tg train --out {tmp_path} --resume --devices 4"
    by_two = "--devices 1 --coordinator HOST:PORT --num-processes 2 --process-id I"
    assert resuming_command(run, Devices(1, 2)) == f"a2tg train --out {tmp_path} --resume {by_two}"


def test_digests_differ_where_training_would():
    scene = a2tg.synthetic_scene(num_views=3, width=24, height=16, num_points=20)
    system = a2tg.Gaussians2dMcmc()
    record = RunRecord(SceneSource("here"), "gaussians-2d-mcmc", system)
    view, size = scene.train[0], scene.train[0].picture.size

    def differ(record=record, session=Session(), own=(), **changes):  # noqa: B008
        """Whether options, devices and scene have other digests."""
        views = dataclasses.replace(view, **dict(own)), *scene.train[1:]
        changed = dataclasses.replace(scene, train=views, **changes)
        found = run_processes.digests_of(record, changed, session)
        return [a != b for a, b in zip(found, wanted, strict=True)]

    wanted = run_processes.digests_of(record, scene, Session())
    assert differ(dataclasses.replace(record, scene=SceneSource("there"))) == [False] * 3
    camera = dataclasses.replace(view.camera, viewmat=view.camera.viewmat + np.float32(1e-6))
    fisheye = dataclasses.replace(view.camera, rays=np.zeros((*size, 2), np.float32))
    for own in ({"camera": camera}, {"camera": fisheye}, {"mask": np.ones(size, bool)}, {"name": "other"},
                {"depth": np.ones(size, np.float32)}, {"picture": np.zeros((*size, 4), np.uint8)}):  # fmt: skip
        assert differ(own=own) == [False, False, True], own
    for changes in ({"points": scene.points + np.float32(1e-6)}, {"colors": scene.colors * 0.5}, {"scale": 9.0}):
        assert differ(**changes) == [False, False, True], changes
    assert differ(dataclasses.replace(record, options=dataclasses.replace(system, seed=1))) == [True, False, False]
    mesh = SimpleNamespace(devices=np.array([SimpleNamespace(process_index=0, id=index) for index in range(2)]))
    assert differ(session=SimpleNamespace(mesh=mesh)) == [False, True, False]


def test_a_process_that_follows_may_have_the_scene_elsewhere(tmp_path):
    run = create_run(tmp_path / "run")
    write_record(run, RunRecord(SceneSource("/there"), "gaussians-2d-mcmc", a2tg.Gaussians2dMcmc()))
    train = train_defaults(deciding_options(["--resume", "--out", str(run.path), "--coordinator", "h:1"]))
    record = dataclasses.replace(train.record, scene=SceneSource(str(tmp_path)))
    train = dataclasses.replace(train, record=record, out=run.path)
    assert train.resumed(run, is_first=False).scene.path == str(tmp_path)
    with pytest.raises(ValueError, match=r"leave out .*, as it was trained on /there"):
        train.resumed(run)


def test_a_lack_of_memory_is_no_lost_process():
    lost = ("Gloo all-reduce failed: Connection closed by peer", "NCCL operation failed", "UNAVAILABLE: task is gone")
    assert all(is_lost(jax.errors.JaxRuntimeError(text)) for text in lost)
    assert is_lost(ValueError(lost[0])) and not is_lost(ValueError("no scene"))
    text = "RESOURCE_EXHAUSTED: Out of memory while trying to allocate 9 bytes."
    assert not is_lost(jax.errors.JaxRuntimeError(text))


@pytest.mark.parametrize(
    ("flags", "printed"),
    [
        ("--num-processes 2", "--num-processes needs --coordinator HOST:PORT"),
        ("--coordinator h:1 --process-id 0", "--coordinator HOST:PORT also needs --num-processes"),
        ("--coordinator h --num-processes 2 --process-id 0", "must be HOST:PORT, [IPv6]:PORT or auto; got 'h'"),
        ("--coordinator h:1 --num-processes 2 --process-id 2", "--process-id must be from 0 to 1"),
        ("--coordinator auto --view", "--view shows the training of one process"),
        ("--coordinator auto --heartbeat-timeout-seconds 0", "--heartbeat-timeout-seconds must be positive and finite"),
        ("--coordinator auto --heartbeat-timeout-seconds nan", "must be positive and finite; got nan"),
        ("--heartbeat-timeout-seconds 9", "--heartbeat-timeout-seconds needs --coordinator HOST:PORT"),
        ("--coordinator auto --num-processes -3", "--num-processes must be at least 1; got -3"),
        ("--coordinator auto --process-id -1", "--process-id must be at least 0; got -1"),
        ("--coordinator ::1:7700 --num-processes 2 --process-id 0", "[IPv6]:PORT or auto; got '::1:7700'"),
    ],
)
def test_wrong_places_are_reported(tmp_path, capsys, flags, printed):
    assert cli.main(["train", "synthetic", "--out", str(tmp_path / "run"), *flags.split()]) == 2
    assert printed in capsys.readouterr().err
