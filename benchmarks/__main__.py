"""Run all measurements and write them as JSON, with the machine, the versions and the commit.

    python -m benchmarks --out benchmarks/results/cpu.json                     # everything: a quarter of an hour
    python -m benchmarks --only render --largest 10000                         # a part of it
    python -m benchmarks --scene SCENES/herz_jesus_p25                         # with a real scene
    python -m benchmarks --only others --other 'name=./program --fast'         # another program on the same workload
    python -m benchmarks --only gpu --gsplat python3                           # on a GPU, beside gsplat

Every case runs in a process of its own, one after the other.
"""

import argparse
import datetime
import importlib.metadata
import json
import os
import pathlib
import platform
import shlex
import subprocess

from benchmarks.sections import SECTIONS, device

OTHER_HELP = """a program to measure beside this library; may be repeated. COMMAND gets one more argument, a case such
as {"num": 10000, "width": 320, "height": 240, "threads": 1}, and prints a last line such as
{"forward": {"ms": 20.1}, "both": {"ms": 43.2}}: milliseconds of a forward pass, and of one with its gradients, of the
Gaussians, the camera and the image to compare with that benchmarks/arrays.py makes"""


def main() -> None:
    args = parse_arguments()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    report: dict = {"machine": machine()}
    for name, section in SECTIONS.items():
        if not args.only or name in args.only:
            report[name] = section(args)
            # After every section: what was measured is kept if the rest is interrupted.
            args.out.write_text(json.dumps(report, indent=1) + "\n")
    print(f"\nwritten to {args.out}")


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("benchmark.json"))
    parser.add_argument("--only", nargs="+", choices=list(SECTIONS), help="run these sections only")
    parser.add_argument("--largest", type=int, default=1_000_000, help="leave out workloads of more Gaussians")
    parser.add_argument("--scene", type=pathlib.Path, help="a real scene of photographs, to train")
    parser.add_argument("--gsplat", metavar="PYTHON", help="a Python with gsplat, to measure beside it on a GPU")
    parser.add_argument("--other", metavar="NAME=COMMAND", type=named_command, action="append", help=OTHER_HELP)
    parser.set_defaults(other=[])
    args = parser.parse_args()
    if args.scene is not None and not args.scene.exists():
        parser.error(f"--scene: there is no {args.scene}")
    return args


def named_command(text: str) -> tuple[str, list[str]]:
    """Return name and command of NAME=COMMAND."""
    name, _, command = text.partition("=")
    if not name or not command:
        raise argparse.ArgumentTypeError(f"wanted NAME=COMMAND; got {text!r}")
    return name, shlex.split(command)


def machine() -> dict:
    """Return the machine, the versions and the commit."""
    names = ("jax", "jaxlib", "numpy", "llvmlite")
    commit = answer("git", "rev-parse", "--short", "HEAD")
    processor = platform.processor()
    cpuinfo = pathlib.Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = [text for text in cpuinfo.read_text().splitlines() if text.startswith("model name")]
        processor = lines[0].split(":", 1)[1].strip() if lines else processor
    return {
        "processor": processor,
        "cores": os.cpu_count(),
        "device": device(),
        "gpu": answer("nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"),
        "python": platform.python_version(),
        "versions": {name: importlib.metadata.version(name) for name in names},
        "commit": commit,
        "date": datetime.date.today().isoformat(),
    }


def answer(*command: str) -> str:
    """Return what a command prints; "" if it fails or does not exist."""
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (FileNotFoundError, subprocess.CalledProcessError):
        return ""


if __name__ == "__main__":
    main()
