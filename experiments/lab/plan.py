"""What is left to run, and about how long it takes."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from lab.grid import Grid
from lab.jobs import Job, Record

GPU_SECONDS, GPU_SECONDS_A_SPLAT = 0.002, 2.4e-8
"""Of a plain step: with 500,000 Gaussians the 14 ms that follow from the paper's 7.18 minutes for 30,000 iterations."""
GPU_TEXTURED = 2.0
"""A textured step takes so many times as long: 19.7 minutes, if they are for both stages, leave 25 ms a step."""


def plan_of(grids: Sequence[Grid], records: Mapping[str, Record]) -> str:
    """A few lines. Runs at equal bytes are counted as if their number of splats were known: that of the cell."""
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
        f"{len(open_jobs)} stages left of those that can be named, {steps:,} iterations: {seconds / 3600:.1f} hours on "
        f"one machine, one at a time. Runs at equal bytes that follow from them: {unknown}, two stages each at most. "
        f"In all about {total / 3600:.1f} hours, or that divided by the machines. A step is taken to last as in runs "
        "that are finished here, where there are some, and else as the paper tells of its own program and GPU: this "
        "one has not been timed on a GPU yet."
    )


def _all_jobs(grid: Grid, records: Mapping[str, Record]) -> Iterable[Job]:
    """Those of a grid, and those that they start from."""
    for job in grid.jobs(records):
        ahead: Job | None = job
        while ahead is not None:
            yield ahead
            ahead = ahead.start


def seconds_of_step(job: Job, records: Mapping[str, Record]) -> float:
    """Of a step of a job: scaled from finished runs of such a stage at this size, or as on the paper's GPU."""
    num = getattr(getattr(job.system, "densify", None), "cap", 100_000)
    stage = job.system.stages()[job.stage].name
    paces = [
        record["ms_per_step"] / 1e3 * (1 + num / 10_000) / (1 + record["num"] / 10_000)
        for record in records.values()
        if record["stage"] == stage and record["downscale"] == job.downscale
    ]
    if np.isfinite(paces).any():
        return float(np.nanmedian(paces))
    return (GPU_SECONDS + GPU_SECONDS_A_SPLAT * num) * (GPU_TEXTURED if stage == "textures" else 1)
