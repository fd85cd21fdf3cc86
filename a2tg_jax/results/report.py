"""report.html: one page with everything a run found, images, style and script inlined, no network."""

import dataclasses
import inspect
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

import numpy as np

from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.json_text import MOST_TOML_BYTES
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.io.config_json import flatten_config
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.images import Crop, file_uri, jpeg_uri
from a2tg_jax.results.markup import image, layers, page, slider, table
from a2tg_jax.results.record import repeating_command
from a2tg_jax.results.summary import (
    ModelResult,
    RunResult,
    bytes_compared,
    learning_lines,
    minutes,
    summary_table,
    versions,
)

SECTIONS = (
    ("summary", "Summary"),
    ("pictures", "Pictures"),
    ("textures", "Textures"),
    ("geometry", "Geometry"),
    ("curves", "Curves"),
    ("views", "Every view"),
    ("files", "Files"),
    ("configuration", "Configuration"),
    ("reproduce", "How to reproduce"),
)
CROP_ZOOM = 3
HIGHER_IS_BETTER = ("PSNR", "SSIM", "frames a second")
LOWER_IS_BETTER = ("LPIPS", "memory")
"""Words in the names of metrics whose best value is marked."""


@dataclasses.dataclass(frozen=True)
class Comparison:
    """One view as photographed and as rendered."""

    name: str
    images: Sequence[np.ndarray]
    """Images, uint8 [H, W, 3], the photograph first."""
    captions: Sequence[str]
    crop: Crop | None
    """Part to show enlarged."""


def write_report(run: RunFolder, result: RunResult, comparisons: Iterable[str]) -> None:
    """Write report.html from the results, the figures in the run folder, and some comparisons (`comparison_html`)."""
    curves = "Loss and PSNR of the training views seen, with running means."
    bodies = {
        "summary": _summary(result),
        "pictures": _pictures(comparisons),
        "textures": _textures(run),
        "geometry": _geometry(run),
        "curves": _figure(run.figures / "curves.png", curves, "chart"),
        "views": _views(result),
        "files": _files(run, result),
        "configuration": _configuration(result),
        "reproduce": _reproduce(run, result),
    }
    sections = "".join(f'<section id="{name}"><h2>{title}</h2>{bodies[name]}</section>\n' for name, title in SECTIONS)
    links = "".join(f'<a href="#{name}">{title}</a>' for name, title in SECTIONS)
    title = f"{next(iter(result.plan.chains))} on {result.scene}"
    viewer = f' <a href="{run.viewer.name}">Look at the scene.</a>' if run.viewer.is_file() else ""
    told = f'<p class="soft">{escape(_system_told(result))} {_views_told(result)}{viewer}</p>'
    body = f"<h1>{escape(title)}</h1>{told}<nav>{links}</nav>\n{sections}"
    style, script = (files("a2tg_jax.results").joinpath(f"report.{kind}").read_text("utf-8") for kind in ("css", "js"))
    with replacing(run.own(run.report)) as temporary:
        temporary.write_text(page(title, body, style=style, script=script), encoding="utf-8")


def _system_told(result: RunResult) -> str:
    """Return the first line of the system's docstring."""
    return (inspect.getdoc(type(result.record.system)) or "").split("\n", 1)[0]


def _views_told(result: RunResult) -> str:
    shown = next(iter(result.models.values()))
    held_out = f", {len(shown.test.per_view)} held out for testing" if shown.test else ", none held out for testing"
    total = len(shown.train.per_view) + (len(shown.test.per_view) if shown.test else 0)
    return f"{total} views{held_out}."


def _summary(result: RunResult) -> str:
    last = result.models[result.main]
    split = "Test" if last.test else "Training"
    own = sum(measured.seconds for name, measured in result.models.items() if name in result.plan.main)
    others = sum(measured.seconds for measured in result.models.values()) - own
    cards = [(f"{split} PSNR", f"{last.shown.psnr:.2f} dB")]
    for name, gain in result.gains.items():
        cards.append((f"Gain over {name}, {bytes_compared(result, name)}", f"{gain:+.2f} dB"))
    cards += [
        ("SSIM", f"{last.shown.ssim:.4f}"),
        ("Gaussians", f"{last.num_gaussians:,}"),
        ("Memory", f"{last.num_bytes / 1e6:.2f} MB"),
        ("Speed", f"{last.shown.frames_per_second:.1f} fps"),
        ("Training", minutes(own)),
    ]
    cards += [("Comparisons' training", minutes(others))] if others else []
    tiles = "".join(f'<div class="card">{escape(name)}<b>{escape(value)}</b></div>' for name, value in cards)
    titles, rows = _main_first(result, *summary_table(result))
    network = f" LPIPS with {result.lpips_network}." if result.lpips_network else ""
    note = (
        "PSNR in dB, means over the views, images clipped to [0, 1]; the best of each figure is marked. MB (10⁶ bytes) "
        "counts all trained floats: 52 to 232 bytes a Gaussian, by its degree, and what it shows, such as 16 bytes a "
        "texel; what a method's authors count, where that is something else, and padding of the buffers stand beside "
        f"it. Training is the time of each stage alone.{network}{_corrected_told(last)}"
    )
    best = {(at, column) for at, row in enumerate(rows) for column in _best(row)}
    warned = "".join(f'<p class="warning">{escape(line)}.</p>' for line in learning_lines(result))
    return f'{warned}<div class="cards">{tiles}</div>{table(titles, rows, best)}<p class="soft">{escape(note)}</p>'


def _corrected_told(measured: ModelResult) -> str:
    """Return what the further metrics mean, if there are any."""
    ways = {key.partition("_")[2] for key in measured.corrected}
    fitted = " Colours fitted: each render's colours mapped to the photograph's by the affine map of least squares."
    aligned = (
        " Poses aligned: test cameras moved to where the model looks most like the photograph, training cameras to "
    )
    aligned += "where training moved them."
    return (fitted if "color_fit" in ways else "") + (aligned if "aligned" in ways else "")


def _main_first(result: RunResult, titles: list[str], rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
    """Return the columns of a table with that of the main model first, where a phone shows it."""
    main = titles.index(result.main)
    order = [0, main, *(at for at in range(1, len(titles)) if at != main)]
    return [titles[at] for at in order], [[row[at] for at in order] for row in rows]


def _best(row: Sequence[str]) -> list[int]:
    """Return the cells that hold a metric's best value; none if it has no best, or all are equal."""
    is_higher = any(word in row[0] for word in HIGHER_IS_BETTER)
    if not is_higher and not any(word in row[0] for word in LOWER_IS_BETTER):
        return []
    values = {at: float(cell.replace(",", "")) for at, cell in enumerate(row[1:], 1) if cell}
    best = max(values.values()) if is_higher else min(values.values())
    found = [at for at, value in values.items() if value == best]
    return found if len(found) < len(values) else []


def comparison_html(comparison: Comparison) -> str:
    """Return the pictures of a view for the report."""
    body = layers([jpeg_uri(image) for image in comparison.images], comparison.captions)
    if comparison.crop is not None:
        crops = [jpeg_uri(comparison.crop.of(image), zoom=CROP_ZOOM) for image in comparison.images]
        body += layers(crops, comparison.captions, "crop")
    return f"<h3>{escape(comparison.name)}</h3>{slider(body, comparison.captions)}"


def _pictures(comparisons: Iterable[str]) -> str:
    told = "Beside each view, enlarged: where the error falls most among the parts that come out well."
    return f'<p class="soft">{told}</p>' + "".join(comparisons)


def _textures(run: RunFolder) -> str:
    if not (run.figures / "sizes.png").is_file():
        return "<p>This run has no textures.</p>"
    coloured = "The first view, every Gaussian in the colour of its texture's number of texels."
    learned = "Some textures that add much to the picture, in their Gaussians' colours; chequered where transparent."
    return (
        _figure(run.figures / "textures.png", learned, "texels")
        + _figure(run.figures / "resolutions.png", coloured)
        + _figure(run.figures / "sizes.png", "How many Gaussians have a texture of each resolution.", "chart")
    )


def _geometry(run: RunFolder) -> str:
    pairs = (("depth", "Depth, near bright."), ("normals", "Normals: red to the right, green up, blue to the camera."))
    both = "".join(_figure(run.figures / f"{name}.png", caption, "") for name, caption in pairs)
    moving = _figure(run.figures / "flight.webp", "A flight past the cameras.", "")
    folded = f"<details><summary>Flight past the cameras</summary>{moving}</details>" if moving else ""
    return f'<div class="row">{both}</div>{folded}'


def _files(run: RunFolder, result: RunResult) -> str:
    """Return links to the files beside the page."""
    told = {
        run.viewer: "the scene in a browser, to turn and to fly through; one file that opens from the disk",
        run.model(result.main): "the model, for a2tg and for load_model",
        run.point_cloud: "the Gaussians for other programs, without textures",
        run.metrics: "all figures",
        run.per_view: "the figures of every view",
        run.record: "what repeats the run",
    }
    items = ""
    for path, what in told.items():
        name = path.relative_to(run.path).as_posix()
        if path.is_file():
            items += f'<li><a href="{escape(quote(name))}">{escape(name)}</a>: {escape(what)}</li>'
    return f"<ul>{items}</ul>"


def _views(result: RunResult) -> str:
    html = ""
    for split in ("test", "train"):
        names = sorted(result.models, key=lambda name: name != result.main)
        found = [(name, getattr(result.models[name], split)) for name in names]
        if any(evaluation is None for _, evaluation in found):
            continue
        titles = ["view"]
        for name, _ in found:
            titles += [f"{name}: PSNR", "SSIM"]
        rows = [
            [views[0].name, *(cell for view in views for cell in (f"{view.psnr:.2f}", f"{view.ssim:.4f}"))]
            for views in zip(*(evaluation.per_view for _, evaluation in found), strict=True)
        ]
        best = {(at, column) for at, row in enumerate(rows) for column in _best_psnr(row)}
        is_open = " open" if split == "test" else ""
        html += f"<details{is_open}><summary>{split} views</summary>{table(titles, rows, best)}</details>"
    return html


def _best_psnr(row: Sequence[str]) -> list[int]:
    """Return the cells of a view's row that hold its best PSNR; every second cell holds an SSIM."""
    return [2 * at - 1 for at in _best(["PSNR", *row[1::2]])]


def _configuration(result: RunResult) -> str:
    leaves = flatten_config(result.record.scene, "scene.") | flatten_config(result.record.system)
    rows = [[name, str(value)] for name, value in leaves.items()]
    return f"<details><summary>{len(rows)} numbers</summary>{table(['field', 'value'], rows)}</details>"


def _reproduce(run: RunFolder, result: RunResult) -> str:
    rows = [[name, value] for name, value in versions().items()]
    command = f"pip install a2tg-jax=={versions()['a2tg-jax']}\n{repeating_command(run)}"
    file = read_regular(run.record, MOST_TOML_BYTES).decode() if is_regular(run.record) else ""
    folded = f"<details><summary>{run.record.name}</summary><pre>{escape(file)}</pre></details>"
    return f"<pre>{escape(command)}</pre>{folded}{table(['what', 'version'], rows)}"


def _figure(path: Path, caption: str, kind: str = "figure") -> str:
    return image(file_uri(path), caption, kind) if path.is_file() else ""
