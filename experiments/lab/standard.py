"""Experiments that are one grid and one table, of the kind that the grid's file names."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid
from lab.grid_file import SUFFIX
from lab.plan import missing_text
from lab.tables import Result


def _gains(grid: Grid, results: Sequence[Result]) -> str:
    """Return a table of gains for the reference and for each method whose label begins with the reference's.

    Each has its own bytes; the other methods have as many Gaussians as fit into the bytes of the reference.
    """
    names = [method.label for method in (grid.reference, *grid.methods)]
    variants = [name for name in names if name.startswith(grid.reference.label)]
    others = [method.label + tables.EQUAL_BYTES for method in grid.at_equal_bytes]
    others += [method.label + tables.EQUAL_TIME for method in grid.at_equal_time]
    others += [name for name in names if name not in variants]
    gains = "\n".join(tables.gains_table(results, variant, others) for variant in variants)
    return f"{gains}\n## Figures of every method\n\n{tables.figures_table(results)}"


def _choices(grid: Grid, results: Sequence[Result]) -> str:
    return tables.choices_table(results, grid.reference.label)


WRITERS: Mapping[str, Callable[[Grid, Sequence[Result]], str]] = {
    "quality": tables.quality_tables,
    "gains": _gains,
    "choices": _choices,
}
"""Functions that write the tables of a grid, by kind."""


def table_experiment(name: str, description: str, grid: str | None = None, paper: str = "") -> Experiment:
    """Return an experiment that writes the tables of one grid.

    Args:
      name: name of the experiment.
      description: one line for the command line.
      grid: name or path of the grid; by default the experiment's name.
      paper: the paper's table, which follows; empty for none.
    """

    def present(lab: Lab, grids: Sequence[Grid]) -> None:
        (grid,) = grids
        text = WRITERS[grid.table](grid, tables.results_of(grid, lab.records))
        text = f"# {grid.title}\n\n{text}{missing_text(grid, lab.records)}"
        lab.write(name, f"{text}\n## In the paper\n\n{paper}" if paper else text)

    return Experiment(name, (grid or name,), present, description)


def paper_experiment(name: str, place: str, description: str, everywhere: str = "mean of the data sets") -> Experiment:
    """Return an experiment that also writes the paper's table of its name; arguments as of `tables.paper_table`."""
    paper = tables.paper_table(name, place, tables.QUALITY_COLUMNS, everywhere)
    return table_experiment(name, description, paper=paper)


def file_experiment(path: str) -> Experiment:
    """Return the experiment of a grid file of one's own."""
    return table_experiment(Path(path).name.removesuffix(SUFFIX), f"The grid {path}.", path)


STANDARD = (
    paper_experiment("fixed_memory", "budget_mb", "Every method in A²TG's final bytes: Table 1 of the paper."),
    paper_experiment("fixed_number", "gaussians", "Every method with one number of Gaussians: Table 2 of the paper."),
    paper_experiment(
        "texture_resolution",
        "gaussians",
        "Textures of one size against textures of at most that size: the paper's appendix.",
        "Deep Blending",
    ),
    table_experiment("degree_0", "The paper's claim with every method at degree 0 (PROTOCOL.md)."),
    table_experiment("degree_1", "The paper's claim with every method at degree 1 (PROTOCOL.md)."),
    table_experiment("degree_3", "The paper's claim with every method at degree 3 (PROTOCOL.md)."),
    table_experiment("quick_degree_3", "A²TG of the preset quick against plain Gaussians of degree 3 (PROTOCOL.md)."),
    table_experiment("quick_degree_1", "A²TG of the preset quick against plain Gaussians of degree 1 (PROTOCOL.md)."),
    table_experiment("quick_degree_0", "A²TG of the preset quick against plain Gaussians of degree 0 (PROTOCOL.md)."),
    table_experiment("paper_degree_3", "The paper's comparison at its length, at degree 3 (PROTOCOL.md)."),
    table_experiment("paper_degree_0", "The paper's comparison at its length, at degree 0 (PROTOCOL.md)."),
    table_experiment("confirmation", "bytewise on captures that nothing was tuned on (PROTOCOL.md)."),
    table_experiment("bytewise_parts", "What the present bytewise is without each of its parts (PROTOCOL.md)."),
)
