"""The registered comparison of `bytewise`: its endpoints, and exploration (E6 of PROTOCOL.md)."""

import collections
import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from findings import Row
from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid, read_grid, seconds_of
from lab.jobs import Record
from lab.markdown import table
from lab.statistics import Comparison, compare, holm
from lab.tables import EQUAL_TIME, Result

BYTEWISE = "Bytewise"
STRONGEST = "Strongest plain method"
ELLIPSOIDS = "3DGS-MCMC, its weights, degree {}"
OTHERS = {
    STRONGEST + EQUAL_TIME: "strongest plain method, equal time",
    STRONGEST: "strongest plain method, equal iterations",
    ELLIPSOIDS.format(0): "3DGS-MCMC, degree 0",
    ELLIPSOIDS.format(3): "3DGS-MCMC, degree 3",
}
"""Methods that `bytewise` is compared with, in the words of the tables."""
BUDGETS = (0.3, 1.2)


@dataclasses.dataclass(frozen=True)
class Endpoint:
    """A figure of a comparison of dense captures that was registered."""

    budget: float
    other: str
    figure: str = "psnr"


PRIMARY = Endpoint(0.3, STRONGEST + EQUAL_TIME)
SECONDARY = (
    Endpoint(0.3, STRONGEST),
    Endpoint(0.3, STRONGEST + EQUAL_TIME, "lpips"),
    Endpoint(1.2, STRONGEST + EQUAL_TIME),
    Endpoint(0.3, ELLIPSOIDS.format(0)),
)


def endpoints_table(
    results: Sequence[Result], confirmation: Sequence[Result], num_pairs: Mapping[float | None, int]
) -> str:
    """Return the table of the endpoints; p-values of the secondary ones are corrected together.

    Args:
      results: runs of dense captures.
      num_pairs: number of pairs of runs that an endpoint has when all are finished, by budget.
      confirmation: runs of captures that nothing was tuned on, each of which has a column.
    """
    found = {one: compare(row_of(results, one.budget, one.other).differences(one.figure)) for one in registered()}
    finished = [one for one in SECONDARY if found[one].by_scene]
    corrected = dict(zip(finished, holm({str(one): found[one].p_value for one in finished}).values(), strict=True))
    captures = list(dict.fromkeys(result.run.cell.scene.label for result in confirmation))
    lines = []
    for one in registered():
        if not found[one].by_scene:
            continue
        p_value = corrected.get(one, found[one].p_value)
        role = "primary" if one == PRIMARY else "secondary"
        num = sum(map(len, row_of(results, one.budget, one.other).differences(one.figure).values()))
        all_pairs = num_pairs[one.budget]
        is_whole = num == all_pairs
        outcome = decision(found[one], p_value) if is_whole else f"unfinished, {num} of {all_pairs} pairs"
        unseen = compare(row_of(confirmation, one.budget, one.other).differences(one.figure)).by_scene
        shown = [tables.signed(unseen.get(name, float("nan")), tables.DIGITS[one.figure]) for name in captures]
        texts = endpoint_texts(one, found[one])
        lines.append([role, *texts, tables.number(p_value, 3), outcome, *shown])
    return table(["", "`bytewise` −", "", "mean over captures", "won", "p", "", *captures], lines)


def registered() -> tuple[Endpoint, ...]:
    """Return all endpoints, the primary one first."""
    return PRIMARY, *SECONDARY


def endpoint_texts(one: Endpoint, found: Comparison) -> list[str]:
    """Return the other method, the figure with its budget, the mean with its interval, and the captures won."""
    sign = -1 if one.figure == "lpips" else 1
    won = sum(sign * value > 0 for value in found.by_scene.values())
    place = f"Δ{one.figure.upper()}, {one.budget:g} MB"
    mean = found.over_scenes.as_text(tables.DIGITS[one.figure])
    return [OTHERS[one.other], place, mean, f"{won}/{len(found.by_scene)}"]


def decision(found: Comparison, p_value: float) -> str:
    """Return whether an endpoint is decided, given its p-value, which is corrected if there are several."""
    return "**decided**" if dataclasses.replace(found, p_value=p_value).is_decided else "undecided"


def row_of(results: Sequence[Result], budget: float, other: str, stratum: str = "") -> Row:
    """Return the comparison of `bytewise` with a method in some of the results."""
    place = f"{budget:g} MB" + (f", {stratum}" if stratum else "")
    chosen = [result for result in results if result.run.cell.budget == budget]
    return Row(f"{OTHERS[other]}, {place}", chosen, BYTEWISE, other)


def exploration_table(rows: Sequence[Row]) -> str:
    """Return all comparisons that have runs, none of them called decided."""
    lines = []
    for row in rows:
        found = {figure: row.compared(figure) for figure in tables.QUALITY}
        psnr = found["psnr"]
        if not psnr.by_scene:
            continue
        texts = [found[figure].over_scenes.as_text(digits) for figure, digits in tables.DIGITS.items()]
        lines.append([row.name, texts[0], row.drawn_interval, *texts[1:], f"{psnr.num_won}/{len(psnr.by_scene)}"])
    return table(["`bytewise` −", "ΔPSNR, dB", "bootstrap", "ΔSSIM", "ΔLPIPS", "captures won"], lines)


def scenes_table(results: Sequence[Result], others: Sequence[str]) -> str:
    """Return the PSNR of `bytewise` on each capture, and what it gains over other methods."""
    lines = []
    for (label, budget), block in tables.grouped(
        results, lambda result: (result.run.cell.scene.label, result.run.cell.budget)
    ):
        own = [result for result in block if result.label == BYTEWISE]
        if not own:
            continue
        gains = []
        for other in others:
            found = (Row("", block, BYTEWISE, other).compared(figure).by_scene for figure in tables.QUALITY)
            means = (next(iter(by_scene.values()), float("nan")) for by_scene in found)
            texts = (tables.signed(mean, digits) for mean, digits in zip(means, tables.DIGITS.values(), strict=True))
            gains.append(" / ".join(texts))
        lines.append([label, f"{budget:g}", str(len(own)), tables.quality(own), *gains])
    header = ["capture", "MB", "runs", "`bytewise`: PSNR / SSIM / LPIPS", *(f"− {OTHERS[other]}" for other in others)]
    return table(header, lines)


def times_text(results: Sequence[Result], records: Mapping[str, Record]) -> str:
    """Return how long the trainings of equal time took, compared with `bytewise`; `records` have all their stages."""
    ratios = []
    for _, block in tables.grouped(results, lambda result: result.run.cell):
        times = {result.label: seconds_of(result.run.job, records) for result in block}
        strongest = times.get(STRONGEST + EQUAL_TIME)
        bytewise = times.get(BYTEWISE)
        if strongest is not None and bytewise is not None:
            ratios.append(strongest / bytewise)
    if not ratios:
        return ""
    return (
        f"The trainings of equal time took {min(ratios):.2f} to {max(ratios):.2f} times as long as "
        f"`bytewise`'s, {np.mean(ratios):.2f} on average, in {len(ratios)} pairs.\n"
    )


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write the tables of the finished runs."""
    (grid,) = grids
    results = tables.results_of(grid, lab.records)
    confirmation = tables.results_of(read_grid("confirmation", lab.scale), lab.records)
    dense, few, unseen = (
        [result for result in each if (result.run.cell.scene.fold is None) == is_dense]
        for each, is_dense in ((results, True), (results, False), (confirmation, True))
    )
    rows = [row_of(dense, budget, other) for budget in BUDGETS for other in OTHERS]
    rows += [row_of(few, budget, other, "few views") for budget in BUDGETS for other in OTHERS]
    num_pairs = collections.Counter(cell.budget for cell in grid.cells if cell.scene.fold is None)
    endpoints = endpoints_table(dense, unseen, num_pairs)
    lab.write(EXPERIMENT.name, f"# {grid.title}\n\n{endpoints}\n{times_text(dense, lab.records)}")
    lab.write("exploration", f"# All comparisons\n\n{exploration_table(rows)}\n{scenes_table(results, list(OTHERS))}")


EXPERIMENT = Experiment("claims", ("claims",), present, __doc__)
