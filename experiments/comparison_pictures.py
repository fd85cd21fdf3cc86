"""Test views at equal bytes beside the photograph: the view of median gain, and the part of it that differs most."""

from collections.abc import Sequence

import numpy as np
from lab import pictures, tables
from lab.cli import Experiment, Lab
from lab.grid import Grid
from skimage.metrics import peak_signal_noise_ratio

import a2tg_jax as a2tg
from a2tg_jax.data.scene import view_image
from a2tg_jax.results.images import largest_gain, save_picture, side_by_side, to_uint8

ZOOM = 4


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Save, for each scene with models, the test view in which the reference gains as much as in half of them, and the
    part of it in which it gains most."""
    (grid,) = grids
    for scene in dict.fromkeys(cell.scene for cell in grid.cells):
        results = [result for result in tables.results_of(grid, lab.records) if result.run.cell.scene == scene]
        models = {result.label: lab.model(result) for result in results}
        if len(models) > 1 and None not in models.values():
            views = lab.folders.load_scene(results[0].run.job).test
            _save_sheets(lab, scene.label.replace("/", "-"), views, models)


def _save_sheets(lab: Lab, stem: str, views: Sequence[a2tg.View], models: dict[str, a2tg.Model]) -> None:
    """Save the whole view and a part; the first model is the reference, the second the one it is compared with."""
    background = next(iter(models.values())).background
    drawn = {label: a2tg.Renderer(model) for label, model in models.items()}
    rows = []
    for view in views:
        images = [to_uint8(draw(view.camera).color) for draw in drawn.values()]
        rows.append([to_uint8(view_image(view, background)), *images])
    rows.sort(key=lambda row: _decibels(row[0], row[1]) - _decibels(row[0], row[2]))
    target, first, second, *others = rows[len(rows) // 2]
    images, captions = [target, first, second, *others], ["photograph", *models]
    save_picture(lab.pages / f"{EXPERIMENT.name}-{stem}.png", side_by_side(images, captions))
    crop = largest_gain(target, second, first)
    close = [pictures.enlarged(image[crop], ZOOM) for image in images]
    save_picture(lab.pages / f"{EXPERIMENT.name}-{stem}-close.png", side_by_side(close, captions))


def _decibels(target: np.ndarray, image: np.ndarray) -> float:
    """Return the PSNR of 8-bit pictures."""
    return float(peak_signal_noise_ratio(target, image))


EXPERIMENT = Experiment("comparison_pictures", ("pictures",), present, __doc__)
