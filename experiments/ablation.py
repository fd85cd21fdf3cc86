"""Gain and cost of upscaling and of anisotropy: Table 3 of the paper."""

from collections.abc import Sequence

from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write our tables, then the paper's."""
    (grid,) = grids
    results = tables.results_of(grid, lab.records)
    others = [method.label for method in grid.methods]
    gains = tables.gains_table(results, grid.reference.label, others)
    ours = tables.quality_tables(grid, results) + "\n## At the same number of Gaussians\n\n" + gains
    paper = tables.paper_table("ablation", "gaussians", tables.QUALITY_COLUMNS)
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{ours}\n## In the paper\n\n{paper}")


EXPERIMENT = Experiment("ablation", ("ablation",), present, __doc__)
