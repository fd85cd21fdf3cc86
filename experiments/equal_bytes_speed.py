"""Frames per second and training time of the methods at equal bytes.

Times are kept in equal_bytes_speed.json. Let nothing else run beside the measurement.
"""

from collections.abc import Sequence

from efficiency import table_of_times
from lab.cli import Experiment, Lab
from lab.grid import Grid


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write the times, measured once on this machine."""
    (grid,) = grids
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{table_of_times(lab, EXPERIMENT.name, grid)}")


EXPERIMENT = Experiment("equal_bytes_speed", ("equal_bytes_speed",), present, __doc__)
