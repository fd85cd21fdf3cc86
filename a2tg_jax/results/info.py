"""Summary of a run folder in a few lines of text."""

import shlex
from pathlib import Path

import numpy as np

from a2tg_jax.core.display import in_bytes
from a2tg_jax.host.regular_files import is_regular
from a2tg_jax.host.text import shortened
from a2tg_jax.io.model_file import load_model
from a2tg_jax.results.folder import RunFolder, iteration_of, read_json, resuming_command
from a2tg_jax.results.record import read_record, repeating_command
from a2tg_jax.results.replacement import old_run

SPLITS = ("test", "validation", "train")


def describe_run(run: RunFolder) -> str:
    """Return the scene, the systems, the progress of each stage, its model, and the metrics if there are any.

    Damaged metrics and models are named in place of what they hold.

    Raises:
      ValueError: if run.toml is damaged or of another version.
    """
    record = read_record(run)
    measured, damage = _psnrs_or_damage(run.metrics)
    compared = f", compared with {', '.join(record.compare)}" if record.compare else ""
    names = record.plan.names
    width = max(map(len, names))
    lines = [
        f"scene    {record.scene.path} (downscale {record.scene.downscale})",
        f"system   {record.name}{compared}",
        f"repeat   {repeating_command(run)}",
        *(f"model    {name:<{width}}  {_describe_stage(run, name, measured.get(name))}" for name in names),
        f"report   {run.report if run.report.is_file() else 'none yet: a2tg eval writes it'}",
        *([f"damaged  {damage}: {shlex.join(['a2tg', 'eval', str(run.path)])} rewrites it"] if damage else []),
    ]
    if not all(is_regular(run.model(name)) for name in names):
        lines.append(f"training is not finished; continue with: {resuming_command(run)}")
    if is_regular(run.finish):
        lines.append(f"finished {run.finish} says from which run and how")
    old = old_run(run)
    if old is not None:
        lines.append(f"replaces a run that is kept in {old.path} until this one has its report")
    return "\n".join(lines)


def read_psnrs(path: Path) -> dict[str, dict[str, float]]:
    """Return the PSNR in a metrics.json: model → test or validation, train → dB.

    Raises:
      ValueError: if the file holds anything else in their place.
    """
    data = read_json(path)
    models = data.get("models") if isinstance(data, dict) else None
    if not isinstance(models, dict):
        raise ValueError(f"{path}: has no models")
    psnrs: dict[str, dict[str, float]] = {}
    for name, model in models.items():
        splits = {split: model[split] for split in SPLITS if split in model} if isinstance(model, dict) else None
        found = None if splits is None else [isinstance(x, dict) and x.get("psnr") for x in splits.values()]
        if splits is None or found is None or not all(type(psnr) in (int, float) for psnr in found):
            raise ValueError(f"{path}: has no PSNR of {shortened(name)}")
        psnrs[name] = {split: float(psnr) for split, psnr in zip(splits, found, strict=True)}  # type: ignore[arg-type]
    return psnrs


def _psnrs_or_damage(path: Path) -> tuple[dict[str, dict[str, float]], str]:
    """Return the PSNR in a metrics.json, and what is wrong with the file; nothing without a file."""
    try:
        return (read_psnrs(path) if is_regular(path) else {}), ""
    except ValueError as error:
        return {}, str(error)


def _describe_stage(run: RunFolder, name: str, measured: dict[str, float] | None) -> str:
    if not is_regular(run.model(name)):
        return _progress(run.checkpoints(name))
    try:
        model = load_model(run.model(name))
    except ValueError as error:
        return f"damaged: {error}; delete it, and a2tg train --resume trains the stage again"
    parts = [f"{model.num:,} Gaussians", in_bytes(model.num_bytes)]
    if model.bands is not None:
        counts = np.bincount(model.bands[1].degrees)
        parts.append("degrees " + ", ".join(f"{degree}: {n:,}" for degree, n in enumerate(counts)))
    if model.textures is not None:
        sizes, counts = np.unique(model.textures[1].sizes, axis=0, return_counts=True)
        parts.append("textures " + ", ".join(f"{tv}×{tu}: {n:,}" for (tv, tu), n in zip(sizes, counts, strict=True)))
    if measured:
        parts += [f"{split} {psnr:.2f} dB" for split, psnr in measured.items()]
    return "; ".join(parts)


def _progress(checkpoints: list[Path]) -> str:
    if not checkpoints:
        return "not begun"
    return f"at iteration {iteration_of(checkpoints[-1])} ({checkpoints[-1]})"
