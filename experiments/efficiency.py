"""Frames per second, time of a frame and of training, and size: Table 4 of the paper.

Times are measured one after the other after all runs, and kept in efficiency.json. Let nothing else run beside the
measurement. Training time is the time of a step with all Gaussians, multiplied by the iterations.
"""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid
from lab.jobs import Job
from lab.kept import Figures, read_kept

import a2tg_jax as a2tg
from a2tg_jax.results.folder import write_json
from a2tg_jax.training import fit_stage

TIMED_ITERATIONS = 150
TIMED_ROUNDS = 3
SMOKE_ITERATIONS = 20
SMOKE_ROUNDS = 1


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write our times, measured once on this machine, then the paper's."""
    (grid,) = grids
    text = table_of_times(lab, grid)
    columns = (
        ("mb", "MB"),
        ("fps", "frames/s"),
        ("seconds_per_frame", "s a frame"),
        ("training_minutes", "training, min"),
    )
    paper = tables.paper_table(EXPERIMENT.name, "gaussians", columns, "Deep Blending")
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{text}\n## In the paper\n\n{paper}")


def table_of_times(lab: Lab, grid: Grid) -> str:
    """Return size and speed of a grid's models, measured once and kept in efficiency.json; runs without times are left
    out."""
    path = lab.out / f"{EXPERIMENT.name}.json"
    rows = []
    kept = read_kept(path)
    for result in tables.results_of(grid, lab.records):
        key = result.run.job.key
        if key not in kept and not lab.args.tables_only:
            model = lab.model(result)
            if model is not None:
                kept[key] = _times(lab, result, model)
                write_json(path, kept)
        if key in kept:
            rows.append(_row(result, kept[key]))
    header = ["scene", "method", "Gaussians", "MB", "frames/s", "ms a frame", "ms a step, stages 1, 2", "training, min"]
    return tables.markdown([*header, "machine"], rows)


def _row(result: tables.Result, times: Figures) -> list[str]:
    minutes = sum(steps * pace for steps, pace in zip(times["iterations"], times["ms_per_step"], strict=True)) / 6e4
    paces = ", ".join(tables.number(pace, 1) for pace in times["ms_per_step"])
    return [
        result.run.cell.scene.label, result.label, f"{result.record['num']:,}", tables.number(result["mb"], 2),
        tables.number(times["fps"], 1), tables.number(1e3 / times["fps"], 1), paces,
        tables.number(minutes, 1 if minutes >= 0.1 else 2),
        times["machine"],
    ]  # fmt: skip


def _times(lab: Lab, result: tables.Result, model: a2tg.Model) -> dict:
    """Return frames per second on the test views, and the time of a step in each stage, compiled and warm."""
    job = result.run.job
    rounds = SMOKE_ROUNDS if lab.is_smoke else TIMED_ROUNDS
    scene = lab.folders.load_scene(job)
    return {
        "fps": max(a2tg.evaluate(scene.test, model).frames_per_second for _ in range(rounds)),
        "ms_per_step": [1e3 * _seconds_per_step(lab, one, scene) for one in job.chain],
        "iterations": job.all_iterations,
        "machine": jax.devices()[0].device_kind,
    }


def _seconds_per_step(lab: Lab, job: Job, scene: a2tg.Scene) -> float:
    """Return the time of a step with all Gaussians of the trained stage: the best median of some rounds."""
    iterations, rounds = (SMOKE_ITERATIONS, SMOKE_ROUNDS) if lab.is_smoke else (TIMED_ITERATIONS, TIMED_ROUNDS)
    system = dataclasses.replace(job.system, **{f"stage{stage}_iterations": iterations for stage in (1, 2)})
    start = a2tg.load_model(lab.folders.model(job if job.stage == 0 else dataclasses.replace(job, stage=0)))
    paces = []
    for _ in range(rounds):
        history = fit_stage(scene, system, job.stage, start).history
        paces.append(float(np.median(np.diff(history.seconds) / np.diff(history.iteration))))
    return min(paces)


EXPERIMENT = Experiment("efficiency", ("efficiency",), present, __doc__)
