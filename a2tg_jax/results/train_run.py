"""Training in a run folder: phase after phase, with checkpoints, and from where an earlier attempt stopped."""

import functools

from a2tg_jax.appearance import Textured
from a2tg_jax.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from a2tg_jax.config import TrainConfig
from a2tg_jax.data import Scene
from a2tg_jax.io.model import load_model, save_model
from a2tg_jax.model import Model
from a2tg_jax.origin import Origin
from a2tg_jax.results.evaluate_run import background_of
from a2tg_jax.results.folder import Phase, RunFolder
from a2tg_jax.results.history import write_history
from a2tg_jax.results.record import read_record
from a2tg_jax.training import FitResult, fit_stage1, fit_stage2, texture_options

LONGEST_WITHOUT_CHECKPOINT = 500
"""Iterations."""


def train_run(run: RunFolder, scene: Scene, *, progress: bool = True) -> None:
    """Trains every phase that the run's record asks for and that is not finished yet.

    A phase goes on from its newest checkpoint. When it ends, its model and its history are written.

    Args:
      run: a run folder with its record.
      scene: the scene of the record.
      progress: show a progress bar.

    Raises:
      ValueError: as `fit` does, or if a checkpoint is damaged or of another version.
    """
    record = read_record(run)
    for phase in record.phases:
        if not run.model(phase).is_file():
            result = _train_phase(run, phase, scene, record.phase_config(phase), progress)
            write_history(run.own(run.history(phase)), result.history)
            save_model(run.own(run.model(phase)), _model_of(result, scene))


def _model_of(result: FitResult, scene: Scene) -> Model:
    """What a phase leaves behind."""
    origin = Origin.of_scene(scene, background_of(result.config))
    if result.textures is None:
        return Model(result.gaussians, origin=origin)
    appearance = Textured(options=texture_options(result.config))
    return Model(result.gaussians, result.textures, result.layout, appearance=appearance, origin=origin)


def _train_phase(run: RunFolder, phase: Phase, scene: Scene, config: TrainConfig, progress: bool) -> FitResult:
    """One phase from its newest checkpoint, or from its beginning."""
    newest = run.checkpoints(phase)[-1:]
    num_iterations = config.stage1_iterations if phase == "stage1" else config.stage2_iterations

    def keep(checkpoint: Checkpoint) -> None:
        save_checkpoint(run.own(run.checkpoint(phase, checkpoint.iteration)), checkpoint)
        run.drop_old_checkpoints(phase)

    if phase == "stage1":
        fit_phase = functools.partial(fit_stage1, scene, config)
    else:
        fit_phase = functools.partial(fit_stage2, scene, load_model(run.model("stage1")).gaussians, config)
    return fit_phase(
        resume=load_checkpoint(newest[0]) if newest else None,
        on_checkpoint=keep,
        checkpoint_every=max(1, min(LONGEST_WITHOUT_CHECKPOINT, num_iterations // 10)),
        progress=progress,
    )
