"""report.html: one page with everything a run found, images and style inlined, no scripts, no network."""

import dataclasses
import inspect
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

import numpy as np

from a2tg_jax.io.atomic import replacing
from a2tg_jax.io.config_json import flatten_config
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.pictures import Crop, jpeg_uri, png_uri
from a2tg_jax.results.record import repeating_command
from a2tg_jax.results.summary import RunResult, minutes, summary_table, versions

SECTIONS = (
    ("summary", "Summary"),
    ("pictures", "Pictures"),
    ("textures", "Textures"),
    ("curves", "Curves"),
    ("views", "Every view"),
    ("configuration", "Configuration"),
    ("reproduce", "How to reproduce"),
)
CROP_ZOOM = 3


@dataclasses.dataclass(frozen=True)
class Comparison:
    """One view as photographed and as rendered."""

    name: str
    images: Sequence[np.ndarray]
    """Photograph first, uint8 [H, W, 3]."""
    captions: Sequence[str]
    crop: Crop | None
    """A part to show enlarged."""


def write_report(run: RunFolder, result: RunResult, comparisons: Iterable[str]) -> None:
    """Writes report.html from the results, the figures that lie in the run folder already, and some comparisons
    (`comparison_html`)."""
    bodies = {
        "summary": _summary(result),
        "pictures": "".join(comparisons),
        "textures": _textures(run),
        "curves": _figure(run.figures / "curves.png", "Loss and PSNR of the training views seen, with running means."),
        "views": _views(result),
        "configuration": _configuration(result),
        "reproduce": _reproduce(run, result),
    }
    sections = "".join(f'<section id="{name}"><h2>{title}</h2>{bodies[name]}</section>\n' for name, title in SECTIONS)
    links = "".join(f'<a href="#{name}">{title}</a>' for name, title in SECTIONS)
    label = next(iter(result.plan.chains))
    style = files("a2tg_jax.results").joinpath("report.css").read_text(encoding="utf-8")
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(label)}: {escape(result.scene)}</title>\n<style>\n{style}</style></head>\n<body>\n"
        f"<h1>{escape(label)} on {escape(result.scene)}</h1>"
        f'<p class="soft">{escape(_system_told(result))} {_views_told(result)}</p>'
        f"<nav>{links}</nav>\n{sections}</body></html>\n"
    )
    with replacing(run.own(run.report)) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _system_told(result: RunResult) -> str:
    """The first line of what the system's author says of it."""
    return (inspect.getdoc(type(result.record.system)) or "").split("\n", 1)[0]


def _views_told(result: RunResult) -> str:
    shown = next(iter(result.models.values()))
    held_out = f", {len(shown.test.per_view)} held out for testing" if shown.test else ", none held out for testing"
    total = len(shown.train.per_view) + (len(shown.test.per_view) if shown.test else 0)
    return f"{total} views{held_out}."


def _summary(result: RunResult) -> str:
    last = result.models[result.main]
    split = "Test" if last.test else "Training"
    cards = [(f"{split} PSNR", f"{last.shown.psnr:.2f} dB")]
    cards += [(f"Gain over {name}", f"{gain:+.2f} dB") for name, gain in result.gains.items()]
    cards += [
        ("SSIM", f"{last.shown.ssim:.4f}"),
        ("Gaussians", f"{last.num_gaussians:,}"),
        ("Memory", f"{last.num_bytes / 1e6:.2f} MB"),
        ("Speed", f"{last.shown.frames_per_second:.1f} fps"),
        ("Training", minutes(sum(measured.seconds for measured in result.models.values()))),
    ]
    tiles = "".join(f'<div class="card">{escape(name)}<b>{escape(value)}</b></div>' for name, value in cards)
    titles, rows = summary_table(result)
    network = f" LPIPS with {result.lpips_network}." if result.lpips_network else ""
    note = (
        "PSNR in dB, means over the views, images clipped to [0, 1]. MB (10⁶ bytes) counts all trained floats: 52 to "
        "232 bytes a Gaussian, by its degree, and what it shows, such as 16 bytes a texel; what a method's authors "
        "count, where that is something else, and padding of the buffers stand beside it. Training is the time of each "
        f"stage alone.{network}"
    )
    return f'<div class="cards">{tiles}</div>{_table(titles, rows)}<p class="soft">{escape(note)}</p>'


def comparison_html(comparison: Comparison) -> str:
    """The pictures of a view for the report."""
    pairs = list(zip(comparison.images, comparison.captions, strict=True))
    whole = "".join(_image(jpeg_uri(image), caption, "") for image, caption in pairs)
    html = f'<h3>{escape(comparison.name)}</h3><div class="row">{whole}</div>'
    if comparison.crop is not None:
        crops = ((jpeg_uri(comparison.crop.of(image), zoom=CROP_ZOOM), caption) for image, caption in pairs)
        html += '<p class="soft">Enlarged, where the error falls most:</p><div class="row">'
        html += "".join(_image(uri, caption, "crop") for uri, caption in crops) + "</div>"
    return html


def _textures(run: RunFolder) -> str:
    if not (run.figures / "sizes.png").is_file():
        return "<p>This run has no textures.</p>"
    coloured = "The first view, every Gaussian in the colour of its texture's number of texels."
    return _figure(run.figures / "resolutions.png", coloured) + _figure(
        run.figures / "sizes.png", "How many Gaussians have a texture of each resolution."
    )


def _views(result: RunResult) -> str:
    html = ""
    for split in ("test", "train"):
        found = [(name, getattr(measured, split)) for name, measured in result.models.items()]
        if any(evaluation is None for _, evaluation in found):
            continue
        titles = ["view"]
        for name, _ in found:
            titles += [f"{name}: PSNR", "SSIM"]
        rows = [
            [views[0].name, *(cell for view in views for cell in (f"{view.psnr:.2f}", f"{view.ssim:.4f}"))]
            for views in zip(*(evaluation.per_view for _, evaluation in found), strict=True)
        ]
        is_open = " open" if split == "test" else ""
        html += f"<details{is_open}><summary>{split} views</summary>{_table(titles, rows)}</details>"
    return html


def _configuration(result: RunResult) -> str:
    leaves = flatten_config(result.record.scene, "scene.") | flatten_config(result.record.system)
    rows = [[name, str(value)] for name, value in leaves.items()]
    return f"<details><summary>{len(rows)} numbers</summary>{_table(['field', 'value'], rows)}</details>"


def _reproduce(run: RunFolder, result: RunResult) -> str:
    rows = [[name, value] for name, value in versions().items()]
    command = f"pip install a2tg-jax=={versions()['a2tg-jax']}\n{repeating_command(run)}"
    file = run.record.read_text(encoding="utf-8") if run.record.is_file() else ""
    folded = f"<details><summary>{run.record.name}</summary><pre>{escape(file)}</pre></details>"
    return f"<pre>{escape(command)}</pre>{folded}{_table(['what', 'version'], rows)}"


def _table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(title)}</th>" for title in titles)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _figure(path: Path, caption: str) -> str:
    return _image(png_uri(path), caption, "figure") if path.is_file() else ""


def _image(uri: str, caption: str, kind: str) -> str:
    text = escape(caption)
    return f'<figure class="{kind}"><img src="{uri}" alt="{text}"><figcaption>{text}</figcaption></figure>'
