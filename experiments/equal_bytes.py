"""The best picture for the bytes: every method fills the same bytes, from few to many.

python experiments/equal_bytes.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from collections.abc import Iterable, Sequence

import numpy as np
from lab import plots, tables
from lab.cli import Experiment, Lab, main
from lab.grid import Grid

from a2tg_jax.results.figures import save_figure

GRIDS = ("equal_bytes", "equal_bytes_again", "equal_bytes_more", "equal_bytes_many")
FIGURES = (("psnr", "PSNR, dB"), ("ssim", "SSIM"), ("lpips", "LPIPS"))


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Quality at each size, what each method gains over the reference, and a chart."""
    grid = grids[0]
    results = unique(result for own in grids for result in tables.results_of(own, lab.records))
    parts = [
        f"# {grid.title}",
        f"dB above {grid.reference.label}, mean over scenes and seeds that both have (of how many), test views. "
        f"The scene held out counts with the others.\n\n{gains(results, grid.reference.label)}",
        *(_quality(grid, seed, results) for seed in sorted({result.run.cell.seed for result in results})),
    ]
    lab.write(EXPERIMENT.name, "\n\n".join(part.strip() for part in parts) + "\n")
    save_figure(lab.pages / f"{EXPERIMENT.name}.png", plots.charts(panels(results)))


def _quality(grid: Grid, seed: int, results: Sequence[tables.Result]) -> str:
    """Seeds apart: not every method was trained from each."""
    own = [result for result in results if result.run.cell.seed == seed]
    return f"## Seed {seed}\n\n{tables.quality_tables(grid, own)}"


def unique(results: Iterable[tables.Result]) -> list[tables.Result]:
    """Each run once, smallest bytes first; grids share that of the reference."""
    found = {(result.run.cell, result.label): result for result in results}
    return sorted(found.values(), key=lambda result: result.run.cell.budget or 0.0)


def by_budget(results: Sequence[tables.Result]) -> dict[str, dict[float, list[tables.Result]]]:
    """Results by method and budget."""
    groups: dict[str, dict[float, list[tables.Result]]] = {}
    for result in results:
        groups.setdefault(result.label, {}).setdefault(result.run.cell.budget or 0.0, []).append(result)
    return groups


def gains(results: Sequence[tables.Result], reference: str) -> str:
    """A row a method, a column a budget."""
    budgets = sorted({result.run.cell.budget or 0.0 for result in results})
    base = {result.run.cell: result for result in results if result.label == reference}
    rows = []
    for label, sizes in by_budget(results).items():
        if label != reference:
            found = [[(r, base[r.run.cell]) for r in sizes.get(size, ()) if r.run.cell in base] for size in budgets]
            shown = [_told(pairs) for pairs in found]
            means = [np.mean([a["psnr"] - b["psnr"] for a, b in pairs]) for pairs in found if pairs]
            rows.append([label, *shown, f"{np.mean(means):+.2f}" if len(means) == len(budgets) else tables.MISSING])
    return tables.markdown(["method", *(f"{size:g} MB: dB · LPIPS" for size in budgets), "mean"], rows)


def _told(pairs: Sequence[tuple[tables.Result, tables.Result]]) -> str:
    if not pairs:
        return tables.MISSING
    decibels, distance = (np.mean([a[figure] - b[figure] for a, b in pairs]) for figure in ("psnr", "lpips"))
    lpips = tables.MISSING if np.isnan(distance) else f"{distance:+.3f}"
    return f"{decibels:+.2f} · {lpips} ({len(pairs)})"


def panels(results: Sequence[tables.Result]) -> list:
    """Of each scene PSNR, SSIM and LPIPS against bytes, of the first seed, from which every method was trained."""
    first = min((result.run.cell.seed for result in results), default=0)
    found = []
    for column in dict.fromkeys(result.column for result in results):
        own = by_budget([result for result in results if result.column == column and result.run.cell.seed == first])
        for figure, told in FIGURES:
            curves = {
                label: [(tables.mean(group, "mb"), tables.mean(group, figure)) for group in sizes.values()]
                for label, sizes in own.items()
            }
            found.append((column, curves, "MB", told))
    return found


EXPERIMENT = Experiment("equal_bytes", GRIDS, present)

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
