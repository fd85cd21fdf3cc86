"""report.html: one page with everything a run found, images, style and script inlined, no network."""

import base64
import dataclasses
import hashlib
import inspect
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from a2tg_jax.host.atomic import replacing
from a2tg_jax.host.json_text import MOST_TOML_BYTES
from a2tg_jax.host.regular_files import is_regular, read_regular
from a2tg_jax.host.source_commit import source_commit
from a2tg_jax.io.config_json import flatten_config
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.images import Crop, jpeg_uri
from a2tg_jax.results.record import repeating_command
from a2tg_jax.results.run_figures import Figures
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


@dataclasses.dataclass(frozen=True)
class Comparison:
    """One view as photographed and as rendered."""

    name: str
    images: Sequence[np.ndarray]
    """Images, uint8 [H, W, 3], the photograph first."""
    captions: Sequence[str]
    crop: Crop | None
    """Part to show enlarged."""


@dataclasses.dataclass(frozen=True)
class ShownComparison:
    """One view as the report holds it: with compressed pictures."""

    name: str
    captions: Sequence[str]
    uris: Sequence[str]
    crops: Sequence[str]
    """Enlarged parts; may be empty."""
    size: tuple[int, int]
    """Width and height of the render in pixels."""

    @classmethod
    def of(cls, view: Comparison) -> "ShownComparison":
        parts = [] if view.crop is None else [view.crop.of(image) for image in view.images]
        crops = [jpeg_uri(part, zoom=CROP_ZOOM) for part in parts]
        height, width = view.images[-1].shape[:2]
        return cls(view.name, view.captions, [jpeg_uri(image) for image in view.images], crops, (width, height))


def write_report(run: RunFolder, result: RunResult, views: Sequence[ShownComparison], figures: Figures) -> None:
    """Write report.html from the results, some views, and the figures in the run folder."""
    shown = next(iter(result.models.values()))
    held_out = result.record.scene.held_out
    num_held_out = len(shown.test.per_view) if shown.test else 0
    page = _page(
        sections=SECTIONS,
        title=f"{next(iter(result.plan.chains))} on {result.scene}",
        about=(inspect.getdoc(type(result.record.system)) or "").split("\n", 1)[0],
        num_views=len(shown.train.per_view) + num_held_out,
        num_held_out=num_held_out,
        purpose={"test": "testing", "validation": "validation"}[held_out],
        viewer=run.viewer.name if run.viewer.is_file() else None,
        warnings=learning_lines(result),
        cards=_cards(result, views[0].size if views else None),
        summary=(summary := _summary(result)),
        rows_shown=[row[0] for row in summary[1]],
        lpips_network=result.lpips_network,
        corrections={key.partition("_")[2] for key in result.models[result.main].corrected},
        comparisons=views,
        figures=figures,
        views=[(split, *_views(result, split)) for split in (held_out, "train") if split in shown.splits],
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
    last = result.models[result.main]
    gains = [
        (f"Gain over {name}, {bytes_compared(result, name)}", f"{gain:+.2f} dB") for name, gain in result.gains.items()
    ]
    device = jax.devices()[0].platform.upper()
    own = sum(measured.seconds for name, measured in result.models.items() if name in result.plan.main)
    others = sum(measured.seconds for measured in result.models.values()) - own
    return [
        (f"{last.held_out.capitalize() if last.test else 'Training'} PSNR", f"{last.shown.psnr:.2f} dB"),
        *gains,
        ("SSIM", f"{last.shown.ssim:.4f}"),
        ("Gaussians", f"{last.num_gaussians:,}"),
        ("Memory", f"{megabytes(last.num_bytes)} MB"),
        (
            f"Speed{f' at {size[0]}×{size[1]}' if size else ''}, on this {device}",
            f"{last.shown.frames_per_second:.1f} fps",
        ),
        ("Training", minutes(own)),
        *([("Comparisons' training", minutes(others))] if others else []),
    ]


def _main_first(result: RunResult) -> list[str]:
    """Return the names of the models, that of the main one first, where a phone shows it."""
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
    """Return PSNR and SSIM of each view by each model, whose bytes stand beside its name."""
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
