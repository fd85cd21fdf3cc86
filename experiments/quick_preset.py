"""What short runs want: the preset `quick` of A²TG with the numbers of the paper, with its own, and with all but one.

Writes one JSON object, "scene/variant" → figures on the test views, and goes on where it stopped.

    python experiments/quick_preset.py SCENES/fox SCENES/lego --lpips-weights lpips_alex.npz --out quick.json
"""

import argparse
import dataclasses
import pathlib

import a2tg_jax as a2tg
from a2tg_jax.results.folder import read_json, write_json

QUICK = a2tg.A2tg.preset("quick")
PAPER = {
    "opacity": {"initial_opacity": 0.1},
    "means": {"rates": dataclasses.replace(QUICK.rates, means=a2tg.LearningRates().means)},
    "sh0": {"rates": dataclasses.replace(QUICK.rates, sh_degree0=a2tg.LearningRates().sh_degree0)},
    "texels": {"texture": a2tg.TextureConfig()},
}
"""The paper's value of each number that the preset changes."""
VARIANTS = {
    "base": {"initial_opacity": 0.1, "rates": a2tg.LearningRates(), "texture": a2tg.TextureConfig()},
    "all": {},
    **{f"all-no-{name}": change for name, change in PAPER.items()},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=pathlib.Path)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--lpips-weights", type=pathlib.Path)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("quick.json"))
    args = parser.parse_args()
    a2tg.configure_cpu()
    done = read_json(args.out) if args.out.is_file() else {}
    for variant, changes in VARIANTS.items():
        for path in args.scenes:
            key = f"{path.name}/{variant}"
            if key not in done:
                done[key] = figures(a2tg.load_scene(path, downscale=args.downscale), changes, args.lpips_weights)
                write_json(args.out, done)
                print(key, done[key], flush=True)


def figures(scene: a2tg.Scene, changes: dict, lpips_weights: pathlib.Path | None) -> dict:
    """Trains one variant and measures both its stages on the test views."""
    is_transparent = scene.train[0].alpha is not None
    system = dataclasses.replace(QUICK, background="white" if is_transparent else "black", **changes)
    result = a2tg.fit(scene, system, progress=False)
    first = a2tg.evaluate(scene.test, result.stages[0].model)
    last = a2tg.evaluate(scene.test, result.model, lpips_weights=lpips_weights)
    return {
        "stage1": first.psnr, "psnr": last.psnr, "ssim": last.ssim, "lpips": last.lpips, "num": result.model.num,
        "mb": result.model.num_bytes / 1e6, "s": result.seconds,
    }  # fmt: skip


if __name__ == "__main__":
    main()
