"""Gains at equal bytes in larger photographs beside smaller ones, where a Gaussian covers more pixels."""

from collections.abc import Sequence

from equal_bytes import at_budget, gain_text, on_scene
from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid

BYTEWISE = "Bytewise, long tails"
LARGER, SMALLER = "larger_pictures", "equal_bytes"
COMPARED = (
    ("A²TG, as quick has it", "2DGS*-MCMC"),
    (BYTEWISE, f"{BYTEWISE}, without textures"),
    (BYTEWISE, "2DGS*-MCMC, degree 0"),
)
"""Methods, each with the one that it is compared with."""


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write the gains at both sizes of the photographs, then the figures of the larger ones."""
    larger, smaller = (tables.results_of(grid, lab.records) for grid in grids)
    wording = (
        "dB · LPIPS, test views, one seed, photographs of so many pixels on the longer side. A mean has its 95 % t "
        "interval over scenes (number of scenes)."
    )
    figures = f"## Figures of the larger photographs\n\n{tables.quality_tables(grids[0], larger)}"
    lab.write(LARGER, f"# {grids[0].title}\n\n{wording}\n\n{gains(smaller, larger)}\n{figures}")


def gains(smaller: Sequence[tables.Result], larger: Sequence[tables.Result]) -> str:
    """Return a table with a row for each comparison and scene, and a column for each budget and size of photographs.

    Args:
      smaller: results among which are those in the cells of the others.
      larger: results in the cells to show.
    """
    cells = dict.fromkeys(_cell(result) for result in larger)
    smaller = [result for result in smaller if _cell(result) in cells]
    budgets = sorted({budget for _, budget, _ in cells})
    groups = [(budget, at_budget(own, budget)) for budget in budgets for own in (smaller, larger)]
    rows = []
    for label, other in COMPARED:
        for scene in dict.fromkeys(scene for scene, _, _ in cells):
            rows.append([f"{label} less {other}: {scene}", *(on_scene(own, scene, label, other) for _, own in groups)])
        rows.append([f"**{label} less {other}: mean**", *(gain_text(own, label, other) for _, own in groups)])
    return tables.markdown(["", *(f"{budget:g} MB, {_pixels_text(own)}" for budget, own in groups)], rows)


def _cell(result: tables.Result) -> tuple[str, float, int]:
    """Return scene, budget and seed."""
    cell = result.run.cell
    return cell.scene.label, cell.budget or 0.0, cell.seed


def _pixels_text(results: Sequence[tables.Result]) -> str:
    """Return the longer sides of the photographs."""
    sides = sorted({max(result["pixels"]) for result in results})
    return " and ".join(map(str, sides)) + " pixels"


EXPERIMENT = Experiment(LARGER, (LARGER, SMALLER), present, __doc__)
