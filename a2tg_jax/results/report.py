"""Results of a run: values, metrics.json, the summary table, and report.html, one page that needs no network."""

import base64
import dataclasses
import hashlib
import inspect
import platform
import shutil
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any, NamedTuple

import jax
import numpy as np

from a2tg_jax import Evaluation
from a2tg_jax.base.atomic import write_whole
from a2tg_jax.base.config_json import flatten_config
from a2tg_jax.base.json_text import MOST_TOML_BYTES
from a2tg_jax.base.regular_files import is_regular, read_regular
from a2tg_jax.base.text import in_bytes
from a2tg_jax.host.source_commit import source_commit
from a2tg_jax.results.commands import next_to, repeating_command, training_command
from a2tg_jax.results.figures import ReportFigure
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.images import file_uri, jpeg_uri
from a2tg_jax.results.plan import RunPlan
from a2tg_jax.results.record import RunRecord

QUALITIES = (("PSNR (dB)", "psnr", 2), ("SSIM", "ssim", 4), ("LPIPS", "lpips", 4))
"""Rows of the summary: name, metric, and decimals."""
WAYS = {
    "color_fit": "colours fitted",
    "aligned": "poses aligned",
    "aligned_color_fit": "poses aligned, colours fitted",
}
"""Titles of metrics up to exposure and pose, by the suffix of a split in metrics.json: test_color_fit, …"""
EQUAL_BYTES = 0.01
"""Largest relative difference between sizes that count as equal."""
WORSE = 1.0
"""Difference in dB between training and held-out views that is visible."""
FEW_PHOTOGRAPHS = 3.0
"""Difference in dB between training and held-out views from which new views need more photographs."""
CROP_ZOOM = 3
HIGHER_IS_BETTER = ("PSNR", "SSIM", "frames a second")
LOWER_IS_BETTER = ("LPIPS", "memory")
"""Words in the names of metrics whose best values are highlighted."""


@dataclasses.dataclass(frozen=True)
class ModelResult:
    """Measurements of one stage's model."""

    splits: Mapping[str, Evaluation]
    """Metrics by their names in metrics.json: "test" or "validation" if views are held out; "train"; then metrics up to
    exposure and pose, if a system of the run learns these."""
    num_gaussians: int
    num_texels: int
    """Number of texels; 0 without textures."""
    num_bytes: int
    num_published_bytes: int
    num_padding_bytes: int
    """Bytes as in `Model`."""
    seconds: float
    """Training time of this stage."""
    sha256: str = ""
    """SHA-256 of the model's file."""

    @property
    def train(self) -> Evaluation:
        return self.splits["train"]

    @property
    def shown(self) -> Evaluation:
        """Evaluation of the held-out views, if any, or else of the training views."""
        return next(iter(self.splits.values()))


@dataclasses.dataclass(frozen=True)
class RunResult:
    """Results of all finished models of a run."""

    scene: str
    record: RunRecord
    plan: RunPlan
    models: Mapping[str, ModelResult]
    """Results by the names of their stages."""
    is_lpips_kept: bool = False
    """Whether LPIPS is from an earlier measurement of the same models."""
    note: str = ""
    """Note on the main model if the main system is not finished (`model_source.chosen_stage`)."""

    @property
    def main(self) -> str:
        """The last finished model of the main system."""
        return [name for name in self.plan.main if name in self.models][-1]

    @property
    def before(self) -> list[str]:
        """The stage that the main model started from, if it has one."""
        start = self.plan[self.main].start
        return [start.name] if start is not None and start.name in self.models else []

    @property
    def compared(self) -> list[str]:
        """The finished last models of the other systems; none before the main system is finished."""
        main, *others = [chain[-1] for chain in self.plan.chains.values()]
        if self.main != main:
            return []
        return [name for name in others if name in self.models and name != main]

    @property
    def gains(self) -> dict[str, float]:
        """Gain in PSNR over each model that the main model is compared with, in dB."""
        psnr = self.models[self.main].shown.psnr
        return {name: psnr - self.models[name].shown.psnr for name in self.compared}

    @property
    def lpips_network(self) -> str | None:
        return self.models[self.main].train.lpips_network


def metrics_json(result: RunResult) -> dict[str, Any]:
    """Return the content of metrics.json."""
    models = {}
    for name, model in result.models.items():
        facts: dict[str, Any] = {}
        for split, evaluation in model.splits.items():
            facts[split] = {metric: getattr(evaluation, metric) for metric in ("psnr", "ssim", "lpips", "flat_psnr")}
            facts[split]["views"] = len(evaluation.per_view)
        facts |= {key: value for key, value in vars(model).items() if key != "splits"}
        models[name] = facts | {"frames_per_second": model.shown.frames_per_second}
    return {
        "scene": result.scene,
        "main": result.main,
        "models": models,
        "gains_db": result.gains,
        "lpips_network": result.lpips_network,
        "versions": versions(),
    }


def per_view_json(result: RunResult) -> dict[str, Any]:
    """Return the content of per_view.json: model → train, test or validation → view → metrics."""
    models: dict[str, Any] = {}
    for name, model in result.models.items():
        models[name] = {}
        for split, evaluation in model.splits.items():
            models[name][split] = {
                view.name: {"psnr": view.psnr, "ssim": view.ssim, "lpips": view.lpips} for view in evaluation.per_view
            }
    return models


def versions() -> dict[str, str]:
    """Return the versions that the metrics depend on, and the devices."""
    device = jax.devices()[0]
    return {
        "a2tg-jax": version("a2tg-jax"),
        "jax": version("jax"),
        "jaxlib": version("jaxlib"),
        "python": platform.python_version(),
        "platform": f"{sys.platform} {platform.machine()}",
        "device": f"{jax.device_count()} × {device.platform}: {device.device_kind}",
    }


def summary_table(result: RunResult, names: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """Return titles and rows of the summary table: a column for each model, a row for each metric present."""
    models = [result.models[name] for name in names]
    rows = []
    splits: dict[str, Evaluation] = {}
    for model in models:
        splits |= model.splits
    for split in splits:
        views, _, way = split.partition("_")
        title = f"{views}, {WAYS[way]}:" if way else views
        for quality, metric, digits in QUALITIES:
            values = [getattr(model.splits.get(split), metric, None) for model in models]
            rows.append([f"{title} {quality}", *("" if value is None else f"{value:.{digits}f}" for value in values)])
    columns = [_figures(model) for model in models]
    for title in columns[0]:
        rows.append([title, *(column[title] for column in columns)])
    return ["", *names], [row for row in rows if any(row[1:])]


def _figures(model: ModelResult) -> dict[str, str]:
    """Return the rows of the summary table under its metrics; empty texts for what a model lacks."""
    has_other_format = model.num_published_bytes != model.num_bytes
    return {
        "Gaussians": f"{model.num_gaussians:,}",
        "texels a Gaussian": f"{model.num_texels / model.num_gaussians:.2f}" if model.num_texels else "",
        "memory (MB)": megabytes(model.num_bytes),
        "as published (MB)": megabytes(model.num_published_bytes) if has_other_format else "",
        "padding (MB)": megabytes(model.num_padding_bytes) if model.num_padding_bytes else "",
        "frames a second": f"{model.shown.frames_per_second:.1f}",
        "time of the stage": minutes(model.seconds),
    }


def summary_text(result: RunResult, width: int | None = None) -> str:
    """Return the summary table, warnings and gains as text. Models that do not fit side by side in `width`
    characters (None: the terminal's width) follow below."""
    titles, rows = summary_table(result, list(result.models))
    names, *columns = zip(titles, *rows, strict=True)
    width = width or shutil.get_terminal_size().columns
    # Columns wrap into blocks, each of which repeats the names of the rows.
    blocks = [[names]]
    for column in columns:
        wider = aligned([*blocks[-1], column])
        if len(blocks[-1]) > 1 and max(map(len, wider)) > width:
            blocks.append([names])
        blocks[-1].append(column)
    lines = "\n\n".join("\n".join(aligned(block)) for block in blocks).split("\n")
    if result.lpips_network:
        kept = ", kept from an earlier measurement of the same models" if result.is_lpips_kept else ""
        lines.append(f"LPIPS with {result.lpips_network}{kept}")
    for name in dict.fromkeys(chain[-1] for chain in result.plan.chains.values()):
        budget = result.plan[name].system.budget_bytes
        if budget is not None and name in result.models:
            used = result.models[name].num_bytes
            lines.append(f"{name} takes {used:,} bytes of its budget of {budget:,} ({100 * used / budget:.2f} %)")
    lines += warning_lines(result)
    photographs = photographs_line(result)
    if photographs:
        lines.append(photographs)
    for name, gain in result.gains.items():
        lines.append(f"{result.main}: {gain:+.2f} dB over {name}, {bytes_compared(result, name)}")
    return "\n".join(lines)


def bytes_compared(result: RunResult, name: str) -> str:
    """Return the bytes of the main model against another's, for the line about its gain."""
    main = result.models[result.main].num_bytes
    other = result.models[name].num_bytes
    if abs(main - other) <= EQUAL_BYTES * other:
        return f"at equal bytes ({megabytes(main)} MB)"
    ratio = main / max(other, 1)
    times = f"{ratio:.1f}" if ratio >= 1.05 else f"{ratio:.2f}"
    return f"with {times} times its bytes ({megabytes(main)} MB and {megabytes(other)} MB)"


def warning_lines(result: RunResult) -> list[str]:
    """Return what the main model is if training is not finished, and a warning for each model that is no better than
    one flat colour per training view."""
    lines = [result.note] if result.note else []
    for name, model in result.models.items():
        if not model.train.has_learned:
            flat = f"where one flat colour per view reaches {model.train.flat_psnr:.1f} dB"
            lines.append(f"{name} did not learn: {model.train.psnr:.1f} dB on its training views, {flat}")
    return lines


def photographs_line(result: RunResult) -> str:
    """Return what the main model's held-out views say about the photographs; empty without such views."""
    main = result.models[result.main]
    held_out = result.record.scene.held_out
    if held_out not in main.splits:
        return ""
    train = main.train.psnr
    test = main.splits[held_out].psnr
    verdict = "views between the photographs are about as good"
    if train - test >= WORSE:
        verdict = "views between the photographs are somewhat worse"
    if train - test >= FEW_PHOTOGRAPHS:
        verdict = "few photographs; stay near where you stood, or take more"
    return f"{train:.1f} dB on training views, {test:.1f} held out: {verdict}"


def sizes_line(run: RunFolder, result: RunResult) -> str:
    """Return the bytes of the main model in memory and of the files that it has."""
    sizes = [f"{in_bytes(result.models[result.main].num_bytes)} in memory"]
    files = {"as a page": run.viewer, "compressed": run.model(result.main).with_suffix(".a2tgz")}
    for what, path in files.items():
        if path.is_file():
            sizes.append(f"{in_bytes(path.stat().st_size)} {what} ({path.name})")
    return f"size of {result.main}: {', '.join(sizes)}"


def aligned(columns: Sequence[tuple[str, ...]]) -> list[str]:
    """Return the lines of a table with its first column left-aligned, all others right-aligned, without empty rows."""
    name_width, *widths = (max(map(len, column)) for column in columns)
    lines = []
    for name, *cells in zip(*columns, strict=True):
        if any(cells):
            padded = [cell.rjust(width) for cell, width in zip(cells, widths, strict=True)]
            lines.append("  ".join([name.ljust(name_width), *padded]).rstrip())
    return lines


def megabytes(num_bytes: int) -> str:
    """Return a number of bytes in MB, without the unit."""
    return f"{num_bytes / 1e6:.2f}"


def loss_text(loss: float) -> str:
    """Return a loss of PSNR in dB as "0.067 dB of PSNR lost", or a negative one as gained."""
    return f"{abs(loss):.3f} dB of PSNR {'gained' if loss < 0 else 'lost'}"


def minutes(seconds: float) -> str:
    """Return a duration as "1 h 2 min", "3 min 4 s" or "5 s"."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60} min"
    return f"{whole // 60} min {whole % 60} s" if whole >= 60 else f"{whole} s"


# The page

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
    def of(
        name: str, images: Sequence[np.ndarray], captions: Sequence[str], crop: tuple[slice, slice] | None
    ) -> "Comparison":
        """Compress pictures [H, W, 3] uint8 of a view, its photograph first; `crop` is the part to show enlarged."""
        crops = [] if crop is None else [jpeg_uri(image[crop], zoom=CROP_ZOOM) for image in images]
        height, width = images[-1].shape[:2]
        return Comparison(name, captions, [jpeg_uri(image) for image in images], crops, (width, height))


def write_report(
    run: RunFolder,
    result: RunResult,
    views: Sequence[Comparison],
    figures: Mapping[str, Sequence[ReportFigure]],
    *,
    is_split_by_number: bool = False,
) -> None:
    """Write report.html from the results, some views, and the figures in the run folder. If `test_every` chose the test
    views, which a scene may also list, the page says how to train on all."""
    main = result.models[result.main]
    record = result.record
    held_out = record.scene.held_out
    # The main model comes first, where a phone shows it, then its earlier stages, and compared systems last.
    order = dict.fromkeys([*reversed(result.plan.main), *result.models])
    names = [name for name in order if name in result.models]
    titles, rows = summary_table(result, names)
    main_seconds = sum(result.models[name].seconds for name in result.plan.main if name in result.models)
    other_seconds = sum(model.seconds for model in result.models.values()) - main_seconds
    leaves = flatten_config(record.scene, "scene.") | flatten_config(record.options)
    leaves |= {f"shortened_at.{name}": iteration for name, iteration in record.shortened_at.items()}
    page = _rendered(
        title=f"{next(iter(result.plan.chains))} on {result.scene}",
        about=(inspect.getdoc(type(record.options)) or "").split("\n", 1)[0],
        result=result,
        main=main,
        held_out=held_out,
        warnings=warning_lines(result),
        photographs=photographs_line(result),
        gains=[(name, bytes_compared(result, name), gain) for name, gain in result.gains.items()],
        device=jax.devices()[0].platform.upper(),
        own_time=minutes(main_seconds),
        other_time=minutes(other_seconds),
        megabytes=megabytes,
        summary=(titles, rows, _marked(rows)),
        rows_shown=[row[0] for row in rows],
        corrections={split.partition("_")[2] for split in main.splits},
        comparisons=views,
        figures=figures,
        file_uri=file_uri,
        views=[(split, *_views(result, names, split)) for split in (held_out, "train") if split in main.splits],
        model_file=run.model(result.main).relative_to(run.path).as_posix(),
        is_written=lambda name: (run.path / name).is_file(),
        configuration=[(name, str(value)) for name, value in leaves.items()],
        versions=versions(),
        commit=source_commit(),
        command=repeating_command(run),
        final=training_command(run, next_to(run, "final"), "--test-every", "0") if is_split_by_number else None,
        record=read_regular(run.record, MOST_TOML_BYTES).decode() if is_regular(run.record) else "",
    )
    write_whole(run.own(run.report), page)


def _rendered(**values: object) -> str:
    """Return the text of report.html, one file, given the values that its template shows.

    Browsers accept only its own style and script, by hash, so that no text from a scene can act as one. Pictures are
    data: URIs.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined  # Its import is slow, and few commands need it.
    from markupsafe import Markup

    loader = PackageLoader("a2tg_jax.results")
    pages = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    policy = "default-src 'none'; img-src data:"
    for name, suffix in (("style", "css"), ("script", "js")):
        text = loader.get_source(pages, f"report.{suffix}")[0]
        # A CSP hash covers the exact text between the tags.
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        policy += f"; {name}-src 'sha256-{digest}'"
        values[name] = Markup(text)
    return pages.get_template("report.html").render(**values, policy=Markup(policy))


def _marked(rows: Sequence[Sequence[str]]) -> set[tuple[int, int]]:
    """Return the (row, column) of the cells with a metric's best value."""
    marked = set()
    for index, row in enumerate(rows):
        for column in _best(row):
            marked.add((index, column))
    return marked


def _best(row: Sequence[str]) -> list[int]:
    """Return the columns with a metric's best value; none if neither direction is better, or all are equal."""
    is_higher = any(word in row[0] for word in HIGHER_IS_BETTER)
    if not is_higher and not any(word in row[0] for word in LOWER_IS_BETTER):
        return []
    # Cells are compared as printed: values that round to the same text are equally good.
    values = {column: float(cell.replace(",", "")) for column, cell in enumerate(row[1:], 1) if cell}
    best = max(values.values()) if is_higher else min(values.values())
    columns = [column for column, value in values.items() if value == best]
    return columns if len(columns) < len(values) else []


def _views(result: RunResult, names: Sequence[str], split: str) -> Table:
    """Return PSNR and SSIM of each view and model, with model sizes in the titles."""
    titles = [f"{name} ({megabytes(result.models[name].num_bytes)} MB)" for name in names]
    rows = []
    psnrs = []
    # Views come in one order for all models.
    for views in zip(*(result.models[name].splits[split].per_view for name in names), strict=True):
        rows.append([views[0].name, *(f"{view.psnr:.2f} / {view.ssim:.4f}" for view in views)])
        psnrs.append(["PSNR", *(f"{view.psnr:.2f}" for view in views)])
    return ["view", *titles], rows, _marked(psnrs)
