"""The tables and the chart of docs/results.md, and the comparisons in NOTEBOOK.md that this page leaves out."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid, read_grid
from lab.jobs import Record
from lab.kept import read_kept
from lab.statistics import Comparison, bootstrap, compare, differences, holm
from lab.tables import EQUAL_BYTES, EQUAL_TIME, Result
from matplotlib.figure import Figure

from a2tg_jax.results.figures import save_figure

A2TG = "A²TG"
IMPROVED = "A²TG, improved"
"""A²TG with the options of `quick` at the paper's length: its name in tables, and its label in grids (", degree 0"
follows)."""
PRESENT = "A²TG, quick"
"""Label of the present A²TG of `quick` in grids, likewise."""
EARLIER = "A²TG of earlier `quick`"
"""Name of the A²TG of E1, whose textures of one texel stay neutral and whose new texels begin without moments."""
PLACES = {
    "paper160": "at the paper's length",
    "long": "at the paper's length, an earlier series",
    "full_size": "at the paper's size",
    "half_size": "at half that size",
}
"""Scales of the paper's comparison (E5, a series before the protocol, E4) in the words of the table."""
SIZE_OF_ENDPOINT = 100_000, 3
"""Gaussians and degree of the rows of E4 that the page shows; others are in NOTEBOOK.md."""
LEAST_SCENES = 3
"""Smallest number of scenes of a row on the page: an interval of two says nothing."""
QUICK = "in `quick`"
"""Name of E1's place in the table."""
QUICK_SIZE = 60
"""Its bytes per pixel; other sizes are in NOTEBOOK.md."""
DENSE = "dense"
FEW = "few views"
BEST = "Best plain method"
MCMC = "2DGS*-MCMC"
TEXTURED = "Textured Gaussians*"
BYTEWISE = "Bytewise"
SECOND = "Bytewise, second version"
FIRST = "Bytewise, first version"
VERSIONS = {BYTEWISE: "bytewise", SECOND: "bytewise 2", FIRST: "bytewise 1"}
"""Names in the table of `bytewise` and of its earlier versions: the second places no Gaussians by errors of pictures,
and the first has textures and no weight on opacities either."""
PRIMARY = f"{VERSIONS[FIRST]} − best plain method, 0.3 MB"
REGISTERED = ", the registered endpoint"
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
    num_scenes: int | None = None
    """Number of scenes of its grid, if some may not be finished."""
    place: str = ""
    """Length, size and degree of all its methods, if the name lacks them."""
    is_on_page: bool = True
    """Whether docs/results.md shows it; NOTEBOOK.md shows the others."""

    @property
    def text(self) -> str:
        """Return its name, with a note if scenes are missing."""
        num = len(self.differences("psnr"))
        return f"{self.name} ({num} of {self.num_scenes} scenes)" if num < (self.num_scenes or 0) else self.name

    @property
    def whole_text(self) -> str:
        """Return its name, with its place and a note if scenes are missing."""
        return ", ".join(filter(None, [self.text, self.place]))

    def differences(self, figure: str) -> dict[str, list[np.ndarray]]:
        return differences(self.results, self.label, self.other, figure)

    def compared(self, figure: str) -> Comparison:
        return compare(self.differences(figure))

    @property
    def drawn_interval(self) -> str:
        """Return the interval of PSNR by the bootstrap for a table, a dash for less than two scenes."""
        low, high = bootstrap(self.differences("psnr"))
        return tables.MISSING if np.isnan(low) else f"{low:+.2f} to {high:+.2f}"


def rows_of_bytewise(results: Sequence[Result], in_equal_time: Sequence[Result]) -> list[Row]:
    """Return the comparisons of `bytewise`, by stratum and budget. At equal iterations, all runs count. At equal time,
    plain methods in `results` trained for as long as the first version, and in `in_equal_time` for as long as the
    present one."""
    rows = []
    order = list(VERSIONS)
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


def rows_against(
    grid: Grid, degree: int, results: Sequence[Result], own: Mapping[str, str], place: str, is_on_page: bool
) -> list[Row]:
    """Return the comparisons of kinds of A²TG with the methods that fill its bytes.

    Args:
      grid: a grid whose reference is A²TG.
      degree: degree of A²TG and of the other methods.
      results: runs of one size.
      own: names of the kinds of A²TG by label.
      place: size or length in the words of the table.
      is_on_page: whether the page shows them.
    """
    plain = suffixed(MCMC, degree)
    others = {
        plain: "plain",
        f"{plain}, first stage": "plain, first stage",
        f"{plain}, shapes of kernels": "plain with its kernels",
        suffixed(TEXTURED, degree): "textures of one size",
    }
    num_scenes = len({cell.scene.label for cell in grid.cells})
    place = f"{place}, degree {degree}"
    return [
        Row(f"{name} − {wording}", results, label, other + EQUAL_BYTES, num_scenes, place, is_on_page)
        for (label, name), (other, wording) in itertools.product(own.items(), others.items())
    ]


def suffixed(label: str, degree: int) -> str:
    """Return the label of a method at a degree; 3 is not named."""
    return label if degree == 3 else f"{label}, degree {degree}"


def rows_at_length(grid: Grid, degree: int, records: Mapping[str, Record], place: str) -> list[Row]:
    """Return the comparisons of A²TG as the paper has it, of the improved one, and of `bytewise`, by size."""
    own = {grid.reference.label: A2TG, suffixed(IMPROVED, degree) + EQUAL_BYTES: IMPROVED}
    has_sizes = len({cell.gaussians for cell in grid.cells}) > 1
    rows = []
    for num, results in tables.grouped(tables.results_of(grid, records), lambda result: result.run.cell.gaussians):
        at_size = f"{place}, {num:,} Gaussians" if has_sizes else place
        is_on_page = (num, degree) == SIZE_OF_ENDPOINT if has_sizes else place != PLACES["long"]
        rows += rows_against(grid, degree, results, own, at_size, is_on_page)
        if degree == 3:
            zero = suffixed(MCMC, 0) + EQUAL_BYTES
            name = f"{A2TG} − plain of degree 0"
            rows.append(dataclasses.replace(rows[-1], name=name, label=grid.reference.label, other=zero))
        name = f"{VERSIONS[BYTEWISE]} − {A2TG}"
        rows.append(dataclasses.replace(rows[-1], name=name, label=BYTEWISE + EQUAL_BYTES, other=grid.reference.label))
    return rows


def rows_of_quick(grid: Grid, degree: int, records: Mapping[str, Record]) -> list[Row]:
    """Return the comparisons of the present A²TG of `quick` with plain Gaussians (E7)."""
    own = {suffixed(PRESENT, degree) + EQUAL_BYTES: A2TG}
    rows = []
    for size, results in tables.grouped(tables.results_of(grid, records), bytes_per_pixel):
        is_on_page = size == QUICK_SIZE
        place = QUICK if is_on_page else f"{size} bytes a pixel"
        rows += rows_against(grid, degree, results, own, place, is_on_page)
    return rows


def rows_of_earlier_quick(grid: Grid, degree: int, records: Mapping[str, Record]) -> list[Row]:
    """Return the comparisons of E1 at a degree by size, and plain degree 0 with degree 3 where both were run.

    They are in the notebook alone.
    """
    zero, three = (suffixed(MCMC, degree) + EQUAL_BYTES for degree in (0, 3))
    rows = []
    own = {grid.reference.label: EARLIER}
    for size, results in tables.grouped(tables.results_of(grid, records), bytes_per_pixel):
        place = f"{size} bytes a pixel"
        rows += rows_against(grid, degree, results, own, QUICK if size == QUICK_SIZE else place, is_on_page=False)
        rows.append(Row("plain: degree 0 − degree 3", results, zero, three, rows[-1].num_scenes, place, False))
    return rows


def bytes_per_pixel(result: Result) -> int:
    """Return the budget of a cell in bytes for each pixel of a photograph, a whole number."""
    cell = result.run.cell
    return round(1e6 * (cell.budget or 0.0) / cell.scene.num_pixels)


def table_of(rows: Sequence[Row]) -> str:
    """Return the table of the comparisons that have runs, with all intervals."""
    lines = []
    for row in rows:
        found = {figure: row.compared(figure) for figure in tables.QUALITY}
        psnr = found["psnr"]
        if not psnr.by_scene:
            continue
        lines.append([
            row.whole_text, with_interval(psnr, "psnr"), row.drawn_interval,
            with_interval(found["ssim"], "ssim"), with_interval(found["lpips"], "lpips"), *tests_of(psnr),
        ])  # fmt: skip
    return tables.markdown(["", "ΔPSNR, dB", "bootstrap", "ΔSSIM", "ΔLPIPS", "scenes won", "p"], lines)


def short_table(rows: Sequence[Row]) -> str:
    """Return the table of the comparisons of enough scenes, below their place, with the intervals of PSNR alone."""
    header = ["", "ΔPSNR, dB", "ΔSSIM", "ΔLPIPS", "scenes won", "p"]
    lines = []
    shown = [row for row in rows if len(row.differences("psnr")) >= LEAST_SCENES]
    for place, block in tables.grouped(shown, lambda row: row.place):
        if place:
            lines.append([f"**{place}**", *[""] * (len(header) - 1)])
        for row in block:
            psnr, ssim, lpips = (row.compared(figure) for figure in tables.QUALITY)
            means = [emphasized(tables.signed(one.over_scenes.mean, 3), one) for one in (ssim, lpips)]
            lines.append([row.text, with_interval(psnr, "psnr"), *means, *tests_of(psnr)])
    return tables.markdown(header, lines)


def tests_of(found: Comparison) -> list[str]:
    """Return the scenes won and the p-value for a table."""
    return [f"{found.num_won}/{len(found.by_scene)}", tables.number(found.p_value, 3)]


def scenes_table(rows: Sequence[Row]) -> str:
    """Return ΔPSNR of each scene in the comparisons that have runs."""
    found = {row.whole_text: row.compared("psnr").by_scene for row in rows}
    found = {name: by_scene for name, by_scene in found.items() if by_scene}
    scenes = dict.fromkeys(scene for by_scene in found.values() for scene in by_scene)
    lines = [
        [scene, *(tables.signed(by_scene.get(scene, float("nan")), 2) for by_scene in found.values())]
        for scene in scenes
    ]
    return tables.markdown(["ΔPSNR, dB", *found], lines)


def with_interval(found: Comparison, figure: str) -> str:
    """Return a mean with its t interval for a table."""
    return emphasized(found.over_scenes.as_text(tables.DIGITS[figure]), found)


def emphasized(text: str, found: Comparison) -> str:
    """Return a text in bold if its comparison is decided."""
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
    """Write the tables and the chart, from the records of this scale and of the other scales."""
    bytewise, equal_time, parts = (tables.results_of(grid, lab.records) for grid in grids)
    of_bytewise = rows_of_bytewise(bytewise, equal_time)
    of_a2tg = rows_of_a2tg(lab)
    shown = [row for row in of_a2tg if row.is_on_page]
    others = [row for row in of_a2tg if not row.is_on_page]
    lab.write("paper", f"# The paper's comparison\n\n{short_table(shown)}", has_old_rows=False)
    lab.write("matched_degree", f"# Other comparisons of A²TG\n\n{table_of(others)}", has_old_rows=False)

    own = shown_of_bytewise(of_bytewise)
    earlier = [row for row in of_bytewise if row not in own]
    lab.write(EXPERIMENT.name, f"# Findings\n\n{short_table(own)}")
    lab.write("parts_of_bytewise", f"# Parts of bytewise 1\n\n{table_of(rows_of_parts(parts))}")
    lab.write("earlier_versions", f"# Earlier versions of bytewise\n\n{table_of(earlier)}\n{endpoints(of_bytewise)}")

    at_length = [row for row in shown if row.place.startswith(PLACES["paper160"])]
    dense = [row for row in own if row.name.endswith(("0.3 MB", EQUAL_TIME))]
    by_scene = [scenes_table(rows) for rows in (at_length, dense) if any(row.differences("psnr") for row in rows)]
    lab.write("details", "\n".join(["# Details of the findings\n", table_of([*shown, *own]), *by_scene]))
    # Differences from 3DGS of degree 3 are several times as large as the others.
    charted = {A2TG: shown, VERSIONS[BYTEWISE]: [row for row in own if row.other != "3DGS-MCMC, degree 3"]}
    found = {
        title: [row for row in rows if len(row.differences("psnr")) >= LEAST_SCENES] for title, rows in charted.items()
    }
    if all(found.values()):
        save_figure(lab.pages / f"{EXPERIMENT.name}.png", forest(found))


def rows_of_a2tg(lab: Lab) -> list[Row]:
    """Return the comparisons of A²TG at the paper's length and size, then in `quick`."""
    rows = []
    for scale, place in ({"smoke": PLACES["paper160"]} if lab.is_smoke else PLACES).items():
        names = {3: "fixed_memory"} if scale == "long" else {3: "paper_degree_3", 0: "paper_degree_0"}
        records = read_kept(lab.out.parent / scale / "records.json")
        for degree, name in names.items():
            rows += rows_at_length(read_grid(name, scale), degree, records, place)
    scale = "smoke" if lab.is_smoke else "protocol160"
    records = read_kept(lab.out.parent / scale / "records.json")
    for degree in (3, 1, 0):
        rows += rows_of_quick(read_grid(f"quick_degree_{degree}", scale), degree, records)
        rows += rows_of_earlier_quick(read_grid(f"degree_{degree}", scale), degree, records)
    return rows


def shown_of_bytewise(rows: Sequence[Row]) -> list[Row]:
    """Return the present comparisons with the best plain method and with 3DGS, and the registered one."""
    found = []
    for row in rows:
        is_plain = row.other.startswith(BEST)
        is_3dgs = row.other.startswith("3DGS") and FEW not in row.name
        if row.label == BYTEWISE and (is_plain or is_3dgs):
            found.append(row)
    registered = [dataclasses.replace(row, name=row.name + REGISTERED) for row in rows if row.name == PRIMARY]
    return [*found, *registered]


def forest(found: Mapping[str, Sequence[Row]]) -> Figure:
    """Return a panel for each group of comparisons with a row for each: the values of its scenes, and their mean with
    its interval.

    Args:
      found: comparisons by the panel's title; the first is drawn on top.
    """
    heights = [1.5 + len(rows) for rows in found.values()]
    figure = Figure(figsize=(8.0, 0.8 + 0.26 * sum(heights)), layout="constrained")
    panels = figure.subplots(len(found), squeeze=False, height_ratios=heights)[:, 0]
    for axes, (title, rows) in zip(panels, found.items(), strict=True):
        for place, row in enumerate(rows):
            psnr = row.compared("psnr")
            values = list(psnr.by_scene.values())
            axes.plot(values, [place] * len(values), "o", color="#4477aa", alpha=0.35, markersize=4, markeredgewidth=0)
            interval = {"xerr": np.nan_to_num(psnr.over_scenes.half_width), "capsize": 3}
            axes.errorbar(psnr.over_scenes.mean, place, fmt="D", color="#000000", markersize=4, **interval)
        axes.axvline(0.0, color="#888888", linewidth=0.8)
        axes.set_yticks(range(len(rows)), [row.whole_text.replace("`", "") for row in rows], fontsize=8)
        axes.set_ylim(len(rows) - 0.4, -0.6)  # The first on top.
        axes.set_title(title, fontsize=9)
        axes.grid(alpha=0.25, axis="x")
    panels[-1].set_xlabel("difference of PSNR, dB")
    return figure


EXPERIMENT = Experiment("findings", ("bytewise", "equal_time", "parts"), present, __doc__)
