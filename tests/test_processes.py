"""Several processes that train together: those of this machine (`on_processes`), and connections without a training."""

import dataclasses
import signal
import socket
import threading
import time
from multiprocessing import AuthenticationError
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from on_processes import SHORT, ended, free_port, pair, started, survivor_of, trainings
from run_folders import create_run

import a2tg_jax as a2tg
from a2tg_jax.cli import main as cli
from a2tg_jax.cli.train import train_defaults
from a2tg_jax.host.machine import Devices
from a2tg_jax.io.archive import write_archive
from a2tg_jax.io.model_file import load_model
from a2tg_jax.parallel import processes
from a2tg_jax.parallel.processes import LOST, Liveness, accept, connect, is_of_collectives, listen
from a2tg_jax.results import run_processes
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.commands import resuming_command
from a2tg_jax.results.history import read_history
from a2tg_jax.results.record import RunRecord, SceneSource, read_record, write_record
from a2tg_jax.training import Session, fit_stage

SECONDS = 0.3


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*floaters changed nothing")
def test_two_processes_train_as_one(tmp_path):
    """The command line trains two stages, with a pruning and the growth of textures. The first is compared."""
    run = RunFolder(tmp_path / "run")
    assert ended(trainings(run.path, SHORT, (), ()))[1] == ""
    record = read_record(run)
    first, _ = record.plan.main
    alone = fit_stage(record.scene.load(), record.options, 0, progress=False)
    np.testing.assert_allclose(read_history(run.history(first)).loss, alone.history.loss, rtol=1e-3)
    assert load_model(run.model(first)).num_bytes == alone.model.num_bytes


@pytest.mark.long
def test_another_seed_than_the_first_process_has_is_refused(tmp_path):
    first, other = trainings(tmp_path / "run", SHORT, (), ("--seed", "1"))
    printed, _ = [process.communicate(timeout=120)[1] for process in (first, other)]
    assert "process 1 of 2 failed: this process has other options than the first" in printed
    assert first.returncode == LOST


def waiting(what="wait", seconds=2):
    """Two processes that have met, and shared photographs and rows before if that is asked for."""
    processes = pair(["--what", what, "--seconds", str(seconds)])
    for process in processes:
        if process.stdout.readline() != "met\n":
            pytest.fail(str(ended(processes, 10)))
    return processes


@pytest.mark.long
def test_each_process_has_its_share_and_an_error_of_the_first_ends_both_at_once():
    """Of the photographs that it draws, and of rows that events on the host change."""
    first, other = waiting("share", 60)
    first.send_signal(signal.SIGINT)
    printed = [process.communicate(timeout=20)[1] for process in (first, other)]
    assert "KeyboardInterrupt" in printed[0] and first.returncode == -signal.SIGINT
    assert printed[1] == "" and other.returncode == LOST


def test_a_lost_process_is_noticed():
    took, printed = survivor_of(waiting(), 0, signal.SIGKILL, 60)
    assert printed == "a2tg: error: process 0 of 2 has ended; go on\n" and took < 8


def test_a_process_that_does_not_come_is_reported():
    """And before, that there is no cluster."""
    code = f"""
import os, sys
from a2tg_jax.parallel import processes as p
os.environ["A2TG_DEBUG"] = "1"
try:
    p.joined(p.ProcessPlace("auto", None, None, 60.0)).__enter__()
except ValueError as error:
    print(error, file=sys.stderr)
del os.environ["A2TG_DEBUG"]
p.JOIN_SECONDS = 1
p.joined(p.ProcessPlace("127.0.0.1:{free_port()}", 2, 0, 60.0)).__enter__()
"""
    alone = started(["-c", code])
    printed = alone.communicate(timeout=120)[1]
    assert "--coordinator auto: no Slurm, Open MPI or Kubernetes was found: give HOST:PORT" in printed
    assert alone.returncode == LOST and "not all processes have joined --coordinator 127.0.0.1:" in printed


@pytest.fixture
def three(monkeypatch):
    """The connections of three processes, and what ends each of them."""
    monkeypatch.setattr(processes, "GRACE", 0.0)
    listener, port, key = listen()
    found = {}
    accepting = threading.Thread(target=lambda: found.update(accept(listener, key, 3)))
    accepting.start()
    silent = socket.create_connection(("127.0.0.1", port))
    with pytest.raises((AuthenticationError, EOFError, OSError)):
        connect("127.0.0.1", port, b"a stranger's", 1)
    others = [connect("127.0.0.1", port, key, number) for number in (1, 2)]
    accepting.join(10)
    with silent:
        yield [found, *others], [[], [], []]


def watched(three, numbers):
    connections, ends = three
    return [Liveness(connections[number], 3, SECONDS, ends[number].append) for number in numbers]


def until(is_so):
    limit = time.perf_counter() + 10
    while not is_so():
        assert time.perf_counter() < limit
        time.sleep(0.01)


def test_processes_that_live_are_left_alone(three):
    everyone = watched(three, (0, 1, 2))
    time.sleep(3 * SECONDS)
    for one in everyone:
        one.end(processes.BYE)
    for connection in (one for connections in three[0] for one in connections.values()):
        connection.close()
    time.sleep(SECONDS)
    assert three[1] == [[], [], []]


@pytest.mark.parametrize(
    ("living", "messages", "printed", "quiet"),
    [
        ((0, 1), [], dict.fromkeys((0, 1), f"process 2 of 3 was not heard from for {SECONDS} s"), ()),
        (
            (0, 1, 2),
            [(1, processes.INTERRUPTED, ""), (0, processes.INTERRUPTED, "")],
            {2: "process 0 of 3 was interrupted"},
            (0, 1),
        ),
        ((0, 1, 2), [(2, processes.FAILED, "no scene")], dict.fromkeys((0, 1), "process 2 of 3 failed: no scene"), ()),
        ((0, 1, 2), [(0, processes.QUIT, "")], {1: "", 2: ""}, ()),
    ],
    ids=["silent", "interrupted", "failed", "quit"],
)
def test_the_end_of_a_process_is_reported_to_those_who_wait(three, monkeypatch, living, messages, printed, quiet):
    monkeypatch.setattr(processes, "INTERRUPTED_GRACE", SECONDS)
    everyone, ends = watched(three, living), three[1]
    for number, kind, reason in messages:
        everyone[number].end(kind, reason)
    until(lambda: all(ends[number] for number in printed))
    assert {number: ends[number] for number in printed} == {number: [reason] for number, reason in printed.items()}
    assert not any(ends[number] for number in quiet)


def test_the_command_to_go_on_names_devices_and_processes(tmp_path):
    run, path = RunFolder(tmp_path), tmp_path / "checkpoints" / "a2tg-gaussians-0000000001.npz"
    assert resuming_command(run) == f"a2tg train --out {tmp_path} --resume"
    path.parent.mkdir()
    path.write_bytes(b"damaged")
    assert resuming_command(run) == f"a2tg train --out {tmp_path} --resume"
    write_archive(path, {"devices": {"each": 4, "processes": 1}}, {})
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
    train = train_defaults(["--resume", "--out", str(run.path), "--coordinator", "h:1"])
    record = dataclasses.replace(train.record, scene=SceneSource(str(tmp_path)))
    train = dataclasses.replace(train, record=record, out=run.path)
    assert train.resumed(run, is_first=False).scene.path == str(tmp_path)
    with pytest.raises(ValueError, match=r"leave out .*, as it was trained on /there"):
        train.resumed(run)


def test_a_lack_of_memory_is_no_lost_connection():
    lost = ("Gloo all-reduce failed: Connection closed by peer", "NCCL operation failed", "UNAVAILABLE: task is gone")
    assert all(is_of_collectives(jax.errors.JaxRuntimeError(text)) for text in lost)
    assert is_of_collectives(ValueError(lost[0])) and not is_of_collectives(ValueError("no scene"))
    text = "RESOURCE_EXHAUSTED: Out of memory while trying to allocate 9 bytes."
    assert not is_of_collectives(jax.errors.JaxRuntimeError(text))


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
