"""The tables and the chart of docs/results.md, and the table of earlier versions of `bytewise` in NOTEBOOK.md."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid, read_grid
from lab.kept import read_kept
from lab.statistics import Comparison, bootstrap, compare, differences, holm
from lab.tables import EQUAL_BYTES, Result
from matplotlib.figure import Figure

from a2tg_jax.results.figures import save_figure

DENSE, FEW = "dense", "few views"
BEST, MCMC = "Best plain method", "2DGS*-MCMC"
BYTEWISE, SECOND, FIRST = "Bytewise", "Bytewise, second version", "Bytewise, first version"
VERSIONS = {BYTEWISE: "bytewise", SECOND: "bytewise 2", FIRST: "bytewise 1"}
"""Names in the table of `bytewise` and of its earlier versions: the second places no Gaussians by errors of pictures,
and the first has textures and no weight on opacities either."""
EQUAL_TIME = ", equal time"
PRIMARY = f"{VERSIONS[FIRST]} − best plain method, 0.3 MB"
SECONDARY = {
    "equal time": (PRIMARY + EQUAL_TIME, "psnr"),
    "SSIM": (PRIMARY, "ssim"),
    "LPIPS": (PRIMARY, "lpips"),
    "1.2 MB": (f"{VERSIONS[FIRST]} − best plain method, 1.2 MB", "psnr"),
}
"""Secondary endpoints: row of the table and figure."""
CHOSEN_ON = {"fox", "lego", "snowmiku"}
"""Scenes on which defaults of `bytewise` were chosen."""
UNSEEN = ", without fox, lego and snowmiku"
OTHERS = {
    BEST: "best plain method",
    BEST + EQUAL_TIME: "best plain method",
    "3DGS-MCMC, degree 0": "3DGS, degree 0",
    "3DGS-MCMC, degree 3": "3DGS, degree 3",
    SECOND: VERSIONS[SECOND],
    FIRST: VERSIONS[FIRST],
}
"""Methods that `bytewise` is compared with, in the words of the table."""
PARTS = {
    "Bytewise without shapes": "shapes of kernels",
    "Bytewise without pruning": "pruning",
    "Bytewise without splitting": "splitting",
    "Bytewise, degree 0": "view dependence and textures",
    "Bytewise without textures": "textures",
}
"""What `bytewise` has that a variant lacks."""


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


def rows_of_bytewise(results: Sequence[Result], in_equal_time: Sequence[Result]) -> list[Row]:
    """Return the comparisons of `bytewise`, by stratum and budget. At equal iterations, all runs count. At equal time,
    plain methods in `results` trained for as long as the first version, and in `in_equal_time` for as long as the
    present one."""
    rows, order = [], list(VERSIONS)
    for stratum in (DENSE, FEW):
        for budget in (0.3, 1.2):
            own, timed = (
                [result for result in each if stratum_of(result) == stratum and result.run.cell.budget == budget]
                for each in (results, in_equal_time)
            )
            trained_for = {FIRST: own, BYTEWISE: timed}
            for (version, prefix), (label, wording) in itertools.product(VERSIONS.items(), OTHERS.items()):
                if label in VERSIONS and order.index(label) <= order.index(version):
                    continue  # Versions are compared with earlier ones.
                is_timed = label.endswith(EQUAL_TIME)
                place = f"{budget:g} MB" + ("" if stratum == DENSE else f", {FEW}") + (EQUAL_TIME if is_timed else "")
                found = trained_for.get(version, []) if is_timed else own + timed
                rows.append(Row(f"{prefix} − {wording}, {place}", found, version, label))
                if version == FIRST and label == BEST and stratum == DENSE:
                    others = [result for result in own if result.run.cell.scene.label not in CHOSEN_ON]
                    rows.append(Row(rows[-1].name + UNSEEN, others, version, label))
    return rows


def stratum_of(result: Result) -> str:
    return DENSE if result.run.cell.scene.fold is None else FEW


def rows_of_parts(results: Sequence[Result]) -> list[Row]:
    """Return what each part of the first version of `bytewise` brings, and shapes of kernels to plain Gaussians."""
    rows = [Row(f"{VERSIONS[FIRST]}: {part}, 0.3 MB", results, FIRST, label) for label, part in PARTS.items()]
    pruned = f"{MCMC}, degree 0, pruned"
    return [*rows, Row("plain, pruned: shapes of kernels, 0.3 MB", results, f"{pruned}, with shapes", pruned)]


def rows_of_degrees(results: Mapping[int, Sequence[Result]]) -> list[Row]:
    """Return the comparisons of A²TG with methods of its degree, and of plain degrees 0 and 3, by bytes per pixel.

    The results are by the degree of A²TG, whose bytes the others of a grid fill.
    """
    rows = []
    for size in sorted({bytes_per_pixel(result) for own in results.values() for result in own}):
        at_size = {degree: [one for one in own if bytes_per_pixel(one) == size] for degree, own in results.items()}
        place = f"{size} bytes a pixel"
        for degree, own in at_size.items():
            suffix = "" if degree == 3 else f", degree {degree}"
            for label, wording in ((MCMC, "plain"), ("Textured Gaussians*", "textures of one size")):
                name = f"A²TG − {wording}, degree {degree}, {place}"
                rows.append(Row(name, own, f"A²TG, degree {degree}", label + suffix + EQUAL_BYTES))
        name = f"plain: degree 0 − degree 3, {place}"
        rows.append(Row(name, at_size[3], f"{MCMC}, degree 0{EQUAL_BYTES}", MCMC + EQUAL_BYTES))
    return rows


def bytes_per_pixel(result: Result) -> int:
    """Return the budget of a cell in bytes for each pixel of a photograph, a whole number."""
    cell = result.run.cell
    return round(1e6 * (cell.budget or 0.0) / cell.scene.num_pixels)


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
            f"{psnr.num_won} of {len(psnr.by_scene)}", tables.number(psnr.p_value, 3),
        ])  # fmt: skip
    return tables.markdown(["", "ΔPSNR, dB", "bootstrap", "ΔSSIM", "ΔLPIPS", "scenes won", "p"], lines)


def scenes_table(rows: Sequence[Row]) -> str:
    """Return ΔPSNR of each scene in the comparisons that have runs."""
    found = {row.name: row.compared("psnr").by_scene for row in rows}
    found = {name: by_scene for name, by_scene in found.items() if by_scene}
    scenes = dict.fromkeys(scene for by_scene in found.values() for scene in by_scene)
    lines = [
        [scene, *(tables.signed(by_scene.get(scene, float("nan")), 2) for by_scene in found.values())]
        for scene in scenes
    ]
    return tables.markdown(["ΔPSNR, dB", *found], lines)


def with_interval(found: Comparison, figure: str) -> str:
    """Return a mean with its t interval, in bold if the interval excludes 0."""
    text = found.over_scenes.as_text(tables.DIGITS[figure])
    return f"**{text}**" if found.is_decided else text


def endpoints(rows: Sequence[Row]) -> str:
    """Return the secondary endpoints with corrected p-values."""
    by_name = {row.name: row for row in rows}
    found = {name: by_name[row].compared(figure) for name, (row, figure) in SECONDARY.items()}
    corrected = holm({name: one.p_value for name, one in found.items() if one.by_scene})
    lines = [
        [name, with_interval(found[name], SECONDARY[name][1]), tables.number(p_value, 3)]
        for name, p_value in corrected.items()
    ]
    return tables.markdown(["secondary endpoint", "mean over scenes", "p, Holm"], lines)


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write the table and the chart, from the records of this scale and of the other one beside it."""
    bytewise, equal_time, parts = (tables.results_of(grid, lab.records) for grid in grids)
    scale = "smoke" if lab.is_smoke else "protocol160"
    records = read_kept(lab.out.parent / scale / "records.json")
    degrees = {degree: tables.results_of(read_grid(f"degree_{degree}", scale), records) for degree in (3, 1, 0)}
    of_bytewise = rows_of_bytewise(bytewise, equal_time)
    newest = newest_of(of_bytewise)
    rows = [*newest, *rows_of_parts(parts), *rows_of_degrees(degrees)]
    at_size = [row for row in newest if "0.3 MB" in row.name and FEW not in row.name]
    lab.write(EXPERIMENT.name, f"# Findings\n\n{table_of(rows)}\n{scenes_table(at_size)}")
    shown = {row.name for row in newest}
    earlier = [row for row in of_bytewise if row.name not in shown]
    lab.write("earlier_versions", f"# Earlier versions of bytewise\n\n{table_of(earlier)}\n{endpoints(of_bytewise)}")
    charted: dict[str, tuple[Sequence[float], float, float]] = {}
    for row in rows:
        # Differences from 3DGS of degree 3 are several times as large as the others.
        if (one := row.compared("psnr")).by_scene and row.other != "3DGS-MCMC, degree 3":
            charted[row.name] = list(one.by_scene.values()), one.over_scenes.mean, one.over_scenes.half_width
    if charted:
        save_figure(lab.pages / f"{EXPERIMENT.name}.png", forest(charted))


def newest_of(rows: Sequence[Row]) -> list[Row]:
    """Return the comparisons of `bytewise` with other methods and its second version, each of the newest version that
    has runs."""
    found: dict[str, Row] = {}
    for row in rows:
        if row.compared("psnr").by_scene and row.other != FIRST and UNSEEN not in row.name:
            # The rest of the name is the same for all versions, and the newest comes first.
            found.setdefault(row.name.partition(" − ")[2], row)
    return list(found.values())


def forest(found: Mapping[str, tuple[Sequence[float], float, float]]) -> Figure:
    """Return a row for each comparison: the values of its scenes, and their mean with its interval.

    Args:
      found: values, mean and half-width of the interval by name; the first is drawn on top.
    """
    figure = Figure(figsize=(8.0, 0.8 + 0.26 * len(found)), layout="constrained")
    axes = figure.add_subplot()
    for place, (values, mean, half_width) in enumerate(found.values()):
        axes.plot(values, [place] * len(values), "o", color="#4477aa", alpha=0.35, markersize=4, markeredgewidth=0)
        axes.errorbar(mean, place, xerr=np.nan_to_num(half_width), fmt="D", color="#000000", markersize=4, capsize=3)
    axes.axvline(0.0, color="#888888", linewidth=0.8)
    axes.set_yticks(range(len(found)), list(found), fontsize=8)
    axes.set_ylim(len(found) - 0.4, -0.6)  # The first on top.
    axes.set_xlabel("difference of PSNR, dB")
    axes.grid(alpha=0.25, axis="x")
    return figure


EXPERIMENT = Experiment("findings", ("bytewise", "equal_time", "parts"), present, __doc__)
