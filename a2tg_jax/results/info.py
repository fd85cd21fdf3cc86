"""What a run folder holds, in a few lines of text."""

from pathlib import Path

import numpy as np

from a2tg_jax.io.model import load_model
from a2tg_jax.results.folder import Phase, RunFolder, read_json
from a2tg_jax.results.record import RunRecord, read_record
from a2tg_jax.texture import AtlasLayout


def describe_run(run: RunFolder) -> str:
    """The scene, how far each phase is, its model, and the metrics where there are any.

    Raises:
      ValueError: if a file of the run is damaged or of another version.
    """
    record = read_record(run)
    measured = read_json(run.metrics) if run.metrics.is_file() else {"phases": {}}
    lines = [
        f"scene    {record.source.path} (downscale {record.source.downscale})",
        f"command  {record.command(run.path)}",
        *(_describe_phase(run, record, phase, measured["phases"].get(phase)) for phase in record.phases),
        f"report   {run.report if run.report.is_file() else 'none yet: a2tg eval writes it'}",
    ]
    return "\n".join(lines)


def _describe_phase(run: RunFolder, record: RunRecord, phase: Phase, measured: dict | None) -> str:
    title = f"{phase:<8} {record.label(phase)}: "
    if not run.model(phase).is_file():
        return title + _progress(run.checkpoints(phase))
    model = load_model(run.model(phase))
    parts = [f"{model.gaussians.num:,} Gaussians", f"{model.num_bytes / 1e6:.2f} MB"]
    if isinstance(model.layout, AtlasLayout):
        sizes, counts = np.unique(model.layout.sizes, axis=0, return_counts=True)
        parts.append("textures " + ", ".join(f"{tv}×{tu}: {n:,}" for (tv, tu), n in zip(sizes, counts, strict=True)))
    if measured:
        splits = [split for split in ("test", "train") if split in measured]
        parts += [f"{split} {measured[split]['psnr']:.2f} dB" for split in splits]
    return title + "; ".join(parts)


def _progress(checkpoints: list[Path]) -> str:
    if not checkpoints:
        return "not begun"
    return f"at iteration {int(checkpoints[-1].stem.rsplit('-', 1)[1])} ({checkpoints[-1]})"
