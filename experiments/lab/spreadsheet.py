"""Finished runs as rows of a CSV file, for programs that draw or compare them."""

import csv
import io
from collections.abc import Iterable

from lab.tables import Result

DIGITS = {
    "mb": 6, "published_mb": 6, "psnr": 4, "ssim": 4, "lpips": 4, "train_psnr": 4, "fps": 1, "seconds": 1,
    "ms_per_step": 2,
}  # fmt: skip
"""Figures of a record with their digits; those that are missing are empty."""
HEADER = ("grid", "scene", "method", "size", "gaussians", "budget_mb", "seed", "iterations", *DIGITS, "key")


def rows_text(results: Iterable[tuple[str, Result]]) -> str:
    """Return the CSV text of some runs, each with the name of its grid."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(HEADER)
    writer.writerows(_row(grid, result) for grid, result in results)
    return text.getvalue()


def _row(grid: str, result: Result) -> list[object]:
    cell = result.run.cell
    job = result.run.job
    place = [cell.scene.label, result.label, cell.size.replace(",", ""), result.record["num"], cell.budget, cell.seed]
    figures: list[object] = []
    for name, digits in DIGITS.items():
        value = result.record.get(name)
        figures.append(None if value is None else round(value, digits))
    return [grid, *place, sum(job.all_iterations), *figures, job.key]
