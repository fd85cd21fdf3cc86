"""One case, measured in a process of its own, so that its peak memory and its compilation are its own.

    python -m benchmarks.measure '{"case": "render", "num": 10000, "width": 320, "height": 240, "textures": "mixed"}'

prints a line of JSON. Times are in milliseconds, medians over several warm runs.
"""

import json
import os
import resource
import sys
import time
from collections.abc import Callable


def main() -> None:
    case = json.loads(sys.argv[1])
    if case.get("threads"):
        os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[: case["threads"]]))
    import a2tg_jax

    a2tg_jax.configure_cpu(use_cache=False)
    figures = CASES[case["case"]](case)
    figures["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(json.dumps({**case, **figures}))


def timed(function: Callable, *args, runs: int | None = None) -> dict[str, float]:
    """Seconds of the first call, and the median and least milliseconds of the following ones."""
    import jax
    import numpy as np

    start = time.perf_counter()
    jax.block_until_ready(function(*args))
    first = time.perf_counter() - start
    times = []
    while len(times) < (runs or 5) or (runs is None and sum(times) < 1.0 and len(times) < 40):
        start = time.perf_counter()
        jax.block_until_ready(function(*args))
        times.append(time.perf_counter() - start)
    return {"first_s": first, "ms": float(np.median(times)) * 1e3, "least_ms": min(times) * 1e3}


def measure_render(case: dict) -> dict:
    """Forward, and forward with backward, of the random workload with L1 against a fixed random image."""
    import jax
    import jax.numpy as jnp

    import a2tg_jax
    from a2tg_jax.render import appearance_of, render_traced
    from benchmarks.workload import random_scene, random_textures

    num, width, height = case["num"], case["width"], case["height"]
    gaussians, camera = random_scene(num, width, height)
    textures, layout = random_textures(num, case.get("textures", "none"))
    settings = a2tg_jax.RenderSettings(compositor=case.get("compositor", "auto"), tile_size=case.get("tile_size", 8))
    settings = a2tg_jax.plan_render(gaussians, camera, textures, layout, settings=settings)
    target = jax.random.uniform(jax.random.key(0), (height, width, 3))

    def image(gaussians, textures, tap=None):
        rule = appearance_of(gaussians, textures, layout, settings)
        return render_traced(gaussians, camera, rule, jnp.zeros(3), settings, has_geometry=False, tap=tap)[0].color

    def loss(gaussians, textures, tap=None):
        return jnp.mean(jnp.abs(image(gaussians, textures, tap) - target))

    forward = timed(jax.jit(image), gaussians, textures)
    if case.get("forward_only"):
        return {"forward": forward}
    tap = jnp.zeros((num, 4))
    _, counts = jax.jit(jax.value_and_grad(loss, argnums=2))(gaussians, textures, tap)
    return {
        "forward": forward,
        "both": timed(jax.jit(jax.grad(loss, argnums=(0, 1))), gaussians, textures),
        "composited_pairs": float(counts[:, 3].sum()),
    }


def measure_stages(case: dict) -> dict:
    """Each stage of a training step apart, on the random workload."""
    import jax
    import jax.numpy as jnp

    import a2tg_jax
    from a2tg_jax.compositor import Compositing, composite
    from a2tg_jax.kernels import native
    from a2tg_jax.optim import adam_init, adam_update
    from a2tg_jax.render import _project, appearance_of
    from a2tg_jax.tiles import TileGrid
    from benchmarks.workload import random_scene, random_textures

    num, width, height = case["num"], case["width"], case["height"]
    gaussians, camera = random_scene(num, width, height)
    textures, layout = random_textures(num, case.get("textures", "none"))
    settings = a2tg_jax.plan_render(gaussians, camera, textures, layout)
    rule, grid = appearance_of(gaussians, textures, layout, settings), TileGrid(width, height, settings.tile_size)
    project = jax.jit(lambda gaussians: _project(gaussians, camera, rule, settings, 3, None))
    splats, bounds = project(gaussians)
    depths = splats.M[:, 2, 2]
    find_lists = jax.jit(lambda bounds, depths: native.tile_lists(bounds, depths, grid, settings.capacity))
    lists = find_lists(bounds, depths)
    how = Compositing(grid, settings.near_plane, False, False, "native", 1)
    jacobian, tap = camera.K @ camera.viewmat[:3, :3], jnp.zeros((num, 4))

    def colors(splats, rule):
        return composite(how, splats, rule, lists, jacobian, tap)[0]

    def all_of_it(splats, rule):
        _, pull_back = jax.vjp(colors, splats, rule)
        return pull_back(jnp.ones((3, height, width)))

    def project_gradient(gaussians):
        splats, pull_back = jax.vjp(lambda gaussians: project(gaussians)[0], gaussians)
        return pull_back(splats)

    image, target = (jax.random.uniform(jax.random.key(k), (height, width, 3)) for k in (0, 1))
    moments = adam_init(gaussians)
    adam = jax.jit(lambda gaussians, moments: adam_update(gaussians, gaussians, moments, 1e-3))
    return {
        "projection": timed(project, gaussians),
        "projection, forward and backward": timed(jax.jit(project_gradient), gaussians),
        "tile lists": timed(find_lists, bounds, depths),
        "compositing": timed(jax.jit(colors), splats, rule),
        "compositing, forward and backward": timed(jax.jit(all_of_it), splats, rule),
        "loss, value and gradient": timed(jax.jit(jax.value_and_grad(a2tg_jax.photometric_loss)), image, target),
        "Adam": timed(adam, gaussians, moments),
        "pairs": {"ms": float(lists.starts[-1]) * settings.tile_size**2},
    }


def measure_training(case: dict) -> dict:
    """Warm steps of both stages on a real scene: median milliseconds, compilation apart."""
    import dataclasses

    import numpy as np

    import a2tg_jax

    scene = a2tg_jax.load_scene(case["scene"], downscale=case["downscale"])
    config = dataclasses.replace(
        a2tg_jax.TrainConfig.quick(),
        stage1_iterations=case["iterations"],
        stage2_iterations=case["iterations"],
        densify=a2tg_jax.DensifyConfig(cap=case["num"]),
    )

    def pace(result, share: slice) -> float:
        history = result.history
        steps = np.diff(history.seconds) / np.diff(history.iteration)
        return float(np.median(steps[share])) * 1e3

    first = a2tg_jax.fit_stage1(scene, config, progress=False)
    plain = dataclasses.replace(config, texture=dataclasses.replace(config.texture, is_enabled=False))
    untextured = a2tg_jax.fit_stage2(scene, first.gaussians, plain, progress=False)
    textured = a2tg_jax.fit_stage2(scene, first.gaussians, config, progress=False)
    height, width = scene.train[0].image.shape[:2]
    late = slice(-(case["iterations"] // 20), None)
    return {
        "image": [width, height],
        "num_live": first.gaussians.num,
        "stage1_ms": pace(first, late),
        "untextured_ms": pace(untextured, late),
        "textured_ms": pace(textured, late),
    }


def measure_limit(case: dict) -> dict:
    """How long the processor takes for a number of multiply-adds and one exp per pixel and splat, and nothing else."""
    import concurrent.futures

    import jax
    import jax.numpy as jnp
    import numpy as np
    from llvmlite import ir

    from a2tg_jax.kernels import lanes, library
    from a2tg_jax.kernels.writer import LONG, Writer

    module, width = ir.Module("limit"), library.vector_bytes() // 4
    writer = Writer(module, "limit", ("data",), ("num",), "float32")
    at = lanes.Lanes(writer.b, width)
    reals = at.vector(writer.real)
    number = jax.ShapeDtypeStruct((), jnp.float32)

    def work(x, y):
        sums = [x, y, x + 1, y + 1, x + 2, y + 2, x + 3, y + 3]
        for k in range(case["multiply_adds"]):
            sums[k % 8] = sums[k % 8] * y + x
        return sum(sums) * 1e-3 + jnp.exp(x)

    traced, _ = lanes.trace(work, number, number)
    total = writer.variable(reals)
    writer.b.store(at.constant(0.0, writer.real), total)
    x, y = (writer.load(writer.arguments["data"], k, reals) for k in range(2))
    with writer.loop(LONG(0), writer.long(writer.arguments["num"])) as (k, _):
        moved = writer.b.fadd(x, at.splat(writer.b.sitofp(k, writer.real)))
        (result,) = at.emit(traced, [moved, y])
        writer.b.store(writer.b.fadd(result, writer.b.load(total, typ=reals)), total)
    writer.store(writer.b.load(total, typ=reals), writer.arguments["data"], 0)
    writer.b.ret_void()
    run = library.as_function(library.compile_module(module)["limit"], 1, 1)
    threads = len(os.sched_getaffinity(0))
    pool = concurrent.futures.ThreadPoolExecutor(threads)
    vectors = int(case["pairs"] / width / threads)

    def everywhere():
        data = [np.full(2 * width, 0.5, np.float32) for _ in range(threads)]
        list(pool.map(lambda own: run(own.ctypes.data, vectors), data))

    return {"limit": timed(everywhere)}


CASES = {
    "render": measure_render,
    "stages": measure_stages,
    "training": measure_training,
    "limit": measure_limit,
}

if __name__ == "__main__":
    main()
