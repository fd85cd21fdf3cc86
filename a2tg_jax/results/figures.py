"""Figures of a run, drawn with matplotlib's object interface (no windows, no global state)."""

import itertools
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from a2tg_jax.host.atomic import replacing
from a2tg_jax.training import History

COLORS = ("#4477aa", "#cc3311", "#777777", "#228833", "#aa3377", "#ccaa33", "#66ccee")
"""Colours of the stages, in turn."""
RUNNING_MEANS = 10
"""Number of running-mean windows in a stage; each covers a tenth."""
MOST_POINTS = 4000
"""Points of a curve; a running mean takes the square of their number in time."""
CURVES = (
    ("loss", "Loss"),
    ("psnr", "Training PSNR (dB)"),
    ("num_gaussians", "Gaussians"),
    ("megabytes", "Memory (MB)"),
)


def save_figure(path: Path, figure: Figure) -> None:
    """Write a PNG on white, whole or not at all."""
    FigureCanvasAgg(figure)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def curves_figure(histories: Mapping[str, History], starts: Mapping[str, int]) -> Figure:
    """Plot loss, PSNR, Gaussians and memory over the iterations, with a dashed line where a later stage begins.

    Args:
      histories: of the stages, by name.
      starts: how many iterations lie before each.
    """
    figure = Figure(figsize=(10, 6), layout="constrained")
    colors = dict(zip(histories, itertools.cycle(COLORS), strict=False))
    for axes, (field, title) in zip(figure.subplots(2, 2).flat, CURVES, strict=True):
        for name, history in histories.items():
            x, y = _thinned(starts[name] + history.iteration), _thinned(getattr(history, field))
            _plot(axes, x, y, name, colors[name], is_noisy=field in ("loss", "psnr"))
        for border in sorted({start for start in starts.values() if start}):
            axes.axvline(border, color="black", linestyle="--", linewidth=0.8)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("iteration", fontsize=9)
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        axes.ticklabel_format(axis="y", useOffset=False)
        axes.grid(alpha=0.25)
    figure.axes[0].set_yscale("log")
    figure.axes[0].legend(fontsize=8)
    return figure


def _thinned(column: np.ndarray) -> np.ndarray:
    """Return a column of at most `MOST_POINTS` numbers, each the mean of as many rows; what is left over at the end
    goes."""
    rows = -(-len(column) // MOST_POINTS)
    return column if rows < 2 else column[: len(column) // rows * rows].reshape(-1, rows).mean(axis=1)


def _plot(axes: Axes, x: np.ndarray, y: np.ndarray, name: str, color: str, *, is_noisy: bool) -> None:
    """Plot one curve; a noisy one is pale, with its running mean over it."""
    if is_noisy and len(y) >= 2 * RUNNING_MEANS:
        axes.plot(x, y, color=color, alpha=0.2, linewidth=0.8)
        window = len(y) // RUNNING_MEANS
        weights = np.full(window, 1 / window)
        x, y = np.convolve(x, weights, mode="valid"), np.convolve(y, weights, mode="valid")
    axes.plot(x, y, color=color, label=name, linewidth=1.6)


def sizes_figure(sizes: np.ndarray) -> Figure:
    """Return how many Gaussians have a texture of each resolution, as a map of Tv × Tu.

    Args:
      sizes: [N, 2] integers (Tv, Tu).
    """
    sides = 2 ** np.arange(int(np.log2(max(4, sizes.max()))) + 1)
    counts = np.array([[np.sum((sizes == (tv, tu)).all(axis=1)) for tu in sides] for tv in sides])
    figure = Figure(figsize=(1.2 + 0.95 * len(sides), 0.9 + 0.75 * len(sides)), layout="constrained")
    axes = figure.add_subplot()
    shown = np.log10(1.0 + counts)
    axes.imshow(shown, cmap="Blues", vmin=0, vmax=1.3 * shown.max(), aspect="auto")
    for (row, column), count in np.ndenumerate(counts):
        text = f"{count:,}\n{count / len(sizes):.1%}" if count else "–"
        axes.text(column, row, text, ha="center", va="center", fontsize=8)
    axes.set_xticks(range(len(sides)), [str(side) for side in sides])
    axes.set_yticks(range(len(sides)), [str(side) for side in sides])
    axes.set_xlabel("Tu (texels along u)")
    axes.set_ylabel("Tv (texels along v)")
    num_empty = int(np.sum((sizes == 0).all(axis=1)))
    without = f"\n({num_empty:,} of them without)" if num_empty else ""
    axes.set_title(f"Textures of {len(sizes):,} Gaussians{without}", fontsize=10)
    return figure
