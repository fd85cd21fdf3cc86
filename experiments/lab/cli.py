"""Experiments and their command line: what to run, where, and what is written at the end."""

import argparse
import contextlib
import dataclasses
import functools
import math
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import a2tg_jax as a2tg
from a2tg_jax.base.atomic import replacing
from a2tg_jax.base.control_groups import cpu_quota
from a2tg_jax.base.memory import memory_limit
from a2tg_jax.base.operating_system import num_cores
from a2tg_jax.base.text import did_you_mean
from a2tg_jax.data.synthetic import BUILT_IN
from a2tg_jax.measure.metrics import load_lpips
from a2tg_jax.results.folder import write_json
from lab import spreadsheet, tables, versions
from lab.grid import Grid, read_grid
from lab.grid_file import SCALES
from lab.jobs import Folders, Job, Record
from lab.kept import read_figures, read_kept
from lab.plan import Machine, plan_of
from lab.progress import Progress
from lab.queue import LocalPool, Pool, SubmititPool, TimeLimit, is_finished, run_all
from lab.scenes import SceneAt, own_scene
from lab.stages import Stage, check_systems, stages_of
from lab.tables import Result

EXPERIMENTS = Path(__file__).resolve().parents[1]
RUNS = EXPERIMENTS.parent / "runs"
USAGE = 2
"""Exit code of a call that cannot be run as it is."""
MEMORY_SHARE = 0.8
"""Default share of the free memory for all jobs together."""
MOST_SENT = 1_000
"""Largest number of jobs in a cluster's queue."""
CLUSTER_DEFAULTS = {"slurm": {"timeout_min": 24 * 60, "gpus_per_node": 1, "cpus_per_task": 4, "mem_gb": 32}}
"""Defaults of --cluster-parameter; submitit's own are five minutes and no GPU."""


class Lab:
    """Folders, pool and records of one call of the command line."""

    def __init__(self, args: argparse.Namespace):
        check_arguments(args)
        self.args = args
        self.limit = TimeLimit() if args.minutes is None else TimeLimit.of_minutes(args.minutes)
        self.scale: str = args.scale
        self.out: Path = args.out or self._default_out()
        self.work: Path = args.work or RUNS / "experiments" / args.scale
        network = None if args.lpips_weights is None else load_lpips(args.lpips_weights).network
        self.folders = Folders(args.scenes, self.work, args.lpips_weights, network)
        self._file = self.out / "records.json"
        self.records: dict[str, Record] = self._all_records()
        self._note = ""

    def _default_out(self) -> Path:
        """Return the folder of the committed results, or one that git ignores for the smoke scale and grids of one's
        own."""
        name = f"{self.scale}-validation" if self.args.validation else self.scale
        name = f"{name}-rehearsal" if self.args.rehearsal else name
        is_own = self.is_smoke or self.args.rehearsal or getattr(self.args, "own_grids", ())
        return (RUNS if is_own else EXPERIMENTS) / "results" / name

    def grid(self, name: str) -> Grid:
        """Return a grid with the requested scenes."""
        return read_grid(
            name, self.scale, scenes=self.args.only, own=self.own_scenes, validation=self.args.validation,
            rehearsal=self.args.rehearsal,
        )  # fmt: skip

    @property
    def own_scenes(self) -> tuple[SceneAt, ...]:
        """Return the scenes given by path, which take the place of the scale's."""
        downscale = 1 if self.args.downscale is None else self.args.downscale
        scenes: dict[str, SceneAt] = {}
        for path in self.args.scene:
            scene = own_scene(path, downscale)
            if scenes.setdefault(scene.label, scene) != scene:
                raise ValueError(f"two folders of --scene are called {scene.label}, one in tables: rename one of them")
        return tuple(scenes.values())

    @property
    def is_smoke(self) -> bool:
        """Return whether the scale only shows that everything runs: figures need little work and mean nothing."""
        return self.scale == "smoke"

    def run(self, grids: Sequence[Grid]) -> list[str]:
        """Run the unfinished jobs of the grids, unless only tables are requested; return what failed, in words."""
        if self.args.tables_only:
            return []
        self.check_inputs(grids)
        if self.records:
            self._save()
        jobs = lambda records: (job for grid in grids for job in grid.jobs(records))  # noqa: E731
        progress = Progress(grids, self.records, self.work / "log.txt")

        def keep(job: Job, record: Record) -> None:
            self._save()
            progress.done(job, record)
            if self.args.drop_models:
                self._drop_models(grids)

        with contextlib.closing(self._pool()) as pool:
            if pool.shares_devices and any(grid.at_equal_time for grid in grids):
                print("Stages that share a GPU or cores are not timed, so runs of equal time are left out. --jobs 1 "
                      "times them.", flush=True)  # fmt: skip
            progress.begin(pool.slots)
            try:
                failures = run_all(jobs, self.folders, pool, self.records, keep, progress.failed, progress.start)
            except KeyboardInterrupt:
                pool.abort()
                raise
        return [f"{progress.as_text(failure.job)}: {failure.reason}" for failure in failures]

    def _drop_models(self, grids: Sequence[Grid]) -> None:
        """Delete the models of finished stages that no unfinished one starts from."""
        stages = stages_of(grids, self.records)
        left = [stage.job for stage in self._left(stages)]
        needed = {job.key for job in left} | {job.start.key for job in left if job.start is not None}
        for key, stage in stages.items():
            if key not in needed:
                self.folders.model(stage.job).unlink(missing_ok=True)

    def _left(self, stages: Mapping[str, Stage]) -> list[Stage]:
        """Return the stages that are not finished."""
        return [stage for stage in stages.values() if not is_finished(stage.job, self.folders, self.records)]

    def rest_text(self, grids: Sequence[Grid]) -> str:
        """Return what is left after the time limit; empty if nothing is, or without a limit."""
        stages = stages_of(grids, self.records)
        left = self._left(stages)
        if not left or not self.limit.is_too_late or self.args.tables_only:
            return ""
        return (
            f"the time limit of {self.args.minutes:g} minutes is over: {len(left)} of {len(stages)} stages are left, "
            f"first {left[0]}; the same command continues, --plan lists them"
        )

    @property
    def is_partial(self) -> bool:
        """Return whether scenes are left out."""
        return bool(self.args.only or self.args.scene)

    @property
    def pages(self) -> Path:
        """Return the folder of tables and charts, and make it; some scenes alone have a folder of their own."""
        folder = self.out / "partial" if self.is_partial else self.out
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def model(self, result: Result) -> a2tg.Model | None:
        """Return the model of a run; print a line and return None if it is missing."""
        path = self.folders.model(result.run.job)
        if path.is_file():
            return a2tg.load_model(path)
        print(
            f"{result.label} on {result.run.cell.scene.label}: left out, its model is missing in {path.parent}; --work "
            "names the folder that has it, --out NEW trains it again"
        )
        return None

    def write(self, name: str, text: str, *, has_old_rows: bool = True) -> None:
        """Print a page and save it among the results. A page that may have rows of runs from before counts them."""
        if self.args.validation:
            text = f"*Measured on validation views, taken from the training views; test views were not used.*\n\n{text}"
        text = f"{text.rstrip()}\n{self._note if has_old_rows else ''}"
        path = self.pages / f"{name}.md"
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
        print(f"\n{text}\n{path}", flush=True)

    def write_rows(self, name: str, grids: Sequence[Grid]) -> None:
        """Save the finished runs of some grids as a CSV file beside their page."""
        found = [(grid.name, result) for grid in grids for result in tables.results_of(grid, self.records)]
        with replacing(self.pages / f"{name}.csv") as temporary:
            temporary.write_text(spreadsheet.rows_text(found), encoding="utf-8")

    def records_of(self, grids: Sequence[Grid]) -> list[Record]:
        """Return the records of the finished runs of some grids, each once."""
        results = (result for grid in grids for result in tables.results_of(grid, self.records))
        return list({result.run.job.key: result.record for result in results}.values())

    def present(self, experiment: "Experiment", grids: Sequence[Grid]) -> None:
        """Write the rows and the pages of an experiment."""
        old = versions.as_text(self.records_of(grids))
        self._note = f"\n*Runs from before: {old}.*\n" if old else ""
        self.write_rows(experiment.name, grids)
        experiment.present(self, grids)

    def check_inputs(self, grids: Sequence[Grid]) -> None:
        """Raise if a scene is missing or an option invalid, before anything is trained."""
        check_systems(grids, self.records)
        for path in {cell.scene.path for grid in grids for cell in grid.cells} - BUILT_IN.keys():
            # Joined to a folder, an absolute path does not change.
            if (self.folders.scenes / path).is_dir():
                continue
            if Path(path).is_absolute():
                raise ValueError(f"there is no scene folder {path}")
            if not self.folders.scenes.is_dir():
                raise ValueError(f"there is no folder --scenes {self.folders.scenes}")
            raise ValueError(
                f"there is no scene {self.folders.scenes / path}: --scenes must name the folder of the scenes, as "
                "grids/scales.toml has them (a2tg download mipnerf360 tandt-db fetches the scenes of --scale full)"
            )

    def _save(self) -> None:
        """Merge the records into the results, to which another program may have added some."""
        self.out.mkdir(parents=True, exist_ok=True)
        with _locked(self.out / ".lock"):
            write_json(self._file, dict(sorted({**read_kept(self._file), **self.records}.items())))

    def _all_records(self) -> dict[str, Record]:
        """Return the records of the results and of jobs that were never collected."""
        own = {path.stem: read_figures(path) for path in (self.work / "records").glob("*.json")}
        found = {**own, **read_kept(self._file)}
        return {key: one for key, one in found.items() if not (self.args.renew and versions.is_from_before(one))}

    def machine(self) -> Machine:
        """Return what --plan plans for."""
        return Machine(self.args.jobs or default_jobs(), self._memory(), num_gpus() > 0)

    def _memory(self) -> float:
        """Return the bytes that jobs of this machine may take together."""
        return self.args.memory_gb * 1e9 if self.args.memory_gb is not None else MEMORY_SHARE * memory_limit()

    def _pool(self) -> Pool:
        args = self.args
        inf = float("inf")
        memory = self._memory()
        if args.cluster:
            parameters = {**CLUSTER_DEFAULTS.get(args.cluster, {}), **dict(map(_parameter, args.cluster_parameter))}
            is_here = args.cluster == "local"
            slots = args.jobs or (default_jobs() if is_here else MOST_SENT)
            return SubmititPool(args.cluster, self.work / "submitit", slots, memory if is_here else inf, **parameters)
        return LocalPool(args.jobs or default_jobs(), memory, num_gpus(), self.limit)


@functools.cache
def num_gpus() -> int:
    """Return the number of GPUs that JAX sees. Another process looks, since JAX would take their memory in this one."""
    script = "import jax; print(len(jax.devices()) if jax.default_backend() == 'gpu' else 0)"
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False).stdout.split()
    return int(found[-1]) if found and found[-1].isdigit() else 0


def default_jobs() -> int:
    """Return one job a GPU, whose memory jobs would share, else one a core that the process may use in full."""
    return num_gpus() or max(1, math.floor(min(num_cores(), cpu_quota())))


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A table or figure: the grids that it needs, and how it presents their results."""

    name: str
    grids: tuple[str, ...]
    """Names of files in `grids/`."""
    present: Callable[[Lab, Sequence[Grid]], None]
    """Function called after the grids were run, even if runs are missing."""
    description: str | None
    """Text whose first line says what the experiment shows."""

    @property
    def summary(self) -> str:
        """Return the first line of the description."""
        return (self.description or "").strip().partition("\n")[0]


def run_experiments(experiments: Sequence[Experiment], args: argparse.Namespace) -> Lab | None:
    """Run all jobs of some experiments in one queue and present each; return None if only a plan was requested."""
    try:
        lab = Lab(args)
        names = list(dict.fromkeys(name for experiment in experiments for name in experiment.grids))
        grids = {name: lab.grid(name) for name in names}
        old = versions.as_text(lab.records_of(list(grids.values())))
        if old:
            print(f"Runs from before: {old}. --renew trains them again.", flush=True)
        if args.plan:
            check_systems(list(grids.values()), lab.records)
            print(plan_of(list(grids.values()), lab.records, lab.folders, lab.machine()))
            return None
        errors = lab.run(list(grids.values()))
    except (ValueError, OSError, RuntimeError, NameError) as error:  # The last two are submitit's.
        stop(str(error))
    for experiment in experiments:
        own = [grids[name] for name in experiment.grids]
        try:
            lab.present(experiment, own)
        except (ValueError, OSError) as error:
            errors.append(f"{experiment.name}: {error}")
    if errors:
        wording = "\n".join(f"  {error}" for error in errors)
        sys.exit(f"error: some jobs failed, and what needs them is missing. Call again to retry:\n{wording}")
    rest = lab.rest_text(list(grids.values()))
    if rest:
        print(rest, flush=True)
    return lab


def stop(message: str) -> NoReturn:
    """End the program with one line and the exit code of a call that cannot be run."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(USAGE)


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Exclude other programs, if the operating system can."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with open(path, "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def argument_parser(description: str) -> argparse.ArgumentParser:
    """Return a parser of the options that all experiments have."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--scenes", type=Path, default=Path("scenes"), help="folder of the scenes that grids/scales.toml names")
    add("--scale", type=_scale, default="small", metavar=f"{{{','.join(SCALES)}}}",
        help="full is the paper's, for a GPU; long has its options and length on small photographs; claims, "
        "protocol160, paper160, full_size (for a GPU) and half_size are in PROTOCOL.md")  # fmt: skip
    add("--only", action="append", metavar="SCENE", help="run this scene of the scale only; may be repeated")
    add("--scene", action="append", type=Path, default=[], metavar="PATH",
        help="run this scene folder instead of the scale's; may be repeated")  # fmt: skip
    add("--downscale", type=int, metavar="K", help="factor by which the photographs of --scene are downscaled")
    add("--validation", action="store_true",
        help="hold out every eighth training view in place of the test views, to choose options by")  # fmt: skip
    add("--rehearsal", action="store_true",
        help="run every method once: the first scene and size of each grid, 1/100 of the iterations")  # fmt: skip
    add("--out", type=Path, help="folder of records, tables and plots; runs finished in it are never run again; "
        "default: experiments/results/SCALE, or runs/results/SCALE for --scale smoke and grid files")  # fmt: skip
    add("--work", type=Path, help="folder of models and checkpoints; default: runs/experiments/SCALE")
    add("--lpips-weights", type=Path, help="weights of LPIPS (AlexNet); without them LPIPS is left out")
    add("--jobs", type=int,
        help="number of jobs at a time; default: one a GPU, else one a core. More share a GPU's memory")  # fmt: skip
    add("--minutes", type=float, help="time limit of this call; the next one continues what was cut off")
    add("--drop-models", action="store_true",
        help="delete each model that no unfinished run starts from; --work then has only what continues")  # fmt: skip
    add(
        "--memory-gb",
        type=float,
        help="memory of all jobs on this machine together; default: 80%% of what is free at the start",
    )
    add("--cluster", help='send jobs out with submitit: "slurm", or "local" for processes of this machine')
    add("--cluster-parameter", action="append", default=[], metavar="NAME=VALUE",
        help="parameter of submitit, such as mem_gb=32; may be repeated")  # fmt: skip
    add("--plan", action="store_true", help="run nothing; print what is left to run and about how long it takes")
    add("--renew", action="store_true", help="train again what earlier versions of systems made")
    add("--tables-only", action="store_true", help="run nothing; write tables and plots of the finished runs")
    return parser


def check_arguments(args: argparse.Namespace) -> None:
    """Refuse numbers out of range, and options that have no effect beside the others.

    Raises:
      ValueError: naming the option.
    """
    if args.jobs is not None and args.jobs < 1:
        raise ValueError(f"--jobs must be at least 1; got {args.jobs}")
    if args.memory_gb is not None and not 0 < args.memory_gb < math.inf:
        raise ValueError(f"--memory-gb must be a finite number larger than 0; got {args.memory_gb}")
    if args.minutes is not None and not 0 < args.minutes < math.inf:
        raise ValueError(f"--minutes must be a finite number larger than 0; got {args.minutes}")
    if args.minutes is not None and args.cluster:
        raise ValueError("--minutes has no effect on jobs of --cluster: set timeout_min with --cluster-parameter")
    if args.downscale is not None and not args.scene:
        raise ValueError("--downscale is that of --scene: add --scene, or set downscale in a grid file of your own")
    if args.only and args.scene:
        raise ValueError("--only chooses scenes of the scale, whose place --scene takes: leave one out")
    if args.cluster_parameter and not args.cluster:
        raise ValueError("--cluster-parameter needs --cluster")
    for text in args.cluster_parameter:
        _parameter(text)


def _scale(name: str) -> str:
    if name not in SCALES:
        stop(f"there is no --scale {name}{did_you_mean(name, SCALES) or '; there are ' + ', '.join(SCALES)}")
    return name


def _parameter(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"--cluster-parameter wants NAME=VALUE; got {text!r}")
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return name, kind(value)
    return name, value
