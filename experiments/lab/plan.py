"""The runs that are left, and about how long they take."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from lab.grid import Grid
from lab.jobs import Job, Record, num_gaussians

GPU_SECONDS, GPU_SECONDS_A_SPLAT = 0.002, 2.4e-8
"""Time of a plain step: 14 ms for 500,000 Gaussians, from the paper's 7.18 minutes for 30,000 iterations."""
GPU_TEXTURED = 2.0
"""Ratio of a textured step to a plain one: 19.7 minutes, if they are for both stages, leave 25 ms a step."""


def plan_of(grids: Sequence[Grid], records: Mapping[str, Record]) -> str:
    """Return what is left in a few lines. Runs at equal bytes count with the number of splats of their cell."""
    open_jobs = {job.key: job for grid in grids for job in _all_jobs(grid, records) if job.key not in records}
    unknown = sum(
        len(grid.at_equal_bytes)
        for grid in grids
        for cell in grid.cells
        if grid.reference_record(cell, records) is None
    )
    steps = sum(job.iterations for job in open_jobs.values())
    seconds = sum(job.iterations * seconds_of_step(job, records) for job in open_jobs.values())
    average = seconds / max(1, len(open_jobs))
    total = seconds + unknown * 2 * average
    return (
        f"{len(open_jobs)} stages left of those that can be named, {steps:,} iterations: {duration(seconds)} on "
        f"one machine, one at a time. Runs at equal bytes that follow from them: {unknown}, two stages each at most. "
        f"In all about {duration(total)}, or that divided by the machines. The time of a step is that of finished runs "
        "here, or else that of the paper's program and GPU: this one has not been timed on a GPU yet."
    )


def duration(seconds: float) -> str:
    """Return a time in hours or minutes."""
    if seconds >= 3600:
        return f"{seconds / 3600:.1f} hours"
    return f"{seconds / 60:.0f} minutes" if seconds >= 60 else "less than a minute"


def _all_jobs(grid: Grid, records: Mapping[str, Record]) -> Iterable[Job]:
    """Return the jobs of a grid and the jobs that they start from."""
    for job in grid.jobs(records):
        ahead: Job | None = job
        while ahead is not None:
            yield ahead
            ahead = ahead.start


def seconds_of_step(job: Job, records: Mapping[str, Record]) -> float:
    """Return the time of a job's step, scaled from finished runs of the stage at this size or from the paper's GPU."""
    num = num_gaussians(job.system)
    stage = job.system.stages()[job.stage].name
    paces = [
        record["ms_per_step"] / 1e3 * (1 + num / 10_000) / (1 + record["num"] / 10_000)
        for record in records.values()
        if record["stage"] == stage and record["downscale"] == job.downscale
    ]
    if np.isfinite(paces).any():
        return float(np.nanmedian(paces))
    return (GPU_SECONDS + GPU_SECONDS_A_SPLAT * num) * (GPU_TEXTURED if stage == "textures" else 1)
