"""What the best picture for the bytes costs in time: frames per second and training at equal bytes.

    python experiments/equal_bytes_speed.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz

Times are kept in equal_bytes_speed.json: let nothing else run beside it.
"""

from collections.abc import Sequence

from efficiency import table_of_times
from lab.cli import Experiment, Lab, main
from lab.grid import Grid


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Ours, measured once on this machine."""
    (grid,) = grids
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{table_of_times(lab, EXPERIMENT.name, grid)}")


EXPERIMENT = Experiment("equal_bytes_speed", ("equal_bytes_speed",), present)

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
