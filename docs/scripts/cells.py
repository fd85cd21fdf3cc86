"""Write the picture of docs/how-it-works.md: the scene of cells, with plain and with textured Gaussians of equal bytes.

python docs/scripts/cells.py docs/images

Prints the PSNR of each. Takes three minutes on two cores.
"""

import pathlib
import sys

import a2tg_jax as a2tg
from a2tg_jax.results.figures import level_maps, level_picture
from a2tg_jax.results.images import save_picture, side_by_side, to_uint8

BUDGET = "0.1MB"
DEGREE = 3
PART = slice(20, 132), slice(24, 136)
"""Rows and columns of the view that are shown."""


def main(folder: pathlib.Path, **lengths: int) -> None:
    """Train both systems for equally many iterations, by default as many as the preset has, and draw a test view."""
    scene = a2tg.cells_scene()
    textured = a2tg.A2tg.preset("quick", memory_budget=BUDGET, sh_degree=DEGREE, **lengths)
    lengths = {name: getattr(textured, name) for name in ("stage1_iterations", "stage2_iterations")}
    plain = a2tg.Gaussians2dMcmc.preset("quick", memory_budget=BUDGET, sh_degree=DEGREE, **lengths)
    models = [a2tg.fit(scene, system).model for system in (plain, textured)]
    for name, model in zip(("plain", "A²TG"), models, strict=True):
        print(f"{name}: {model.num_bytes:,} bytes, {a2tg.evaluate(scene.test, model).psnr:.2f} dB")
    view = scene.test[2]
    renders = [to_uint8(a2tg.Renderer(model)(view.camera).color) for model in models]
    maps = {file: levels for file, _, levels, _ in level_maps(models[1])}
    sizes = level_picture(models[1], maps["resolutions.png"], view.camera, a2tg.RenderSettings())
    pictures = [to_uint8(a2tg.view_image(view)), *renders, sizes]
    captions = ["photograph", "plain Gaussians", "A²TG", "texels: none (dark) to 16 (bright)"]
    save_picture(folder / "cells.png", side_by_side([picture[PART] for picture in pictures], captions))


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
