"""Checkpoints and states at the end of stages in a run folder, read with a check of the options that made them."""

import warnings
from pathlib import Path

from a2tg_jax.base.archive import read_archive_header
from a2tg_jax.base.machine import this_machine
from a2tg_jax.core.config_json import flatten_config
from a2tg_jax.model_file import FORMAT
from a2tg_jax.results.folder import DAMAGED, RunFolder
from a2tg_jax.results.plan import PlannedStage
from a2tg_jax.training import Checkpoint, System, load_checkpoint
from a2tg_jax.training.registry import system_from_dict


def newest_checkpoint(run: RunFolder, planned: PlannedStage) -> Checkpoint | None:
    """Return the newest readable checkpoint of a stage, made with the same options; None if there are no checkpoints.
    Damaged ones are renamed, with a warning. Raises ValueError if none of them can be read."""
    damaged: list[tuple[Path, ValueError]] = []
    for path in reversed(run.checkpoints(planned.name)):
        try:
            checkpoint = load_checkpoint(path, system=type(planned.system))
        except ValueError as error:
            damaged.append((path, error))
            continue
        _check_made_alike(path, checkpoint, planned)
        for damaged_path, reason in damaged:
            aside = damaged_path.replace(run.own(damaged_path.with_name(damaged_path.name + DAMAGED)))
            warnings.warn(
                f"{reason}; it was renamed to {aside.name}, and training continues from {path.name}", stacklevel=2
            )
        return checkpoint
    if damaged:
        raise ValueError(
            f"{damaged[0][1]}; there is no other checkpoint: delete it to train {planned.name} from its beginning"
        )
    return None


def last_state(run: RunFolder, before: PlannedStage, name: str) -> Checkpoint | None:
    """Return the state at the end of a stage, which the stage `name` continues; None, with a warning, if it was not
    kept. Raises ValueError if it cannot be read, or was made with other options."""
    path = run.state(before.name)
    if not path.is_file():
        warnings.warn(
            f"{name} continues {before.name} without Adam's moments, so that the first iterations may make pictures "
            f"worse: there is no {path}",
            stacklevel=3,
        )
        return None
    try:
        state = load_checkpoint(path, system=type(before.system))
    except ValueError as error:
        raise ValueError(f"{error}; delete it to train {name} without Adam's moments") from error
    _check_made_alike(path, state, before)
    return state


def check_finished(path: Path, planned: PlannedStage) -> None:
    """Raise ValueError if the file of a finished stage is damaged, or was made with other options than the record's."""
    try:
        system = read_archive_header(path, format=FORMAT).get("system")
    except ValueError as error:
        raise ValueError(f"{error}; delete it to train {planned.name} again") from error
    if system is not None:  # The first stage may be from a file.
        _check_options(path, system_from_dict(system, str(path), type(planned.system)), planned.system)


def _check_made_alike(path: Path, checkpoint: Checkpoint, planned: PlannedStage) -> None:
    """Raise ValueError if a checkpoint was made with other options than the record's; warn if on another machine."""
    _check_options(path, checkpoint.system, planned.system)
    differences = [] if checkpoint.machine is None else checkpoint.machine.differences(this_machine())
    if differences:
        warnings.warn(
            f"{path.name} was made on another machine, so last bits will differ: {'; '.join(differences)}",
            stacklevel=3,
        )


def _check_options(path: Path, made: System, wanted: System) -> None:
    before = flatten_config(made)
    now = flatten_config(wanted)
    names = [name for name in now if before.get(name) != now[name]]
    if names:
        raise ValueError(
            f"{path} was made with another {', '.join(names)} than in run.toml: restore that, or train in a new folder"
        )
