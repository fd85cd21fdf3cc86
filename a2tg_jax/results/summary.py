"""The numbers of a run: what they are, as metrics.json, and as a table."""

import dataclasses
import platform
import sys
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import jax

from a2tg_jax.evaluation import Evaluation
from a2tg_jax.results.folder import Phase
from a2tg_jax.results.record import RunRecord

FIGURES = (
    "test PSNR (dB)", "test SSIM", "test LPIPS", "train PSNR (dB)", "train SSIM", "train LPIPS", "Gaussians",
    "texels a Gaussian", "memory (MB)", "padding (MB)", "frames a second", "training time",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class PhaseResult:
    """One phase's model, measured."""

    train: Evaluation
    test: Evaluation | None
    """None where the scene has no test views."""
    num_gaussians: int
    num_texels: int
    """0 without textures."""
    megabytes: float
    """Parameters as the paper counts them: 232 bytes a Gaussian and 16 a texel, 10⁶ bytes an MB."""
    padding_megabytes: float
    """Bytes that exist in the texture buffers only."""
    seconds: float
    """Training time of this phase."""

    @property
    def shown(self) -> Evaluation:
        """The test views, or the training views where there are none."""
        return self.test or self.train


@dataclasses.dataclass(frozen=True)
class RunResult:
    """All the phases of a run that are finished."""

    scene: str
    """Name of the scene."""
    record: RunRecord
    phases: Mapping[Phase, PhaseResult]

    @property
    def gain(self) -> float | None:
        """What textures bring in dB: stage 2 over the untextured baseline; None without one."""
        if not {"stage2", "baseline"} <= self.phases.keys():
            return None
        return self.phases["stage2"].shown.psnr - self.phases["baseline"].shown.psnr

    @property
    def lpips_network(self) -> str | None:
        return next(iter(self.phases.values())).train.lpips_network


def metrics_json(result: RunResult) -> dict[str, Any]:
    """The content of metrics.json."""
    return {
        "scene": result.scene,
        "phases": {phase: _phase_json(measured) for phase, measured in result.phases.items()},
        "gain_db": result.gain,
        "lpips_network": result.lpips_network,
        "versions": versions(),
    }


def per_view_json(result: RunResult) -> dict[str, Any]:
    """The content of per_view.json: phase → train or test → view → metrics."""
    return {
        phase: {
            split: {view.name: {"psnr": view.psnr, "ssim": view.ssim, "lpips": view.lpips} for view in found.per_view}
            for split, found in (("train", measured.train), ("test", measured.test))
            if found is not None
        }
        for phase, measured in result.phases.items()
    }


def versions() -> dict[str, str]:
    """Versions of what the figures depend on, and the devices."""
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
    """Titles and rows of the headline table: a column for each phase, a row for each figure that there is."""
    columns = [_figures(measured) for measured in result.phases.values()]
    rows = [[name, *cells] for name, *cells in zip(FIGURES, *columns, strict=True) if any(cells)]
    return ["", *(result.record.label(phase) for phase in result.phases)], rows


def summary_text(result: RunResult) -> str:
    """The headline table for a terminal, and the gain."""
    titles, rows = summary_table(result)
    name_width, *widths = (max(map(len, column)) for column in zip(titles, *rows, strict=True))
    lines = []
    for name, *cells in [titles, *rows]:
        aligned = (cell.rjust(width) for cell, width in zip(cells, widths, strict=True))
        lines.append("  ".join([name.ljust(name_width), *aligned]).rstrip())
    if result.lpips_network:
        lines.append(f"LPIPS with {result.lpips_network}")
    if result.gain is not None:
        lines.append(f"textures bring {result.gain:+.2f} dB over the untextured second stage")
    return "\n".join(lines)


def minutes(seconds: float) -> str:
    """A duration as "1 h 2 min", "3 min 4 s" or "5 s"."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60} min"
    return f"{whole // 60} min {whole % 60} s" if whole >= 60 else f"{whole} s"


def _phase_json(measured: PhaseResult) -> dict[str, Any]:
    quality = {
        split: {"psnr": found.psnr, "ssim": found.ssim, "lpips": found.lpips, "views": len(found.per_view)}
        for split, found in (("train", measured.train), ("test", measured.test))
        if found is not None
    }
    counts = {
        name: getattr(measured, name)
        for name in ("num_gaussians", "num_texels", "megabytes", "padding_megabytes", "seconds")
    }
    return {**quality, **counts, "frames_per_second": measured.shown.frames_per_second}


def _figures(measured: PhaseResult) -> list[str]:
    """One phase's column of the headline table; empty where there is no figure."""

    def quality(found: Evaluation | None) -> list[str]:
        if found is None:
            return ["", "", ""]
        return [f"{found.psnr:.2f}", f"{found.ssim:.4f}", "" if found.lpips is None else f"{found.lpips:.4f}"]

    is_textured = measured.num_texels > 0
    return [
        *quality(measured.test),
        *quality(measured.train),
        f"{measured.num_gaussians:,}",
        f"{measured.num_texels / measured.num_gaussians:.2f}" if is_textured else "",
        f"{measured.megabytes:.2f}",
        f"{measured.padding_megabytes:.2f}" if is_textured else "",
        f"{measured.shown.frames_per_second:.1f}",
        minutes(measured.seconds),
    ]
