"""Gain of least squares on the colours and texels of trained models, at fixed shapes and bytes.

Figures are kept in polish.json.
"""

import time
from collections.abc import Mapping, Sequence

import numpy as np
from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid
from lab.jobs import MOST_TRAIN_VIEWS, background_of
from lab.measured import measured_once

import a2tg_jax as a2tg

NUM_STEPS, SMOKE_STEPS = (2, 5, 10), (1,)


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write a table of the available models, each measured once."""
    (grid,) = grids
    num_steps = _num_steps(lab)
    rows, gains = [], []
    for result, found in measured_once(lab, EXPERIMENT.name, grid, _measure):
        shown = [_as_text(found[str(steps)], found["0"]) for steps in num_steps]
        gains.append([found[str(steps)]["psnr"] - found["0"]["psnr"] for steps in num_steps])
        size = f"{result.run.cell.budget:g} MB"
        rows.append([result.run.cell.scene.label, size, result.label, f"{found['0']['psnr']:.2f}", *shown])
    if gains:
        means = [tables.signed(gain, 2) for gain in np.mean(gains, axis=0)]
        rows.append(["*mean*", "", "", "", *means])
    steps = [f"{steps} steps: dB · LPIPS · train dB" for steps in num_steps]
    header = ["scene", "bytes", "method", "test PSNR", *steps]
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{tables.markdown(header, rows)}")


def _num_steps(lab: Lab) -> tuple[int, ...]:
    return SMOKE_STEPS if lab.is_smoke else NUM_STEPS


def _measure(lab: Lab, result: tables.Result, model: a2tg.Model) -> dict[str, dict[str, float]]:
    """Return quality before and after each number of steps."""
    scene = lab.folders.load_scene(result.run.job)
    background = background_of(scene)
    found = {"0": _quality(lab, scene, model, background)}
    for steps in _num_steps(lab):
        start = time.perf_counter()
        polished = a2tg.polish(model, scene.train, num_steps=steps, background=background)
        found[str(steps)] = {"seconds": time.perf_counter() - start, **_quality(lab, scene, polished, background)}
    return found


def _quality(lab: Lab, scene: a2tg.Scene, model: a2tg.Model, background) -> dict[str, float]:
    train = scene.train[:: -(-len(scene.train) // MOST_TRAIN_VIEWS)]
    test = a2tg.evaluate(scene.test, model, background=background, lpips_weights=lab.folders.lpips_weights)
    lpips = float("nan") if test.lpips is None else test.lpips
    return {"psnr": test.psnr, "lpips": lpips, "train": a2tg.evaluate(train, model, background=background).psnr}


def _as_text(after: Mapping[str, float], before: Mapping[str, float]) -> str:
    digits = {"psnr": 2, "lpips": 3, "train": 2}
    return " · ".join(tables.signed(after[figure] - before[figure], digits[figure]) for figure in digits)


EXPERIMENT = Experiment("polish", ("polish",), present, __doc__)
