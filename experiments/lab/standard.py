"""The presentations that several experiments share."""

from collections.abc import Sequence

from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid


def quality_experiment(name: str, place: str) -> Experiment:
    """Every method in every column of scenes, then the table of this name in the paper.

    Args:
      name: of the experiment, its grid, and the paper's table.
      place: what the paper's blocks differ in (`tables.paper_table`).
    """

    def present(lab: Lab, grids: Sequence[Grid]) -> None:
        (grid,) = grids
        ours = tables.quality_tables(grid, tables.results_of(grid, lab.records))
        paper = tables.paper_table(name, place, tables.QUALITY_COLUMNS)
        lab.write(name, f"# {grid.title}\n\n{ours}\n## In the paper\n\n{paper}")

    return Experiment(name, (name,), present)


def choices_experiment(name: str) -> Experiment:
    """What each variant of a grid gains over its reference."""

    def present(lab: Lab, grids: Sequence[Grid]) -> None:
        (grid,) = grids
        results = tables.results_of(grid, lab.records)
        lab.write(name, f"# {grid.title}\n\n{tables.choices_table(results, grid.reference.label)}")

    return Experiment(name, (name,), present)


def gains_experiment(name: str) -> Experiment:
    """By how much the reference of a grid, and any variant of it, is above the others, with the spread of seeds."""

    def present(lab: Lab, grids: Sequence[Grid]) -> None:
        (grid,) = grids
        results = tables.results_of(grid, lab.records)
        lab.write(name, f"# {grid.title}\n\n{tables.variants_of_reference(grid, results)}")

    return Experiment(name, (name,), present)
