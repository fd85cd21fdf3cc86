"""Training from photographs: the stages of a system, each from the result of the one before."""

import dataclasses
import functools
import os
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from a2tg_jax.base.checks import check_int, check_kind, check_untraced, kind_of
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.text import counted, in_bytes, shortened
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.budget import LARGEST_SHORTFALL
from a2tg_jax.core.gaussians import Gaussians
from a2tg_jax.model import Model
from a2tg_jax.scene import Scene, check_scene
from a2tg_jax.training.checkpoint import Checkpoint, check_resume
from a2tg_jax.training.corrections import corrected_origin
from a2tg_jax.training.cost import check_rows_fit
from a2tg_jax.training.history import History
from a2tg_jax.training.loop import IsStopped, OnCheckpoint, OnLog, Session, StageRun, never
from a2tg_jax.training.options import System
from a2tg_jax.training.reports import Display, Progress, RestOfRun
from a2tg_jax.training.stage import Stage
from a2tg_jax.training.start import check_points, given_model, initial_model


@dataclasses.dataclass(frozen=True, eq=False)
class StageResult(NamedFields):
    """Result of one stage."""

    name: str
    """Name of the stage."""
    model: Model
    """The Gaussians that exist, in the normalised world of the scene, with its cameras."""
    history: History
    """Loss, PSNR and sizes that the stage logged."""
    seconds: float
    """Training time, compilation included."""
    num_regrown: int
    """Number of times the tile lists needed more room; each cost a compilation."""

    def __repr__(self) -> str:
        return f"StageResult({self.name!r}, {_in_words(self.model, self.seconds)})"


@dataclasses.dataclass(frozen=True, eq=False)
class FitResult(NamedFields):
    """Result of training."""

    system: System
    """The system that was trained."""
    stages: tuple[StageResult, ...]
    """Stages that were trained; if training was resumed in a later stage, the earlier ones are missing."""
    checkpoint: Checkpoint | None = None
    """State at the end, for `more`, in the memory of the host: three times as large as the model."""

    def more(self, scene: Scene, iterations: int, **options: Any) -> "FitResult":
        """Continue the last stage for further iterations.

        It begins with the state at its end, Adam's moments and corrections included. Learning rates and all other
        schedules stay as they were at the end. Of the stage's events, only the ones of every iteration happen, such as
        noise: no Gaussians or texels are added. You can call it again on its result.

        Args:
          scene: the scene of the training.
          iterations: number of further iterations.
          **options: other arguments of `fit`, such as `progress` or `session`.

        Returns:
          The result, with the further stage after the others.

        Raises:
          ValueError: if the result has no `checkpoint`, and otherwise as `fit`.

        Examples:
          >>> system = a2tg.Gaussians2dMcmc.preset("smoke", stage1_iterations=20)
          >>> result = a2tg.fit(scene, system).more(scene, 10)
          >>> [stage.name for stage in result.stages]
          ['gaussians', 'more']
        """
        if self.checkpoint is None:
            raise ValueError("the result has no checkpoint to continue from: take what fit returns")
        system = dataclasses.replace(self.system, more=(*self.system.more, iterations))
        further = fit(scene, system, resume=self.checkpoint, **options)
        return dataclasses.replace(further, stages=(*self.stages, *further.stages))

    @property
    def model(self) -> Model:
        """The last stage's model."""
        return self.stages[-1].model

    @property
    def history(self) -> History:
        """History of all stages."""
        return functools.reduce(History.followed_by, (stage.history for stage in self.stages))

    @property
    def seconds(self) -> float:
        """Training time in all, compilation included."""
        return sum(stage.seconds for stage in self.stages)

    @property
    def num_regrown(self) -> int:
        """Number of times the tile lists needed more room."""
        return sum(stage.num_regrown for stage in self.stages)

    def __repr__(self) -> str:
        stages = counted(len(self.stages), "stage")
        return f"FitResult({type(self.system).__name__}, {stages}, {_in_words(self.model, self.seconds)})"


def _in_words(model: Model, seconds: float) -> str:
    return f"{counted(model.num, 'Gaussian')}, {in_bytes(model.num_bytes)}, {seconds:.0f} s"


def fit(
    scene: Scene,
    system: System,
    *,
    start: Model | None = None,
    resume: Checkpoint | None = None,
    on_checkpoint: OnCheckpoint | None = None,
    checkpoint_every: int | None = None,
    on_log: OnLog | None = None,
    progress: type[Display] | None = None,
    is_stopped: IsStopped = never,
    session: Session | None = None,
    max_memory: int | None = None,
) -> FitResult:
    """Train all stages of a system on a scene, each from the result of the one before.

    Args:
      scene: from `load_scene` or `synthetic_scene`.
      system: stages and options, such as `A2tg.preset("quick")`.
      start: the model that the first stage starts from, in the world of the scene; None: Gaussians at the scene's
        points. Its spherical harmonics are cut off or padded with zeros to the degree at which the system begins.
        `initial_gaussians` and `initial_opacity` do not apply. To train a result on at the rates where it ended, call
        `FitResult.more`.
      resume: a checkpoint of the same system, which may now have further stages (`more`).
      on_checkpoint: called with the state every `checkpoint_every` iterations and at the end of each stage. The next
        iteration reuses the state's buffers, so save or copy it in the call.
      checkpoint_every: None: at the end of each stage only.
      on_log: called with each new row of the history, every 10 iterations: a dictionary of numbers, with the names of
        the columns of `History.to_dict`.
      progress: class that shows the progress, such as `ProgressBar`; None: it is not shown.
      is_stopped: called between steps and after the last. If it returns True, `on_checkpoint` is called once more and
        `Interrupted` is raised. `stop_on_signals` gives one for Ctrl-C.
      session: what trainings of this process share, compiled shapes and devices; None: a new one.
      max_memory: bytes of memory that may be in use, of the process or of the GPU; None: what the machine or the GPU
        has available. Training is refused before it begins if parameters, gradients and moments alone take more, and
        before its first step if XLA reports more for that, or a later stage would take more.

    Returns:
      The trained model, `result.model`, and what its stages logged.

    Raises:
      Interrupted: if training is stopped; a KeyboardInterrupt with the `checkpoint` to resume from.
      DivergedError: if the loss or a gradient is not finite, or the loss explodes; the error holds the state before.
      ValueError: if options contradict each other, the scene or the checkpoint, or allow more Gaussians than
        `max_memory` can hold.

    Examples:
      >>> system = a2tg.Gaussians2dMcmc.preset("smoke", stage1_iterations=20)
      >>> result = a2tg.fit(scene, system)
      >>> result.model.render(camera).color.shape
      (36, 48, 3)
      >>> result.history.iteration
      array([10, 20])
    """
    _check_arguments(scene, system, start, resume, checkpoint_every, progress)
    session = session or Session()
    first = 0
    model_bytes: list[float] = []
    begin: Model | Checkpoint
    if resume is None:
        begin, model_bytes = _checked_start(scene, system, 0, start, session, max_memory)
    elif start is not None:
        raise ValueError("start and resume are both given, but a checkpoint has its own model: leave out start")
    else:
        check_resume(resume, system)
        begin = resume
        first = resume.stage
    stages = system.all_stages()
    # A finished stage is not resumed if the next one continues it.
    if resume is not None and resume.is_at_end and first + 1 < len(stages) and stages[first + 1].continues:
        first += 1
    for stage in stages[first:]:
        stage.check_views(scene.train)
    results: list[StageResult] = []
    is_shortened = resume is not None and resume.shortened_at is not None
    for index in range(first, len(stages)):
        after = RestOfRun(model_bytes=max(model_bytes[index + 1 :], default=0))
        run = StageRun(
            scene, system, index, begin, None, session, max_memory, Progress(progress, after=after),
            # The stages after a shortened one are shortened as well.
            shortened_at=0 if is_shortened and index > first else None,
        )  # fmt: skip
        run.train(on_checkpoint, checkpoint_every, on_log, is_stopped)
        is_last = index == len(stages) - 1
        results.append(_result_of(run, scene, is_last=is_last))
        begin = run.checkpoint if is_last or stages[index + 1].continues else results[-1].model
    assert isinstance(begin, Checkpoint)
    # In the memory of the host, so that further trainings have the memory of the GPU.
    return FitResult(system, tuple(results), dataclasses.replace(begin, state=jax.tree.map(np.asarray, begin.state)))


def _checked_start(
    scene: Scene, system: System, index: int, start: Model | None, session: Session, max_memory: int | None
) -> tuple[Model, list[float]]:
    """Return the model from which training begins with a stage, and the largest bytes of the model of this stage and
    those after it, after all checks before rows are allocated."""
    num = None
    if start is None:
        check_points(scene, system)
    else:
        start = given_model(start, scene, system, index)
        num = start.num
    model_bytes = check_rows_fit(scene, system, index, num, session.devices, max_memory)
    return initial_model(scene, system) if start is None else start, model_bytes


def _check_arguments(
    scene: Scene, system: System, start: Model | None, resume: Checkpoint | None, checkpoint_every: int | None,
    progress: object,
) -> None:  # fmt: skip
    """Raise ValueError unless the arguments are of their classes, and the training views and the options are valid."""
    check_untraced("fit")
    paths = (str, os.PathLike)
    check_kind("scene", scene, Scene, f"use load_scene({os.fspath(scene)!r})" if isinstance(scene, paths) else "")
    if not isinstance(system, System):
        kind = kind_of(system)
        example = ""
        if isinstance(system, str):
            kind = "a name"
            example = f": use find_system({shortened(system)!r}).preset('quick')"
        elif isinstance(system, type) and issubclass(system, System):
            example = f": use {system.__name__}() or {system.__name__}.preset('quick')"
        raise ValueError(f"system must be a System; got {kind}{example}")
    if resume is not None:
        check_kind("resume", resume, Checkpoint, "use load_checkpoint(path)" if isinstance(resume, paths) else "")
    if start is not None:
        hints: dict[Any, str] = {
            paths: "use load_model(path)",
            Gaussians: "use Model(gaussians), in the world of the scene",
            FitResult: "use result.model, or call result.more(scene, iterations) to train on",
            StageResult: "use result.model",
            Checkpoint: "give it as resume",
        }
        hint = next((text for cls, text in hints.items() if isinstance(start, cls)), "")
        check_kind("start", start, Model, hint)
    if checkpoint_every is not None:
        check_int("checkpoint_every", checkpoint_every, 1)
    if progress is True:
        raise ValueError("progress must be None, or a class such as a2tg_jax.ProgressBar; got True")
    system.check()
    check_scene(scene)


def fit_stage(
    scene: Scene,
    system: System,
    index: int,
    start: Model | None = None,
    *,
    resume: Checkpoint | None = None,
    num_restored: int | None = None,
    on_checkpoint: OnCheckpoint | None = None,
    checkpoint_every: int | None = None,
    on_log: OnLog | None = None,
    progress: type[Display] | Progress | None = None,
    is_stopped: IsStopped = never,
    session: Session | None = None,
    max_memory: int | None = None,
    shortened_at: int | None = None,
) -> StageResult:
    """Train one stage of a system.

    Args:
      scene: as in `fit`.
      system: as in `fit`.
      index: stage, from 0.
      start: the model to start from, as in `fit`; not used with `resume`.
      resume: a checkpoint of this stage, or of the end of the stage that it continues; None: begin it.
      num_restored: number of times the stage went back because it diverged; each number gives another order of the
        views. None: the checkpoint's number, or 0.
      on_checkpoint: as in `fit`.
      checkpoint_every: as in `fit`.
      on_log: as in `fit`.
      progress: as in `fit`; or with a title, and what follows the stage.
      is_stopped: as in `fit`.
      session: as in `fit`.
      max_memory: as in `fit`.
      shortened_at: iteration from which what is left of the stage is done in a tenth of the steps, at least 100, as
        `Session.is_shortened` does; None: the checkpoint's, or none.

    Returns:
      The model after the stage, and its history.

    Raises:
      ValueError: if there is no such stage, and otherwise as `fit` raises, the other errors of `fit` included.

    Examples:
      >>> system = a2tg.Gaussians2dMcmc.preset("smoke", stage1_iterations=20)
      >>> result = a2tg.fit_stage(scene, system, 0)
      >>> len(result.history.psnr)
      2
    """
    _check_arguments(scene, system, start, resume, checkpoint_every, progress)
    stages = system.all_stages()
    if not 0 <= index < len(stages):
        raise ValueError(f"index must be in 0..{len(stages) - 1}, one of the stages; got {index}")
    stages[index].check_views(scene.train)
    session = session or Session()
    begin: Model | Checkpoint
    if resume is None:
        begin, _ = _checked_start(scene, system, index, start, session, max_memory)
    else:
        _check_stage(resume, stages, index)
        check_resume(resume, system)
        begin = resume
    if not isinstance(progress, Progress):
        progress = Progress(progress)
    run = StageRun(scene, system, index, begin, num_restored, session, max_memory, progress, shortened_at)
    run.train(on_checkpoint, checkpoint_every, on_log, is_stopped)
    return _result_of(run, scene, is_last=index == len(stages) - 1)


def _check_stage(resume: Checkpoint, stages: Sequence[Stage], index: int) -> None:
    """Raise ValueError unless the checkpoint is of that stage, or of the end of the stage that it continues."""
    if resume.stage == index:
        return
    if resume.stage != index - 1 or not stages[index].continues:
        raise ValueError(f"the checkpoint is of stage {resume.stage + 1}, but stage {index + 1} was to be resumed")
    if not resume.is_at_end:
        raise ValueError(
            f"the checkpoint is of iteration {resume.iteration:,} of {stages[resume.stage].iterations:,} of stage "
            f"{resume.stage + 1}, which stage {index + 1} continues: resume that one first"
        )


def _result_of(run: StageRun, scene: Scene, *, is_last: bool) -> StageResult:
    """Return the result of a trained stage."""
    origin = corrected_origin(scene.origin, run.stage.corrections, run.whole_state.corrections)
    model = dataclasses.replace(run.model, background=run.system.background_color, origin=origin)
    if is_last:
        warn_of_budget(run.system, model)
    return StageResult(run.stage.name, model, run.history, run.seconds, run.num_regrown)


def warn_of_budget(system: System, model: Model) -> None:
    """Warn if a finished model does not fill its memory budget or exceeds it."""
    budget = system.budget_bytes
    used = model.num_bytes
    bytes_each = (used - model.bytes_of(0)) / model.num
    if budget is None or budget * (1 - LARGEST_SHORTFALL) <= used <= budget:
        return
    if used > budget:
        advice = f"compose the stages of {type(system).__name__} with System.budget_cap"
    elif used + bytes_each > budget:
        advice = f"there is no room for another Gaussian of {bytes_each:,.0f} bytes: raise memory_budget"
    else:
        advice = f"raise {system.more_growth()}"
    share = f"{used / budget:.1%} of the memory_budget of {budget:,}"
    warn(f"the model takes {used:,} bytes, {share}: {advice}")
