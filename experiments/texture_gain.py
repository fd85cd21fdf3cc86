"""What textures bring at equal Gaussians and equal training: a second stage with textures against one without.

Trains the first stage once per scene, number of Gaussians and seed, then both second stages from its result, and
appends one JSON line a run to the output: PSNR, SSIM and LPIPS on test and train views after each stage, seconds and
memory.

    python experiments/texture_gain.py SCENES/fox SCENES/snowmiku --gaussians 3000 7000 --seeds 0 1 --out gain.jsonl
"""

import argparse
import dataclasses
import json
import pathlib
import resource

import a2tg_jax
from a2tg_jax import A2tg
from a2tg_jax.startup import configure_cpu
from a2tg_jax.systems.gaussians_2d_mcmc import Gaussians2dMcmc
from a2tg_jax.systems.stage1 import McmcConfig
from a2tg_jax.training import StageResult, fit_stage, like


def main() -> None:
    args = parse_arguments()
    configure_cpu()
    for path in args.scenes:
        scene = a2tg_jax.load_scene(path, downscale=args.downscale)
        for num in args.gaussians:
            for seed in args.seeds:
                row = {"scene": scene.name, "gaussians": num, "seed": seed, **run_one(scene, num, seed, args)}
                with args.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")
                print_row(row)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=pathlib.Path)
    parser.add_argument("--gaussians", nargs="+", type=int, default=[3000, 7000])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--iterations", nargs=2, type=int, default=[2000, 1000], metavar=("STAGE1", "STAGE2"))
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--lpips-weights", type=pathlib.Path)
    parser.add_argument("--renders", type=pathlib.Path, help="a folder for the test views of each stage")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("texture_gain.jsonl"))
    return parser.parse_args()


def run_one(scene, num: int, seed: int, args: argparse.Namespace) -> dict:
    """Both second stages of one scene, size and seed."""
    textured = dataclasses.replace(
        A2tg.preset("quick"),
        stage1_iterations=args.iterations[0],
        stage2_iterations=args.iterations[1],
        seed=seed,
        densify=McmcConfig(cap=num),
    )
    plain = like(Gaussians2dMcmc, textured)
    first = fit_stage(scene, textured, 0, progress=False)
    results = {
        "stage1": first,
        "untextured": fit_stage(scene, plain, 1, first.model, progress=False),
        "textured": fit_stage(scene, textured, 1, first.model, progress=False),
    }
    name = f"{scene.name}-{num}-{seed}"
    row: dict = {phase: measure(scene, result, f"{name}-{phase}", args) for phase, result in results.items()}
    row["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return row


def measure(scene, result: StageResult, name: str, args: argparse.Namespace) -> dict:
    """Figures of one trained model."""
    figures: dict = {
        "num": result.model.num,
        "megabytes": result.model.num_bytes / 1e6,
        "seconds": result.seconds,
        "ms_per_step": median_step(result.history) * 1e3,
    }
    for split, views in (("test", scene.test), ("train", scene.train)):
        weights = args.lpips_weights
        found = a2tg_jax.evaluate(views, result.model, lpips_weights=weights, num_renders=len(scene.test))
        figures[split] = {"psnr": found.psnr, "ssim": found.ssim, "lpips": found.lpips}
        if split == "test" and args.renders is not None:
            save_renders(args.renders, name, found.renders)
    return figures


def median_step(history) -> float:
    """Median seconds of an iteration, from the logged times: compilation does not count."""
    seconds, iterations = history.seconds, history.iteration
    pace = sorted((seconds[1:] - seconds[:-1]) / (iterations[1:] - iterations[:-1]))
    return float(pace[len(pace) // 2]) if pace else float("nan")


def save_renders(folder: pathlib.Path, name: str, renders) -> None:
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    for index, image in enumerate(renders):
        Image.fromarray(image).save(folder / f"{name}-{index}.png")


def print_row(row: dict) -> None:
    test = {phase: row[phase]["test"]["psnr"] for phase in ("stage1", "untextured", "textured")}
    train = {phase: row[phase]["train"]["psnr"] for phase in ("stage1", "untextured", "textured")}
    gain = test["textured"] - test["untextured"]
    print(
        f"{row['scene']:16s} N {row['gaussians']:6d} seed {row['seed']}: test {test['stage1']:.2f} "
        f"-> {test['untextured']:.2f} untextured, {test['textured']:.2f} textured ({gain:+.2f} dB); "
        f"train {train['stage1']:.2f} -> {train['untextured']:.2f}, {train['textured']:.2f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
