"""report.html: one page with everything a run found, images, style and script inlined, no network."""

import base64
import hashlib
import inspect
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.json_text import MOST_TOML_BYTES
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.host.source_commit import source_commit
from a2tg_jax.io.config_json import flatten_config
from a2tg_jax.results.figures import ReportFigure
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.images import Crop, file_uri, jpeg_uri
from a2tg_jax.results.record import repeating_command
from a2tg_jax.results.summary import (
    RunResult,
    bytes_compared,
    learning_lines,
    megabytes,
    minutes,
    summary_table,
    versions,
)

SECTIONS = {
    "summary": "Summary",
    "pictures": "Pictures",
    "appearance": "Appearance",
    "geometry": "Geometry",
    "curves": "Curves",
    "views": "Every view",
    "files": "Files",
    "configuration": "Configuration",
    "reproduce": "How to reproduce",
}
CROP_ZOOM = 3
HIGHER_IS_BETTER = ("PSNR", "SSIM", "frames a second")
LOWER_IS_BETTER = ("LPIPS", "memory")
"""Words in the names of metrics whose best value is marked."""

Table = tuple[Sequence[str], Sequence[Sequence[str]], set[tuple[int, int]]]
"""Titles, rows, and the (row, column) of the marked cells."""


class Comparison(NamedTuple):
    """One view as photographed and as rendered, in compressed pictures."""

    name: str
    captions: Sequence[str]
    uris: Sequence[str]
    """Photograph first."""
    crops: Sequence[str]
    """Enlarged parts; may be empty."""
    size: tuple[int, int]
    """Width and height of the render in pixels."""

    @staticmethod
    def of(name: str, images: Sequence[np.ndarray], captions: Sequence[str], crop: Crop | None) -> "Comparison":
        """Args:
        name: of the view.
        images: uint8 [H, W, 3], the photograph first.
        captions: of the images.
        crop: the part to show enlarged.
        """
        crops = [] if crop is None else [jpeg_uri(crop.of(image), zoom=CROP_ZOOM) for image in images]
        height, width = images[-1].shape[:2]
        return Comparison(name, captions, [jpeg_uri(image) for image in images], crops, (width, height))


def write_report(
    run: RunFolder, result: RunResult, views: Sequence[Comparison], figures: Mapping[str, Sequence[ReportFigure]]
) -> None:
    """Write report.html from the results, some views, and the figures in the run folder."""
    main, held_out = result.models[result.main], result.record.scene.held_out
    num_held_out = len(main.splits[held_out].per_view) if held_out in main.splits else 0
    page = _page(
        sections=SECTIONS,
        title=f"{next(iter(result.plan.chains))} on {result.scene}",
        about=(inspect.getdoc(type(result.record.system)) or "").split("\n", 1)[0],
        num_views=len(main.train.per_view) + num_held_out,
        num_held_out=num_held_out,
        purpose={"test": "testing", "validation": "validation"}[held_out],
        viewer=run.viewer.name if run.viewer.is_file() else None,
        warnings=learning_lines(result),
        cards=_cards(result, views[0].size if views else None),
        summary=(summary := _summary(result)),
        rows_shown=[row[0] for row in summary[1]],
        lpips_network=result.lpips_network,
        corrections={split.partition("_")[2] for split in main.splits},
        comparisons=views,
        figures=figures,
        file_uri=file_uri,
        views=[(split, *_views(result, split)) for split in (held_out, "train") if split in main.splits],
        files=_files(run, result),
        configuration=_configuration(result),
        versions=versions(),
        commit=source_commit(),
        command=repeating_command(run),
        record=read_regular(run.record, MOST_TOML_BYTES).decode() if is_regular(run.record) else "",
    )
    with replacing(run.own(run.report)) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _page(**content: Any) -> str:
    """Return the page. Browsers take its own style and script only, by their hashes: no text of a scene becomes one."""
    from jinja2 import Environment, PackageLoader, StrictUndefined  # Its import is slow, and few commands need it.
    from markupsafe import Markup

    loader = PackageLoader("a2tg_jax.results")
    pages = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    style, script = (loader.get_source(pages, f"report.{kind}")[0] for kind in ("css", "js"))
    policy = f"default-src 'none'; img-src data:; style-src {_source(style)}; script-src {_source(script)}"
    inlined = {"style": Markup(style), "script": Markup(script), "policy": Markup(policy)}
    return pages.get_template("report.html").render(**content, **inlined)


def _source(text: str) -> str:
    """Return the name of an inline style or script in a content security policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _cards(result: RunResult, size: tuple[int, int] | None) -> list[tuple[str, str]]:
    """Return the figures on top of the page; `size` is that of the renders."""
    last, scene = result.models[result.main], result.record.scene
    split = scene.held_out.capitalize() if scene.held_out in last.splits else "Training"
    own = sum(measured.seconds for name, measured in result.models.items() if name in result.plan.main)
    others = sum(measured.seconds for measured in result.models.values()) - own
    gains = [
        (f"Gain over {name}, {bytes_compared(result, name)}", f"{gain:+.2f} dB") for name, gain in result.gains.items()
    ]
    speed = f"Speed{f' at {size[0]}×{size[1]}' if size else ''}, on this {jax.devices()[0].platform.upper()}"
    return [
        (f"{split} PSNR", f"{last.shown.psnr:.2f} dB"),
        *gains,
        ("SSIM", f"{last.shown.ssim:.4f}"),
        ("Gaussians", f"{last.num_gaussians:,}"),
        ("Memory", f"{megabytes(last.num_bytes)} MB"),
        (speed, f"{last.shown.frames_per_second:.1f} fps"),
        ("Training", minutes(own)),
        *([("Comparisons' training", minutes(others))] if others else []),
    ]


def _main_first(result: RunResult) -> list[str]:
    """Return the names of the models, the main one first, where a phone shows it."""
    return sorted(result.models, key=lambda name: name != result.main)


def _summary(result: RunResult) -> Table:
    titles, rows = summary_table(result)
    order = [0, *(titles.index(name) for name in _main_first(result))]
    rows = [[row[at] for at in order] for row in rows]
    best = {(at, column) for at, row in enumerate(rows) for column in _best(row)}
    return [titles[at] for at in order], rows, best


def _best(row: Sequence[str]) -> list[int]:
    """Return the cells that hold a metric's best value; none if it has no best, or all are equal."""
    is_higher = any(word in row[0] for word in HIGHER_IS_BETTER)
    if not is_higher and not any(word in row[0] for word in LOWER_IS_BETTER):
        return []
    values = {at: float(cell.replace(",", "")) for at, cell in enumerate(row[1:], 1) if cell}
    best = max(values.values()) if is_higher else min(values.values())
    found = [at for at, value in values.items() if value == best]
    return found if len(found) < len(values) else []


def _views(result: RunResult, split: str) -> Table:
    """Return PSNR and SSIM of each view by each model, with its bytes next to its name."""
    names = _main_first(result)
    sizes = [f"{name} ({megabytes(result.models[name].num_bytes)} MB)" for name in names]
    found = zip(*(result.models[name].splits[split].per_view for name in names), strict=True)
    rows, best = [], set()
    for at, views in enumerate(found):
        rows.append([views[0].name, *(f"{view.psnr:.2f} / {view.ssim:.4f}" for view in views)])
        best |= {(at, column) for column in _best(["PSNR", *(f"{view.psnr:.2f}" for view in views)])}
    return ["view", *sizes], rows, best


def _files(run: RunFolder, result: RunResult) -> list[tuple[str, str]]:
    """Return the files beside the page, and what they are."""
    told = {
        run.viewer: "the scene in a browser, to turn and to fly through; one file that opens from the disk",
        run.model(result.main): "the model, for a2tg and for load_model",
        run.point_cloud: "the Gaussians for other programs, without textures",
        run.metrics: "all figures",
        run.per_view: "the figures of every view",
        run.record: "the settings of this run",
    }
    return [(path.relative_to(run.path).as_posix(), what) for path, what in told.items() if path.is_file()]


def _configuration(result: RunResult) -> list[tuple[str, str]]:
    leaves = flatten_config(result.record.scene, "scene.") | flatten_config(result.record.system)
    return [(name, str(value)) for name, value in leaves.items()]
