"""Processes of this machine that train together, for `test_processes`; a process of a training is killed or stopped.

python tests/on_processes.py       a process of a training is killed or stopped in every way

`test_processes` calls it with the place of one process, which it then is.
"""

import argparse
import dataclasses
import functools
import itertools
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from jax.experimental import multihost_utils
from on_devices import attempted, close, plain, scene, system

import a2tg_jax as a2tg
from a2tg_jax import Gaussians2dMcmc, Session
from a2tg_jax.cli.processes import ProcessPlace, joined
from a2tg_jax.parallel import whole
from a2tg_jax.training import loop
from a2tg_jax.training.batches import PhotoStore
from a2tg_jax.training.loop import StageRun
from a2tg_jax.training.step import attempt

SMALL = ("--system", "a2tg", "--preset", "smoke", "--downscale", "4", "--densify.cap", "60")
PRUNING = ("--floaters.min-views", "2", "--floaters.at", "0.25")
"""Options with an event on the host."""
SHORT = (*SMALL, *PRUNING, "--texture.at", "0.5", "--stage1-iterations", "20", "--stage2-iterations", "10")
LONG = (*SMALL, "--stage1-iterations", "20000")


def free_port():
    """A port that nothing listens on."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def ipv6_loopback():
    """The loopback as trainings name it: by IPv6 where the machine has it."""
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6):
            return "[::1]"
    except OSError:
        return "127.0.0.1"


def pair(arguments):
    """Two processes that run this script with some arguments and the place of each."""
    place = ["--coordinator", f"127.0.0.1:{free_port()}", "--process-id"]
    return [started([__file__, *arguments, *place, str(number)]) for number in range(2)]


def trainings(out, flags, *own):
    """Processes of the command line that train together, each with some flags of its own."""
    words = ["-m", "a2tg_jax", "train", "synthetic", "--out", str(out), *flags]
    place = ["--coordinator", f"{ipv6_loopback()}:{free_port()}", "--num-processes", str(len(own)), "--process-id"]
    return [started([*words, *place, str(number), *each]) for number, each in enumerate(own)]


def started(arguments):
    command = [sys.executable, *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def ended(processes, timeout=600):
    """Text that processes write to stderr, once they have ended well; they are killed after some seconds."""
    try:
        printed = [process.communicate(timeout=timeout)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert all(process.returncode == 0 for process in processes), "\n".join(printed)[-5000:]
    return printed


def survivor_of(processes, victim, number, timeout):
    """Seconds until the other process has ended, its exit code, and what it wrote to stderr."""
    os.kill(processes[victim].pid, number)
    at = time.perf_counter()
    printed = processes[1 - victim].communicate(timeout=timeout)[1]
    took = time.perf_counter() - at
    processes[victim].kill()
    processes[victim].communicate()
    return took, processes[1 - victim].returncode, printed


def share():
    """A step has the gradients of one device; each process reads only the photographs that it draws."""
    read = []

    def counted(view):
        load = lambda: read.append(view.name) or view.image  # noqa: E731
        return dataclasses.replace(view, picture=dataclasses.replace(view.picture, read=load))

    own = system(Gaussians2dMcmc, densify={"cap": 120}, batch_size=2)
    expected = attempted(scene(), own, 0, plain(), 1, is_streamed=True)
    watched = dataclasses.replace(scene(), train=tuple(map(counted, scene().train)))
    loop.PhotoStore = functools.partial(PhotoStore, room=0)
    run = StageRun(watched, own, 0, plain(), session=Session(devices=jax.devices()))
    order = run.order.indices(1)
    batch, _ = run.photographs.batch(1)
    assert watched.train[order[jax.process_index()]].name in read
    assert batch.images.shape[0] == 2 and batch.images.addressable_shards[0].data.shape[0] == 1
    tried = whole(jax.jit(attempt, static_argnums=(0,))(*run.arguments(1)))
    close(expected, (tried.views, tried.grads, tried.state.model), 1e-6)
    run.photographs.close()
    others = {watched.train[run.order.indices(each)[1 - jax.process_index()]].name for each in range(1, 3)}
    mine = {watched.train[run.order.indices(each)[jax.process_index()]].name for each in range(1, 12)}
    assert not (others - mine) & set(read)


def wait(place, what):
    """Meet the other process for ever, after sharing a step if that is asked for."""
    with joined(place, lambda: "go on"):
        if what == "share":
            share()
        while True:
            multihost_utils.process_allgather(np.zeros(1))
            print("met", flush=True)
            time.sleep(0.02)


def losses(seconds=8.0):
    """A process of a training is killed or stopped: the other one ends in time, and the checkpoint can be read."""
    for victim, number in itertools.product((0, 1), (signal.SIGKILL, signal.SIGSTOP)):
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "run"
            processes = trainings(out, (*LONG, "--heartbeat-timeout-seconds", str(seconds)), (), ())
            while not list(out.glob("checkpoints/*.npz")):
                assert all(process.poll() is None for process in processes)
                time.sleep(0.1)
            took, code, printed = survivor_of(processes, victim, number, 10 * seconds)
            checkpoint = a2tg.load_checkpoint(sorted(out.glob("checkpoints/*.npz"))[-1])
            print(victim, number.name, took, code, printed.splitlines()[-1], checkpoint)
            assert code != 0 and took < 5 * seconds


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--what", default="wait")
    parser.add_argument("--coordinator")
    parser.add_argument("--process-id", type=int)
    args = parser.parse_args()
    if args.coordinator is None:
        losses()
    else:
        wait(ProcessPlace(args.coordinator, 2, args.process_id, 10.0), args.what)


if __name__ == "__main__":
    main()
