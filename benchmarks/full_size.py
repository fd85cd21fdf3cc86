"""Time and peak memory of one forward and backward pass at full size, on a random scene.

    python benchmarks/full_size.py --gaussians 300000 --width 1600 --height 1060
    python benchmarks/full_size.py --gaussians 20000 --width 640 --height 480 --texture-side 16

Means uniform in a unit cube seen from 1.5 away, scales log-uniform in [0.005, 0.03], opacities uniform in [0.1, 0.9],
SH degree 3, focal length 0.8 times the width, L1 against a fixed random image.
"""

import argparse
import json
import resource
import time

import jax
import jax.numpy as jnp
import numpy as np

import a2tg_jax


def random_scene(num: int, width: int, height: int, seed: int = 0):
    """Gaussians and a camera as the module says."""
    rng = np.random.default_rng(seed)
    opacities = rng.uniform(0.1, 0.9, num)
    gaussians = a2tg_jax.Gaussians(
        means=rng.uniform(-0.5, 0.5, (num, 3)),
        quats=rng.normal(size=(num, 4)),
        log_scales=rng.uniform(np.log(0.005), np.log(0.03), (num, 2)),
        logit_opacities=np.log(opacities / (1 - opacities)),
        sh=rng.normal(size=(num, 16, 3)) * 0.2,
    )
    viewmat = np.eye(4)
    viewmat[2, 3] = 1.5
    K = np.array([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
    as_float = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return jax.tree.map(as_float, gaussians), a2tg_jax.Camera(as_float(viewmat), as_float(K), width, height)


def seconds(function, *args, runs: int) -> float:
    """Median of several runs, compiled before."""
    jax.block_until_ready(function(*args))
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        jax.block_until_ready(function(*args))
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=300_000)
    parser.add_argument("--width", type=int, default=1600)
    parser.add_argument("--height", type=int, default=1060)
    parser.add_argument("--texture-side", type=int, default=0, help="every texture so large; 0: no textures")
    parser.add_argument("--runs", type=int, default=3)
    args = parser.parse_args()
    a2tg_jax.configure_cpu()

    gaussians, camera = random_scene(args.gaussians, args.width, args.height)
    textures, layout = None, None
    if args.texture_side:
        sizes = np.full((args.gaussians, 2), args.texture_side)
        textures, layout = a2tg_jax.allocate_textures(sizes)
    settings = a2tg_jax.plan_render(gaussians, camera, textures, layout)
    target = jax.random.uniform(jax.random.key(0), (args.height, args.width, 3))

    def image(gaussians, textures):
        return a2tg_jax.render_image(gaussians, camera, textures, layout, settings=settings).color

    def loss(gaussians, textures):
        return jnp.mean(jnp.abs(image(gaussians, textures) - target))

    forward = seconds(jax.jit(image), gaussians, textures, runs=args.runs)
    both = seconds(jax.jit(jax.grad(loss, argnums=(0, 1))), gaussians, textures, runs=args.runs)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    figures = {"forward_s": forward, "forward_backward_s": both, "peak_mb": peak, "capacity": settings.capacity}
    print(json.dumps({**vars(args), **figures}))


if __name__ == "__main__":
    main()
