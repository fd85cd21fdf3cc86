"""Charts of results, drawn with matplotlib's object interface."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

COLORS = {
    "A²TG": "#cc3311", "2DGS*-MCMC": "#4477aa", "Textured Gaussians*": "#228833", "SuperGaussians": "#aa3377",
    "BBSplat": "#ccaa33", "2DGS*": "#66ccee", "A²TG, as quick has it": "#ee7733",
    "Bytewise": "#000000", "2DGS*-MCMC, degree 0": "#332288", "2DGS*-MCMC, degree 1": "#44aa99",
}  # fmt: skip
OTHER_COLOR = "#777777"
STYLES = (("-", "o"), ("--", "s"), (":", "^"), ("-.", "D"))
"""Line and marker of the first, second, … curve of one colour."""
Point = tuple[float, float]


def color_of(label: str) -> str:
    """Return a method's colour; variants without one of their own have the same."""
    return COLORS.get(label) or COLORS.get(label.split(",")[0], OTHER_COLOR)


def lines(axes: Axes, curves: Mapping[str, Sequence[Point]], x_label: str, y_label: str, title: str) -> None:
    """Draw curves through points sorted by x, with a logarithmic x axis."""
    used: list[str] = []
    for label, points in curves.items():
        used.append(color_of(label))
        line, marker = STYLES[(used.count(used[-1]) - 1) % len(STYLES)]
        if points:
            x, y = np.array(sorted(points)).T
            axes.plot(
                x, y, linestyle=line, marker=marker, markersize=4, linewidth=1.4, label=label, color=color_of(label)
            )
    axes.set_xscale("log")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.25, which="both")


COLUMNS, LEGEND_COLUMNS = 3, 4


def charts(panels: Sequence[tuple[str, Mapping[str, Sequence[Point]], str, str]]) -> Figure:
    """Return several charts, three in a row, with one legend.

    Args:
      panels: title, curves by label, and labels of the axes.
    """
    columns = min(COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.4 * columns, 3.4 * rows + 0.5), layout="constrained")
    row = [figure.add_subplot(rows, columns, index + 1) for index in range(len(panels))]
    for axes, (title, curves, x_label, y_label) in zip(row, panels, strict=True):
        lines(axes, curves, x_label, y_label, title)
    handles = {label: handle for axes in row for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    columns = min(LEGEND_COLUMNS, max(1, len(handles)))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns, fontsize=8)
    return figure


def forest(found: Mapping[str, tuple[Sequence[float], float, float]], x_label: str) -> Figure:
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
    axes.set_xlabel(x_label)
    axes.grid(alpha=0.25, axis="x")
    return figure
