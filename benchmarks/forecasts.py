"""Forecast and measured memory of `a2tg train`: ten configurations, each in a process of its own.

    python -m benchmarks.forecasts --scenes SCENES --out benchmarks/results/forecasts.json

SCENES holds the folders fox, herz_jesus_p25, lego and snowmiku. Each case starts with an empty
cache, as a first run does. A table is printed.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile

from a2tg_jax.cli import main as cli
from a2tg_jax.results.forecast import forecast_run
from benchmarks.large_scene import write_scene
from benchmarks.timing import memory_peak
from experiments.lab import markdown

SHORT = ("--stage1-iterations", "20", "--stage2-iterations", "20")
CASES: dict[str, tuple[str, ...]] = {
    "synthetic, a2tg": ("synthetic", "--system", "a2tg", "--preset", "smoke", *SHORT),
    "synthetic, gaussians-2d, 200,000 rows": (
        "synthetic", "--system", "gaussians-2d", "--preset", "smoke", "--densify.cap", "200000", *SHORT,
    ),
    "fox, a2tg, texture side 8": (
        "fox", "--system", "a2tg", "--preset", "smoke", "--densify.cap", "20000", "--initial-gaussians", "20000",
        "--texture.cap", "8", *SHORT,
    ),
    "fox / 2, bbsplat": ("fox", "--downscale", "2", "--system", "bbsplat", "--preset", "smoke", *SHORT),
    "herz_jesus_p25, supergaussians": (
        "herz_jesus_p25", "--system", "supergaussians", "--preset", "smoke", "--densify.cap", "50000", *SHORT,
    ),
    "herz_jesus_p25, a2tg, batches of 8, normals": (
        "herz_jesus_p25", "--system", "a2tg", "--preset", "smoke", "--batch-size", "8", "--loss.normal-weight", "0.05",
        *SHORT,
    ),
    "lego / 2, textured-gaussians": (
        "lego", "--downscale", "2", "--system", "textured-gaussians", "--preset", "smoke", "--initial-gaussians",
        "10000", "--densify.cap", "10000", *SHORT,
    ),
    "snowmiku, gaussians-2d-mcmc, batches of 4": (
        "snowmiku", "--system", "gaussians-2d-mcmc", "--preset", "smoke", "--batch-size", "4", *SHORT,
    ),
    "snowmiku / 2, bytewise in 2 MB": (
        "snowmiku", "--downscale", "2", "--system", "bytewise", "--preset", "smoke", "--memory-budget", "2MB",
        "--initial-gaussians", "20000", *SHORT,
    ),
    "6 written photographs of 6000×4000 / 2, gaussians-2d-mcmc": (
        "written", "--downscale", "2", "--test-every", "6", "--system", "gaussians-2d-mcmc", "--preset", "smoke",
        "--stage1-iterations", "4", "--stage2-iterations", "0",
    ),
}  # fmt: skip
"""Arguments of `a2tg train`."""


def measure(name: str, scenes: pathlib.Path, folder: pathlib.Path) -> int:
    """Return the peak memory of one case's process, in bytes."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder / f"cache-{len(os.listdir(folder))}")}
    command = [sys.executable, "-m", "benchmarks.forecasts", "--run", json.dumps(arguments_of(name, scenes, folder))]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
    return json.loads(done.stdout.splitlines()[-1])["peak"]


def arguments_of(name: str, scenes: pathlib.Path, folder: pathlib.Path) -> list[str]:
    """Return the arguments of `a2tg train`, without the name of the command."""
    scene, *options = CASES[name]
    places = {"synthetic": "synthetic", "written": str(folder / "written")}
    return [places.get(scene, str(scenes / scene)), "--out", str(folder / "run"), "--overwrite", *options]


def compare(name: str, arguments: list[str], peak: int) -> dict:
    """Return a case for the file: the forecast and the peak."""
    record = cli.parsed("train", arguments).whole_record
    phase, told = forecast_run(record.scene.load(), record.plan).peak
    ratio = round(told.total / peak, 3)
    return {"case": name, "phase": phase, **told._asdict(), "forecast": told.total, "peak": peak, "ratio": ratio}


def table(found: list[dict]) -> str:
    """Return the cases as a table in Markdown."""
    rows = [
        [case["case"], f"{case['forecast'] / 1e6:,.0f}", f"{case['peak'] / 1e6:,.0f}", f"{case['ratio']:.2f}"]
        for case in found
    ]
    return markdown.table(["run", "forecast, MB", "peak, MB", "forecast / peak"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=pathlib.Path, default=pathlib.Path("scenes"))
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("forecasts.json"))
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--again", action="store_true", help="forecast again; keep the peaks of the file")
    parser.add_argument("--run", type=json.loads, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.run is not None:
        if code := cli.main(["train", *args.run]):
            sys.exit(code)
        print(json.dumps({"peak": memory_peak()}))
        return
    found = {case["case"]: case for case in json.loads(args.out.read_text())} if args.out.is_file() else {}
    with tempfile.TemporaryDirectory() as name_of_folder:
        folder = pathlib.Path(name_of_folder)
        write_scene(folder / "written", 6, 6000, 4000)
        for name in args.only:
            peak = found[name]["peak"] if args.again else measure(name, args.scenes, folder)
            found[name] = compare(name, arguments_of(name, args.scenes, folder), peak)
            args.out.write_text(json.dumps(list(found.values()), indent=1) + "\n")
    print(table(list(found.values())), end="")


if __name__ == "__main__":
    main()
