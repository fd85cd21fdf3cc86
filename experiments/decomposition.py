"""The share of textures in a picture: all, spherical harmonics only, textures only; and the textures."""

from collections.abc import Sequence

import numpy as np
from lab import pictures, tables
from lab.cli import Experiment, Lab
from lab.grid import Grid
from lab.jobs import background_of
from PIL import Image

import a2tg_jax as a2tg
from a2tg_jax.results.images import save_picture, side_by_side, to_uint8

NUM_TEXTURES, ZOOM = 16, 12


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Save two pictures of each scene with a model, and write the PSNR that textures add to its test views."""
    (grid,) = grids
    rows = []
    for result in tables.results_of(grid, lab.records):
        model = lab.model(result) if result.label == grid.reference.label else None
        if model is None:
            continue
        name = result.run.cell.scene.label
        views = {"full": model, "SH only": pictures.without_textures(model), "texture only": pictures.without_sh(model)}
        camera = model.origin.cameras[0]
        shown = [to_uint8(a2tg.Renderer(one)(camera).color) for one in views.values()]
        stem = name.replace("/", "-")
        save_picture(lab.pages / f"{EXPERIMENT.name}-{stem}.png", side_by_side(shown, list(views)))
        save_picture(lab.pages / f"learned_textures-{stem}.png", _textures_picture(model))
        scene = lab.folders.load_scene(result.run.job)
        quality = [a2tg.evaluate(scene.test, one, background=background_of(scene)) for one in views.values()]
        rows.append([name, *(tables.number(found.psnr, 2) for found in quality)])
    text = tables.markdown(["scene", "full: PSNR", "SH only", "texture only"], rows)
    lab.write(EXPERIMENT.name, f"# What textures carry\n\n{text}")


def _textures_picture(model: a2tg.Model) -> Image.Image:
    """Return the most varied textures of 4×4, 1×4 and 4×1 texels (rows × columns): RGB above, alpha below."""
    sheets = [pictures.learned_textures(model, size, NUM_TEXTURES) for size in ((4, 4), (1, 4), (4, 1))]
    sheets = [pictures.enlarged(sheet, ZOOM) for sheet in sheets if sheet.shape[1]]
    width = max((sheet.shape[1] for sheet in sheets), default=1)
    padded = [np.pad(sheet, ((0, ZOOM), (0, width - sheet.shape[1]), (0, 0)), constant_values=255) for sheet in sheets]
    return Image.fromarray(np.concatenate(padded) if padded else np.full((1, 1, 3), 255, np.uint8))


EXPERIMENT = Experiment("decomposition", ("pictures",), present, __doc__)
