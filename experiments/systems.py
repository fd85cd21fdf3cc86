"""Every built-in system at the bytes of A²TG: its quality on the test views, its size, and the time of a step.

A²TG trains first, with as many Gaussians as are asked for; the others get as many splats as fit in the bytes that it
ends with. Writes one JSON object, "scene/system" → figures, and goes on where it stopped.

    python experiments/systems.py SCENES/fox synthetic --gaussians 5000 --lpips-weights lpips_alex.npz
"""

import argparse
import pathlib

import numpy as np

import a2tg_jax as a2tg
from a2tg_jax.appearance.base import BYTES_PER_FLOAT
from a2tg_jax.results.folder import read_json, write_json
from a2tg_jax.results.record import SceneSource
from a2tg_jax.training.registry import SYSTEMS, with_changes

FLOATS = {"textured-gaussians": 58 + 64, "supergaussians": 85, "bbsplat": 1_081}
"""Of a splat, where it is not the 58 of a plain Gaussian."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", help='scene folders, or "synthetic"')
    parser.add_argument("--gaussians", type=int, default=5_000)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--lpips-weights", type=pathlib.Path)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("systems.json"))
    args = parser.parse_args()
    a2tg.configure_cpu()
    done = read_json(args.out) if args.out.is_file() else {}
    for path in args.scenes:
        scene = SceneSource(path, 1 if path == "synthetic" else args.downscale).load()
        cap = args.gaussians
        for name in SYSTEMS:
            key = f"{scene.name}/{name}"
            if key not in done:
                done[key] = figures(scene, name, cap, args.lpips_weights)
                write_json(args.out, done)
                print(key, done[key], flush=True)
            num_bytes = 1e6 * done[f"{scene.name}/a2tg"]["mb"]
            following = [*SYSTEMS, ""][list(SYSTEMS).index(name) + 1]
            cap = int(num_bytes // (BYTES_PER_FLOAT * FLOATS.get(following, 58)))


def figures(scene: a2tg.Scene, name: str, cap: int, lpips_weights: pathlib.Path | None) -> dict:
    """Trains one system and measures it."""
    system = with_changes(type(a2tg.find_system(name)).preset("quick"), {"densify": {"cap": cap}}, name)
    result = a2tg.fit(scene, system, progress=False)
    found = a2tg.evaluate(scene.test, result.model, lpips_weights=lpips_weights)
    return {
        "psnr": found.psnr, "ssim": found.ssim, "lpips": found.lpips, "num": result.model.num,
        "mb": result.model.num_bytes / 1e6, "published_mb": result.model.num_published_bytes / 1e6,
        "ms_per_step": [milliseconds(stage.history) for stage in result.stages], "seconds": result.seconds,
    }  # fmt: skip


def milliseconds(history: a2tg.History) -> float:
    """Median time of a step, compilation left out by the median."""
    return 1e3 * float(np.median(np.diff(history.seconds) / np.diff(history.iteration)))


if __name__ == "__main__":
    main()
