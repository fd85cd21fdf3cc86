"""Training in a run folder, stage after stage, with checkpoints to resume from."""

import dataclasses
import warnings
from pathlib import Path

from a2tg_jax.data import Scene
from a2tg_jax.host.machine import this_machine
from a2tg_jax.io.archive import read_archive_header
from a2tg_jax.io.config_json import flatten_config
from a2tg_jax.io.model_file import FORMAT, load_model, save_model
from a2tg_jax.model import Model
from a2tg_jax.results.first_stage import GivenSplats, given_splats, write_first_stage
from a2tg_jax.results.folder import RunFolder, iteration_of
from a2tg_jax.results.history import write_history
from a2tg_jax.results.plan import PlannedStage, is_same_so_far
from a2tg_jax.results.preflight import check_held_out
from a2tg_jax.results.record import OnNan, RunRecord, read_record, write_record
from a2tg_jax.results.run_replacement import set_aside
from a2tg_jax.results.several_processes import tell_end, tell_stage
from a2tg_jax.results.tensorboard import EventWriter
from a2tg_jax.training import (
    Checkpoint,
    DivergedError,
    Session,
    StageResult,
    System,
    fit_stage,
    load_checkpoint,
    save_checkpoint,
)
from a2tg_jax.training.loop import IsStopped, Watch, never, unwatched
from a2tg_jax.training.registry import system_from_dict, system_to_dict

MOST_RESTORED = 5
"""Largest number of times a diverged stage is restored, each time with another order of the views."""


def train_run(
    run: RunFolder,
    scene: Scene,
    *,
    replaced_by: RunRecord | None = None,
    progress: bool = True,
    is_stopped: IsStopped = never,
    watch: Watch = unwatched,
    session: Session | None = None,
    tensorboard: bool = False,
    given: GivenSplats | None = None,
) -> None:
    """Train every stage of the run's record that is not finished yet.

    A stage goes on from its newest checkpoint. When it ends, its history and its model are written, and its checkpoints
    deleted.

    Args:
      run: a run folder with its record.
      scene: the scene of the record.
      replaced_by: what takes the place of the run that is in the folder, which is set aside at the first checkpoint.
      progress: show a progress bar.
      is_stopped: asked between steps. Once it says True, there is a checkpoint and a KeyboardInterrupt.
      watch: called between steps with the stage under way (`training.loop.Watch`).
      session: what trainings of this process share, compiled shapes and devices; None: a new one.
      tensorboard: write the histories as files of TensorBoard too, at each checkpoint.
      given: splats in place of the first stage, if their file was read already.

    Raises:
      ValueError: as `fit` does, or if a checkpoint or model is damaged, of another version, or made with other numbers
        than the record's.
    """
    record = replaced_by or read_record(run)
    session = Session() if session is None else session
    given = given or given_splats(record)
    for planned in record.plan.stages:
        if given is not None and planned.name == record.plan.main[0] and not run.model(planned.name).is_file():
            write_first_stage(run, planned, given, scene)
        events = EventWriter(run, planned.name) if tensorboard else None
        training = _Training(run, planned, scene, record.on_nan, progress, is_stopped, watch, session, events)
        if replaced_by is not None:
            result = training.train(replaced_by)
        elif run.model(planned.name).is_file():
            _check_model(run.model(planned.name), planned)
            run.drop_old_checkpoints(planned.name, keep=0)
            continue
        else:
            result = training.train()
        replaced_by = None
        if events is not None:
            events.add(result.history)
            events.close()
        write_history(run.own(run.history(planned.name)), result.history)
        save_model(run.own(run.model(planned.name)), result.model, {"system": system_to_dict(planned.system)})
        run.drop_old_checkpoints(planned.name, keep=0)
    tell_end()


@dataclasses.dataclass(frozen=True)
class _Training:
    """One stage in a run folder."""

    run: RunFolder
    planned: PlannedStage
    scene: Scene
    on_nan: OnNan
    progress: bool
    is_stopped: IsStopped
    watch: Watch
    session: Session
    events: EventWriter | None

    def train(self, replaced_by: RunRecord | None = None) -> StageResult:
        """Train the stage from its newest checkpoint or from its beginning; after a divergence, restore if that is
        allowed."""
        keep = _Keeper(self.run, self.planned.name, replaced_by, self.events)
        num_restored = None
        while True:
            resume = None if keep.replaced_by is not None else _newest_checkpoint(self.run, self.planned)
            try:
                return self._train(resume, keep, num_restored)
            except DivergedError as error:
                is_own = keep.replaced_by is None
                num_restored = self._restored(error, self.run.checkpoints(self.planned.name) if is_own else [])

    def _train(self, resume: Checkpoint | None, keep: "_Keeper", num_restored: int | None) -> StageResult:
        planned = self.planned
        if self.events is not None and resume is not None:
            self.events.skip(resume.history)
        resumed = None if resume is None else self.run.checkpoint(planned.name, resume.iteration)
        start = None if planned.start is None else self.run.model(planned.start)
        model = None if start is None else self._checked_model(start)
        tell_stage(planned.name, resumed, start, num_restored)
        return fit_stage(
            self.scene,
            planned.system,
            planned.index,
            model,
            resume=resume,
            on_checkpoint=keep,
            checkpoint_every=planned.checkpoint_every,
            progress=self.progress,
            title=planned.name,
            is_stopped=self.is_stopped,
            num_restored=num_restored,
            watch=self.watch,
            session=self.session,
        )

    def _checked_model(self, path: Path) -> Model:
        """Return the model that the stage starts from, unless it was trained on views that are held out now."""
        model = load_model(path)
        check_held_out(model, self.scene, path)
        return model

    def _restored(self, error: DivergedError, checkpoints: list[Path]) -> int:
        """Save the state before the diverged step, and return the number of the next order of views.

        Raises:
          ValueError: if the run is to stop then, or has gone back often enough.
        """
        before, run = error.checkpoint, self.run
        path = run.own(run.diverged(self.planned.name, before.iteration))
        save_checkpoint(path, before)
        told, count = f"{error}, in {path}", before.num_restored + 1
        if self.on_nan == "stop":
            raise ValueError(f"{told}; --on-nan restore continues with the views in another order") from error
        if count > MOST_RESTORED:
            raise ValueError(f"{told}; the stage was restored {MOST_RESTORED} times already") from error
        back = f"iteration {iteration_of(checkpoints[-1])}" if checkpoints else "its beginning"
        warnings.warn(
            f"{told}; the stage restarts from {back} with the views in another order ({count} of {MOST_RESTORED} "
            "times)",
            stacklevel=4,
        )
        return count


class _Keeper:
    """Writer of checkpoints. The first checkpoint of a replacing run sets the old run aside."""

    def __init__(self, run: RunFolder, name: str, replaced_by: RunRecord | None, events: EventWriter | None):
        self.run, self.name, self.replaced_by, self.events = run, name, replaced_by, events

    def __call__(self, checkpoint: Checkpoint) -> None:
        if checkpoint.iteration == 0:
            return  # The stage would begin with the same state again.
        if self.replaced_by is not None:
            set_aside(self.run)
        if self.events is not None:
            self.events.add(checkpoint.history)
        save_checkpoint(self.run.own(self.run.checkpoint(self.name, checkpoint.iteration)), checkpoint)
        if self.replaced_by is not None:
            # Last: a folder without a record is one in which the old run is put back.
            write_record(self.run, self.replaced_by)
            self.replaced_by = None
        self.run.drop_old_checkpoints(self.name)


def _newest_checkpoint(run: RunFolder, planned: PlannedStage) -> Checkpoint | None:
    """Return the newest readable checkpoint of a stage, made with the same options so far; None without one.

    Raises:
      ValueError: if there are some, and none can be read.
    """
    paths = run.checkpoints(planned.name)[::-1]
    damages: list[ValueError] = []
    for path in paths:
        try:
            checkpoint = load_checkpoint(path, system=type(planned.system))
        except ValueError as error:
            damages.append(error)
            continue
        _check_unchanged(path, checkpoint.system, planned)
        for damaged, damage in zip(paths, damages, strict=False):
            aside = run.set_damaged_aside(damaged)
            warnings.warn(
                f"{damage}; it was renamed to {aside.name}, and training continues from {path.name}", stacklevel=2
            )
        _warn_of_machine(path, checkpoint)
        return dataclasses.replace(checkpoint, system=planned.system)
    if damages:
        raise ValueError(
            f"{damages[0]}; there is no other checkpoint: delete it to train {planned.name} from its beginning"
        )
    return None


def _warn_of_machine(path: Path, checkpoint: Checkpoint) -> None:
    """Warn if a resumed run will differ in its last bits, because another machine wrote the checkpoint."""
    told = [] if checkpoint.machine is None else checkpoint.machine.differences(this_machine())
    if told:
        warnings.warn(
            f"{path.name} was made on another machine, so last bits will differ: {'; '.join(told)}", stacklevel=3
        )


def _check_model(path: Path, planned: PlannedStage) -> None:
    """Raise if a finished model was made with other options than those of the record."""
    try:
        made = read_archive_header(path, format=FORMAT).get("system")
    except ValueError as error:
        raise ValueError(f"{error}; delete it to train {planned.name} again") from error
    if made is not None:
        _check_unchanged(path, system_from_dict(made, str(path), type(planned.system)), planned)


def _check_unchanged(path: Path, made: System, planned: PlannedStage) -> None:
    if is_same_so_far(made, planned.system, planned.index):
        return
    before, now = flatten_config(made), flatten_config(planned.system)
    names = ", ".join(name for name in now if before[name] != now[name])
    advice = "restore that, or train in a new folder"
    raise ValueError(f"{path} was made with another {names} than in run.toml: {advice}")
