"""Bytes saved by shrinking textures within 0.02 and 0.05 dB on training views, and the loss on test views.

Figures are kept in shrink.json.
"""

from collections.abc import Sequence
from typing import Any

from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid
from lab.jobs import MOST_TRAIN_VIEWS, background_of
from lab.measured import measured_once

import a2tg_jax as a2tg

MAX_LOSSES, SMOKE_LOSSES = (0.02, 0.05), (0.05,)


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write a table of the available models, each measured once."""
    (grid,) = grids
    max_losses = _max_losses(lab)
    rows = []
    for result, figures in measured_once(lab, EXPERIMENT.name, grid, _measure):
        cell = result.run.cell
        size = f"{cell.gaussians:,}" if cell.budget is None else f"{cell.budget:g} MB"
        shown = [_as_text(figures[str(most)], figures["0"]) for most in max_losses]
        rows.append([cell.scene.label, size, result.label, _kilobytes(figures["0"]), *shown])
    header = ["scene", "size", "method", "kB: all, texels", *(f"within {most} dB" for most in max_losses)]
    wording = "kB of all and of texels, and dB · LPIPS on test views against the model before."
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{wording}\n\n{tables.markdown(header, rows)}")


def _max_losses(lab: Lab) -> tuple[float, ...]:
    return SMOKE_LOSSES if lab.is_smoke else MAX_LOSSES


def _measure(lab: Lab, result: tables.Result, model: a2tg.Model) -> dict[str, Any]:
    """Return bytes and quality before and after."""
    scene = lab.folders.load_scene(result.run.job)
    background = background_of(scene)
    train = scene.train[:: -(-len(scene.train) // MOST_TRAIN_VIEWS)]
    found = {"0": _figures(lab, scene, model, background)}
    for most in _max_losses(lab):
        small = a2tg.shrink_textures(model, train, max_loss=most, background=background)
        found[str(most)] = _figures(lab, scene, small, background)
    return found


def _figures(lab: Lab, scene: a2tg.Scene, model: a2tg.Model, background) -> dict[str, Any]:
    test = a2tg.evaluate(scene.test, model, background=background, lpips_weights=lab.folders.lpips_weights)
    assert model.textures is not None
    texels = model.textures.num_texels
    return {"bytes": model.num_bytes, "texels": texels, "psnr": test.psnr, "lpips": test.lpips}


def _kilobytes(figures: dict[str, Any]) -> str:
    return f"{figures['bytes'] / 1e3:.1f}, {16 * figures['texels'] / 1e3:.1f}"


def _as_text(after: dict[str, Any], before: dict[str, Any]) -> str:
    is_measured = None not in (after["lpips"], before["lpips"])
    lpips = after["lpips"] - before["lpips"] if is_measured else float("nan")
    return f"{_kilobytes(after)} kB: {tables.signed(after['psnr'] - before['psnr'], 2)} · {tables.signed(lpips, 3)}"


EXPERIMENT = Experiment("shrink", ("shrink",), present, __doc__)
