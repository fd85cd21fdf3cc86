"""A table with the figures of every method in each cell, which gains alone do not show."""

import dataclasses
from collections.abc import Sequence

from lab import tables
from lab.tables import Result

HEADER = ("scene", "pixels", "iterations", "method", "Gaussians", "MB", "PSNR / SSIM / LPIPS", "train PSNR", "seeds")


def figures_table(results: Sequence[Result]) -> str:
    """Return a row for every method in each cell, averaged over seeds."""
    cells = tables.grouped(results, lambda result: dataclasses.replace(result.run.cell, seed=0))
    rows = [_row(own) for _, block in cells for _, own in tables.grouped(block, lambda result: result.label)]
    return tables.markdown(HEADER, rows)


def _row(results: Sequence[Result]) -> list[str]:
    first = results[0]
    width, height = first.record["pixels"]
    return [
        first.run.cell.scene.label, f"{width}×{height}", tables.iterations(results), first.label,
        tables.num_gaussians(results), tables.number(tables.mean(results, "mb"), 2), tables.quality(results),
        tables.number(tables.mean(results, "train_psnr"), 2), str(len(results)),
    ]  # fmt: skip
