"""Every method with the same number of Gaussians: Table 2 of the paper, and the table of its appendix.

python experiments/fixed_number.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
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
    paper = tables.paper_table("fixed_number", "gaussians", tables.QUALITY_COLUMNS)
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{ours}\n## In the paper\n\n{paper}")


EXPERIMENT = Experiment("fixed_number", ("fixed_number",), present)

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
