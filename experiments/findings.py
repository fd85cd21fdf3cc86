"""The tables of the paper's claim on docs/results.md, their chart, and comparisons that are in NOTEBOOK.md alone."""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from lab import tables
from lab.cli import Experiment, Lab
from lab.grid import Grid, read_grid
from lab.jobs import Record
from lab.kept import read_kept
from lab.statistics import Comparison, bootstrap, compare, differences
from lab.tables import EQUAL_BYTES, Result
from matplotlib.axes import Axes
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
DEGREE_COLORS = {3: "#4477aa", 0: "#cc3311"}
PANELS_IN_ROW = 3
MCMC = "2DGS*-MCMC"
TEXTURED = "Textured Gaussians*"
BYTEWISE = "Bytewise"


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
        name = f"`bytewise` − {A2TG}"
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


def present(lab: Lab, grids: Sequence[Grid]) -> None:
    """Write the tables and the chart, from the records of this scale and of the other scales."""
    of_a2tg = rows_of_a2tg(lab)
    shown = [row for row in of_a2tg if row.is_on_page]
    others = [row for row in of_a2tg if not row.is_on_page]
    lab.write("paper", f"# The paper's comparison\n\n{short_table(shown)}", has_old_rows=False)
    lab.write("matched_degree", f"# Other comparisons of A²TG\n\n{table_of(others)}", has_old_rows=False)
    at_length = [row for row in shown if row.place.startswith(PLACES["paper160"])]
    by_scene = scenes_table(at_length) if any(row.differences("psnr") for row in at_length) else ""
    lab.write(EXPERIMENT.name, f"# Findings\n\n{table_of(shown)}\n{by_scene}", has_old_rows=False)
    results = [result for grid in grids for result in tables.results_of(grid, lab.records)]
    if results:
        save_figure(lab.pages / "psnr_by_bytes.png", psnr_by_bytes(results))


def rows_of_a2tg(lab: Lab) -> list[Row]:
    """Return the comparisons of A²TG at the paper's length and size, then in `quick`."""
    rows = []
    for scale, place in ({"smoke": PLACES["paper160"]} if lab.is_smoke else PLACES).items():
        names = {3: "fixed_memory"} if scale == "long" else {3: "paper_degree_3", 0: "paper_degree_0"}
        records = read_kept(lab.out.parent / scale / "records.json")
        for degree, name in names.items():
            rows += rows_at_length(read_grid(name, scale), degree, records, place)
    for degree in (3, 1, 0):
        rows += rows_of_quick(read_grid(f"quick_degree_{degree}", lab.scale), degree, lab.records)
        rows += rows_of_earlier_quick(read_grid(f"degree_{degree}", lab.scale), degree, lab.records)
    return rows


def psnr_by_bytes(results: Sequence[Result]) -> Figure:
    """Return a panel for each capture with PSNR against bytes: A²TG of `quick`, and plain Gaussians with its kernels.

    Args:
      results: runs of E7, at least one.
    """
    sizes = sorted(set(map(bytes_per_pixel, results)))
    by_capture = tables.grouped(results, lambda result: result.run.cell.scene.label)
    num_rows = math.ceil(len(by_capture) / PANELS_IN_ROW)
    figure = Figure(figsize=(8.0, 0.7 + 2.2 * num_rows), layout="constrained")
    panels = figure.subplots(num_rows, PANELS_IN_ROW, squeeze=False, sharex=True).ravel()
    for axes in panels[len(by_capture) :]:
        axes.remove()
    for axes, (capture, own) in zip(panels, by_capture, strict=False):
        axes.set_title(capture, fontsize=9)
        for degree, color in DEGREE_COLORS.items():
            textured = suffixed(PRESENT, degree) + EQUAL_BYTES
            plain = f"{suffixed(MCMC, degree)}, shapes of kernels{EQUAL_BYTES}"
            draw_curve(axes, own, textured, f"A²TG, degree {degree}", color, "o-")
            draw_curve(axes, own, plain, f"without textures, degree {degree}", color, "s--")
        axes.set_xscale("log")
        axes.set_xticks(sizes, list(map(str, sizes)))
        axes.minorticks_off()
        axes.grid(alpha=0.25)
    figure.supxlabel("bytes of a model for each pixel of a photograph", fontsize=9)
    figure.supylabel("PSNR of test views, dB", fontsize=9)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=2, fontsize=8)
    return figure


def draw_curve(axes: Axes, results: Sequence[Result], label: str, name: str, color: str, style: str) -> None:
    """Draw the PSNR of one method on a capture against its bytes."""
    own = sorted((result for result in results if result.label == label), key=bytes_per_pixel)
    figures = [result["psnr"] for result in own]
    axes.plot(list(map(bytes_per_pixel, own)), figures, style, color=color, markersize=4, label=name)


EXPERIMENT = Experiment("findings", ("quick_degree_3", "quick_degree_0", "quick_degree_1"), present, __doc__)
