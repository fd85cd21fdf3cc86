"""Trains on several processes of this machine and compares with one; kills and stops processes of trainings.

python tests/on_processes.py --processes 4           with gradients and more systems than `test_processes`
python tests/on_processes.py --losses                a process of a training is killed or stopped in every way

`test_processes` calls it with the number of one process, which it then is.
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
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest
from a2tg_jax.parallel.processes import LOST, ProcessPlace, joined
from a2tg_jax.parallel.sharded_rows import placed_like, spread
from jax.experimental import multihost_utils
from on_devices import custom_events_change_rows, rows_are_read_and_moved, scene, system
from test_pictures import write_scene

import a2tg_jax as a2tg
from a2tg_jax.data import decoding, photo_reading, photo_store
from a2tg_jax.systems.baselines import Gaussians2dMcmc
from a2tg_jax.training import Session, loop
from a2tg_jax.training.batches import BatchOrder, PhotoStore

SHARED = {"densify": {"cap": 120}}
SYSTEMS = {
    "a2tg": lambda length: system(
        a2tg.A2tg, **SHARED, texture={"at": (0.5,)}, stage1_iterations=length, stage2_iterations=length
    ),
    "streamed": lambda length: system(Gaussians2dMcmc, **SHARED, stage1_iterations=2 * length, batch_size=6),
}
"""The second one does not leave its photographs on the devices."""
SMALL = ("--system", "a2tg", "--preset", "smoke", "--downscale", "4", "--densify.cap", "60")
PRUNING = ("--floaters.min-views", "2", "--floaters.at", "0.25")
"""Options with which process 0 prunes for all."""
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


def pair(arguments, count=2):
    """Processes that run this script with some arguments and the place of each."""
    place = ["--coordinator", f"127.0.0.1:{free_port()}", "--num-processes", str(count), "--process-id"]
    return [started([__file__, *arguments, *place, str(number)]) for number in range(count)]


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


def fit(own, path, session, **options):
    """The result, and Adam's first moments after the first step, which are a tenth of its gradients."""
    first = []

    def keep(checkpoint):
        if checkpoint.stage == 0 and checkpoint.iteration == 1:
            first.append(jax.tree.map(np.array, checkpoint.state.moments.mu))
        if checkpoint.iteration == own.stages()[checkpoint.stage].iterations // 2 and path is not None:
            a2tg.save_checkpoint(path, checkpoint)

    result = a2tg.fit(scene(), own, progress=False, session=session, on_checkpoint=keep, checkpoint_every=1, **options)
    return result, first


def train(place, name, length, folder):
    """Train together, then on the first process alone, from the start and from the common checkpoint."""
    loop.LOG_EVERY = 1
    if name == "streamed":
        loop.PhotoStore = functools.partial(PhotoStore, room=0)
    own = SYSTEMS[name](length)
    with joined(place) as team:
        path = Path(folder) / "checkpoint.npz" if team.is_first else None
        together, first = fit(own, path, Session(devices=jax.devices()))
    if not team.is_first:
        return
    alone, expected = fit(own, None, None)
    np.testing.assert_allclose(together.history.loss[0], alone.history.loss[0], rtol=1e-5)
    for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(first), strict=True):
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-5 * max(np.abs(a).max(), 1e-9))
    assert together.model.num_bytes == alone.model.num_bytes
    checkpoint = a2tg.load_checkpoint(path)
    assert checkpoint.devices.processes == team.count
    resumed, _ = fit(own, None, None, resume=checkpoint)
    end, *others = (float(np.mean(result.history.psnr[-4:])) for result in (alone, together, resumed))
    assert all(abs(other - end) < 0.02 for other in others)
    print(f"{name}: {end:.3f} dB alone, {others[0]:.3f} by {team.count} processes", file=sys.stderr)


def read_own_photographs(place):
    """Read streamed batches of a view for each process, of which this one draws and reads its own alone."""
    read = []

    def counted(view):
        load = lambda: read.append(view.name) or view.image  # noqa: E731
        return dataclasses.replace(view, picture=dataclasses.replace(view.picture, read=load))

    views = a2tg.synthetic_scene(num_views=6, width=24, height=15, num_points=20).train
    order, exchange = BatchOrder(views, place.num_processes, 0), Session(devices=jax.devices()).exchange
    exchange = exchange.for_batches(place.num_processes)
    photographs = PhotoStore(tuple(map(counted, views)), order, 3, exchange, room=0)
    own = [views[order.indices(iteration)[place.process_id]] for iteration in (1, 2, 3)]
    for iteration, view in enumerate(own, 1):
        batch, places = photographs.batch(iteration)
        (part,) = batch.images.addressable_shards
        assert places is None and batch.images.shape == (place.num_processes, 15, 24, 3)
        np.testing.assert_array_equal(part.data, view.image[None])
    photographs.close()
    assert sorted(read) == sorted(view.name for view in own)


def read_own_share():
    """Read a scene together: each process decodes its share of the photographs, and the others when they are needed."""
    read = []

    def counted(file):
        read.append(file)
        return decoding.read_pixels(file)

    photo_reading.read_pixels = photo_store.read_pixels = counted
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write_scene(Path(folder), alpha=True)
        scene = a2tg.load_scene(folder, room=0, is_divided=True)
        assert len(read) == 6 // jax.process_count()
        alone = a2tg.load_scene(folder)
        for one, other in zip((*scene.train, *scene.test), (*alone.train, *alone.test), strict=True):
            np.testing.assert_array_equal(one.picture.read(), other.picture.read())


def change_rows():
    """Events on the host change what is spread over the processes as they change it on one device."""
    session = Session(devices=jax.devices())
    with pytest.raises(ValueError, match="the processes differ after a change of the model"):
        placed_like(np.full(4, jax.process_index()), spread(session.mesh, np.zeros(4)))
    rows_are_read_and_moved(session.exchange)
    custom_events_change_rows(session)


def wait(place, what):
    """Meet the other processes for ever, after sharing photographs and rows if that is asked for."""
    with joined(place) as team:
        team.advice = lambda: "go on"
        if what == "share":
            read_own_photographs(place)
            read_own_share()
            change_rows()
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
            took, printed = survivor_of(processes, victim, number, 5 * seconds)
            checkpoint = a2tg.load_checkpoint(sorted(out.glob("checkpoints/*.npz"))[-1])
            assert took < 3 * seconds
            print(victim, number.name, took, printed.splitlines()[-1], checkpoint)


def survivor_of(processes, victim, number, timeout):
    """Seconds until the other process has ended, and what it wrote to stderr."""
    os.kill(processes[victim].pid, number)
    at = time.perf_counter()
    printed = processes[1 - victim].communicate(timeout=timeout)[1]
    took = time.perf_counter() - at
    processes[victim].kill()
    processes[victim].communicate()
    assert processes[1 - victim].returncode == LOST, printed
    return took, printed


def main():
    parser = argparse.ArgumentParser()
    for name, default in {"what": "train", "system": "a2tg", "length": 120, "seconds": 60.0, "processes": 4}.items():
        parser.add_argument(f"--{name}", default=default, type=type(default))
    for name, kind in {"folder": str, "coordinator": str, "num-processes": int, "process-id": int}.items():
        parser.add_argument(f"--{name}", type=kind)
    parser.add_argument("--losses", action="store_true")
    args = parser.parse_args()
    if args.coordinator is not None:
        place = ProcessPlace(args.coordinator, args.num_processes, args.process_id, args.seconds)
        if args.what == "train":
            train(place, args.system, args.length, args.folder)
        else:
            wait(place, args.what)
    elif args.losses:
        losses()
    else:
        for name in SYSTEMS:
            with tempfile.TemporaryDirectory() as folder:
                arguments = ["--system", name, "--length", str(args.length), "--folder", folder]
                print(ended(pair(arguments, args.processes), 3600)[0])


if __name__ == "__main__":
    main()
