"""All measurements, as tables and as JSON, with the machine, the versions and the commit.

    python -m benchmarks --out benchmarks/results/cpu.json                     # everything: about half an hour
    python -m benchmarks --only render --largest 10000                         # a part of it
    python -m benchmarks --scene SCENES/herz_jesus_p25 --mitsuba python3       # with a real scene and Mitsuba 3

Every case runs in a process of its own (`benchmarks.measure`), one after the other.
"""

import argparse
import datetime
import importlib.metadata
import json
import os
import pathlib
import platform
import subprocess
import sys

from benchmarks.fit import fit_growth
from benchmarks.workload import TEXTURE_KINDS

SIZES = ((320, 240), (640, 480))
NUMBERS = (2_000, 10_000, 50_000, 200_000)
FULL_SIZE = (1600, 1060)
MULTIPLY_ADDS = {"forward": 20, "both": 80}
"""Needed for a splat at a pixel: nine for the ray's plane, four for (u, v) and ρ, and what falloff, colour and
transmittance take; the backward pass does this again and about twice as much for the derivatives."""


def main() -> None:
    args = parse_arguments()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    report: dict = {"machine": machine()}
    for name, section in SECTIONS.items():
        if not args.only or name in args.only:
            report[name] = section(args)
            if name == "render":
                report["growth"] = fit_growth(report[name])
            # After every section: what was measured is kept if the rest is interrupted.
            args.out.write_text(json.dumps(report, indent=1) + "\n")
    print(f"\nwritten to {args.out}")


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("benchmark.json"))
    parser.add_argument("--only", nargs="+", choices=list(SECTIONS), help="these sections only")
    parser.add_argument("--largest", type=int, default=1_000_000, help="leave out workloads of more Gaussians")
    parser.add_argument("--scene", type=pathlib.Path, help="a real scene to train, at downscale 2 and 1")
    parser.add_argument("--mitsuba", help="a Python with Mitsuba 3 installed, to measure beside it")
    return parser.parse_args()


def measure(timeout: float = 1200, python: str = sys.executable, module: str = "benchmarks.measure", **case) -> dict:
    """The figures of one case, printed as a line; a case that fails says so and is kept as a failure."""
    command = [python, "-m", module, json.dumps(case)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    except subprocess.TimeoutExpired:
        figures = {**case, "failed": f"took longer than {timeout:g} s"}
    else:
        last = (done.stdout.strip().splitlines() or [""])[-1]
        figures = json.loads(last) if done.returncode == 0 else {**case, "failed": done.stderr[-500:]}
    print(line(figures), flush=True)
    return figures


def line(figures: dict) -> str:
    """A case as one line of a table."""
    words = []
    for name, value in figures.items():
        if isinstance(value, dict):
            words.append(f"{name} {value['ms']:.1f}")
        elif isinstance(value, float):
            words.append(f"{name} {value:.4g}")
        else:
            words.append(f"{name} {value}")
    return "  ".join(words)


def render_section(args: argparse.Namespace) -> list[dict]:
    """The random workload at two sizes, untextured and textured, with one thread and with all."""
    cases = [
        {"num": num, "width": width, "height": height, "textures": kind, "threads": threads}
        for width, height in SIZES
        for num in NUMBERS
        if num <= args.largest
        for kind in TEXTURE_KINDS[:3]
        for threads in (1, os.cpu_count())
    ]
    return [measure(case="render", **case) for case in cases]


def full_size_section(args: argparse.Namespace) -> list[dict]:
    """Large scenes and large textures."""
    width, height = FULL_SIZE
    cases = [
        {"num": 300_000, "width": width, "height": height},
        {"num": 1_000_000, "width": width, "height": height, "forward_only": True},
        {"num": 20_000, "width": 640, "height": 480, "textures": "16x16"},
    ]
    return [measure(case="render", **case) for case in cases if case["num"] <= args.largest]


def stages_section(args: argparse.Namespace) -> list[dict]:
    cases = [
        {"num": num, "width": width, "height": height, "textures": kind, "threads": threads}
        for num, (width, height) in ((10_000, SIZES[0]), (50_000, SIZES[1]))
        for kind in ("none", "mixed")
        for threads in (1, os.cpu_count())
        if num <= args.largest
    ]
    return [measure(case="stages", **case) for case in cases]


def compositors_section(args: argparse.Namespace) -> list[dict]:
    """Native loops beside XLA, and tile sizes."""
    common = {"case": "render", "num": 10_000, "width": 320, "height": 240}
    cases = [
        {"textures": kind, **choice}
        for kind in ("none", "mixed")
        for choice in ({"compositor": "xla"}, {"tile_size": 4}, {"tile_size": 8}, {"tile_size": 16}, {"tile_size": 32})
    ]
    return [measure(**common, **case) for case in cases]


def limit_section(args: argparse.Namespace) -> dict:
    """What the processor could do at best, for the multiply-adds of a million pairs of a splat and a pixel."""
    return {
        name: [
            measure(case="limit", multiply_adds=number, pairs=1e7, threads=threads) for threads in (1, os.cpu_count())
        ]
        for name, number in MULTIPLY_ADDS.items()
    }


def training_section(args: argparse.Namespace) -> list[dict]:
    """Training steps on a real scene."""
    if args.scene is None:
        return []
    scene = str(args.scene.resolve())
    return [
        measure(case="training", scene=scene, downscale=downscale, num=num, iterations=200)
        for downscale, num in ((4, 10_000), (2, 10_000), (2, 19_179), (1, 19_179))
    ]


def others_section(args: argparse.Namespace) -> list[dict]:
    """Mitsuba 3's Gaussian primitives on the same workload, one thread, beside ours."""
    if args.mitsuba is None:
        return []
    found = []
    for num, (width, height) in ((10_000, SIZES[0]), (50_000, SIZES[1])):
        common = {"num": num, "width": width, "height": height, "threads": 1}
        found.append(measure(python=args.mitsuba, module="benchmarks.mitsuba", **common))
        found.append(measure(case="render", **common))
    return found


def machine() -> dict:
    """Where and with what this was measured."""
    names = ("jax", "jaxlib", "numpy", "llvmlite")
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    processor = platform.processor()
    cpuinfo = pathlib.Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = [text for text in cpuinfo.read_text().splitlines() if text.startswith("model name")]
        processor = lines[0].split(":", 1)[1].strip() if lines else processor
    return {
        "processor": processor,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: importlib.metadata.version(name) for name in names},
        "commit": commit.stdout.strip(),
        "date": datetime.date.today().isoformat(),
    }


SECTIONS = {
    "render": render_section,
    "stages": stages_section,
    "limit": limit_section,
    "compositors": compositors_section,
    "full_size": full_size_section,
    "training": training_section,
    "others": others_section,
}

if __name__ == "__main__":
    main()
