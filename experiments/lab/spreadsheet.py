"""Finished runs as rows of a CSV file, for programs that draw or compare them."""

import csv
import io
from collections.abc import Iterable

from lab.tables import Result

FIGURES = ("num", "mb", "published_mb", "psnr", "ssim", "lpips", "train_psnr", "fps", "seconds", "ms_per_step")
"""Figures of a record; those that are missing are empty."""
HEADER = ("grid", "scene", "method", "gaussians", "budget_mb", "seed", "iterations", *FIGURES, "key")


def rows_text(results: Iterable[tuple[str, Result]]) -> str:
    """Return the CSV text of some runs, each with the name of its grid."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(HEADER)
    writer.writerows(_row(grid, result) for grid, result in results)
    return text.getvalue()


def _row(grid: str, result: Result) -> list[object]:
    cell, job = result.run.cell, result.run.job
    place = [cell.scene.label, result.label, cell.gaussians or None, cell.budget, cell.seed]
    figures = [result.record.get(name) for name in FIGURES]
    return [grid, *place, sum(job.all_iterations), *figures, job.key]
