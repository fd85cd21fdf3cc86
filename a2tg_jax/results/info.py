"""Summary of a run folder, or of a file of splats, in a few lines of text."""

import contextlib
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax import Model, load_checkpoint, load_model
from a2tg_jax.base.json_text import read_json
from a2tg_jax.base.regular_files import is_regular
from a2tg_jax.base.text import counted, in_bytes
from a2tg_jax.io.formats import file_bytes, format_of, load_splats
from a2tg_jax.results.commands import repeating_command, resuming_command
from a2tg_jax.results.folder import RunFolder, iteration_of, old_run
from a2tg_jax.results.model_source import chosen_stage
from a2tg_jax.results.plan import PlannedStage, RunPlan
from a2tg_jax.results.record import is_finished, read_record

SPLITS = ("test", "validation", "train")


def describe_run(run: RunFolder) -> str:
    """Return scene, systems, and each stage's progress, model and metrics as text. Damaged metrics and models are
    named. Raises ValueError if run.toml is damaged."""
    facts = run_facts(run)
    compared = f", compared with {', '.join(facts['compare'])}" if facts["compare"] else ""
    lines = [
        f"scene    {facts['scene']} (downscale {facts['downscale']})",
        f"system   {facts['system']}{compared}",
        f"repeat   {repeating_command(run)}",
    ]
    width = max(len(stage["name"]) for stage in facts["stages"])
    for stage in facts["stages"]:
        lines.append(f"model    {stage['name']:<{width}}  {_stage_text(stage)}")
    lines.append(f"report   {facts['report'] or 'none yet: a2tg eval writes it'}")
    if facts["page"]:
        lines.append(f"page     {facts['page']}, {in_bytes(run.viewer.stat().st_size)}")
    lines.append(f"disk     {in_bytes(facts['disk_bytes'])}")
    if facts["damage"]:
        lines.append(f"damaged  {facts['damage']}: {shlex.join(['a2tg', 'eval', str(run.path)])} rewrites it")
    if not facts["is_finished"]:
        if facts["shown"]:
            lines.append(f"shown    {facts['shown']}, unless --model is given")
        lines.append(f"training is not finished; continue with: {resuming_command(run)}")
    if is_regular(run.finish):
        lines.append(f"finished {run.finish} has its source and options")
    old = old_run(run)
    if old is not None:
        lines.append(f"replaces a run that is kept in {old.path} until this one has its report")
    return "\n".join(lines)


def file_facts(path: Path) -> dict[str, Any]:
    """Return what a file of splats holds as JSON values. Raises as `load_splats`."""
    model = load_splats(path)
    return {
        "path": str(path),
        "format": format_of(path).name,
        "file_bytes": file_bytes(path),
        "appearance": type(model.appearance).__name__,
        "sh_degree": model.gaussians.sh_degree,
        **model_facts(model),
        "num_cameras": 0 if model.origin is None else len(model.origin.cameras),
    }


def describe_file(path: Path) -> str:
    """Return what a file of splats holds as text. Raises as `load_splats`."""
    facts = file_facts(path)
    degree = "" if "degrees" in facts else f"; degree {facts['sh_degree']}"
    shown = "" if facts["appearance"] == "Appearance" else f", {facts['appearance']}"
    cameras = facts["num_cameras"]
    return "\n".join([
        f"file     {path}, {facts['format']}, {in_bytes(facts['file_bytes'])}",
        f"model    {_counts_text(facts)}{degree}{shown}",
        f"cameras  {cameras or 'none'}",
    ])  # fmt: skip


def describe_runs(runs: Sequence[RunFolder], folder: Path) -> str:
    """Return a line for each run in a folder: its name, system, disk use, and the last model or the progress of its
    main system, or what is damaged."""
    rows = []
    for run in runs:
        name = str(run.path.relative_to(folder))
        facts = facts_or_damage(run)
        if "system" not in facts:
            rows.append((name, "", "", facts["damage"]))
            continue
        main = facts["stages"][: len(read_record(run).plan.main)]
        begun = [stage for stage in main if stage["state"] != "not begun"]
        last = begun[-1] if begun else main[-1]
        text = _stage_text(last)
        if last["state"] == "in training" or last is not main[-1]:
            text = f"{last['name']} {text}"
        rows.append((name, facts["system"], in_bytes(facts["disk_bytes"]), text))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)


def run_facts(run: RunFolder) -> dict[str, Any]:
    """Return the content of a run folder as JSON values. Raises ValueError if run.toml is damaged."""
    record = read_record(run)
    psnrs: dict[str, dict[str, float]] = {}
    damage = None
    try:
        if is_regular(run.metrics):
            psnrs = read_psnrs(run.metrics)
    except ValueError as error:
        damage = str(error)
    plan = record.plan
    stages = []
    for name in plan.names:
        facts = {"name": name, **_stage_facts(run, plan[name]), "psnr": psnrs.get(name)}
        if name in record.shortened_at:
            facts["shortened_at"] = record.shortened_at[name]
        stages.append(facts)
    return {
        "path": str(run.path),
        "scene": record.scene.path,
        "downscale": record.scene.downscale,
        "system": record.system,
        "compare": list(record.compare),
        "is_finished": is_finished(run, record),
        "shown": _shown(run, plan),
        "stages": stages,
        "report": str(run.report) if run.report.is_file() else None,
        "page": str(run.viewer) if run.viewer.is_file() else None,
        "disk_bytes": sum(map(_size_of, run.path.rglob("*"))),
        "damage": damage,
    }


def _shown(run: RunFolder, plan: RunPlan) -> str | None:
    """Return the name of the stage whose model other commands take; None if nothing was kept yet."""
    try:
        return chosen_stage(run, plan)[0].name
    except FileNotFoundError:
        return None


def facts_or_damage(run: RunFolder) -> dict[str, Any]:
    """Return the content of a run folder, or only its path and damage if a file cannot be read."""
    try:
        return run_facts(run)
    except (ValueError, OSError) as error:
        return {"path": str(run.path), "damage": str(error)}


def _size_of(path: Path) -> int:
    try:
        return path.stat().st_size if path.is_file() else 0
    except FileNotFoundError:  # A run in progress replaces its checkpoints.
        return 0


def read_psnrs(path: Path) -> dict[str, dict[str, float]]:
    """Return the PSNR in a metrics.json: model → test or validation, train → dB. Raises ValueError if it is damaged."""
    psnrs: dict[str, dict[str, float]] = {}
    metrics = read_json(path)
    try:
        for name, model in metrics["models"].items():
            psnrs[name] = {split: model[split]["psnr"] for split in SPLITS if split in model}
            # Not isinstance: true would be printed as 1.00 dB.
            if not all(type(psnr) in (int, float) for psnr in psnrs[name].values()):
                raise TypeError
    except (KeyError, TypeError, AttributeError):
        raise ValueError(f"{path}: has no PSNR of its models") from None
    return psnrs


def _stage_facts(run: RunFolder, planned: PlannedStage) -> dict[str, Any]:
    """Return facts of a stage's model, or of its newest checkpoint."""
    path = run.newest(planned.name)
    if path is None:
        return {"state": "not begun"}
    if path != run.model(planned.name):
        facts: dict[str, Any] = {"state": "in training", "iteration": iteration_of(path)}
        facts |= {"iterations": planned.stage.iterations, "checkpoint": str(path)}
        with contextlib.suppress(ValueError):  # Training continues from the one before a damaged checkpoint.
            facts |= model_facts(load_checkpoint(path, system=type(planned.system)).model)
        return facts
    try:
        model = load_model(path)
    # A damaged file must not hide the other stages.
    except ValueError as error:
        return {"state": "damaged", "damage": str(error)}
    return {"state": "finished", "model": str(path), **model_facts(model)}


def model_facts(model: Model) -> dict[str, Any]:
    """Return the numbers of Gaussians and bytes of a model, of its degrees, and of its textures by size, with their
    extent."""
    facts: dict[str, Any] = {"num_gaussians": model.num, "num_bytes": model.num_bytes}
    if model.appearance.bands is not None:
        facts["degrees"] = np.bincount(model.degrees).tolist()
    if model.appearance.texture is not None and model.textures is not None:
        facts["extent"] = model.appearance.texture.options.extent
        sizes, counts = np.unique(model.textures.sizes, axis=0, return_counts=True)
        facts["textures"] = {f"{tv}×{tu}": int(num) for (tv, tu), num in zip(sizes, counts, strict=True)}
    return facts


def _stage_text(stage: Mapping[str, Any]) -> str:
    match stage["state"]:
        case "in training":
            counts = f"; {_counts_text(stage)}" if "num_gaussians" in stage else "; its checkpoint is damaged"
            return f"after iteration {stage['iteration']:,} of {stage['iterations']:,}{counts}{_shortened(stage)}"
        case "damaged":
            return f"damaged: {stage['damage']}; delete it, and a2tg train --resume trains the stage again"
        case "finished":
            psnrs = [f"{split} {psnr:.2f} dB" for split, psnr in (stage["psnr"] or {}).items()]
            return "; ".join([_counts_text(stage), *psnrs]) + _shortened(stage)
    return str(stage["state"])


def _shortened(stage: Mapping[str, Any]) -> str:
    return f"; finished early, from iteration {stage['shortened_at']:,}" if "shortened_at" in stage else ""


def _counts_text(facts: Mapping[str, Any]) -> str:
    """Return the numbers of `model_facts` as text."""
    parts = [counted(facts["num_gaussians"], "Gaussian"), in_bytes(facts["num_bytes"])]
    if facts.get("degrees"):
        parts.append("degrees " + ", ".join(f"{degree}: {num:,}" for degree, num in enumerate(facts["degrees"])))
    if facts.get("textures"):
        sizes = ", ".join(f"{size}: {num:,}" for size, num in facts["textures"].items())
        parts.append(f"textures over ±{facts['extent']:g}σ {sizes}")
    return "; ".join(parts)
