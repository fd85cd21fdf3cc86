"""What short runs want: the preset `quick` with its numbers put back to the paper's, one at a time.

python experiments/quick_preset.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from collections.abc import Sequence

from lab import tables
from lab.cli import Experiment, Lab, main
from lab.grid import Grid


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """What each number of the paper gains over that of `quick`."""
    (grid,) = grids
    results = tables.results_of(grid, lab.records)
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{tables.choices_table(results, grid.reference.label)}")


EXPERIMENT = Experiment("quick_preset", ("quick_preset",), present)

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
