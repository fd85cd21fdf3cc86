"""Tables of results in Markdown, ours and the paper's.

A column is a scene, or the mean over a data set if scenes belong to data sets. Means are taken over the seeds of a
scene first, then over scenes, so that every scene counts once. `± x` is the half-width of the 95 % t interval over
scenes.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import scipy.stats

from a2tg_jax.base.json_text import read_json
from a2tg_jax.base.text import MEGABYTE
from a2tg_jax.core.budget import bytes_per_gaussian
from lab.grid import Cell, Grid, Run
from lab.jobs import Record
from lab.markdown import table as markdown
from lab.scenes import SceneAt

T = TypeVar("T")
EQUAL_BYTES = ", equal bytes"
"""End of the labels of methods in the bytes of the reference."""
EQUAL_TIME = ", equal time"
"""End of the labels of methods in the training time of the reference."""
PAPER: dict[str, list[dict[str, Any]]] = read_json(Path(__file__).with_name("paper.json"))
"""The figures that the paper publishes, by table."""
MISSING = "–"
DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3}
QUALITY = tuple(DIGITS)
"""Figures of quality in the order of all tables."""
QUALITY_COLUMNS = (("psnr", "PSNR"), ("ssim", "SSIM"), ("lpips", "LPIPS"), ("mb", "MB"))
PLAIN_DEGREE = 3
"""Degree of spherical harmonics of the paper's plain Gaussians."""
QUALITY_AND_SIZE = "PSNR / SSIM / LPIPS · MB"
CONFIDENCE = 0.95
"""Level of the intervals over scenes."""


@dataclasses.dataclass(frozen=True)
class Result:
    """A finished run."""

    run: Run
    record: Record

    @property
    def label(self) -> str:
        """Return the method's label, unique within its cell."""
        return self.run.label

    @property
    def column(self) -> str:
        scene = self.run.cell.scene
        return scene.dataset or scene.label

    def __getitem__(self, figure: str) -> float:
        value = self.record[figure]
        return float("nan") if value is None else value


def results_of(grid: Grid, records: Mapping[str, Record]) -> list[Result]:
    """Return the finished runs of a grid."""
    return [Result(run, records[run.job.key]) for run in grid.runs(records) if run.job.key in records]


def mean(results: Iterable[Result], figure: str) -> float:
    """Return the mean over scenes of each scene's mean; NaN without results."""
    means = [np.mean([result[figure] for result in own]) for _, own in grouped(results, _scene)]
    return float(np.mean(means)) if means else float("nan")


def _scene(result: Result) -> str:
    return result.run.cell.scene.label


@dataclasses.dataclass(frozen=True)
class SceneMean:
    """Mean over scenes with its uncertainty."""

    mean: float
    """NaN without scenes."""
    half_width: float
    """Half-width of the t interval over scenes at the level `CONFIDENCE`; NaN with fewer than two scenes."""

    def as_text(self, digits: int) -> str:
        """Return the mean and its interval for a table."""
        if np.isnan(self.half_width):
            return signed(self.mean, digits)
        return f"{self.mean:+.{digits}f} ± {self.half_width:.{digits}f}"


def over_scenes(values: Iterable[float]) -> SceneMean:
    """Return the mean of one value a scene."""
    found = np.array(list(values), float)
    if len(found) < 2 or np.isnan(found).any():
        return SceneMean(float(np.mean(found)) if len(found) else float("nan"), float("nan"))
    half = scipy.stats.sem(found) * scipy.stats.t.ppf((1 + CONFIDENCE) / 2, len(found) - 1)
    return SceneMean(float(found.mean()), float(half))


def number(value: float, digits: int) -> str:
    """Return a number for a table, a dash for NaN; three digits lose their leading zero."""
    if np.isnan(value):
        return MISSING
    text = f"{value:,.{digits}f}"
    return text[1:] if digits == 3 and text.startswith("0.") else text


def signed(value: float, digits: int) -> str:
    """Return a difference with its sign for a table, a dash for NaN."""
    return MISSING if np.isnan(value) else f"{value:+.{digits}f}"


def percent(share: float) -> str:
    """Return a share for a table."""
    return f"{100 * share:.1f} %" if share else MISSING


def quality(results: Sequence[Result]) -> str:
    """Return PSNR / SSIM / LPIPS for a table."""
    return _quality_text(*(mean(results, figure) for figure in QUALITY)) if results else MISSING


def _quality_text(*figures: float) -> str:
    return " / ".join(number(value, DIGITS[name]) for name, value in zip(QUALITY, figures, strict=True))


def quality_tables(grid: Grid, results: Sequence[Result]) -> str:
    """Return a table for each number of Gaussians or budget: a row a method, quality and MB in each column and on
    average, at equal numbers of Gaussians with the paper's percentages."""
    columns = {column: {r.run.cell.scene for r in own} for column, own in grouped(results, lambda r: r.column)}
    parts = []
    for (num, budget), block in grouped(results, lambda result: (result.run.cell.gaussians, result.run.cell.budget)):
        rows = []
        for label, own in grouped(block, lambda result: result.label):
            by_column = {column: [result for result in own if result.column == column] for column in columns}
            shown = [_quality_and_size(found, columns[column]) for column, found in by_column.items()]
            rows.append([label, iterations(own), num_gaussians(own), *shown, _mean_of_columns(by_column)])
        header = ["method", "iterations", "Gaussians", *(f"{column}: {QUALITY_AND_SIZE}" for column in columns)]
        size = f"**{num:,} Gaussians** of {grid.reference.label}" if budget is None else f"**{budget:g} MB**"
        size += " (+ x %: more bytes than as many plain Gaussians)" if any(map(_overhead, ([r] for r in block))) else ""
        parts.append(f"{size}\n\n" + markdown([*header, f"mean: {QUALITY_AND_SIZE}"], rows))
    return "\n".join(parts)


def _quality_and_size(results: Sequence[Result], scenes: set[SceneAt]) -> str:
    """Return quality and MB, with a note if some of the scenes are not finished."""
    if not results:
        return MISSING
    found = {result.run.cell.scene for result in results}
    note = "" if found == scenes else f" ({len(found)} of {len(scenes)} scenes)"
    return f"{quality(results)} · {number(mean(results, 'mb'), 2)}{_overhead(results)}{note}"


def _overhead(results: Sequence[Result]) -> str:
    """Return the bytes on top of as many plain Gaussians in percent; empty where bytes are given, not numbers."""
    if any(result.run.equal or result.run.cell.budget is not None for result in results):
        return ""
    plain = mean(results, "num") * bytes_per_gaussian(PLAIN_DEGREE) / MEGABYTE
    return f" ({100 * (mean(results, 'mb') / plain - 1):+.0f} %)"


def _mean_of_columns(by_column: Mapping[str, Sequence[Result]]) -> str:
    """Return the means over all columns, each counted once as in the paper; a dash if one is missing."""
    if not all(by_column.values()):
        return MISSING
    *figures, mb = (
        float(np.mean([mean(found, figure) for found in by_column.values()])) for figure in (*QUALITY, "mb")
    )
    return f"{_quality_text(*figures)} · {number(mb, 2)}"


def iterations(results: Sequence[Result]) -> str:
    """Return the iterations of all stages."""
    return "+".join(f"{count:,}" for count in results[0].run.job.all_iterations)


def num_gaussians(results: Sequence[Result]) -> str:
    """Return the number of Gaussians, or its range."""
    counts = sorted({int(result["num"]) for result in results})
    return f"{counts[0]:,}" if len(counts) == 1 else f"{counts[0]:,}–{counts[-1]:,}"


def grouped(results: Iterable[T], key: Callable[[T], Any]) -> list[tuple[Any, list[T]]]:
    """Return groups by key, in the order of first occurrence."""
    groups: dict[Any, list[T]] = {}
    for result in results:
        groups.setdefault(key(result), []).append(result)
    return list(groups.items())


def gains_table(results: Sequence[Result], reference: str, others: Sequence[str]) -> str:
    """Return the gain of the reference over other methods in each cell.

    Args:
      results: finished runs of one grid.
      reference: label of the method.
      others: labels of the compared methods; those at equal bytes end with `EQUAL_BYTES`.
    """
    rows: list[list[str]] = []
    every: dict[str, dict[str, list[float]]] = {other: {} for other in others}
    for place, block in grouped(results, lambda result: dataclasses.replace(result.run.cell, seed=0)):
        own = [result for result in block if result.label == reference]
        if not own:
            continue
        shown = []
        for other in others:
            gains, lpips, train = (_gains(block, reference, other, name) for name in ("psnr", "lpips", "train_psnr"))
            if not gains:
                shown.append(MISSING)
                continue
            every[other].setdefault(place.scene.label, []).append(float(np.mean(gains)))
            means = (float(np.mean(found)) for found in (gains, lpips, train))
            shown.append(" · ".join(signed(one, digits) for one, digits in zip(means, (2, 3, 2), strict=True)))
        seeds = {result.run.cell.seed for result in own}
        rows.append([*_place_texts(place, own[0]), number(mean(own, "mb"), 2), quality(own), str(len(seeds)), *shown])
    rows.append(["*mean ± 95 % interval*", *[""] * 6, *map(_mean_and_interval, every.values())])
    header = ["scene", "pixels", "iterations", "Gaussians", "MB", f"{reference}: PSNR / SSIM / LPIPS", "seeds"]
    text = markdown([*header, *(f"against {other}: dB · LPIPS · train dB" for other in others)], rows)
    return f"{text}\nThe last row is the mean over scenes, each counted once, with its 95 % t interval over scenes.\n"


def _place_texts(cell: Cell, result: Result) -> list[str]:
    """Return scene, pixels, iterations and Gaussians of a cell; a budget has those that the run ended with."""
    width, height = result.record["pixels"]
    length = "+".join(f"{count:,}" for count in cell.iterations)
    num = cell.gaussians if cell.budget is None else result.record["num"]
    return [cell.scene.label, f"{width}×{height}", length, f"{num:,} ({num / (width * height):.2f} a pixel)"]


def _mean_and_interval(gains: Mapping[str, Sequence[float]]) -> str:
    """Return the mean over scenes, after averaging the sizes within each scene."""
    if len(gains) < 2:
        return MISSING
    return over_scenes(float(np.mean(own)) for own in gains.values()).as_text(2)


def _gains(block: Sequence[Result], reference: str, other: str, figure: str) -> list[float]:
    """Return the reference's figure less the other's for each seed that has both."""
    by_seed = {(result.label, result.run.cell.seed): result[figure] for result in block}
    seeds = sorted({seed for _, seed in by_seed})
    return [
        by_seed[reference, seed] - by_seed[other, seed]
        for seed in seeds
        if (reference, seed) in by_seed and (other, seed) in by_seed
    ]


def paper_table(
    name: str, place: str, columns: Sequence[tuple[str, str]], everywhere: str = "mean of the data sets"
) -> str:
    """Return a table of the paper.

    Args:
      name: key in `paper.json`.
      place: key in which the blocks differ, "gaussians" or "budget_mb".
      columns: (key, heading) of each figure.
      everywhere: heading of the figures if the table names no data sets.
    """
    table = PAPER[name]
    datasets = list(dict.fromkeys(row.get("dataset", everywhere) for row in table))
    header = [PLACES[place], "method", *(f"{one}: {' / '.join(heading for _, heading in columns)}" for one in datasets)]
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for row in sorted(table, key=lambda row: -row[place]):
        label = row["method"] + (f", {row['side']}×{row['side']}" if "side" in row else "")
        shown = " / ".join(_as_printed(key, row[key]) for key, _ in columns)
        cells.setdefault((f"{row[place]:,}", label), {})[row.get("dataset", everywhere)] = shown
    rows = [[*key, *(found.get(dataset, MISSING) for dataset in datasets)] for key, found in cells.items()]
    return markdown(header, rows)


PLACES = {"gaussians": "Gaussians", "budget_mb": "MB"}


def _as_printed(key: str, value: float) -> str:
    """Return a figure with the paper's number of digits."""
    return number(value, DIGITS[key]) if key in DIGITS else f"{value:g}"


def choices_table(results: Sequence[Result], default: str) -> str:
    """Return the gain of each variant over the default, in dB and LPIPS, in each column and on average.

    Only cells that both have count.
    """
    sizes = {result.run.cell.size for result in results}

    def place(result: Result) -> str:
        return result.column if len(sizes) == 1 else f"{result.column}, {result.run.cell.size}"

    columns = list(dict.fromkeys(map(place, results)))
    base = {result.run.cell: result for result in results if result.label == default}
    rows = []
    for label, own in grouped(results, lambda result: result.label):
        by_column = {column: [result for result in own if place(result) == column] for column in columns}
        if label == default:
            shown = [quality(found) for found in by_column.values()]
            rows.append([f"*{default}, unchanged*", *shown, number(mean(own, "psnr"), 2), number(mean(own, "mb"), 2)])
            continue
        gains = [_mean_gain(found, base) for found in by_column.values()]
        average = MISSING if None in gains else _gain_text(np.mean(gains, axis=0))
        shown = [MISSING if gain is None else _gain_text(gain) for gain in gains]
        rows.append([label, *shown, average, number(mean(own, "mb"), 2)])
    return markdown(["choice", *(f"{column}: dB · LPIPS" for column in columns), "mean", "MB"], rows)


def _mean_gain(results: Sequence[Result], base: Mapping[Cell, Result]) -> tuple[float, float] | None:
    """Return the mean gains in PSNR and LPIPS over the cells that have the default too, each scene counted once."""
    both = [(result, base[result.run.cell]) for result in results if result.run.cell in base]
    if not both:
        return None
    pairs = [pair for _, pair in grouped(both, lambda pair: _scene(pair[0]))]
    means = [[np.mean([a[figure] - b[figure] for a, b in own]) for own in pairs] for figure in ("psnr", "lpips")]
    psnr, lpips = (float(np.mean(own)) for own in means)
    return psnr, lpips


def _gain_text(gain: Sequence[float]) -> str:
    decibels, distance = gain
    return f"{signed(decibels, 2)} · {signed(distance, 3)}"


def figures_table(results: Sequence[Result]) -> str:
    """Return a row for every method in each cell, averaged over seeds, with its figures, which gains alone do not
    show."""
    rows = []
    for _, block in grouped(results, lambda result: dataclasses.replace(result.run.cell, seed=0)):
        for label, own in grouped(block, lambda result: result.label):
            width, height = own[0].record["pixels"]
            place = [own[0].run.cell.scene.label, f"{width}×{height}", iterations(own), label, num_gaussians(own)]
            figures = [number(mean(own, "mb"), 2), quality(own), number(mean(own, "train_psnr"), 2)]
            rows.append([*place, *figures, str(len(own))])
    header = ["scene", "pixels", "iterations", "method", "Gaussians", "MB", "PSNR / SSIM / LPIPS", "train PSNR"]
    return markdown([*header, "seeds"], rows)
