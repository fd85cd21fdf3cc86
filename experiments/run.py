"""Run experiments by name: train what is missing, then write their tables and charts.

    python experiments/run.py fixed_memory ablation --scenes SCENES --lpips-weights lpips_alex.npz
    python experiments/run.py all --scenes SCENES --scale small --lpips-weights lpips_alex.npz
    python experiments/run.py pages

    python experiments/run.py fixed_memory --scene ~/scenes/garden --downscale 4
    python experiments/run.py path/to/mine.toml --scenes SCENES

A stopped call continues when it is called again; finished runs are never run again. `--plan` prints what is left to
do and about how long it takes. docs/sweeps.md says how to write a grid file of your own.
"""

import argparse
import contextlib
import importlib
import os
import shlex
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from lab import pages
from lab.cli import Experiment, argument_parser, run_experiments, stop
from lab.grid import has_scale
from lab.grid_file import SUFFIX
from lab.standard import STANDARD, file_experiment

from a2tg_jax import configure_cpu
from a2tg_jax.base.text import did_you_mean
from a2tg_jax.host import signals

MODULES = ("choose_plain", "findings", "claims", "ablation", "resolution_shares", "efficiency")
"""Modules of this folder that hold an EXPERIMENT; the one that measures time comes last."""
EVERYTHING = "all"
PAGES = "pages"
OTHERS = {
    EVERYTHING: "All of these experiments, then the pages.",
    PAGES: "Write the tables of docs/results.md and NOTEBOOK.md from the committed results.",
}


def experiments() -> dict[str, Experiment]:
    """Return all experiments by name."""
    found = (*STANDARD, *(importlib.import_module(name).EXPERIMENT for name in MODULES))
    return {experiment.name: experiment for experiment in found}


def parse_arguments(known: Mapping[str, Experiment], arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the names and options of a call."""
    wording = {**{name: experiment.summary for name, experiment in known.items()}, **OTHERS}
    listed = "\n".join(f"  {name:20s} {textwrap.shorten(text, 110)}" for name, text in wording.items())
    parser = argument_parser(f"{(__doc__ or '').strip()}\n\nnames:\n{listed}")
    parser.add_argument("names", nargs="+", metavar="NAME", help="experiments to run, as above, or grid files")
    args = parser.parse_intermixed_args(arguments)
    args.own_grids = [name for name in args.names if name.endswith(SUFFIX)]
    return args


def chosen(known: Mapping[str, Experiment], args: argparse.Namespace) -> list[Experiment]:
    """Return the experiments of a call, or all that have its scale; unknown names end the program."""
    for name in args.names:
        if name not in known and name not in OTHERS and name not in args.own_grids:
            hint = did_you_mean(name, [*known, *OTHERS]) or _of_an_option(name, args) or "; --help lists all"
            stop(f"there is no experiment {name!r}{hint}")
    are_both = len(set(args.names) - set(args.own_grids) - {PAGES}) and args.own_grids
    if are_both and args.out is None and args.scale != "smoke":
        stop("results of grid files and of experiments lie in different folders: call them one after another, or name "
             "a folder for both with --out")  # fmt: skip
    if EVERYTHING in args.names:
        whole = [found for found in known.values() if all(has_scale(grid, args.scale) for grid in found.grids)]
        return [*whole, *_file_experiments(known, args.own_grids)]
    named = [known[name] for name in dict.fromkeys(args.names) if name in known]
    return [*named, *_file_experiments(known, args.own_grids)]


def _of_an_option(name: str, args: argparse.Namespace) -> str:
    """Return how to repeat an option whose second value a name seems to be; empty if it does not."""
    if "=" in name and args.cluster_parameter:
        return f"; repeat the option for each value: --cluster-parameter {name}"
    return f"; if it is a scene, repeat the option: --only {name}" if args.only else ""


def _file_experiments(known: Mapping[str, Experiment], paths: Sequence[str]) -> list[Experiment]:
    """Return the experiments of grid files, whose tables must not take the place of others."""
    taken = dict.fromkeys(known, "an experiment")
    found = []
    for path in dict.fromkeys(paths):
        if not Path(path).expanduser().is_file():
            stop(f"there is no grid file {path}")
        experiment = file_experiment(path)
        if experiment.name in taken:
            stop(f"{path}: rename the file, since its tables would have the name of {taken[experiment.name]}")
        taken[experiment.name] = path
        found.append(experiment)
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the experiments of a command line."""
    known = experiments()
    args = parse_arguments(known, arguments)
    wanted = chosen(known, args)
    lab = run_experiments(wanted, args) if wanted else None
    is_committed = lab is not None and lab.out.resolve().parent == pages.EXPERIMENTS / "results" and not lab.is_partial
    if (EVERYTHING in args.names and is_committed) or (PAGES in args.names and not args.plan):
        pages.refresh()


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """End the program with one line if a signal comes within the block. The exit code is 128 plus the signal's number:
    130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP."""
    try:
        with signals.raised():
            yield
    except KeyboardInterrupt as interrupt:
        code = signals.Stopped.of(interrupt).exit_code
        wording = "interrupted" if code == 128 + signals.CTRL_C else "terminated"
        command = shlex.join([Path(sys.executable).name, *sys.argv])
        print(f"\n{wording}; what is finished is kept; continue with: {command}", file=sys.stderr)
        sys.exit(code)


if __name__ == "__main__":
    with interruptible():
        # Jobs take what they need of a GPU's memory, and leave the rest to each other and to this process.
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
        configure_cpu()
        main()
