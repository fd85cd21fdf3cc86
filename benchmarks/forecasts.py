"""Memory of `a2tg train`, as known before its steps run and as measured: ten configurations, each in its own process.

    python -m benchmarks.forecasts --scenes SCENES --out benchmarks/results/forecasts.json

SCENES holds the folders fox, herz_jesus_p25, lego and snowmiku. Each case starts with an empty
cache, as a first run does. A table is printed. "At least" is known before anything is compiled, "XLA" before the first
step of each stage; the peak includes compilation and evaluation.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile
from typing import Any
from unittest import mock

from a2tg_jax.cli import main as cli
from a2tg_jax.results.forecast import forecast_run
from a2tg_jax.training import cost, loop
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


def measure(name: str, scenes: pathlib.Path, folder: pathlib.Path) -> dict:
    """Return what `run` measures, in a process of its own."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder / f"cache-{len(os.listdir(folder))}")}
    command = [sys.executable, "-m", "benchmarks.forecasts", "--run", json.dumps(arguments_of(name, scenes, folder))]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
    return json.loads(done.stdout.splitlines()[-1])


def arguments_of(name: str, scenes: pathlib.Path, folder: pathlib.Path) -> list[str]:
    """Return the arguments of `a2tg train`, without the name of the command."""
    scene, *options = CASES[name]
    places = {"synthetic": "synthetic", "written": str(folder / "written")}
    return [places.get(scene, str(scenes / scene)), "--out", str(folder / "run"), "--overwrite", *options]


def run(arguments: list[str]) -> dict:
    """Train in this process, and return bytes of memory: known before, of the largest step, and at the peak."""
    record = cli.parsed("train", arguments).whole_record
    least = forecast_run(record.scene.load(), record.plan).peak[1].total
    of_steps = []

    def noted(*given: Any) -> float:
        of_steps.append(cost.check_step_fits(*given))
        return of_steps[-1]

    with mock.patch.object(loop, "check_step_fits", noted):
        code = cli.main(["train", *arguments])
    if code:
        sys.exit(code)
    return {"least": least, "xla": max(of_steps), "peak": memory_peak()}


def table(cases: list[dict]) -> str:
    """Return the cases as a table in Markdown."""
    rows = []
    for case in cases:
        sizes = [f"{case[name] / 1e6:,.0f}" for name in ("least", "xla", "peak")]
        rows.append([case["case"], *sizes, f"{case['xla'] / case['peak']:.2f}"])
    return markdown.table(["run", "at least, MB", "XLA, MB", "peak, MB", "XLA / peak"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=pathlib.Path, default=pathlib.Path("scenes"))
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("forecasts.json"))
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--run", type=json.loads, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.run is not None:
        print(json.dumps(run(args.run)))
        return
    cases = {case["case"]: case for case in json.loads(args.out.read_text())} if args.out.is_file() else {}
    with tempfile.TemporaryDirectory() as name_of_folder:
        folder = pathlib.Path(name_of_folder)
        write_scene(folder / "written", 6, 6000, 4000)
        for name in args.only:
            cases[name] = {"case": name, **measure(name, args.scenes, folder)}
            args.out.write_text(json.dumps(list(cases.values()), indent=1) + "\n")
    print(table(list(cases.values())), end="")


if __name__ == "__main__":
    main()
