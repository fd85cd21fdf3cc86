"""Many small views of one model: `vmap` and a loop of jitted calls, with gradients and without, by turns.

    python -m benchmarks.many_views                                        # 64 views of 64×64 of 10,000 Gaussians
    python -m benchmarks.many_views --views 8 --size 128 --against OTHER   # OTHER is a checkout of an earlier version

Milliseconds of a whole batch, and CPU time of all threads, each the least of several turns. Ratios are of both.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import a2tg_jax
from benchmarks.workload import random_scene

WAYS = ("vmap gradients", "loop gradients", "vmap render", "loop render")


def programs(num_views: int, size: int, num: int) -> dict[str, Callable[[], object]]:
    """Return the calls of `WAYS`."""
    gaussians, camera = random_scene(num, size, size)
    shifts = 0.1 * np.random.default_rng(0).normal(size=(num_views, 3))
    viewmats = [camera.viewmat.at[:3, 3].add(jnp.asarray(shift, jnp.float32)) for shift in shifts]
    stacked = jnp.stack(viewmats)
    cameras = [a2tg_jax.Camera(viewmat, camera.K, size, size) for viewmat in viewmats]
    settings = a2tg_jax.plan_render(gaussians, cameras)

    def loss(gaussians: a2tg_jax.Gaussians, viewmat: jax.Array) -> jax.Array:
        view = a2tg_jax.Camera(viewmat, camera.K, size, size)
        return jnp.mean((a2tg_jax.render_image(gaussians, view, settings=settings).color - 0.5) ** 2)

    losses = jax.vmap(loss, in_axes=(None, 0))
    of_views = jax.jit(jax.value_and_grad(lambda gaussians: jnp.sum(losses(gaussians, stacked))))
    of_view = jax.jit(jax.value_and_grad(loss))
    render_views = jax.jit(losses)
    render_view = jax.jit(loss)
    add = jax.jit(lambda total, more: jax.tree.map(jnp.add, total, more))

    def loop() -> object:
        total = of_view(gaussians, viewmats[0])
        for viewmat in viewmats[1:]:
            total = add(total, of_view(gaussians, viewmat))
        return total

    calls = (
        lambda: of_views(gaussians),
        loop,
        lambda: render_views(gaussians, stacked),
        lambda: [render_view(gaussians, viewmat) for viewmat in viewmats],
    )
    return dict(zip(WAYS, calls, strict=True))


def serve(*sizes: int) -> None:
    """Answer lines with a way by the milliseconds of one call, and of its CPU time."""
    calls = programs(*sizes)
    for call in calls.values():
        jax.block_until_ready(call())
    for line in sys.stdin:
        call = calls[json.loads(line)]
        cpu = time.process_time()
        start = time.perf_counter()
        jax.block_until_ready(call())
        print(json.dumps([1e3 * (time.perf_counter() - start), 1e3 * (time.process_time() - cpu)]), flush=True)


def started(checkout: pathlib.Path, sizes: list[str]) -> subprocess.Popen:
    """Return a process that serves with the library of a checkout."""
    here = pathlib.Path(__file__).resolve().parents[1]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(checkout), str(here)])}
    command = [sys.executable, __file__, "--serve", *sizes]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)


def asked(server: subprocess.Popen, way: str) -> list[float]:
    assert server.stdin is not None and server.stdout is not None
    server.stdin.write(json.dumps(way) + "\n")
    server.stdin.flush()
    return json.loads(server.stdout.readline())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=64)
    parser.add_argument("--size", type=int, default=64, help="width and height of an image")
    parser.add_argument("--gaussians", type=int, default=10_000)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--against", type=pathlib.Path, help="checkout of another version")
    parser.add_argument("--serve", type=int, nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve:
        serve(*args.serve)
        return
    checkouts = [pathlib.Path(__file__).parents[1], *([args.against] if args.against else [])]
    sizes = [str(number) for number in (args.views, args.size, args.gaussians)]
    servers = [started(checkout.resolve(), sizes) for checkout in checkouts]
    turns = [[[asked(server, way) for way in WAYS] for server in servers] for _ in range(args.turns)]
    least = np.min(turns, axis=0)
    for checkout, of_checkout in zip(checkouts, least, strict=True):
        for way, (wall, cpu) in zip(WAYS, of_checkout, strict=True):
            wall_ratio, cpu_ratio = of_checkout[WAYS.index(f"loop {way.split()[1]}")] / (wall, cpu)
            loop = f"the loop takes {wall_ratio:.2f} and {cpu_ratio:.2f} times as long"
            print(f"{checkout} {way}: {wall:.0f} ms, CPU {cpu:.0f} ms; {loop}")
    if args.against:
        for way, here, there in zip(WAYS, *least, strict=True):
            wall_ratio, cpu_ratio = there / here
            print(f"{way}: {args.against} takes {wall_ratio:.2f} and {cpu_ratio:.2f} times as long")
    for server in servers:
        server.communicate()


if __name__ == "__main__":
    main()
