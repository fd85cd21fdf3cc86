"""PSNR against memory, and memory against the number of Gaussians: the line charts of the paper."""

from collections.abc import Sequence

from lab import plots, tables
from lab.cli import Experiment, Lab
from lab.grid import Grid

from a2tg_jax.results.figures import save_figure

METHODS = ("2DGS*-MCMC", "Textured Gaussians*", "A²TG", "A²TG, as quick has it")


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Save a chart of quality for each column of scenes, and one of memory."""
    results = list(
        {id(result.record): result for grid in grids for result in tables.results_of(grid, lab.records)}.values()
    )
    panels = []
    for column in dict.fromkeys(result.column for result in results):
        own = [result for result in results if result.column == column]
        panels.append((column, {label: _points(own, label, "mb", "psnr") for label in METHODS}, "MB", "test PSNR, dB"))
    sizes = {label: _points(results, label, "num", "mb") for label in METHODS}
    panels.append(("memory of all scenes", sizes, "Gaussians", "MB"))
    log_y = [False] * (len(panels) - 1) + [True]
    save_figure(lab.pages / "memory_charts.png", plots.charts(panels, log_y=log_y))
    print(lab.pages / "memory_charts.png")


def _points(results: Sequence[tables.Result], label: str, x: str, y: str) -> list[plots.Point]:
    """Return a method's points, means over scenes, for each number of Gaussians and each way to choose its own."""
    groups: dict[tuple[int, bool], list[tables.Result]] = {}
    for result in results:
        if result.run.method.label == label:
            groups.setdefault((result.run.cell.gaussians, result.run.equal), []).append(result)
    return [(tables.mean(group, x), tables.mean(group, y)) for group in groups.values()]


EXPERIMENT = Experiment("memory_charts", ("fixed_memory", "fixed_number", "ablation"), present, __doc__)
