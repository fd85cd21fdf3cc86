"""Figures of a run: files in its folder, drawn with matplotlib's object interface, and how the report shows them."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from a2tg_jax.core.cameras import Camera
from a2tg_jax.host.atomic import replacing
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.renderer import Renderer
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.images import save_picture
from a2tg_jax.results.model_pictures import (
    depth_picture,
    flight,
    learned_textures,
    level_colors,
    level_maps,
    level_picture,
    normal_picture,
)
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
NOT_HIT = "chequered where nothing is hit and the background shows"


@dataclasses.dataclass(frozen=True)
class ReportFigure:
    """A file in the run folder, as the report shows it."""

    path: Path
    caption: str
    kind: str = ""
    """Class of the report's style."""
    legend: Sequence[tuple[str, str]] = ()
    """Colours, as CSS names them, and what they mean."""


def write_figures(
    run: RunFolder, model: Model, camera: Camera, settings: RenderSettings, histories: Mapping[str, History],
    starts: Mapping[str, int],
) -> dict[str, list[ReportFigure]]:  # fmt: skip
    """Write the figures of a run, and return them by their places in the report.

    Args:
      run: its folder.
      model: its main model.
      camera: view that shows maps, depth and normals.
      settings: render settings of the model.
      histories: of the stages, by name.
      starts: number of iterations before each.
    """
    found: dict[str, list[ReportFigure]] = {"curves": [], "textures": [], "maps": [], "geometry": [], "flight": []}

    def own(name: str) -> Path:
        return run.own(run.figures / name)

    save_figure(curves := own("curves.png"), curves_figure(histories, starts))
    caption = "Loss and PSNR of the training views seen, with running means."
    found["curves"].append(ReportFigure(curves, caption, "chart"))
    maps = level_maps(model)
    if model.textures is not None and (model.textures.sizes.prod(axis=1) > 1).any():
        learned = learned_textures(model)
        if learned is not None:
            save_picture(textures := own("textures.png"), learned)
            caption = "Some textures that add much to the picture, in their Gaussians' colours; chequered where "
            found["textures"].append(ReportFigure(textures, f"{caption}transparent.", "texels"))
        save_figure(sizes := own("sizes.png"), sizes_figure(model.textures.sizes))
        caption = "How many Gaussians have a texture of each resolution."
        found["textures"].append(ReportFigure(sizes, caption, "chart"))
    for shown in maps:
        save_picture(path := own(shown.file), level_picture(model, shown.levels, camera, settings))
        legend = list(zip(map(to_hex, level_colors(len(shown.names))), shown.names, strict=True))
        caption = f"The first view, every Gaussian by {shown.told}; {NOT_HIT}."
        found["maps"].append(ReportFigure(path, caption, legend=legend))
    output = Renderer(model, settings=settings)(camera)
    picture, stops = depth_picture(output)
    save_picture(depth := own("depth.png"), picture)
    legend = [(to_hex(tuple(color)), f"{distance:.3g}") for distance, color in stops]
    caption = "Depth in units of the normalised world; nearer and farther depths take the colours of the ends; "
    save_picture(normals := own("normals.png"), normal_picture(output, camera))
    facing = f"Normals: red to the right, green up, blue to the camera; {NOT_HIT}."
    found["geometry"] += [ReportFigure(depth, f"{caption}{NOT_HIT}.", legend=legend), ReportFigure(normals, facing)]
    if (moving := flight(model, settings)) is not None:
        with replacing(animation := own("flight.webp")) as temporary:
            temporary.write_bytes(moving)
        found["flight"].append(ReportFigure(animation, "A flight past the cameras.", "figure"))
    return found


def save_figure(path: Path, figure: Figure) -> None:
    """Write a PNG on white, whole or not at all."""
    FigureCanvasAgg(figure)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def curves_figure(histories: Mapping[str, History], starts: Mapping[str, int]) -> Figure:
    """Plot loss, PSNR, Gaussians and memory over the iterations, with a dashed line where a later stage begins.

    Args:
      histories: of the stages, by name.
      starts: number of iterations before each.
    """
    figure = Figure(figsize=(10, 6), layout="constrained")
    colors = dict(zip(histories, itertools.cycle(COLORS), strict=False))
    for axes, (field, title) in zip(figure.subplots(2, 2).flat, CURVES, strict=True):
        for name, history in histories.items():
            x, y = _thinned(starts[name] + history.iteration), _thinned(getattr(history, field))
            if field in ("loss", "psnr") and len(y) >= 2 * RUNNING_MEANS:
                # A noisy curve is pale, with its running mean over it.
                axes.plot(x, y, color=colors[name], alpha=0.2, linewidth=0.8)
                window = len(y) // RUNNING_MEANS
                x, y = (np.convolve(column, np.full(window, 1 / window), mode="valid") for column in (x, y))
            axes.plot(x, y, color=colors[name], label=name, linewidth=1.6)
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
