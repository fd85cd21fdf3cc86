"""Compositing of trained models in two checkouts, by turns: milliseconds of CPU time on one thread, and their ratio.

    python -m benchmarks.compositing RUN/models/NAME.npz … --against OTHER

OTHER is a checkout of an earlier version. A model is seen by the first camera of its training. The least of many calls
is compared, so that other programs on the machine hardly matter.
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
from a2tg_jax.rasterize.compositor import composite, list_tiles
from a2tg_jax.rasterize.splats import project_gaussians, settings_of_pass
from a2tg_jax.rasterize.tiles import TileGrid

PASSES = ("forward", "both")
CALLS = 5
"""Number of calls of a pass at a turn."""


def compositing_passes(model: a2tg_jax.Model) -> dict[str, Callable[[], object]]:
    """Return the forward pass, and the forward and backward pass, of a model in its first camera."""
    origin = model.origin
    if origin is None:
        raise ValueError("the model has no cameras")
    width, height = (int(size) for size in origin.sizes[0])
    camera = a2tg_jax.Camera(
        jnp.asarray(origin.viewmats[0], jnp.float32), jnp.asarray(origin.Ks[0], jnp.float32), width, height
    )
    settings = a2tg_jax.RenderSettings()
    grid = TileGrid(width, height, settings.tile_size)
    splats, cutoff = project_gaussians(
        model.gaussians, camera, model.appearance, settings.near_plane, settings.sh_degree
    )
    compositing, texels, regions = settings_of_pass(
        model.appearance, splats, grid, settings.near_plane, has_geometry=False, compositor="auto", tile_batch=None
    )
    lists = list_tiles("auto", splats.M, cutoff, settings.near_plane, grid, 64 * model.gaussians.num)
    if bool(lists.overflow):
        raise ValueError("the model has more pairs of Gaussians and tiles than expected")
    jacobian = camera.K @ camera.viewmat[:3, :3]
    probe = jnp.zeros((model.gaussians.num, 4))
    cotangent = jnp.asarray(np.random.default_rng(0).normal(size=(3, height, width)), jnp.float32)

    @jax.jit
    def forward(splats, texels):
        return composite(compositing, splats, texels, regions, cutoff, lists, jacobian, probe)[0]

    @jax.jit
    def both(splats, texels):
        return jax.vjp(forward, splats, texels)[1](cotangent)

    return {"forward": lambda: forward(splats, texels), "both": lambda: both(splats, texels)}


def serve() -> None:
    """Answer lines (path of a model, pass) with the least milliseconds of some calls."""
    passes: dict[str, dict[str, Callable[[], object]]] = {}
    for line in sys.stdin:
        path, name = json.loads(line)
        if path not in passes:
            passes[path] = compositing_passes(a2tg_jax.load_model(path))
            for function in passes[path].values():
                jax.block_until_ready(function())
        times = []
        for _ in range(CALLS):
            start = time.process_time()
            jax.block_until_ready(passes[path][name]())
            times.append(1e3 * (time.process_time() - start))
        print(min(times), flush=True)


def started(checkout: pathlib.Path) -> subprocess.Popen:
    """Return a process that serves with the library of a checkout."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "A2TG_NUM_THREADS": "1", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, str(pathlib.Path(__file__).resolve()), "--serve"]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment, cwd=checkout)


def asked(server: subprocess.Popen, path: pathlib.Path, name: str) -> float:
    assert server.stdin is not None and server.stdout is not None
    server.stdin.write(json.dumps([str(path.resolve()), name]) + "\n")
    server.stdin.flush()
    return float(server.stdout.readline())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", type=pathlib.Path)
    parser.add_argument("--against", type=pathlib.Path, default=pathlib.Path("."))
    parser.add_argument("--turns", type=int, default=10)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve:
        serve()
        return
    servers = [started(checkout.resolve()) for checkout in (args.against, pathlib.Path(__file__).parents[1])]
    for path in args.models:
        for name in PASSES:
            turns = [[asked(server, path, name) for server in servers] for _ in range(args.turns)]
            there, here = np.min(turns, axis=0)
            print(f"{path} {name}: {here:.2f} ms, there {there:.2f} ms, ratio {here / there:.2f}", flush=True)
    for server in servers:
        server.communicate()


if __name__ == "__main__":
    main()
