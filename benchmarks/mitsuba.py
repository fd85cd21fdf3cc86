"""Mitsuba 3's Gaussian ellipsoids (`volprim_rf_basic`) on the random workload, for a Python that has Mitsuba.

    PYTHON_WITH_MITSUBA -m benchmarks.mitsuba '{"num": 10000, "width": 320, "height": 240, "threads": 1}'

The ellipsoids are the workload's Gaussians with a third scale of a tenth of the smaller one: Mitsuba has no flat ones.
It traces rays; one sample a pixel, L1 against a fixed random image, gradients for all of the ellipsoids' parameters.
"""

import json
import math
import os
import sys
import time

import numpy as np


def main() -> None:
    case = json.loads(sys.argv[1])
    if case.get("threads"):
        os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[: case["threads"]]))
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(case.get("threads") or os.cpu_count())
    scene = load_scene(mi, case["num"], case["width"], case["height"])
    params = mi.traverse(scene)
    keys = [key for key in params.keys() if key.endswith(("data", "sh_coeffs", "opacities"))]  # noqa: SIM118
    target = mi.TensorXf(np.random.default_rng(3).uniform(size=(case["height"], case["width"], 3)).astype(np.float32))

    def forward():
        with dr.suspend_grad():
            dr.eval(mi.render(scene, spp=1))
        dr.sync_thread()

    def both():
        for key in keys:
            dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(dr.abs(mi.render(scene, params, spp=1) - target), axis=None))
        dr.eval([dr.grad(params[key]) for key in keys])
        dr.sync_thread()

    figures = {"forward": timed(forward), "both": timed(both)}
    print(json.dumps({"case": "mitsuba", "mitsuba": mi.__version__, **case, **figures}))


def load_scene(mi, num: int, width: int, height: int):
    """The workload of `benchmarks.workload.random_scene`, drawn by the same generator."""
    rng = np.random.default_rng(0)
    opacities = rng.uniform(0.1, 0.9, num)
    means = rng.uniform(-0.5, 0.5, (num, 3))
    quats = rng.normal(size=(num, 4))
    scales = np.exp(rng.uniform(np.log(0.005), np.log(0.03), (num, 2)))
    sh = rng.normal(size=(num, 16, 3)) * 0.2
    tensor = lambda x: mi.TensorXf(np.ascontiguousarray(x, np.float32))  # noqa: E731
    camera = {
        "type": "perspective",
        "fov": 2 * math.degrees(math.atan(0.5 / 0.8)),
        "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, -1.5], target=[0, 0, 0], up=[0, -1, 0]),
        "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent"},
    }
    ellipsoids = {
        "type": "ellipsoids",
        "centers": tensor(means),
        "scales": tensor(np.concatenate([scales, scales.min(axis=1, keepdims=True) / 10], axis=1)),
        "quaternions": tensor(np.roll(quats / np.linalg.norm(quats, axis=1, keepdims=True), -1, axis=1)),
        "opacities": tensor(opacities[:, None]),
        "sh_coeffs": tensor(sh.reshape(num, 48)),
    }
    integrator = {"type": "volprim_rf_basic", "max_depth": -1}
    return mi.load_dict({"type": "scene", "integrator": integrator, "camera": camera, "splats": ellipsoids})


def timed(function) -> dict[str, float]:
    """Seconds of the first call, and the median and least milliseconds of the following ones."""
    start = time.perf_counter()
    function()
    first, times = time.perf_counter() - start, []
    while len(times) < 3 or (sum(times) < 2.0 and len(times) < 20):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return {"first_s": first, "ms": float(np.median(times)) * 1e3, "least_ms": min(times) * 1e3}


if __name__ == "__main__":
    main()
