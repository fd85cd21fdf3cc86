"""Results of a run: values, metrics.json, and the headline table."""

import dataclasses
import platform
import shutil
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import jax

from a2tg_jax.measure.evaluation import Evaluation
from a2tg_jax.results.plan import RunPlan
from a2tg_jax.results.record import RunRecord

QUALITIES = ("PSNR (dB)", "SSIM", "LPIPS")
WAYS = {
    "color_fit": "colours fitted",
    "aligned": "poses aligned",
    "aligned_color_fit": "poses aligned, colours fitted",
}
"""Titles of metrics up to exposure and pose, by the suffix of a split in metrics.json: test_color_fit, …"""
EQUAL_BYTES = 0.01
"""Largest relative difference of two sizes that are called equal."""


@dataclasses.dataclass(frozen=True)
class ModelResult:
    """Measurements of one stage's model."""

    splits: Mapping[str, Evaluation]
    """Metrics by their names in metrics.json: of the held-out views, "test" or "validation", if there are any; of the
    "train" views; then those up to exposure and pose, if a system of the run learns these."""
    num_gaussians: int
    num_texels: int
    """Number of texels; 0 without textures."""
    num_bytes: int
    """Bytes of the trained floats without padding: `Model.num_bytes`."""
    num_published_bytes: int
    """Bytes as the method's authors count them: `Model.num_published_bytes`."""
    num_padding_bytes: int
    """Bytes of padding in the buffers."""
    seconds: float
    """Training time of this stage."""
    sha256: str = ""
    """SHA-256 of the model's file."""

    @property
    def train(self) -> Evaluation:
        return self.splits["train"]

    @property
    def shown(self) -> Evaluation:
        """Evaluation of the held-out views, or of the training views if there are none."""
        return next(iter(self.splits.values()))


@dataclasses.dataclass(frozen=True)
class RunResult:
    """Results of all finished models of a run."""

    scene: str
    """Name of the scene."""
    record: RunRecord
    plan: RunPlan
    models: Mapping[str, ModelResult]
    """Results by the names of their stages."""
    is_lpips_kept: bool = False
    """Whether LPIPS was kept from an earlier measurement of the same models."""

    @property
    def main(self) -> str:
        """The last finished model of the main system."""
        return [name for name in self.plan.main if name in self.models][-1]

    @property
    def before(self) -> list[str]:
        """The stage that the main model started from, if it has one."""
        start = self.plan[self.main].start
        return [] if start is None else [start]

    @property
    def compared(self) -> list[str]:
        """The finished last models of the other systems; none before the main system is finished."""
        last = [chain[-1] for chain in self.plan.chains.values()]
        return [name for name in last[1:] if name in self.models and self.main == last[0] != name]

    @property
    def gains(self) -> dict[str, float]:
        """PSNR of the main model over that of each model it is compared with, in dB."""
        psnr = self.models[self.main].shown.psnr
        return {name: psnr - self.models[name].shown.psnr for name in self.compared}

    @property
    def lpips_network(self) -> str | None:
        return self.models[self.main].train.lpips_network


def metrics_json(result: RunResult) -> dict[str, Any]:
    """Return the content of metrics.json."""
    models = {}
    for name, measured in result.models.items():
        counts = {key: value for key, value in vars(measured).items() if key != "splits"}
        splits = {
            split: {
                "psnr": found.psnr, "ssim": found.ssim, "lpips": found.lpips, "flat_psnr": found.flat_psnr,
                "views": len(found.per_view),
            }
            for split, found in measured.splits.items()
        }  # fmt: skip
        models[name] = {**splits, **counts, "frames_per_second": measured.shown.frames_per_second}
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
    return {
        name: {
            split: {view.name: {"psnr": view.psnr, "ssim": view.ssim, "lpips": view.lpips} for view in found.per_view}
            for split, found in measured.splits.items()
        }
        for name, measured in result.models.items()
    }


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


def summary_table(result: RunResult) -> tuple[list[str], list[list[str]]]:
    """Return titles and rows of the headline table: a column for each model, a row for each metric present."""
    models = list(result.models.values())
    rows = []
    for split in dict.fromkeys(split for measured in models for split in measured.splits):
        views, _, way = split.partition("_")
        title = f"{views}, {WAYS[way]}:" if way else views
        cells = zip(*(_qualities(measured.splits.get(split)) for measured in models), strict=True)
        rows += [[f"{title} {name}", *row] for name, row in zip(QUALITIES, cells, strict=True)]
    figures = [
        {
            "Gaussians": f"{found.num_gaussians:,}",
            "texels a Gaussian": f"{found.num_texels / found.num_gaussians:.2f}" if found.num_texels else "",
            "memory (MB)": megabytes(found.num_bytes),
            "as published (MB)": (
                megabytes(found.num_published_bytes) if found.num_published_bytes != found.num_bytes else ""
            ),
            "padding (MB)": megabytes(found.num_padding_bytes) if found.num_padding_bytes else "",
            "frames a second": f"{found.shown.frames_per_second:.1f}",
            "training time": minutes(found.seconds),
        }
        for found in models
    ]
    rows += [[name, *(column[name] for column in figures)] for name in figures[0]]
    return ["", *result.models], [row for row in rows if any(row[1:])]


def summary_text(result: RunResult, width: int | None = None) -> str:
    """Return the headline table for a terminal, followed by warnings and gains.

    Args:
      result: the run.
      width: in characters; models that do not fit next to each other follow below. None: the terminal's.
    """
    titles, rows = summary_table(result)
    names, *columns = zip(titles, *rows, strict=True)
    width = width or shutil.get_terminal_size().columns
    blocks = [[names]]
    for column in columns:
        if len(blocks[-1]) > 1 and max(map(len, aligned([*blocks[-1], column]))) > width:
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
    lines += learning_lines(result)
    for name, gain in result.gains.items():
        lines.append(f"{result.main}: {gain:+.2f} dB over {name}, {bytes_compared(result, name)}")
    return "\n".join(lines)


def bytes_compared(result: RunResult, name: str) -> str:
    """Return the bytes of the main model against another's, for the line of its gain."""
    own, other = result.models[result.main].num_bytes, result.models[name].num_bytes
    if abs(own - other) <= EQUAL_BYTES * other:
        return f"at equal bytes ({megabytes(own)} MB)"
    ratio = own / max(other, 1)
    times = f"{ratio:.1f}" if ratio >= 1.05 else f"{ratio:.2f}"
    return f"with {times} times its bytes ({megabytes(own)} MB and {megabytes(other)} MB)"


def learning_lines(result: RunResult) -> list[str]:
    """Return a warning for each finished model that does not beat one flat colour per view on its training views."""
    return [
        f"{name} did not learn: {measured.train.psnr:.1f} dB on its training views, where one flat colour per view "
        f"reaches {measured.train.flat_psnr:.1f} dB"
        for name, measured in result.models.items()
        if not measured.train.has_learned
    ]


def aligned(columns: Sequence[tuple[str, ...]]) -> list[str]:
    """Return the lines of a table: first column left-aligned, the others right-aligned; empty rows are left out."""
    name_width, *widths = (max(map(len, column)) for column in columns)
    lines = []
    for name, *cells in (line for line in zip(*columns, strict=True) if any(line[1:])):
        aligned = (cell.rjust(width) for cell, width in zip(cells, widths, strict=True))
        lines.append("  ".join([name.ljust(name_width), *aligned]).rstrip())
    return lines


def megabytes(num_bytes: int) -> str:
    """Return a number of bytes in MB, without the unit."""
    return f"{num_bytes / 1e6:.2f}"


def minutes(seconds: float) -> str:
    """Return a duration as "1 h 2 min", "3 min 4 s" or "5 s"."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60} min"
    return f"{whole // 60} min {whole % 60} s" if whole >= 60 else f"{whole} s"


def _qualities(found: Evaluation | None) -> list[str]:
    """Return PSNR, SSIM and LPIPS; empty for a missing metric."""
    if found is None:
        return ["", "", ""]
    return [f"{found.psnr:.2f}", f"{found.ssim:.4f}", "" if found.lpips is None else f"{found.lpips:.4f}"]
