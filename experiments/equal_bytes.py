"""Quality of every method at equal bytes, from few to many."""

from collections.abc import Iterable, Sequence

import numpy as np
from lab import plots, tables
from lab.cli import Experiment, Lab
from lab.grid import Grid

from a2tg_jax.results.figures import save_figure

GRIDS = ("equal_bytes", "equal_bytes_again", "equal_bytes_more", "equal_bytes_many")
FIGURES = (("psnr", "test PSNR, dB"), ("lpips", "test LPIPS"))


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write the gain of each method over the reference, quality at each size, and a chart of the means."""
    grid = grids[0]
    results = unique(result for own in grids for result in tables.results_of(own, lab.records))
    parts = [
        f"# {grid.title}",
        f"dB · LPIPS above {grid.reference.label}, test views: averaged over the seeds of a scene, then over scenes, "
        f"with the 95 % t interval over scenes (number of scenes). The held-out scene counts as the others do.\n\n"
        f"{gains(results, grid.reference.label)}",
        *(_quality(grid, seed, results) for seed in sorted({result.run.cell.seed for result in results})),
    ]
    lab.write(EXPERIMENT.name, "\n\n".join(part.strip() for part in parts) + "\n")
    save_figure(lab.pages / f"{EXPERIMENT.name}.png", plots.charts(panels(results)))


def _quality(grid: Grid, seed: int, results: Sequence[tables.Result]) -> str:
    """Return quality from one seed; not every method was trained from each."""
    own = [result for result in results if result.run.cell.seed == seed]
    return f"## Seed {seed}\n\n{tables.quality_tables(grid, own)}"


def unique(results: Iterable[tables.Result]) -> list[tables.Result]:
    """Return each run once, smallest budget first; grids share the runs of the reference."""
    found = {(result.run.cell, result.label): result for result in results}
    return sorted(found.values(), key=lambda result: result.run.cell.budget or 0.0)


def by_budget(results: Sequence[tables.Result]) -> dict[str, dict[float, list[tables.Result]]]:
    """Return the results by method and budget."""
    groups: dict[str, dict[float, list[tables.Result]]] = {}
    for result in results:
        groups.setdefault(result.label, {}).setdefault(result.run.cell.budget or 0.0, []).append(result)
    return groups


def at_budget(results: Sequence[tables.Result], budget: float) -> list[tables.Result]:
    """Return the results in so many MB."""
    return [result for result in results if (result.run.cell.budget or 0.0) == budget]


def gains(results: Sequence[tables.Result], reference: str) -> str:
    """Return a table with a row a method and a column a budget."""
    budgets = sorted({result.run.cell.budget or 0.0 for result in results})
    rows = []
    for label in by_budget(results):
        if label != reference:
            found = [at_budget(results, budget) for budget in budgets]
            shown = [gain_text(own, label, reference) for own in found]
            means = [tables.gains_by_scene(own, label, reference, "psnr").values() for own in found]
            average = np.mean([np.mean(list(own)) for own in means]) if all(means) else float("nan")
            rows.append([label, *shown, tables.signed(float(average), 2)])
    return tables.markdown(["method", *(f"{size:g} MB: dB · LPIPS" for size in budgets), "mean"], rows)


def gain_text(results: Sequence[tables.Result], label: str, other: str) -> str:
    """Return the gain in dB with its interval, the gain in LPIPS, and the number of scenes."""
    psnr, lpips = (tables.gains_by_scene(results, label, other, figure).values() for figure in ("psnr", "lpips"))
    if not psnr:
        return tables.MISSING
    distance = tables.signed(tables.over_scenes(lpips).mean, 3)
    return f"{tables.over_scenes(psnr).as_text(2)} · {distance} ({len(psnr)})"


def on_scene(results: Sequence[tables.Result], scene: str, label: str, other: str) -> str:
    """Return the gains of a method over another on one scene, in dB and in LPIPS."""
    psnr, lpips = (tables.gains_by_scene(results, label, other, figure) for figure in ("psnr", "lpips"))
    if scene not in psnr:
        return tables.MISSING
    return f"{tables.signed(psnr[scene], 2)} · {tables.signed(lpips[scene], 3)}"


def panels(results: Sequence[tables.Result]) -> list:
    """Return curves of PSNR and LPIPS against bytes: means over the scenes, if a method was trained on all of them.

    Methods with such a mean at half of the sizes or fewer are left to the tables.
    """
    scenes = {result.run.cell.scene for result in results}
    num_sizes = len({result.run.cell.budget for result in results})
    found = []
    for figure, wording in FIGURES:
        curves = {
            label: [
                (tables.mean(group, "mb"), tables.mean(group, figure))
                for group in sizes.values()
                if {result.run.cell.scene for result in group} == scenes
            ]
            for label, sizes in by_budget(results).items()
        }
        shown = {label: points for label, points in curves.items() if 2 * len(points) > num_sizes}
        found.append((f"mean of {len(scenes)} scenes", shown, "MB", wording))
    return found


EXPERIMENT = Experiment("equal_bytes", GRIDS, present, __doc__)
