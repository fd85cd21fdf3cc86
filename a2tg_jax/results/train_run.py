"""Training in a run folder: stage after stage, with checkpoints, and from where an earlier attempt stopped."""

from a2tg_jax.data import Scene
from a2tg_jax.io.model import load_model, save_model
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.history import write_history
from a2tg_jax.results.plan import PlannedStage
from a2tg_jax.results.record import read_record
from a2tg_jax.training import Checkpoint, StageResult, fit_stage, load_checkpoint, save_checkpoint

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
      ValueError: as `fit` does, or if a checkpoint is damaged or of another version.
    """
    for planned in read_record(run).plan.stages:
        if not run.model(planned.name).is_file():
            result = _train_stage(run, planned, scene, progress)
            write_history(run.own(run.history(planned.name)), result.history)
            save_model(run.own(run.model(planned.name)), result.model)


def _train_stage(run: RunFolder, planned: PlannedStage, scene: Scene, progress: bool) -> StageResult:
    """One stage from its newest checkpoint, or from its beginning."""
    name, system = planned.name, planned.system
    newest = run.checkpoints(name)[-1:]

    def keep(checkpoint: Checkpoint) -> None:
        save_checkpoint(run.own(run.checkpoint(name, checkpoint.iteration)), checkpoint)
        run.drop_old_checkpoints(name)

    return fit_stage(
        scene,
        system,
        planned.index,
        None if planned.start is None else load_model(run.model(planned.start)),
        resume=load_checkpoint(newest[0], system=type(system)) if newest else None,
        on_checkpoint=keep,
        checkpoint_every=max(1, min(LONGEST_WITHOUT_CHECKPOINT, planned.stage.iterations // 10)),
        progress=progress,
        title=name,
    )
