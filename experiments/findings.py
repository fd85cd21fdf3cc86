"""The table of docs/results.md: every comparison of PROTOCOL.md, from the committed records of both scales."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid, read_grid
from lab.kept import read_kept
from lab.statistics import Comparison, bootstrap, compare, differences, holm
from lab.tables import EQUAL_BYTES, Result

DENSE, FEW = "dense", "few views"
BEST, MCMC, BYTEWISE = "Best plain method", "2DGS*-MCMC", "Bytewise"
EQUAL_TIME = ", equal time"
PRIMARY = "bytewise − best plain method, 0.3 MB"
SECONDARY = {
    "equal time": (f"{PRIMARY}, equal time", "psnr"),
    "SSIM": (PRIMARY, "ssim"),
    "LPIPS": (PRIMARY, "lpips"),
    "1.2 MB": ("bytewise − best plain method, 1.2 MB", "psnr"),
}
"""Secondary endpoints: row of the table and figure."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One comparison."""

    name: str
    results: Sequence[Result]
    label: str
    other: str

    def differences(self, figure: str) -> dict[str, list[np.ndarray]]:
        return differences(self.results, self.label, self.other, figure)

    def compared(self, figure: str) -> Comparison:
        return compare(self.differences(figure))


def rows_of_degrees(results: Mapping[int, Sequence[Result]]) -> list[Row]:
    """Return the comparisons of A²TG with plain Gaussians of its degree, and of degrees 0 and 3, by bytes per pixel.

    The results are by the degree of A²TG, whose bytes the others of a grid fill.
    """
    rows = []
    for size in sorted({bytes_per_pixel(result) for own in results.values() for result in own}):
        at_size = {degree: [one for one in own if bytes_per_pixel(one) == size] for degree, own in results.items()}
        for degree, own in at_size.items():
            plain = MCMC if degree == 3 else f"{MCMC}, degree {degree}"
            name = f"A²TG − plain, degree {degree}, {size} bytes a pixel"
            rows.append(Row(name, own, f"A²TG, degree {degree}", plain + EQUAL_BYTES))
        name = f"plain, degree 0 − degree 3, {size} bytes a pixel"
        rows.append(Row(name, at_size[3], f"{MCMC}, degree 0{EQUAL_BYTES}", MCMC + EQUAL_BYTES))
    return rows


def bytes_per_pixel(result: Result) -> int:
    """Return the budget of a cell in bytes for each pixel of a photograph, a whole number."""
    cell = result.run.cell
    return round(1e6 * (cell.budget or 0.0) / cell.scene.num_pixels)


def rows_of_bytewise(results: Sequence[Result]) -> list[Row]:
    """Return the comparisons of `bytewise`, by stratum and budget."""
    rows = []
    for stratum in (DENSE, FEW):
        for budget in (0.3, 1.2):
            own = [result for result in results if stratum_of(result) == stratum and result.run.cell.budget == budget]
            place = f"{budget:g} MB" if stratum == DENSE else f"{budget:g} MB, {FEW}"
            others = {BEST: "best plain method", f"{MCMC}, degree 0": "MCMC, degree 0", MCMC: "MCMC, degree 3"}
            others |= {f"3DGS-MCMC, degree {degree}": f"3DGS-MCMC, degree {degree}" for degree in (0, 3)}
            rows += [Row(f"bytewise − {wording}, {place}", own, BYTEWISE, label) for label, wording in others.items()]
            rows.append(Row(f"bytewise − best plain method, {place}, equal time", own, BYTEWISE, BEST + EQUAL_TIME))
    return rows


def stratum_of(result: Result) -> str:
    return DENSE if result.run.cell.scene.fold is None else FEW


def table_of(rows: Sequence[Row]) -> str:
    """Return the table of the comparisons that have runs."""
    lines = []
    for row in rows:
        found = {figure: row.compared(figure) for figure in tables.QUALITY}
        psnr = found["psnr"]
        if not psnr.by_scene:
            continue
        low, high = bootstrap(row.differences("psnr"))
        lines.append([
            row.name, with_interval(psnr, "psnr"), "–" if np.isnan(low) else f"{low:+.2f} to {high:+.2f}",
            with_interval(found["ssim"], "ssim"), with_interval(found["lpips"], "lpips"),
            f"{psnr.num_won()} of {len(psnr.by_scene)}",
            f"{found['lpips'].num_won(is_lower_better=True)} of {len(psnr.by_scene)}", tables.number(psnr.p_value, 3),
        ])  # fmt: skip
    header = ["", "ΔPSNR, dB", "bootstrap", "ΔSSIM", "ΔLPIPS", "scenes won, PSNR", "LPIPS", "p"]
    return tables.markdown(header, lines)


def with_interval(found: Comparison, figure: str) -> str:
    """Return a mean with its t interval, in bold if the interval excludes 0."""
    text = found.over_scenes.as_text(tables.DIGITS[figure])
    return f"**{text}**" if found.is_decided else text


def endpoints(rows: Sequence[Row]) -> str:
    """Return the secondary endpoints with corrected p-values."""
    by_name = {row.name: row for row in rows}
    found = {name: by_name[row].compared(figure) for name, (row, figure) in SECONDARY.items()}
    corrected = holm({name: one.p_value for name, one in found.items()})
    lines = [
        [name, with_interval(found[name], SECONDARY[name][1]), tables.number(corrected[name], 3)] for name in SECONDARY
    ]
    return tables.markdown(["secondary endpoint", "mean over scenes", "p, Holm"], lines)


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write the table, from the records of this scale and of the other one beside it."""
    (bytewise,) = grids
    rows = rows_of_bytewise(tables.results_of(bytewise, lab.records))
    text = f"# Findings\n\n{table_of(rows)}\n"
    if rows[0].compared("psnr").by_scene:
        text += f"{endpoints(rows)}\n"
    scale = "smoke" if lab.is_smoke else "protocol160"
    records = read_kept(lab.out.parent / scale / "records.json")
    results = {degree: tables.results_of(read_grid(f"degree_{degree}", scale), records) for degree in (3, 1, 0)}
    lab.write(EXPERIMENT.name, f"{text}## A²TG and degrees\n\n{table_of(rows_of_degrees(results))}")


EXPERIMENT = Experiment("findings", ("bytewise",), present, __doc__)
