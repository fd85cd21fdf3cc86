"""Test views of the systems at equal bytes beside the photograph, where they differ most: the paper's comparison.

python experiments/comparison_pictures.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from collections.abc import Sequence

import numpy as np
from lab import tables
from lab.cli import Experiment, Lab, main
from lab.grid import Grid

import a2tg_jax as a2tg
from a2tg_jax.data import view_image
from a2tg_jax.results.pictures import largest_gain, save_picture, side_by_side, to_uint8

ZOOM = 4


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Of each scene whose models are there, the first test view, and the part in which A²TG gains most."""
    (grid,) = grids
    for scene in dict.fromkeys(cell.scene for cell in grid.cells):
        results = [result for result in tables.results_of(grid, lab.records) if result.run.cell.scene == scene]
        models = {result.label: lab.model(result) for result in results}
        models = {label: model for label, model in models.items() if model is not None}
        if len(models) > 1:
            view = lab.folders.load_scene(results[0].run.job).test[0]
            _save_sheets(lab, scene.label.replace("/", "-"), view, models)


def _save_sheets(lab: Lab, stem: str, view: a2tg.View, models: dict[str, a2tg.Model]) -> None:
    lab.out.mkdir(parents=True, exist_ok=True)
    target = to_uint8(view_image(view, next(iter(models.values())).background))
    shown = {label: to_uint8(a2tg.Renderer(model)(view.camera).color) for label, model in models.items()}
    first, *others = shown.values()
    images, captions = [target, *shown.values()], ["photograph", *shown]
    save_picture(lab.out / f"comparison-{stem}.png", side_by_side(images, captions))
    crop = largest_gain(target, others[0], first)
    close = [np.repeat(np.repeat(crop.of(image), ZOOM, 0), ZOOM, 1) for image in images]
    save_picture(lab.out / f"comparison-{stem}-close.png", side_by_side(close, captions))


EXPERIMENT = Experiment("comparison_pictures", ("pictures",), present)

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
