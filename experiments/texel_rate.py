"""The texels' learning rate at two densities, on all scenes but those held out.

python experiments/texel_rate.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from collections.abc import Sequence

from lab import tables
from lab.cli import Experiment, Lab, main
from lab.grid import Grid


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """What each rate gains over the default."""
    (grid,) = grids
    results = tables.results_of(grid, lab.records)
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{tables.choices_table(results, grid.reference.label)}")


EXPERIMENT = Experiment("texel_rate", ("texel_rate",), present)

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
