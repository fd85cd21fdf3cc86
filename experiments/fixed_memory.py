"""Every method in the bytes that A²TG ends with: Table 1 of the paper.

python experiments/fixed_memory.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from collections.abc import Sequence

from lab import tables
from lab.cli import Experiment, Lab, main
from lab.grid import Grid


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Ours, then the paper's."""
    (grid,) = grids
    results = tables.results_of(grid, lab.records)
    ours = tables.quality_tables(grid, results)
    paper = tables.paper_table("fixed_memory", "budget_mb", tables.QUALITY_COLUMNS)
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{ours}\n## In the paper\n\n{paper}")


EXPERIMENT = Experiment("fixed_memory", ("fixed_memory",), present)

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
