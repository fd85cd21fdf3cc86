"""What an experiment is, and the command line of all of them: what to run, where, and what is written in the end."""

import argparse
import contextlib
import dataclasses
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import a2tg_jax as a2tg
from a2tg_jax.host.atomic import replacing
from a2tg_jax.measure.metrics import load_lpips
from a2tg_jax.results.folder import read_json, write_json
from a2tg_jax.results.record import SYNTHETIC
from lab import machine
from lab.grid import Grid, read_grid
from lab.jobs import Folders, Job, Record
from lab.plan import plan_of
from lab.queue import Failure, LocalPool, Pool, SubmititPool, run_all
from lab.tables import Result

EXPERIMENTS = Path(__file__).resolve().parents[1]
MEMORY_SHARE = 0.8
"""Of the machine's, unless --memory-gb says otherwise."""
MOST_SENT = 1_000
"""Jobs that wait in a cluster's queue at a time."""
CLUSTER_DEFAULTS = {"slurm": {"timeout_min": 24 * 60, "gpus_per_node": 1, "cpus_per_task": 4, "mem_gb": 32}}
"""What --cluster-parameter may say otherwise; submitit's own are five minutes and no GPU."""


class Lab:
    """Folders, pool and records of one call."""

    def __init__(self, args: argparse.Namespace):
        self.args = args
        self.scale: str = args.scale
        self.out: Path = args.out or EXPERIMENTS / "results" / args.scale
        self.work: Path = args.work or EXPERIMENTS.parent / "runs" / "experiments" / args.scale
        network = None if args.lpips_weights is None else load_lpips(args.lpips_weights).network
        self.folders = Folders(args.scenes, self.work, args.lpips_weights, network)
        self._file = self.out / "records.json"
        self.records: dict[str, Record] = self._all_records()

    def grid(self, name: str) -> Grid:
        """A grid, with the scenes that are wanted."""
        return read_grid(name, self.scale, scenes=self.args.only, held_out=not self.args.without_held_out)

    def run(self, grids: Sequence[Grid]) -> list[Failure]:
        """Runs what is not finished of the grids, unless only tables are wanted."""
        if self.args.tables_only:
            return []
        self._check_inputs(grids)
        if self.records:
            self._save()
        jobs = lambda records: (job for grid in grids for job in grid.jobs(records))  # noqa: E731
        with contextlib.closing(self._pool()) as pool:
            return run_all(jobs, self.folders, pool, self.records, self._keep, _tell_failure)

    @property
    def is_partial(self) -> bool:
        """Whether scenes are left out."""
        return bool(self.args.only or self.args.without_held_out)

    @property
    def pages(self) -> Path:
        """Where tables and pictures go: a folder of their own where only some scenes are wanted. It is made."""
        folder = self.out / "partial" if self.is_partial else self.out
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def model(self, result: Result, *, first_stage: bool = False) -> a2tg.Model | None:
        """What a run, or its first stage, left; None, and a line that says so, where it is gone."""
        job = dataclasses.replace(result.run.job, stage=0) if first_stage else result.run.job
        path = self.folders.model(job)
        if path.is_file():
            return a2tg.load_model(path)
        print(f"{result.label} on {result.run.cell.scene.label}: left out, for its model is not in {path.parent}")
        return None

    def write(self, name: str, text: str) -> None:
        """Prints a page and keeps it among the results."""
        path = self.pages / f"{name}.md"
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
        print(f"\n{text}\n{path}", flush=True)

    def _check_inputs(self, grids: Sequence[Grid]) -> None:
        """Before anything is trained: the scenes and the weights are there."""
        for path in {cell.scene.path for grid in grids for cell in grid.cells} - {SYNTHETIC}:
            if not (self.folders.scenes / path).is_dir():
                raise ValueError(
                    f"there is no scene {self.folders.scenes / path}: --scenes must name the folder of the scenes, as "
                    "grids/scales.toml has them (experiments/download.py fetches those of --scale full)"
                )

    def _keep(self, job: Job, record: Record) -> None:
        self._save()
        print(
            f"{len(self.records):4d}  {job.key}: {record['num']} splats, {record['mb']:.2f} MB, "
            f"{record['psnr']:.2f} dB; {record['seconds']:.0f} s, {record['ms_per_step']:.0f} ms a step",
            flush=True,
        )

    def _save(self) -> None:
        """Adds the records to those in the results, where another program may have added some."""
        self.out.mkdir(parents=True, exist_ok=True)
        with _locked(self.out / ".lock"):
            write_json(self._file, dict(sorted({**self._kept(), **self.records}.items())))

    def _kept(self) -> dict[str, Record]:
        return read_json(self._file) if self._file.is_file() else {}

    def _all_records(self) -> dict[str, Record]:
        """Those of the results, and those of jobs that nobody was there to collect."""
        own = {path.stem: read_json(path) for path in (self.work / "records").glob("*.json")}
        return {**own, **self._kept()}

    def _pool(self) -> Pool:
        args, inf = self.args, float("inf")
        memory = args.memory_gb * 1e9 if args.memory_gb else MEMORY_SHARE * machine.memory_bytes()
        if args.cluster:
            parameters = {**CLUSTER_DEFAULTS.get(args.cluster, {}), **dict(map(_parameter, args.cluster_parameter))}
            is_here = args.cluster == "local"
            slots = args.jobs or (machine.default_jobs() if is_here else MOST_SENT)
            return SubmititPool(args.cluster, self.work / "submitit", slots, memory if is_here else inf, **parameters)
        return LocalPool(args.jobs or machine.default_jobs(), memory, machine.num_gpus())


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A table or figure: the grids that it needs, and what it makes of their results."""

    name: str
    grids: tuple[str, ...]
    """Names of files in `grids/`."""
    present: Callable[[Lab, Sequence[Grid]], None]
    """Called when the grids were run, also where runs are missing."""


def main(experiments: Sequence[Experiment], description: str) -> Lab | None:
    """Runs all that some experiments need, in one queue, and presents each; None where only a plan was wanted."""
    args = parse_arguments(description)
    try:
        lab = Lab(args)
        names = list(dict.fromkeys(name for experiment in experiments for name in experiment.grids))
        grids = {name: lab.grid(name) for name in names}
        if args.plan:
            print(plan_of(list(grids.values()), lab.records))
            return None
        failures = lab.run(list(grids.values()))
    except (ValueError, OSError, RuntimeError, NameError) as error:  # The last two are submitit's.
        sys.exit(f"error: {error}")
    errors = [f"{failure.job.key}: {failure.reason}" for failure in failures]
    for experiment in experiments:
        try:
            experiment.present(lab, [grids[name] for name in experiment.grids])
        except (ValueError, OSError) as error:
            errors.append(f"{experiment.name}: {error}")
    if errors:
        told = "\n".join(f"  {error}" for error in errors)
        sys.exit(f"error: not all could be done; what needs it is missing. Call again to retry:\n{told}")
    return lab


def _tell_failure(failure: Failure) -> None:
    print(f"FAILED {failure.job.key}: {failure.reason}", flush=True)


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """One program at a time, where the system can see to that."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with open(path, "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def parse_arguments(description: str, arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The options that all experiments have."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--scenes", type=Path, default=Path("scenes"), help="folder of scenes; what lies in it: grids/scales.toml")
    add("--scale", choices=("full", "small", "smoke"), default="small", help="full is the paper's, for a GPU")
    add("--only", nargs="+", metavar="SCENE", help="these scenes of the scale")
    add("--without-held-out", action="store_true", help="leave out the scenes on which nothing may be chosen")
    add("--out", type=Path, help="results: records, tables, plots; finished runs in it are never run again")
    add("--work", type=Path, help="models and checkpoints; default: runs/experiments/SCALE")
    add("--lpips-weights", type=Path, help="weights of LPIPS (AlexNet), which is left out otherwise")
    add("--jobs", type=int, help="at a time; default: one a GPU, else one a core")
    add("--memory-gb", type=float, help="that jobs on this machine may take together; default: 80%% of it")
    add("--cluster", help='send jobs out with submitit: "slurm", or "local" for processes of this machine')
    add("--cluster-parameter", nargs="*", default=[], metavar="NAME=VALUE", help="as submitit has them: mem_gb=32 …")
    add("--plan", action="store_true", help="run nothing; say what is left to run, and about how long it takes")
    add("--tables-only", action="store_true", help="run nothing; write tables and plots from what is there")
    return parser.parse_args(arguments)


def _parameter(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"--cluster-parameter wants NAME=VALUE; got {text!r}")
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return name, kind(value)
    return name, value
