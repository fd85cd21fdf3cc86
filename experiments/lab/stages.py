"""The stages of a sweep with the runs that need them, and their names in tables and logs."""

import dataclasses
from collections.abc import Mapping, Sequence

from lab.grid import Cell, Grid, Run
from lab.grid_file import SUFFIX
from lab.jobs import Job, Record, model_bytes
from lab.scenes import SceneAt


@dataclasses.dataclass(frozen=True)
class Stage:
    """A stage to train, and a run that needs it."""

    job: Job
    run: Run

    def __str__(self) -> str:
        cell = self.run.cell
        stage = self.job.system.stages()[self.job.stage].name
        size = cell.size if cell.budget is not None else f"{cell.size} Gaussians"
        if self.run.equal:
            size = f"{self.run.equal} of {size}"
        fold = "" if cell.scene.fold is None else f", fold {cell.scene.fold}"
        return f"{scene_text(cell.scene)}{fold}, {self.run.method.label}, stage {stage}, {size}, seed {cell.seed}"


def scene_text(scene: SceneAt) -> str:
    """Return the label of a scene with its size."""
    return scene.label if scene.downscale == 1 else f"{scene.label} 1/{scene.downscale}"


def stages_of(grids: Sequence[Grid], records: Mapping[str, Record]) -> dict[str, Stage]:
    """Return the stages of all runs by the key of their job; the bytes of unfinished references are guessed."""
    found: dict[str, Stage] = {}
    for grid in grids:
        for run in grid.runs(guessed(grid, records)):
            for job in run.job.chain:
                found.setdefault(job.key, Stage(job, run))
    return found


def check_systems(grids: Sequence[Grid], records: Mapping[str, Record]) -> None:
    """Raise ValueError if training would refuse an option of a run; grid and method are named."""
    for grid in grids:
        grid.check_choices()
        for run in grid.runs(guessed(grid, records)):
            try:
                run.job.system.check()
            except ValueError as error:
                raise ValueError(f"{grid.name}{SUFFIX}: {run.method.label!r}: {error}") from error


def guessed(grid: Grid, records: Mapping[str, Record]) -> dict[str, Record]:
    """Return the records, with the largest possible bytes of references that are not finished."""
    references = map(grid.reference_job, grid.cells if grid.at_equal_bytes or grid.at_equal_time else ())
    return {**{job.key: {"mb": model_bytes(job.system) / 1e6} for job in references}, **records}


def runs_by_cell(grids: Sequence[Grid], records: Mapping[str, Record]) -> dict[Cell, dict[str, Run]]:
    """Return the runs of every cell by label of the method; bytes are guessed as in `stages_of`."""
    cells: dict[Cell, dict[str, Run]] = {}
    for grid in grids:
        for run in grid.runs(guessed(grid, records)):
            cells.setdefault(run.cell, {})[run.label] = run
    return cells
