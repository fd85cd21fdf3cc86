"""Figures of a run, drawn with matplotlib's object interface (no windows, no global state)."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from a2tg_jax.checkpoint import History
from a2tg_jax.io.atomic import replacing
from a2tg_jax.results.folder import Phase
from a2tg_jax.results.pictures import resolution_colors

COLORS: dict[Phase, str] = {"stage1": "#4477aa", "stage2": "#cc3311", "baseline": "#777777"}
LABELS: dict[Phase, str] = {"stage1": "stage 1", "stage2": "stage 2", "baseline": "stage 2 without textures"}
RUNNING_MEANS = 10
"""A running mean covers this share of a phase: a tenth."""
CURVES = (
    ("loss", "Loss"),
    ("psnr", "Training PSNR (dB)"),
    ("num_gaussians", "Gaussians"),
    ("megabytes", "Memory (MB)"),
)


def save_figure(path: Path, figure: Figure) -> None:
    """Writes a PNG, whole or not at all."""
    FigureCanvasAgg(figure)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def curves_figure(histories: Mapping[Phase, History]) -> Figure:
    """Loss, PSNR, Gaussians and memory over the iterations of both stages; the stages' border is dashed."""
    figure = Figure(figsize=(10, 6), layout="constrained")
    border = int(histories["stage1"].iteration[-1]) if "stage1" in histories else 0
    for axes, (name, title) in zip(figure.subplots(2, 2).flat, CURVES, strict=True):
        for phase, history in histories.items():
            start = 0 if phase == "stage1" else border
            _plot(axes, start + history.iteration, getattr(history, name), phase, is_noisy=name in ("loss", "psnr"))
        axes.axvline(border, color="black", linestyle="--", linewidth=0.8)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("iteration", fontsize=9)
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        axes.ticklabel_format(axis="y", useOffset=False)
        axes.grid(alpha=0.25)
    figure.axes[0].set_yscale("log")
    figure.axes[0].legend(fontsize=8)
    return figure


def _plot(axes: Axes, x: np.ndarray, y: np.ndarray, phase: Phase, *, is_noisy: bool) -> None:
    """One curve; a noisy one pale, with its running mean over it."""
    color = COLORS[phase]
    if is_noisy and len(y) >= 2 * RUNNING_MEANS:
        axes.plot(x, y, color=color, alpha=0.2, linewidth=0.8)
        window = len(y) // RUNNING_MEANS
        weights = np.full(window, 1 / window)
        x, y = np.convolve(x, weights, mode="valid"), np.convolve(y, weights, mode="valid")
    axes.plot(x, y, color=color, label=LABELS[phase], linewidth=1.6)


def sizes_figure(sizes: np.ndarray) -> Figure:
    """How many Gaussians have a texture of each resolution, as a map of Tv × Tu.

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
    axes.set_title(f"Textures of {len(sizes):,} Gaussians", fontsize=10)
    return figure


def resolutions_figure(picture: np.ndarray, num_levels: int) -> Figure:
    """A view whose Gaussians are coloured by their number of texels, with a legend.

    Args:
      picture: uint8 [H, W, 3] render of the coloured model.
      num_levels: colours in use: 2⁰ to 2^(num_levels - 1) texels.
    """
    height, width = picture.shape[:2]
    figure = Figure(figsize=(8, 8 * height / width + 0.7), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(picture)
    axes.set_axis_off()
    handles = [Patch(color=color, label=str(2**i)) for i, color in enumerate(resolution_colors(num_levels))]
    figure.legend(
        handles=handles, title="texels per Gaussian", loc="outside lower center", ncols=num_levels, fontsize=9
    )
    return figure
