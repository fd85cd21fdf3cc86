"""Training in a run folder: stage after stage, with checkpoints, and from where an earlier attempt stopped."""

import dataclasses
from pathlib import Path

from a2tg_jax.data import Scene
from a2tg_jax.io.archive import read_archive_header
from a2tg_jax.io.config_json import flatten_config
from a2tg_jax.io.model import FORMAT, load_model, save_model
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.history import write_history
from a2tg_jax.results.plan import PlannedStage, is_same_so_far
from a2tg_jax.results.record import read_record
from a2tg_jax.training import Checkpoint, StageResult, System, fit_stage, load_checkpoint, save_checkpoint
from a2tg_jax.training.registry import system_from_dict, system_to_dict

LONGEST_WITHOUT_CHECKPOINT = 500
"""Iterations."""


def train_run(run: RunFolder, scene: Scene, *, progress: bool = True) -> None:
    """Trains every stage that the run's record asks for and that is not finished yet.

    A stage goes on from its newest checkpoint. When it ends, its history and its model are written.

    Args:
      run: a run folder with its record.
      scene: the scene of the record.
      progress: show a progress bar.

    Raises:
      ValueError: as `fit` does, or if a checkpoint or model is damaged, of another version, or made with other numbers
        than the record's.
    """
    for planned in read_record(run).plan.stages:
        model = run.model(planned.name)
        if model.is_file():
            _check_model(model, planned)
            continue
        result = _train_stage(run, planned, scene, progress)
        write_history(run.own(run.history(planned.name)), result.history)
        save_model(run.own(model), result.model, {"system": system_to_dict(planned.system)})


def _train_stage(run: RunFolder, planned: PlannedStage, scene: Scene, progress: bool) -> StageResult:
    """One stage from its newest checkpoint, or from its beginning."""
    name, system = planned.name, planned.system
    newest = run.checkpoints(name)[-1:]
    resume = _load_checkpoint(newest[0], planned) if newest else None

    def keep(checkpoint: Checkpoint) -> None:
        save_checkpoint(run.own(run.checkpoint(name, checkpoint.iteration)), checkpoint)
        run.drop_old_checkpoints(name)

    return fit_stage(
        scene,
        system,
        planned.index,
        None if planned.start is None else load_model(run.model(planned.start)),
        resume=resume,
        on_checkpoint=keep,
        checkpoint_every=max(1, min(LONGEST_WITHOUT_CHECKPOINT, planned.stage.iterations // 10)),
        progress=progress,
        title=name,
    )


def _load_checkpoint(path: Path, planned: PlannedStage) -> Checkpoint:
    """A checkpoint of a stage, after a check that it was made with the same numbers so far."""
    checkpoint = load_checkpoint(path, system=type(planned.system))
    _check_unchanged(path, checkpoint.system, planned)
    return dataclasses.replace(checkpoint, system=planned.system)


def _check_model(path: Path, planned: PlannedStage) -> None:
    """Refuses a finished model that was made with other numbers than are wanted now."""
    made = read_archive_header(path, format=FORMAT).get("system")
    if made is not None:
        _check_unchanged(path, system_from_dict(made, str(path), type(planned.system)), planned)


def _check_unchanged(path: Path, made: System, planned: PlannedStage) -> None:
    if is_same_so_far(made, planned.system, planned.index):
        return
    before, now = flatten_config(made), flatten_config(planned.system)
    names = ", ".join(name for name in now if before[name] != now[name])
    advice = "put that back, or train in a new folder"
    raise ValueError(f"{path} was made with another {names} than run.toml says: {advice}")
