"""The claim over the number of Gaussians, the length of training and the size of the photographs.

python experiments/where_textures_pay.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from collections.abc import Sequence

from lab import tables
from lab.cli import Experiment, Lab, main
from lab.grid import Grid


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """By how much A²TG, and any variant of it, is above plain Gaussians in its bytes."""
    (grid,) = grids
    results = tables.results_of(grid, lab.records)
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{tables.variants_of_reference(grid, results)}")


EXPERIMENT = Experiment("where_textures_pay", ("where_textures_pay",), present)

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
