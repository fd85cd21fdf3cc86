"""Mitsuba 3's Gaussian ellipsoids (`volprim_rf_basic`) on the random workload, for a Python that has Mitsuba.

    PYTHON_WITH_MITSUBA -m benchmarks.mitsuba '{"num": 10000, "width": 320, "height": 240, "threads": 1}'

The ellipsoids are the workload's Gaussians with a third scale of a tenth of the smaller one: Mitsuba has no flat ones.
It traces rays; one sample a pixel, L1 against a fixed random image, gradients for all of the ellipsoids' parameters.
"""

import json
import math
import os
import sys

import numpy as np

from benchmarks.arrays import random_image, random_splats
from benchmarks.timing import timed


def main() -> None:
    case = json.loads(sys.argv[1])
    if case.get("threads"):
        os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[: case["threads"]]))
    import drjit as dr  # type: ignore[import-not-found]
    import mitsuba as mi  # type: ignore[import-not-found]

    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(case.get("threads") or os.cpu_count())
    scene = load_scene(mi, case["num"], case["width"], case["height"])
    params = mi.traverse(scene)
    keys = [key for key in params.keys() if key.endswith(("data", "sh_coeffs", "opacities"))]  # noqa: SIM118
    target = mi.TensorXf(random_image(case["width"], case["height"]))

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

    figures = {"forward": timed(forward, least_runs=3), "both": timed(both, least_runs=3)}
    print(json.dumps({"version": mi.__version__, **figures}))


def load_scene(mi, num: int, width: int, height: int):
    """Return the workload of `benchmarks.arrays`."""
    splats = random_splats(num)
    quats = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    scales = np.concatenate([splats.scales, splats.scales.min(axis=1, keepdims=True) / 10], axis=1)
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
        "centers": tensor(splats.means),
        "scales": tensor(scales),
        "quaternions": tensor(np.roll(quats, -1, axis=1)),
        "opacities": tensor(splats.opacities[:, None]),
        "sh_coeffs": tensor(splats.sh.reshape(num, 48)),
    }
    integrator = {"type": "volprim_rf_basic", "max_depth": -1}
    return mi.load_dict({"type": "scene", "integrator": integrator, "camera": camera, "splats": ellipsoids})


if __name__ == "__main__":
    main()
