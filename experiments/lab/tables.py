"""Tables of results in Markdown, ours and the paper's.

A column is a scene, or, where scenes belong to data sets, the mean over a data set. Several seeds are averaged; a
difference that is not larger than seeds make is called undecided.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax.results.folder import read_json
from lab.grid import Cell, Grid, Run
from lab.jobs import Record

PAPER: dict[str, list[dict[str, Any]]] = read_json(Path(__file__).with_name("paper.json"))
"""The figures that the paper publishes, by table."""
MISSING = "–"


@dataclasses.dataclass(frozen=True)
class Result:
    """A finished run."""

    run: Run
    record: Record

    @property
    def label(self) -> str:
        """The method; in its cell, no other has this one."""
        return self.run.method.label + (EQUAL_BYTES if self.run.is_at_equal_bytes else "")

    @property
    def column(self) -> str:
        scene = self.run.cell.scene
        return scene.dataset or scene.label

    def __getitem__(self, figure: str) -> float:
        value = self.record[figure]
        return float("nan") if value is None else value


EQUAL_BYTES = ", equal bytes"


def results_of(grid: Grid, records: Mapping[str, Record]) -> list[Result]:
    """The finished runs of a grid."""
    return [Result(run, records[run.job.key]) for run in grid.runs(records) if run.job.key in records]


def mean(results: Iterable[Result], figure: str) -> float:
    """Over scenes and seeds; not a number where there is none."""
    values = [result[figure] for result in results]
    return float(np.mean(values)) if values else float("nan")


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def number(value: float, digits: int) -> str:
    """A number for a table; what is not there, a dash. Fractions of 1 lose the zero that says nothing."""
    if np.isnan(value):
        return MISSING
    text = f"{value:,.{digits}f}"
    return text[1:] if digits == 3 and text.startswith("0.") else text


def percent(share: float) -> str:
    """A share for a table."""
    return f"{100 * share:.1f} %" if share else MISSING


def quality(results: Sequence[Result]) -> str:
    """PSNR / SSIM / LPIPS."""
    figures = zip(("psnr", "ssim", "lpips"), (2, 3, 3), strict=True)
    return " / ".join(number(mean(results, name), digits) for name, digits in figures) if results else MISSING


def quality_tables(grid: Grid, results: Sequence[Result]) -> str:
    """For each number of Gaussians, the methods, and in each column quality and MB."""
    columns = list(dict.fromkeys(result.column for result in results))
    parts = []
    for num, block in _grouped(results, lambda result: result.run.cell.gaussians):
        rows = []
        for label, own in _grouped(block, lambda result: result.label):
            by_column = [[result for result in own if result.column == column] for column in columns]
            shown = [f"{quality(found)} · {number(mean(found, 'mb'), 2)}" if found else MISSING for found in by_column]
            rows.append([label, _splats(own), *shown, number(mean(own, "psnr"), 2)])
        header = ["method", "splats", *(f"{column}: PSNR / SSIM / LPIPS · MB" for column in columns), "mean PSNR"]
        parts.append(f"**{num:,} Gaussians** of {grid.reference.label}\n\n" + markdown(header, rows))
    return "\n".join(parts)


def _splats(results: Sequence[Result]) -> str:
    """How many there are, or from how few to how many."""
    counts = sorted({int(result["num"]) for result in results})
    return f"{counts[0]:,}" if len(counts) == 1 else f"{counts[0]:,}–{counts[-1]:,}"


def _grouped(results: Iterable[Result], key: Callable[[Result], Any]) -> list[tuple[Any, list[Result]]]:
    """By a key, in the order in which keys first come."""
    groups: dict[Any, list[Result]] = {}
    for result in results:
        groups.setdefault(key(result), []).append(result)
    return list(groups.items())


def gains_table(results: Sequence[Result], reference: str, others: Sequence[str]) -> str:
    """By how much the reference is above other methods in its cell, with a verdict.

    Args:
      results: of one grid.
      reference: label of the method.
      others: labels of those it is compared with; `EQUAL_BYTES` ends the name of one at equal bytes.
    """
    spread = seed_spread(results, reference, others)
    rows: list[list[str]] = []
    every: dict[str, list[float]] = {other: [] for other in others}
    for place, block in _grouped(results, lambda result: dataclasses.replace(result.run.cell, seed=0)):
        own = [result for result in block if result.label == reference]
        if not own:
            continue
        shown = []
        for other in others:
            gains, lpips = (_gains(block, reference, other, figure) for figure in ("psnr", "lpips"))
            every[other] += [float(np.mean(gains))] if gains else []
            told = f"{np.mean(gains):+.2f} ({verdict(gains, spread)}) · {np.mean(lpips):+.3f}" if gains else MISSING
            shown.append(told)
        rows.append([*_told_place(place, own[0]), number(mean(own, "mb"), 2), quality(own), _seeds(own), *shown])
    rows.append(["*mean ± standard error*", *[""] * 6, *map(_mean_and_error, every.values())])
    header = ["scene", "pixels", "iterations", "Gaussians", "MB", f"{reference}: PSNR / SSIM / LPIPS", "seeds"]
    text = markdown([*header, *(f"against {other}: dB · LPIPS" for other in others)], rows)
    return text + f"\nTwo seeds differ by {spread:.2f} dB in such a difference (root mean square); less is undecided.\n"


def _told_place(cell: Cell, result: Result) -> list[str]:
    """Scene, pixels, iterations and Gaussians of a cell."""
    width, height = result.record["pixels"]
    length = "+".join(f"{count:,}" for count in cell.iterations)
    density = cell.gaussians / (width * height)
    return [cell.scene.label, f"{width}×{height}", length, f"{cell.gaussians:,} ({density:.2f} a pixel)"]


def _seeds(results: Sequence[Result]) -> str:
    return str(len({result.run.cell.seed for result in results}))


def _mean_and_error(gains: Sequence[float]) -> str:
    """Over the cells; the error is that of independent ones."""
    if len(gains) < 2:
        return MISSING
    return f"{np.mean(gains):+.2f} ± {np.std(gains, ddof=1) / np.sqrt(len(gains)):.2f}"


def seed_spread(results: Sequence[Result], reference: str, others: Sequence[str]) -> float:
    """By how much two seeds differ in a gain, root mean square, in dB; 0 where no cell has two."""
    spreads = []
    for _, block in _grouped(results, lambda result: dataclasses.replace(result.run.cell, seed=0)):
        for other in others:
            gains = _gains(block, reference, other, "psnr")
            spreads += [a - b for a, b in itertools.pairwise(gains)]
    return float(np.sqrt(np.mean(np.square(spreads)))) if spreads else 0.0


def verdict(gains: Sequence[float], spread: float) -> str:
    """Whether gains that seeds alone move by `spread` say anything."""
    mean_gain = float(np.mean(gains))
    if abs(mean_gain) <= spread / np.sqrt(len(gains)):
        return "undecided"
    return "above" if mean_gain > 0 else "below"


def _gains(block: Sequence[Result], reference: str, other: str, figure: str) -> list[float]:
    """The reference's figure less the other's, of each seed that has both."""
    by_seed = {(result.label, result.run.cell.seed): result[figure] for result in block}
    seeds = sorted({seed for _, seed in by_seed})
    return [
        by_seed[reference, seed] - by_seed[other, seed]
        for seed in seeds
        if (reference, seed) in by_seed and (other, seed) in by_seed
    ]


def paper_table(name: str, place: str, columns: Sequence[tuple[str, str, int]]) -> str:
    """A table of the paper.

    Args:
      name: its key in `paper.json`.
      place: what its blocks differ in: "gaussians" or "budget_mb".
      columns: (key, heading, digits) of the figures.
    """
    table = PAPER[name]
    datasets = list(dict.fromkeys(row.get("dataset", "mean of the data sets") for row in table))
    header = ["", "method", *(f"{dataset}: {' / '.join(heading for _, heading, _ in columns)}" for dataset in datasets)]
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for row in sorted(table, key=lambda row: -row[place]):
        at = f"{row[place]:,}" + (" MB" if place == "budget_mb" else "")
        label = row["method"] + (f", {row['side']}×{row['side']}" if "side" in row else "")
        shown = " / ".join(number(row[key], digits) for key, _, digits in columns)
        cells.setdefault((at, label), {})[row.get("dataset", "mean of the data sets")] = shown
    rows = [[*key, *(found.get(dataset, MISSING) for dataset in datasets)] for key, found in cells.items()]
    return markdown(header, rows)


QUALITY_COLUMNS = (("psnr", "PSNR", 2), ("ssim", "SSIM", 3), ("lpips", "LPIPS", 3), ("mb", "MB", 0))


def choices_table(results: Sequence[Result], default: str) -> str:
    """What each variant gains over the default, in dB and LPIPS, in each cell and on average."""
    counts = {result.run.cell.gaussians for result in results}

    def place(result: Result) -> str:
        return result.column if len(counts) == 1 else f"{result.column}, {result.run.cell.gaussians:,}"

    columns = list(dict.fromkeys(map(place, results)))
    base = {place(result): result for result in results if result.label == default}
    rows = []
    for label, own in _grouped(results, lambda result: result.label):
        found = {place(result): result for result in own}
        if label == default:
            shown = [quality([found[column]]) if column in found else MISSING for column in columns]
            rows.append([f"*{default}, as it is*", *shown, number(mean(own, "psnr"), 2), number(mean(own, "mb"), 2)])
            continue
        gains = {column: _gain(found[column], base[column]) for column in columns if column in found and column in base}
        shown = [_told(gains[column]) if column in gains else MISSING for column in columns]
        average = _told(np.mean(list(gains.values()), axis=0)) if gains else MISSING
        rows.append([label, *shown, average, number(mean(own, "mb"), 2)])
    return markdown(["choice", *(f"{column}: dB · LPIPS" for column in columns), "mean", "MB"], rows)


def _gain(result: Result, base: Result) -> tuple[float, float]:
    """In PSNR and in LPIPS."""
    return result["psnr"] - base["psnr"], result["lpips"] - base["lpips"]


def _told(gain: Sequence[float]) -> str:
    decibels, distance = gain
    return f"{decibels:+.2f} · {distance:+.3f}"
