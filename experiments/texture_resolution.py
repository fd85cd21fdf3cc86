"""Textures of one size against textures of at most that size: the table and the charts of the paper's appendix.

python experiments/texture_resolution.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from collections.abc import Sequence

from lab import plots, tables
from lab.cli import Experiment, Lab, main
from lab.grid import Grid

from a2tg_jax.results.figures import save_figure


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Ours, then the paper's; and PSNR and LPIPS against memory."""
    (grid,) = grids
    results = tables.results_of(grid, lab.records)
    paper = tables.paper_table("texture_resolution", "gaussians", tables.QUALITY_COLUMNS)
    ours = tables.quality_tables(grid, results)
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{ours}\n## In the paper, on Deep Blending\n\n{paper}")
    panels = []
    for column in dict.fromkeys(result.column for result in results):
        own = [result for result in results if result.column == column]
        panels.append((column, _curves(own, "psnr"), "MB", "test PSNR, dB"))
        panels.append((column, _curves(own, "lpips"), "MB", "test LPIPS"))
    if panels:
        save_figure(lab.out / f"{EXPERIMENT.name}.png", plots.charts(panels))


def _curves(results: Sequence[tables.Result], figure: str) -> dict[str, list[plots.Point]]:
    """Of each method and number of Gaussians, the points of its resolutions."""
    curves: dict[str, list[plots.Point]] = {}
    for result in results:
        curves.setdefault(result.label.rpartition(", ")[0], []).append((result["mb"], result[figure]))
    return curves


EXPERIMENT = Experiment("texture_resolution", ("texture_resolution",), present)

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
