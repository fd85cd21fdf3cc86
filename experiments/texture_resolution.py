"""Textures of one size against textures of at most that size: the paper's appendix."""

from collections.abc import Sequence

from lab import plots, tables
from lab.cli import Experiment, Lab
from lab.grid import Grid

from a2tg_jax.results.figures import save_figure


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write our tables, then the paper's, and charts of PSNR and LPIPS against memory."""
    (grid,) = grids
    results = tables.results_of(grid, lab.records)
    paper = tables.paper_table(EXPERIMENT.name, "gaussians", tables.QUALITY_COLUMNS, "Deep Blending")
    ours = tables.quality_tables(grid, results)
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{ours}\n## In the paper\n\n{paper}")
    panels = []
    for column in dict.fromkeys(result.column for result in results):
        own = [result for result in results if result.column == column]
        panels.append((column, _curves(own, "psnr"), "MB", "test PSNR, dB"))
        panels.append((column, _curves(own, "lpips"), "MB", "test LPIPS"))
    if panels:
        save_figure(lab.pages / f"{EXPERIMENT.name}.png", plots.charts(panels))


def _curves(results: Sequence[tables.Result], figure: str) -> dict[str, list[plots.Point]]:
    """Return the points of all resolutions, means over scenes, by method and number of Gaussians."""
    points: dict[tuple[str, int, str], list[tables.Result]] = {}
    for result in results:
        method, _, resolution = result.label.rpartition(", ")
        points.setdefault((method, result.run.cell.gaussians, resolution), []).append(result)
    curves: dict[str, list[plots.Point]] = {}
    for (method, num, _), own in points.items():
        curves.setdefault(f"{method}, {num:,}", []).append((tables.mean(own, "mb"), tables.mean(own, figure)))
    return curves


EXPERIMENT = Experiment("texture_resolution", ("texture_resolution",), present, __doc__)
