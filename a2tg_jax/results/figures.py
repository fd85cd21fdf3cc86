"""Figures for a run's report (curves, texture sizes, pictures of the model), and a plot of a scene's cameras.

They use matplotlib's object interface, without windows or global state.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from a2tg_jax import Camera, History, Model, Renderer, RenderOutput, RenderSettings, texture_arrays
from a2tg_jax.base.atomic import replacing
from a2tg_jax.base.text import PROGRAM
from a2tg_jax.core.sh import SH_C0
from a2tg_jax.data.capture_geometry import perpendicular
from a2tg_jax.data.colmap import read_cameras_and_points
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.images import checkered, save_picture, to_uint8

COLORS = ("#4477aa", "#cc3311", "#777777", "#228833", "#aa3377", "#ccaa33", "#66ccee")
"""Colours of the stages, in turn."""
RUNNING_MEANS = 10
"""Number of running-mean windows in a stage; each covers a tenth."""
MOST_POINTS = 4000
"""Points of a curve; the time of a running mean grows with their square."""
CURVES = (
    ("loss", "Loss"),
    ("psnr", "Training PSNR (dB)"),
    ("num_gaussians", "Gaussians"),
    ("megabytes", "Memory (MB)"),
)
NUM_TEXTURES = 24
TEXTURES_PER_ROW = 8
TEXTURE_SIDE = 64
"""Side of a texture in the sheet, in pixels."""
TEXTURE_MARGIN = 8
LEAST_ALPHA = 0.5
"""Smallest alpha that shows a depth and a normal."""
DEPTH_RANGE = (5, 95)
"""Percentiles of the inverse depths at the ends of the colour scale."""
DEPTH_STOPS = 5
"""Number of depths in the legend."""
NUM_CHECKERS = 60
"""Squares across a picture's empty parts."""
MOST_CLOUD_POINTS = 20_000
"""Largest number of points drawn."""
WIDEST = 3.0
"""Largest half-width of the plot, in distances of the farthest camera from the middle."""
NOT_HIT = "chequered where nothing is hit and the background shows"


@dataclasses.dataclass(frozen=True)
class ReportFigure:
    """File in the run folder, with its caption in the report."""

    path: Path
    caption: str
    kind: str = ""
    """Class in the report's style sheet."""
    legend: Sequence[tuple[str, str]] = ()
    """CSS colours and their meanings."""


def write_figures(
    run: RunFolder, model: Model, camera: Camera, settings: RenderSettings, histories: Mapping[str, History],
    starts: Mapping[str, int],
) -> dict[str, list[ReportFigure]]:  # fmt: skip
    """Write the figures of a run's main model, some of them from one camera, and return them by their places in the
    report. `starts` has the number of iterations before each stage."""

    figures: dict[str, list[ReportFigure]] = {"curves": [], "textures": [], "maps": [], "geometry": []}

    def add(
        place: str, name: str, content: Figure | np.ndarray, caption: str, kind: str = "",
        legend: Sequence[tuple[str, str]] = (),
    ) -> None:  # fmt: skip
        path = run.own(run.figures / name)
        if isinstance(content, Figure):
            save_figure(path, content)
        else:
            save_picture(path, content)
        figures[place].append(ReportFigure(path, caption, kind, legend))

    caption = "Loss and PSNR of the training views seen, with running means."
    add("curves", "curves.png", curves_figure(histories, starts), caption, "chart")
    if model.textures is not None and (model.textures.sizes.prod(axis=1) > 1).any():
        sheet = learned_textures(model)
        if sheet is not None:
            caption = "Some of the most visible textures, in their Gaussians' colours; chequered where transparent."
            add("textures", "textures.png", sheet, caption, "texels")
        caption = "Number of Gaussians with a texture of each resolution."
        add("textures", "sizes.png", sizes_figure(model.textures.sizes), caption, "chart")
    for name, varying, levels, meanings in level_maps(model):
        legend = list(zip(map(to_hex, level_colors(len(meanings))), meanings, strict=True))
        caption = f"The first view, every Gaussian by {varying}; {NOT_HIT}."
        add("maps", name, level_picture(model, levels, camera, settings), caption, legend=legend)
    output = Renderer(model, settings=settings)(camera)
    picture, stops = depth_picture(output)
    legend = [(to_hex(tuple(color)), f"{distance:.3g}") for distance, color in stops]
    caption = "Depth in units of the normalised world; nearer and farther depths have the colours of the ends"
    add("geometry", "depth.png", picture, f"{caption}; {NOT_HIT}.", legend=legend)
    caption = f"Normals: red to the right, green up, blue to the camera; {NOT_HIT}."
    add("geometry", "normals.png", normal_picture(output, camera), caption)
    return figures


def save_figure(path: Path, figure: Figure) -> None:
    """Write a PNG on white, atomically."""
    FigureCanvasAgg(figure)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110, metadata={"Software": PROGRAM})


def curves_figure(histories: Mapping[str, History], starts: Mapping[str, int]) -> Figure:
    """Plot loss, PSNR, Gaussians and memory over the iterations, with a dashed line where a later stage begins."""
    figure = Figure(figsize=(10, 6), layout="constrained")
    colors = dict(zip(histories, itertools.cycle(COLORS), strict=False))
    for axes, (field, title) in zip(figure.subplots(2, 2).flat, CURVES, strict=True):
        for name, history in histories.items():
            x = _thinned(starts[name] + history.iteration)
            y = _thinned(getattr(history, field))
            if field in ("loss", "psnr") and len(y) >= 2 * RUNNING_MEANS:
                # Loss and PSNR jump from view to view: the curve is pale, with its running mean over it.
                axes.plot(x, y, color=colors[name], alpha=0.2, linewidth=0.8)
                width = len(y) // RUNNING_MEANS
                window = np.full(width, 1 / width)
                x = np.convolve(x, window, mode="valid")
                y = np.convolve(y, window, mode="valid")
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
    """Return means of equally many rows of a column, at most `MOST_POINTS`; a remainder at the end is dropped."""
    rows = math.ceil(len(column) / MOST_POINTS)
    if rows < 2:
        return column
    num = len(column) // rows
    return column[: num * rows].reshape(num, rows).mean(axis=1)


def sizes_figure(sizes: np.ndarray) -> Figure:
    """Plot the number of Gaussians by the resolution of their textures, sizes [N, 2], as a map of Tv × Tu."""
    # Textures grow by doubling their sides; textures of one size may have other sides.
    doubled = 2 ** np.arange(int(np.log2(max(4, sizes.max()))) + 1)
    sides = np.union1d(doubled, sizes[sizes > 0])
    counts = np.zeros((len(sides), len(sides)), int)
    for row, column in np.ndindex(*counts.shape):
        counts[row, column] = np.sum((sizes == (sides[row], sides[column])).all(axis=1))
    figure = Figure(figsize=(1.2 + 0.95 * len(sides), 0.9 + 0.75 * len(sides)), layout="constrained")
    axes = figure.add_subplot()
    shown = np.log10(1.0 + counts)  # Most Gaussians have the smallest size; others would be invisible.
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


# Pictures of the model


def learned_textures(model: Model) -> np.ndarray | None:
    """Return a sheet of the most visible textures of a model (by variance of texels times area of the Gaussian), in
    their Gaussians' colours and proportions, over a chequered background.

    Returns:
      uint8 [H, W, 4], transparent between the textures; None if no Gaussian has more than one texel.
    """
    texture = model.appearance.texture
    if texture is None:
        return None
    texels = texture_arrays(texture.shown())[: model.num]
    areas = np.exp(np.asarray(model.gaussians.log_scales)[: model.num].sum(axis=1))
    # The variance of a single texel is 0.
    spread = np.asarray([texture.reshape(-1, 4).var(axis=0).sum() if texture.size else 0.0 for texture in texels])
    order = [index for index in np.argsort(-areas * spread)[:NUM_TEXTURES] if spread[index] > 0]
    if not order:
        return None
    colors = 0.5 + SH_C0 * np.asarray(model.gaussians.sh)[:, 0]
    step = TEXTURE_SIDE + TEXTURE_MARGIN
    rows = math.ceil(len(order) / TEXTURES_PER_ROW)
    columns = min(len(order), TEXTURES_PER_ROW)
    sheet = np.zeros((rows * step - TEXTURE_MARGIN, columns * step - TEXTURE_MARGIN, 4), np.uint8)
    for place, index in enumerate(order):
        # A whole factor: every texel stays a sharp square.
        scale = TEXTURE_SIDE // max(texels[index].shape[:2])
        large = np.kron(texels[index], np.ones((scale, scale, 1)))  # [h, w, 4]: RGB residual and alpha factor
        alpha = np.clip(large[..., 3:], 0, 1)
        color = np.clip(colors[index] + large[..., :3], 0, 1)
        picture = to_uint8(alpha * color + (1 - alpha) * checkered(large.shape[:2], TEXTURE_SIDE // 8))
        row, column = divmod(place, TEXTURES_PER_ROW)
        target = sheet[row * step :, column * step :][: picture.shape[0], : picture.shape[1]]
        target[..., :3] = picture
        target[..., 3] = 255
    return sheet


def depth_picture(output: RenderOutput) -> tuple[np.ndarray, list[tuple[float, np.ndarray]]]:
    """Return depths as colours, uint8 [H, W, 3], near bright, chequered where nearly nothing is hit; and some depths,
    nearest first, with their colours [3] in [0, 1]. Depths beyond these are clipped."""
    is_hit = _is_hit(output)
    # Colours are even in inverse depth, so that a far background uses few of them.
    inverse = np.asarray(output.alpha) / np.where(is_hit, np.asarray(output.depth), 1.0)
    far, near = np.percentile(inverse[is_hit], DEPTH_RANGE) if is_hit.any() else (1.0, 1.0)
    colors = colormaps["viridis"](np.clip((inverse - far) / max(near - far, 1e-9), 0, 1))[..., :3]
    shares = np.linspace(1, 0, DEPTH_STOPS if near > far else 1)
    stops = [(1 / (far + share * (near - far)), colormaps["viridis"](share)[:3]) for share in shares]
    return _on_hit(colors, is_hit), stops


def normal_picture(output: RenderOutput, camera: Camera) -> np.ndarray:
    """Return uint8 [H, W, 3] of the normals in camera axes, chequered as in `depth_picture`."""
    # Camera axes are x right, y down, z forward: flipped to right, up, towards the camera.
    normal = np.asarray(output.normal) @ np.asarray(camera.viewmat)[:3, :3].T * (1, -1, -1)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    is_seen = _is_hit(output) & (length[..., 0] > 0)
    return _on_hit(0.5 + 0.5 * normal / np.where(is_seen[..., None], length, 1.0), is_seen)


def level_maps(model: Model) -> Iterator[tuple[str, str, np.ndarray, list[str]]]:
    """Yield file name, property, levels [N] and their meanings, for the number of texels and the degree of Gaussians
    if they vary."""
    if model.textures is not None and model.appearance.texture_options is not None:
        levels = np.rint(np.log2(np.maximum(model.textures.sizes.prod(axis=1), 1))).astype(int)
        if len(np.unique(levels)) > 1:
            names = ["1 or none", *(str(2**level) for level in range(1, levels.max() + 1))]
            yield "resolutions.png", "the number of its texels", levels, names
    if model.appearance.bands is not None and len(np.unique(model.degrees)) > 1:
        names = [str(degree) for degree in range(model.degrees.max() + 1)]
        yield "degrees.png", "the degree of its view dependence", model.degrees, names


def level_colors(num_levels: int) -> np.ndarray:
    """Return [num_levels, 3] colours of levels 0, 1, …, dark to bright."""
    return colormaps["viridis"](np.linspace(0.0, 1.0, max(2, num_levels)))[:num_levels, :3]


def level_picture(model: Model, levels: np.ndarray, camera: Camera, settings: RenderSettings) -> np.ndarray:
    """Return uint8 [H, W, 3] of the Gaussians in the colours of their levels [N], without RGB residuals and view
    dependence, over a chequered background."""
    colors = (level_colors(int(levels.max()) + 1)[levels] - 0.5) / SH_C0
    if model.textures is not None:
        # Alpha factors stay: they shape the splats.
        buckets = tuple(bucket.at[..., :3].set(0.0) for bucket in model.textures.buckets)
        model = model.with_textures(dataclasses.replace(model.textures, buckets=buckets))
    sh = np.zeros_like(model.sh)
    sh[:, 0] = colors
    output = Renderer(model.with_sh(sh), settings=settings, has_geometry=False)(camera)
    behind = (1 - np.asarray(output.alpha))[..., None]
    # The render has its own background behind it, (1 − alpha) of it, which the squares replace.
    ground = _ground((camera.height, camera.width)) - np.asarray(model.background)
    return to_uint8(np.asarray(output.color) + behind * ground)


def _is_hit(output: RenderOutput) -> np.ndarray:
    """Return [H, W] whether a ray hits enough for a depth and a normal."""
    return (np.asarray(output.alpha) > LEAST_ALPHA) & (np.asarray(output.depth) > 0)


def _on_hit(colors: np.ndarray, is_hit: np.ndarray) -> np.ndarray:
    """Return uint8 [H, W, 3] of colours where something is hit."""
    return to_uint8(np.where(is_hit[..., None], colors, _ground(is_hit.shape)))


def _ground(shape: tuple[int, ...]) -> np.ndarray:
    return checkered(shape, max(1, shape[1] // NUM_CHECKERS))


# Cameras of a scene


def save_camera_picture(scene: Path, path: Path) -> None:
    """Draw the cameras and points of a COLMAP scene folder as a PNG. Raises as `read_cameras_and_points`."""
    viewmats, cloud = read_cameras_and_points(scene)
    rotations = viewmats[:, :3, :3]
    centers = -np.einsum("vij,vi->vj", rotations, viewmats[:, :3, 3])
    # Right, ahead and up of the picture; up is the mean upper side of the photographs.
    # Rows of a rotation are the camera's axes in the world; y points down.
    up = -rotations[:, 1].mean(axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    right = rotations[:, 0].mean(axis=0)
    right = right - up * (right @ up)
    if np.linalg.norm(right) < 1e-6:  # Cameras in a ring have no common right side.
        right = perpendicular(up)
    right = right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(up, right), up])
    middle = np.median(np.concatenate([centers, cloud.points]), axis=0)
    # Half the side of the picture: all cameras, and most of the points.
    far_cameras = float(np.abs(centers - middle).max())
    far_points = float(np.quantile(np.abs(cloud.points - middle).max(axis=1), 0.9)) if len(cloud.points) else 0.0
    reach = 1.1 * max(far_cameras, min(far_points, WIDEST * far_cameras), 1e-9)
    step = max(1, len(cloud.points) // MOST_CLOUD_POINTS)
    figure = Figure(figsize=(11, 5.5), layout="constrained")
    planes = {"from above": axes[[0, 1]], "from the side": axes[[0, 2]]}
    for panel, (title, plane) in zip(figure.subplots(1, 2), planes.items(), strict=True):
        x, y = plane @ (cloud.points[::step] - middle).T
        panel.scatter(x, y, s=1, c=cloud.colors[::step] / 255, linewidths=0)
        # Cameras are joined in the order of their names; short lines are their viewing directions.
        places = plane @ (centers - middle).T
        ahead = plane @ rotations[:, 2].T * (0.06 * reach)
        panel.plot(*places, color=COLORS[2], linewidth=0.5, alpha=0.5)
        panel.plot(*np.stack([places, places + ahead], axis=1), color=COLORS[1], linewidth=0.8)
        panel.scatter(places[0], places[1], s=8, color=COLORS[0], zorder=3)
        panel.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xticks=[], yticks=[])
        panel.set_title(f"{len(centers)} cameras {title}", fontsize=10)
    save_figure(path, figure)
