"""gsplat's 2D Gaussians (`rasterization_2dgs`) on the random workload, for a Python that has gsplat.

    PYTHON_WITH_GSPLAT -m benchmarks.gsplat '{"num": 100000, "width": 1600, "height": 1060}'

Needs an NVIDIA GPU, PyTorch for CUDA and gsplat 1.4 or 1.5 (pip install torch gsplat; gsplat compiles its kernels at
first use and needs nvcc for that, unless its wheel was built for this PyTorch). L1 against a fixed random image,
gradients for all of the Gaussians' parameters.
"""

import functools
import json
import sys

import gsplat  # type: ignore[import-not-found]
import torch  # type: ignore[import-not-found]

from benchmarks import timing
from benchmarks.arrays import camera_matrices, random_image, random_splats

timed = functools.partial(timing.timed, wait=lambda _: torch.cuda.synchronize())


def main() -> None:
    case = json.loads(sys.argv[1])
    width = case["width"]
    height = case["height"]
    splats = random_splats(case["num"])
    # Flat Gaussians have no third scale; gsplat wants one and does not use it.
    scales = splats.scales[:, [0, 1, 1]]
    parameters = [on_gpu(x).requires_grad_() for x in (splats.means, splats.quats, scales, splats.opacities, splats.sh)]
    viewmat, K = (on_gpu(matrix)[None] for matrix in camera_matrices(width, height))
    target = on_gpu(random_image(width, height))

    def image():
        return gsplat.rasterization_2dgs(*parameters, viewmat, K, width, height, near_plane=0.2, sh_degree=3)[0][0]

    def both():
        return torch.autograd.grad((image() - target).abs().mean(), parameters)

    figures = {
        "version": gsplat.__version__,
        "torch": torch.__version__,
        "forward": timed(torch.no_grad()(image)),
        "both": timed(both),
        "device_peak_mb": torch.cuda.max_memory_allocated() / 1e6,
    }
    print(json.dumps(figures))


def on_gpu(array) -> torch.Tensor:
    return torch.as_tensor(array, dtype=torch.float32, device="cuda")


if __name__ == "__main__":
    main()
