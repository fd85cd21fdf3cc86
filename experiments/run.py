"""Run experiments by name: train what is missing, then write their tables, charts and pictures.

    python experiments/run.py claim ablation --scenes SCENES --lpips-weights lpips_alex.npz
    python experiments/run.py all --scenes SCENES --scale small --lpips-weights lpips_alex.npz
    python experiments/run.py appendix

    python experiments/run.py claim --scene ~/scenes/garden --downscale 4

A stopped call continues when it is called again; finished runs are never run again. `--plan` prints what is left to
do and about how long it takes. docs/sweeps.md says how to write a grid of your own.
"""

import argparse
import importlib
import textwrap
from collections.abc import Mapping, Sequence

from lab import pages
from lab.cli import Experiment, argument_parser, run_experiments
from lab.interrupts import interruptible
from lab.standard import STANDARD

MODULES = (
    "summary", "equal_bytes", "ablation", "texture_resolution", "memory_charts", "resolution_shares", "decomposition",
    "comparison_pictures", "upscale_gains", "polish", "shrink", "on_disk", "efficiency", "equal_bytes_speed",
)  # fmt: skip
"""Modules of this folder that hold an EXPERIMENT; those that measure time come last."""
EVERYTHING, APPENDIX = "all", "appendix"
OTHERS = {
    EVERYTHING: "All of these experiments, then the pages.",
    APPENDIX: "Write docs/results-appendix.md and the tables of docs/results.md from the committed results.",
}


def experiments() -> dict[str, Experiment]:
    """Return all experiments by name."""
    found = (*STANDARD, *(importlib.import_module(name).EXPERIMENT for name in MODULES))
    return {experiment.name: experiment for experiment in found}


def parse_arguments(known: Mapping[str, Experiment], arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the names and options of a call."""
    told = {**{name: experiment.summary for name, experiment in known.items()}, **OTHERS}
    listed = "\n".join(f"  {name:20s} {textwrap.shorten(text, 110)}" for name, text in told.items())
    parser = argument_parser(f"{(__doc__ or '').strip()}\n\nnames:\n{listed}")
    parser.add_argument("names", nargs="+", metavar="NAME", choices=list(told), help="experiments to run, as above")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the experiments of a command line."""
    known = experiments()
    args = parse_arguments(known, arguments)
    is_all = EVERYTHING in args.names
    wanted = list(known.values()) if is_all else [known[name] for name in dict.fromkeys(args.names) if name in known]
    lab = run_experiments(wanted, args) if wanted else None
    is_committed = lab is not None and lab.out.resolve().parent == pages.EXPERIMENTS / "results" and not lab.is_partial
    if (is_all and is_committed) or (APPENDIX in args.names and not args.plan):
        pages.refresh()


if __name__ == "__main__":
    with interruptible():
        main()
