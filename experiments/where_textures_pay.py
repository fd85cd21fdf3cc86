"""The claim over the number of Gaussians, the length of training and the size of the photographs.

python experiments/where_textures_pay.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from collections.abc import Sequence

from lab import tables
from lab.cli import Experiment, Lab, main
from lab.grid import Grid


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """By how much A²TG is above plain Gaussians in its bytes."""
    results = [result for grid in grids for result in tables.results_of(grid, lab.records)]
    label = grids[0].reference.label
    others = [*(method.label + tables.EQUAL_BYTES for method in grids[1].at_equal_bytes), "2DGS*-MCMC"]
    text = tables.gains_table(results, label, others)
    lab.write(EXPERIMENT.name, f"# {grids[1].title}\n\n{text}")


EXPERIMENT = Experiment("where_textures_pay", ("claim", "where_textures_pay"), present)

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
