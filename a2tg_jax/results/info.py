"""What a run folder holds, in a few lines of text."""

from pathlib import Path

import numpy as np

from a2tg_jax.appearance import Banded
from a2tg_jax.io.model import load_model
from a2tg_jax.results.folder import RunFolder, iteration_of, read_json
from a2tg_jax.results.record import read_record, repeating_command


def describe_run(run: RunFolder) -> str:
    """The scene, the systems, how far each stage is, its model, and the metrics where there are any.

    Raises:
      ValueError: if a file of the run is damaged or of another version.
    """
    record = read_record(run)
    measured = read_json(run.metrics)["models"] if run.metrics.is_file() else {}
    compared = f", compared with {', '.join(record.compare)}" if record.compare else ""
    names = record.plan.names
    width = max(map(len, names))
    lines = [
        f"scene    {record.scene.path} (downscale {record.scene.downscale})",
        f"system   {record.name}{compared}",
        f"repeat   {repeating_command(run)}",
        *(f"model    {name:<{width}}  {_describe_stage(run, name, measured.get(name))}" for name in names),
        f"report   {run.report if run.report.is_file() else 'none yet: a2tg eval writes it'}",
    ]
    return "\n".join(lines)


def _describe_stage(run: RunFolder, name: str, measured: dict | None) -> str:
    if not run.model(name).is_file():
        return _progress(run.checkpoints(name))
    model = load_model(run.model(name))
    parts = [f"{model.num:,} Gaussians", f"{model.num_bytes / 1e6:.2f} MB"]
    if isinstance(model.appearance, Banded):
        counts = np.bincount(model.layout.bands.degrees)
        parts.append("degrees " + ", ".join(f"{degree}: {n:,}" for degree, n in enumerate(counts)))
    if model.textures is not None:
        sizes, counts = np.unique(model.textures[1].sizes, axis=0, return_counts=True)
        parts.append("textures " + ", ".join(f"{tv}×{tu}: {n:,}" for (tv, tu), n in zip(sizes, counts, strict=True)))
    if measured:
        splits = [split for split in ("test", "train") if split in measured]
        parts += [f"{split} {measured[split]['psnr']:.2f} dB" for split in splits]
    return "; ".join(parts)


def _progress(checkpoints: list[Path]) -> str:
    if not checkpoints:
        return "not begun"
    return f"at iteration {iteration_of(checkpoints[-1])} ({checkpoints[-1]})"
