"""What must hold of a checkpoint before a stage goes on from it."""

import warnings

from a2tg_jax.host.text import shortened
from a2tg_jax.io.config_json import flatten_config
from a2tg_jax.training.checkpoint import Checkpoint
from a2tg_jax.training.options import System

MOST_TOLD = 300
"""Largest number of characters of the options that differ from a checkpoint's."""


def check_resume(resume: Checkpoint, system: System, index: int) -> None:
    """Raise ValueError unless the checkpoint is of that stage of that system."""
    if resume.stage != index:
        raise ValueError(f"the checkpoint is of stage {resume.stage + 1}, but stage {index + 1} was to go on")
    if resume.system != system:
        raise ValueError(
            f"the checkpoint was made with another configuration ({_differing(resume.system, system)}): resume with "
            f"checkpoint.system{_or_anew(resume.system, system)}"
        )
    found, wanted = resume.state.model.gaussians.sh_degree, system.initial_sh_degree
    if found != wanted:
        raise ValueError(
            f"the checkpoint's Gaussians are of degree {found}, but the system's of {wanted}: it was made by an older "
            "version, so train anew"
        )


def warn_of_uneven_rows(resume: Checkpoint, num_devices: int) -> None:
    """Warn if the rows of a checkpoint cannot be spread evenly over so many devices, which costs memory."""
    rows = resume.state.model.gaussians.num
    if rows % num_devices:
        fitting = [number for number in range(1, num_devices) if rows % number == 0]
        warnings.warn(
            f"the checkpoint has {rows:,} rows, which {num_devices} devices cannot share evenly: each holds all of "
            f"them until the stage ends; {' or '.join(map(str, fitting))} could share them",
            stacklevel=2,
        )


def _is_defined_anew(before: System, now: System) -> bool:
    """Return whether the classes of two systems are of one name and module, as when a notebook's cell runs twice."""
    kinds = type(before), type(now)
    return kinds[0] is not kinds[1] and len({(kind.__module__, kind.__qualname__) for kind in kinds}) == 1


def _or_anew(before: System, now: System) -> str:
    """Return what leads to the new class, for advice; empty if it is the same one."""
    if not _is_defined_anew(before, now):
        return ""
    return f", or with load_checkpoint(path, {type(now).__name__}) of what save_checkpoint wrote, for the new class"


def _differing(before: System, now: System) -> str:
    """Return the options in which two systems differ, in a few words."""
    if _is_defined_anew(before, now):
        return f"the class {type(now).__name__} as it was before it was defined anew"
    if type(before) is not type(now):
        return f"{type(before).__name__}, not {type(now).__name__}"
    values, others = flatten_config(before), flatten_config(now)
    pairs = ((name, value, others[name]) for name, value in values.items() if value != others[name])
    return shortened(", ".join(f"{name} {value!r}, not {other!r}" for name, value, other in pairs), MOST_TOLD)
