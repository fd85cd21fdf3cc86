"""The cells of a sweep with what is left, and about how much time, disk and memory that takes."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

import a2tg_jax as a2tg
from a2tg_jax.base.text import in_bytes
from a2tg_jax.base.threads import num_threads
from a2tg_jax.data.synthetic import BUILT_IN
from a2tg_jax.events import HostEvent
from lab.grid import Grid, Run
from lab.jobs import Folders, Job, Record, num_gaussians
from lab.markdown import table
from lab.queue import estimated_bytes
from lab.stages import Stage, runs_by_cell, scene_text, stages_of

GPU_SECONDS = 0.002
GPU_SECONDS_PER_GAUSSIAN = 2.4e-8
"""Time of a plain step: 14 ms for 500,000 Gaussians, from the paper's 7.18 minutes for 30,000 iterations."""
GPU_TEXTURED = 2.0
"""Ratio of a textured step to a plain one: 19.7 minutes, if they are for both stages, leave 25 ms a step."""
CPU_SECONDS_PER_GAUSSIAN = 2.4e-6
"""Seconds for a view on one core (docs/performance.md); all cores share them."""
CPU_SECONDS_PER_PIXEL = 0.72e-6
COMPILE_SECONDS = 5.0
"""Seconds on one core to compile a program of training."""
OTHER_SECONDS = 4.0
"""Seconds on one core to load, measure and save a stage."""
MOST_ROWS = 40
"""Largest number of cells in the table."""
FINISHED = "the steps of finished stages of the same size"
GPU = "the paper's program on its GPU, since none has been timed here"
MISSING = "the paper's program on its GPU, since not all scenes are below --scenes"
CPU = "a very rough figure of CPUs, which may be wrong by a factor of two"


@dataclasses.dataclass(frozen=True)
class Machine:
    """Machine that trains the stages."""

    jobs: int
    """Number of stages at a time."""
    memory: float
    """Bytes that they may take together."""
    has_gpu: bool


@dataclasses.dataclass(frozen=True)
class Estimate:
    """Estimate of a stage."""

    shared: float
    """Seconds of its steps if it has the machine to itself."""
    own: float
    """Seconds in which other stages train beside it."""
    source: str
    """Origin of the time of its steps."""

    @property
    def seconds(self) -> float:
        """Seconds of the stage alone."""
        return self.shared + self.own


def plan_of(grids: Sequence[Grid], records: Mapping[str, Record], folders: Folders, machine: Machine) -> str:
    """Return a table of the cells, and estimates of what is left."""
    stages = stages_of(grids, records)
    left = [stage for key, stage in stages.items() if key not in records]
    if not left:
        return f"{_cells(grids, records)}\nAll {len(stages)} stages are finished."
    steps = sum(stage.job.iterations for stage in left)
    forecaster = Forecaster(folders)
    estimates = [_estimate(stage.job, records, machine, forecaster) for stage in left]
    return (
        f"{_cells(grids, records)}\n"
        f"{len(left)} of {len(stages)} stages are left, {steps:,} iterations; one that several methods share "
        f"counts once.\n\n{jobs_text(left, estimates)}\n{_time(estimates, machine)}\n"
        f"{_room(left, folders, machine)}"
    )


def jobs_text(left: Sequence[Stage], estimates: Sequence[Estimate]) -> str:
    """Return a row for each stage that is left, with its hours and memory as a job of its own."""
    rows = [
        [str(stage), f"{one.seconds / 3600:.2g}", in_bytes(estimated_bytes(stage.job))]
        for stage, one in zip(left, estimates, strict=True)
    ]
    more = f"… and {len(rows) - MOST_ROWS} more stages\n" if len(rows) > MOST_ROWS else ""
    return table(["stage, a job on a cluster", "hours", "memory"], rows[:MOST_ROWS]) + more


def _cells(grids: Sequence[Grid], records: Mapping[str, Record]) -> str:
    """Return a row for each cell with the methods that are left."""
    rows = []
    for cell, runs in runs_by_cell(grids, records).items():
        left = _left(runs, records)
        length = "+".join(f"{count:,}" for count in cell.iterations)
        done = f"{len(runs) - len(left)} of {len(runs)}"
        rows.append([scene_text(cell.scene), cell.size, str(cell.seed), length, done, _left_text(left, len(runs))])
    more = f"… and {len(rows) - MOST_ROWS} more cells\n" if len(rows) > MOST_ROWS else ""
    header = ["scene", "Gaussians or budget", "seed", "iterations", "methods finished", "methods left"]
    return table(header, rows[:MOST_ROWS]) + more


def missing_text(grid: Grid, records: Mapping[str, Record]) -> str:
    """Return a line with the unfinished runs of each cell; empty if all are finished."""
    parts = []
    for cell, runs in runs_by_cell([grid], records).items():
        left = _left(runs, records)
        if left:
            place = f"{scene_text(cell.scene)}, {cell.size}, seed {cell.seed}"
            parts.append(f"{place}: {_left_text(left, len(runs))}")
    return f"\n*Not finished: {' · '.join(parts)}.*\n" if parts else ""


def _left(runs: Mapping[str, Run], records: Mapping[str, Record]) -> list[str]:
    """Return the labels of the unfinished runs of a cell."""
    return [label for label, run in runs.items() if run.job.key not in records]


def _left_text(labels: Sequence[str], num: int) -> str:
    if not labels:
        return "–"
    return "all" if len(labels) == num > 1 else "; ".join(labels)


def _time(found: Sequence[Estimate], machine: Machine) -> str:
    seconds = sum(one.shared for one in found) + sum(one.own for one in found) / machine.jobs
    sources = " and ".join(dict.fromkeys(one.source for one in found))
    compiling = "" if machine.has_gpu else ", with compilation"
    return (
        f"Time: about {duration(seconds)} on this machine, {machine.jobs} at a time{compiling}, estimated from "
        f"{sources}. Pages that measure models take some minutes more."
    )


class Forecaster:
    """Seconds of stages on the CPUs of this machine; each scene is read once, its photographs are not."""

    def __init__(self, folders: Folders):
        self._folders = folders
        self._scenes: dict[tuple, a2tg.Scene] = {}

    def seconds(self, job: Job) -> float:
        """Return the seconds of a stage's steps."""
        views = self._scene(job).train
        pixels = sum(view.camera.width * view.camera.height for view in views) / len(views)
        view_seconds = CPU_SECONDS_PER_GAUSSIAN * num_gaussians(job.system) + CPU_SECONDS_PER_PIXEL * pixels
        return job.iterations * job.system.batch_size * view_seconds / num_threads()

    def has_scene(self, job: Job) -> bool:
        """Return whether the scene of a stage is there."""
        return job.scene in BUILT_IN or (self._folders.scenes / job.scene).is_dir()

    def _scene(self, job: Job) -> a2tg.Scene:
        place = job.scene, job.downscale, job.fold, job.validation
        if place not in self._scenes:
            self._scenes[place] = self._folders.load_scene(job, room=0)
        return self._scenes[place]


def _estimate(job: Job, records: Mapping[str, Record], machine: Machine, forecaster: Forecaster) -> Estimate:
    """Return the time of a stage."""
    compiling = 0.0 if machine.has_gpu else COMPILE_SECONDS * num_programs(job) + OTHER_SECONDS
    pace = finished_pace(job, records)
    if pace is not None:
        return Estimate(0.0, job.iterations * pace + compiling, FINISHED)
    if machine.has_gpu:
        return Estimate(0.0, job.iterations * gpu_pace(job), GPU)
    if not forecaster.has_scene(job):
        return Estimate(job.iterations * gpu_pace(job), compiling, MISSING)
    return Estimate(forecaster.seconds(job), compiling, CPU)


def num_programs(job: Job) -> int:
    """Return the number of programs that a stage compiles, about."""
    stage = job.system.stages()[job.stage]
    return 1 + sum(one.num_programs(stage.iterations) for one in stage.events if isinstance(one, HostEvent))


def _room(left: Sequence[Stage], folders: Folders, machine: Machine) -> str:
    """Return disk and memory in words."""
    disk = sum(stage.job.model_bytes for stage in left)
    memory = max(estimated_bytes(stage.job) for stage in left)
    return (
        f"Disk: about {in_bytes(disk)} of models in {folders.work}. Memory: at most {in_bytes(memory)} for a stage; "
        f"{in_bytes(machine.memory)} may be used."
    )


def duration(seconds: float) -> str:
    """Return a time in hours or minutes."""
    if seconds >= 3600:
        return f"{seconds / 3600:.1f} hours"
    return f"{seconds / 60:.0f} minutes" if seconds >= 90 else "a minute"


def finished_pace(job: Job, records: Mapping[str, Record]) -> float | None:
    """Return the seconds of a step, scaled from finished runs of the stage at this size; None without."""
    num = num_gaussians(job.system)
    stage = job.system.stages()[job.stage].name
    paces = [
        record["ms_per_step"] / 1e3 * (1 + num / 10_000) / (1 + record["num"] / 10_000)
        for record in records.values()
        if record["stage"] == stage and record["downscale"] == job.downscale and record["ms_per_step"] is not None
    ]
    return float(np.nanmedian(paces)) if np.isfinite(paces).any() else None


def gpu_pace(job: Job) -> float:
    """Return the seconds of a step on the paper's GPU."""
    stage = job.system.stages()[job.stage].name
    plain = GPU_SECONDS + GPU_SECONDS_PER_GAUSSIAN * num_gaussians(job.system)
    return plain * (GPU_TEXTURED if stage == "textures" else 1)
