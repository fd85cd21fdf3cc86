"""The paper's claim: at equal bytes A²TG is above more plain Gaussians, and above textures of one size.

python experiments/claim.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from collections.abc import Sequence

from lab import tables
from lab.cli import Experiment, Lab, main
from lab.grid import Grid


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """By how much A²TG, and any variant of it, is above the others, with the spread of seeds."""
    (grid,) = grids
    results = tables.results_of(grid, lab.records)
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{tables.variants_of_reference(grid, results)}")


EXPERIMENT = Experiment("claim", ("claim",), present)

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
