"""Training of one stage in a folder, from its newest checkpoint, with checks of what it resumes and starts from."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from a2tg_jax import Checkpoint, Model, Origin, Scene, StageResult, System, load_checkpoint, load_model, save_checkpoint
from a2tg_jax.base.archive import read_archive_header
from a2tg_jax.base.config_json import flatten_config
from a2tg_jax.base.machine import this_machine
from a2tg_jax.base.text import counted
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.model_file import FORMAT
from a2tg_jax.results.folder import DAMAGED, StageFiles
from a2tg_jax.results.plan import PlannedStage, is_same_so_far
from a2tg_jax.results.run_processes import send_stage
from a2tg_jax.training.recorded_views import check_names
from a2tg_jax.training.registry import system_from_dict

OnCheckpoint = Callable[[Checkpoint], object]


def train_stage(
    files: StageFiles,
    planned: PlannedStage,
    scene: Scene,
    fit: Callable[..., StageResult],
    *,
    num_restored: int | None = None,
    shortened_at: int | None = None,
    on_resume: OnCheckpoint = lambda checkpoint: None,
    on_checkpoint: OnCheckpoint = lambda checkpoint: None,
) -> StageResult:
    """Train a stage from its newest checkpoint, or else from the model of the stage before, and keep its checkpoints.

    Args:
      files: the files of the stage, and of the one that it starts from.
      planned: the stage.
      scene: the scene.
      fit: `fit_stage` with its scene and options, except those that this function decides.
      num_restored: as in `fit_stage`.
      shortened_at: as in `fit_stage`.
      on_resume: called with the newest checkpoint of the stage, if there is one.
      on_checkpoint: called with each checkpoint before it is written; one of iteration 0 is not.

    Raises:
      ValueError: as `fit_stage` does, or if a checkpoint or model is damaged, of another version, or made with other
        options.
      DivergedError, Interrupted: as `fit_stage`.
    """

    def keep(checkpoint: Checkpoint) -> None:
        on_checkpoint(checkpoint)
        if checkpoint.iteration == 0:
            return  # The stage's start gives the same state.
        save_checkpoint(files.own(files.checkpoint(planned.name, checkpoint.iteration)), checkpoint)
        files.drop_old_checkpoints(planned.name)

    before = planned.start
    start = None
    start_file = None
    if before is not None:
        start_file = files.model(before.name)
        start = _model_to_start(start_file, scene)
    resume = newest_checkpoint(files, planned)
    resume_file = None
    if resume is not None:
        resume_file = files.checkpoint(planned.name, resume.iteration)
        on_resume(resume)
    elif before is not None and planned.stage.continues:
        resume = last_state(files, before, planned.name)
        resume_file = None if resume is None else files.state(before.name)
    if resume is not None:
        # Its system may have other options for later stages.
        resume = dataclasses.replace(resume, system=planned.system)
    # Files, not arrays: other processes read them exactly as this one did.
    send_stage(planned.name, [resume_file, start_file], num_restored, shortened_at)
    return fit(
        planned.system,
        planned.index,
        start,
        resume=resume,
        on_checkpoint=keep,
        num_restored=num_restored,
        shortened_at=shortened_at,
    )


def _model_to_start(path: Path, scene: Scene) -> Model:
    """Return the model of the stage before, after a check that the scene still has its training views."""
    model = load_model(path)
    check_held_out(model, scene, path)
    if model.origin is not None:
        advice = "restore the photographs, or train in a new folder"
        check_names(_trained_names(model.origin), [view.name for view in scene.train], str(path), advice)
    return model


def _trained_names(origin: Origin) -> list[str]:
    return [name for name, is_test in zip(origin.names, origin.is_test, strict=True) if not is_test]


def check_held_out(model: Model, scene: Scene, path: Path) -> None:
    """Raise ValueError if a file's model was trained on views that its scene now holds out, which would flatter their
    metrics. A model without an origin, whose views are unknown, passes."""
    if model.origin is None:
        return
    held_out = {view.name for view in scene.test} - {view.name for view in scene.train}
    leaked = sorted(held_out.intersection(_trained_names(model.origin)))
    if leaked:
        raise ValueError(
            f"{path} was trained on {counted(len(leaked), 'view')} that {scene.name} now holds out, such as "
            f"{leaked[0]}: the photographs have changed, or views of panoramas, which are held out together since, are "
            "among them; train in a new folder"
        )


def newest_checkpoint(files: StageFiles, planned: PlannedStage) -> Checkpoint | None:
    """Return the newest readable checkpoint of a stage, of a system that trains it alike; None if there are no
    checkpoints. Damaged ones are renamed, with a warning. Raises ValueError if none of them can be read."""
    damaged: list[tuple[Path, ValueError]] = []
    for path in reversed(files.checkpoints(planned.name)):
        try:
            checkpoint = load_checkpoint(path, system=type(planned.system))
        except ValueError as error:
            damaged.append((path, error))
            continue
        _check_made_alike(path, checkpoint, planned)
        for damaged_path, reason in damaged:
            aside = damaged_path.replace(files.own(damaged_path.with_name(damaged_path.name + DAMAGED)))
            warn(f"{reason}; it was renamed to {aside.name}, and training continues from {path.name}")
        return checkpoint
    if damaged:
        raise ValueError(
            f"{damaged[0][1]}; there is no other checkpoint: delete it to train {planned.name} from its beginning"
        )
    return None


def last_state(files: StageFiles, before: PlannedStage, name: str) -> Checkpoint | None:
    """Return the state at the end of a stage, which the stage `name` continues; None, with a warning, if it was not
    kept. Raises ValueError if it cannot be read, or was made with other options."""
    path = files.state(before.name)
    if not path.is_file():
        warn(
            f"{name} continues {before.name} without Adam's moments, so that the first iterations may make pictures "
            f"worse: there is no {path}"
        )
        return None
    try:
        state = load_checkpoint(path, system=type(before.system))
    except ValueError as error:
        raise ValueError(f"{error}; delete it to train {name} without Adam's moments") from error
    _check_made_alike(path, state, before)
    return state


def check_finished(path: Path, planned: PlannedStage) -> None:
    """Raise ValueError if the file of a finished stage is damaged, or was made with other options than planned."""
    try:
        system = read_archive_header(path, format=FORMAT).get("system")
    except ValueError as error:
        raise ValueError(f"{error}; delete it to train {planned.name} again") from error
    if system is not None:  # The first stage may be from a file.
        _check_options(path, system_from_dict(system, str(path), type(planned.system)), planned)


def _check_made_alike(path: Path, checkpoint: Checkpoint, planned: PlannedStage) -> None:
    """Raise ValueError if a checkpoint was made with other options than planned; warn if on another machine."""
    _check_options(path, checkpoint.system, planned)
    differences = [] if checkpoint.machine is None else checkpoint.machine.differences(this_machine())
    if differences:
        warn(f"{path.name} was made on another machine, so last bits will differ: {'; '.join(differences)}")


def _check_options(path: Path, made: System, planned: PlannedStage) -> None:
    """Raise ValueError unless a system trains the stages up to the planned one alike."""
    before = flatten_config(made)
    now = flatten_config(planned.system)
    names = [name for name in now if before.get(name) != now[name]]
    # Options of later stages may differ.
    if names and not is_same_so_far(made, planned.system, planned.index):
        raise ValueError(
            f"{path} was made with another {', '.join(names)} than the run has now: restore that, or train in a new "
            "folder"
        )
