"""Experiments that are one grid and one table."""

from collections.abc import Sequence

from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid


def quality_experiment(name: str, place: str, description: str) -> Experiment:
    """Return an experiment that writes every method in every column of scenes, then the paper's table of that name.

    Args:
      name: name of the experiment, its grid, and the paper's table.
      place: key in which the paper's blocks differ (`tables.paper_table`).
      description: one line for the command line.
    """

    def present(lab: Lab, grids: Sequence[Grid]) -> None:
        (grid,) = grids
        ours = tables.quality_tables(grid, tables.results_of(grid, lab.records))
        paper = tables.paper_table(name, place, tables.QUALITY_COLUMNS)
        lab.write(name, f"# {grid.title}\n\n{ours}\n## In the paper\n\n{paper}")

    return Experiment(name, (name,), present, description)


def choices_experiment(name: str, description: str) -> Experiment:
    """Return an experiment that writes the gain of each variant of a grid over its reference."""

    def present(lab: Lab, grids: Sequence[Grid]) -> None:
        (grid,) = grids
        results = tables.results_of(grid, lab.records)
        lab.write(name, f"# {grid.title}\n\n{tables.choices_table(results, grid.reference.label)}")

    return Experiment(name, (name,), present, description)


def gains_experiment(name: str, description: str) -> Experiment:
    """Return an experiment that writes the gains of a grid's reference and its variants, with the spread of seeds."""

    def present(lab: Lab, grids: Sequence[Grid]) -> None:
        (grid,) = grids
        results = tables.results_of(grid, lab.records)
        lab.write(name, f"# {grid.title}\n\n{tables.variants_of_reference(grid, results)}")

    return Experiment(name, (name,), present, description)


STANDARD = (
    gains_experiment("claim", "The paper's claim: A²TG beside plain Gaussians and textures of one size, equal bytes."),
    choices_experiment("texel_rate", "The texels' learning rate at two densities, without the held-out scene."),
    choices_experiment("defaults", "Each open choice of the method, one at a time, without the held-out scene."),
    gains_experiment("where_textures_pay", "The claim over the number of Gaussians, training length and image size."),
    quality_experiment("fixed_memory", "budget_mb", "Every method in A²TG's final bytes: Table 1 of the paper."),
    quality_experiment("fixed_number", "gaussians", "Every method with one number of Gaussians: Table 2 of the paper."),
    choices_experiment("quick_preset", "The preset `quick` with its numbers put back to the paper's, one at a time."),
)
