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
from lab.grid import Cell, Grid, Run, SceneAt
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
    """For each number of Gaussians, or budget, the methods, and in each column quality and MB, means where it is of
    several."""
    columns = {column: {r.run.cell.scene for r in own} for column, own in _grouped(results, lambda r: r.column)}
    parts = []
    for (num, budget), block in _grouped(results, lambda result: (result.run.cell.gaussians, result.run.cell.budget)):
        rows = []
        for label, own in _grouped(block, lambda result: result.label):
            by_column = {column: [result for result in own if result.column == column] for column in columns}
            shown = [_quality_and_size(found, columns[column]) for column, found in by_column.items()]
            rows.append([label, _iterations(own), _splats(own), *shown, _mean_of_columns(by_column)])
        header = ["method", "iterations", "splats", *(f"{column}: PSNR / SSIM / LPIPS · MB" for column in columns)]
        size = f"**{num:,} Gaussians** of {grid.reference.label}" if budget is None else f"**{budget:g} MB**"
        parts.append(f"{size}\n\n" + markdown([*header, "mean PSNR"], rows))
    return "\n".join(parts)


def _quality_and_size(results: Sequence[Result], scenes: set[SceneAt]) -> str:
    """With a note where some of the scenes are not finished."""
    if not results:
        return MISSING
    found = {result.run.cell.scene for result in results}
    note = "" if found == scenes else f" ({len(found)} of {len(scenes)} scenes)"
    return f"{quality(results)} · {number(mean(results, 'mb'), 2)}{note}"


def _mean_of_columns(by_column: Mapping[str, Sequence[Result]]) -> str:
    """Of all columns, each counted once as in the paper, or none."""
    if not all(by_column.values()):
        return MISSING
    return number(float(np.mean([mean(found, "psnr") for found in by_column.values()])), 2)


def _iterations(results: Sequence[Result]) -> str:
    """Of all stages."""
    return "+".join(f"{count:,}" for count in results[0].run.job.all_iterations)


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


def variants_of_reference(grid: Grid, results: Sequence[Result]) -> str:
    """A table of gains for the reference, and one for each method of the grid whose name begins with its.

    Their bytes are their own; the splats of the others fit into those of the reference.
    """
    names = [method.label for method in (grid.reference, *grid.methods)]
    variants = [name for name in names if name.startswith(grid.reference.label)]
    others = [method.label + EQUAL_BYTES for method in grid.at_equal_bytes]
    others += [name for name in names if name not in variants]
    return "\n".join(gains_table(results, variant, others) for variant in variants)


def gains_table(results: Sequence[Result], reference: str, others: Sequence[str]) -> str:
    """By how much the reference is above other methods in its cell, with a verdict.

    Args:
      results: of one grid.
      reference: label of the method.
      others: labels of those it is compared with; `EQUAL_BYTES` ends the name of one at equal bytes.
    """
    spread = seed_spread(results, reference, others)
    rows: list[list[str]] = []
    every: dict[str, dict[str, list[float]]] = {other: {} for other in others}
    for place, block in _grouped(results, lambda result: dataclasses.replace(result.run.cell, seed=0)):
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
            said = "" if spread is None else f" ({verdict(gains, spread)})"
            shown.append(f"{np.mean(gains):+.2f}{said} · {np.mean(lpips):+.3f} · {np.mean(train):+.2f}")
        rows.append([*_told_place(place, own[0]), number(mean(own, "mb"), 2), quality(own), _seeds(own), *shown])
    rows.append(["*mean ± standard error*", *[""] * 6, *map(_mean_and_error, every.values())])
    header = ["scene", "pixels", "iterations", "Gaussians", "MB", f"{reference}: PSNR / SSIM / LPIPS", "seeds"]
    text = markdown([*header, *(f"against {other}: dB · LPIPS · train dB" for other in others)], rows)
    return f"{text}\n{_told_spread(spread)}\n"


def _told_spread(spread: float | None) -> str:
    errors = "The last row's errors are those of independent scenes."
    if spread is None:
        return f"No cell has two seeds, so that nothing is said of what is above what. {errors}"
    return (
        f"Two seeds differ by {spread:.2f} dB in such a difference (root mean square). A mean of n seeds that is not "
        f"beyond that, divided by √n, is called undecided. {errors}"
    )


def _told_place(cell: Cell, result: Result) -> list[str]:
    """Scene, pixels, iterations and Gaussians of a cell."""
    width, height = result.record["pixels"]
    length = "+".join(f"{count:,}" for count in cell.iterations)
    density = cell.gaussians / (width * height)
    return [cell.scene.label, f"{width}×{height}", length, f"{cell.gaussians:,} ({density:.2f} a pixel)"]


def _seeds(results: Sequence[Result]) -> str:
    return str(len({result.run.cell.seed for result in results}))


def _mean_and_error(gains: Mapping[str, Sequence[float]]) -> str:
    """Over scenes, within which the gains at several sizes are averaged first."""
    means = [float(np.mean(own)) for own in gains.values()]
    if len(means) < 2:
        return MISSING
    return f"{np.mean(means):+.2f} ± {np.std(means, ddof=1) / np.sqrt(len(means)):.2f}"


def seed_spread(results: Sequence[Result], reference: str, others: Sequence[str]) -> float | None:
    """By how much two seeds differ in a gain, root mean square, in dB; None where no cell has two."""
    spreads = []
    for _, block in _grouped(results, lambda result: dataclasses.replace(result.run.cell, seed=0)):
        for other in others:
            gains = _gains(block, reference, other, "psnr")
            spreads += [a - b for a, b in itertools.pairwise(gains)]
    return float(np.sqrt(np.mean(np.square(spreads)))) if spreads else None


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


def paper_table(
    name: str, place: str, columns: Sequence[tuple[str, str]], everywhere: str = "mean of the data sets"
) -> str:
    """A table of the paper.

    Args:
      name: its key in `paper.json`.
      place: what its blocks differ in: "gaussians" or "budget_mb".
      columns: (key, heading) of the figures.
      everywhere: heading of the figures of a table that names no data sets.
    """
    table = PAPER[name]
    datasets = list(dict.fromkeys(row.get("dataset", everywhere) for row in table))
    header = [PLACES[place], "method", *(f"{one}: {' / '.join(told for _, told in columns)}" for one in datasets)]
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for row in sorted(table, key=lambda row: -row[place]):
        label = row["method"] + (f", {row['side']}×{row['side']}" if "side" in row else "")
        shown = " / ".join(_as_printed(key, row[key]) for key, _ in columns)
        cells.setdefault((f"{row[place]:,}", label), {})[row.get("dataset", everywhere)] = shown
    rows = [[*key, *(found.get(dataset, MISSING) for dataset in datasets)] for key, found in cells.items()]
    return markdown(header, rows)


PLACES = {"gaussians": "Gaussians", "budget_mb": "MB"}
DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3}


def _as_printed(key: str, value: float) -> str:
    """With the digits that such figures have in the paper, or those that it has."""
    return number(value, DIGITS[key]) if key in DIGITS else f"{value:g}"


QUALITY_COLUMNS = (("psnr", "PSNR"), ("ssim", "SSIM"), ("lpips", "LPIPS"), ("mb", "MB"))


def choices_table(results: Sequence[Result], default: str) -> str:
    """What each variant gains over the default, in dB and LPIPS, in each column and on average.

    Of the scenes and seeds of a column, those count that both have.
    """
    counts = {result.run.cell.gaussians for result in results}

    def place(result: Result) -> str:
        return result.column if len(counts) == 1 else f"{result.column}, {result.run.cell.gaussians:,}"

    columns = list(dict.fromkeys(map(place, results)))
    base = {result.run.cell: result for result in results if result.label == default}
    rows = []
    for label, own in _grouped(results, lambda result: result.label):
        by_column = {column: [result for result in own if place(result) == column] for column in columns}
        if label == default:
            shown = [quality(found) for found in by_column.values()]
            rows.append([f"*{default}, as it is*", *shown, number(mean(own, "psnr"), 2), number(mean(own, "mb"), 2)])
            continue
        gains = [_mean_gain(found, base) for found in by_column.values()]
        average = MISSING if None in gains else _told_gain(np.mean(gains, axis=0))
        shown = [MISSING if gain is None else _told_gain(gain) for gain in gains]
        rows.append([label, *shown, average, number(mean(own, "mb"), 2)])
    return markdown(["choice", *(f"{column}: dB · LPIPS" for column in columns), "mean", "MB"], rows)


def _mean_gain(results: Sequence[Result], base: Mapping[Cell, Result]) -> tuple[float, float] | None:
    """In PSNR and in LPIPS, over the cells in which there is the default too."""
    both = [(result, base[result.run.cell]) for result in results if result.run.cell in base]
    if not both:
        return None
    psnr, lpips = (float(np.mean([a[figure] - b[figure] for a, b in both])) for figure in ("psnr", "lpips"))
    return psnr, lpips


def _told_gain(gain: Sequence[float]) -> str:
    decibels, distance = gain
    return f"{decibels:+.2f} · {distance:+.3f}"
