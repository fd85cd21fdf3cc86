"""Photographs read ahead of the step from object storage that takes its time: loading and training, and what they wait.

    python -m benchmarks.remote_scene --out benchmarks/results/remote_scene.json

A scene is trained on from a folder and from fsspec's file system in memory, each request of which sleeps. No photograph
has room in memory. Steps that compile are left out.
"""

import argparse
import json
import pathlib
import tempfile
import time

import fsspec

import a2tg_jax
from a2tg_jax.training.batches import PhotoStore
from benchmarks.large_scene import write_scene

STORE = "/bucket/scene"
WARM_UP = 12
"""Iterations that are not timed: they compile."""


class Timed:
    """`PhotoStore.batch` with the seconds that steps have waited for photographs."""

    def __init__(self) -> None:
        self.waited, self.started, self._batch = 0.0, 0.0, PhotoStore.batch
        PhotoStore.batch = lambda store, iteration: self._wait(store, iteration)  # type: ignore[method-assign]

    def _wait(self, store: PhotoStore, iteration: int):
        if iteration == WARM_UP + 1:
            self.waited, self.started = 0.0, time.perf_counter()
        before = time.perf_counter()
        batch = self._batch(store, iteration)
        self.waited += time.perf_counter() - before
        return batch


def delay_requests(seconds: float) -> None:
    """Have each request of fsspec's file system in memory take a while."""
    kind = type(fsspec.filesystem("memory"))
    for name in ("ls", "info", "cat_file"):
        ask = getattr(kind, name)

        def asked(*args, ask=ask, **kwargs):
            time.sleep(seconds)
            return ask(*args, **kwargs)

        setattr(kind, name, asked)


def measure(where: str, timed: Timed, session: a2tg_jax.Session, iterations: int) -> dict[str, float]:
    """Return the seconds of loading, and of the steps and of waiting for photographs in milliseconds a step."""
    start = time.perf_counter()
    scene = a2tg_jax.load_scene(where, room=0)
    loaded = time.perf_counter() - start
    system = a2tg_jax.Gaussians2dMcmc(stage1_iterations=WARM_UP + iterations, densify=a2tg_jax.Mcmc(cap=2000))
    a2tg_jax.fit(scene, system, progress=False, session=session)
    step = (time.perf_counter() - timed.started) / iterations
    return {"load_seconds": loaded, "step_ms": 1e3 * step, "waited_ms": 1e3 * timed.waited / iterations}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("remote_scene.json"))
    parser.add_argument("--photographs", type=int, default=48)
    parser.add_argument("--size", type=int, nargs=2, default=(600, 400), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--iterations", type=int, default=50)
    parser.add_argument("--latency", type=float, default=0.02, help="seconds of each request")
    args = parser.parse_args()
    a2tg_jax.configure_cpu()
    timed, session = Timed(), a2tg_jax.Session()
    with tempfile.TemporaryDirectory() as folder:
        here = f"{folder}/scene"
        write_scene(pathlib.Path(here), args.photographs, *args.size)
        fsspec.filesystem("memory").put(f"{here}/", f"{STORE}/", recursive=True)
        delay_requests(args.latency)
        measure(here, timed, session, args.iterations)
        places = {"folder": here, "store": f"memory:/{STORE}"}
        found = {name: measure(where, timed, session, args.iterations) for name, where in places.items()}
    told = {"photographs": args.photographs, "size": args.size, "iterations": args.iterations, "latency": args.latency}
    args.out.write_text(json.dumps(told | found, indent=1) + "\n")
    print(args.out.read_text())


if __name__ == "__main__":
    main()
