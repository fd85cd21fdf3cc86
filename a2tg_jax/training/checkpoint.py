"""Checkpoints: the whole state of a training run, on disk and back, bit for bit."""

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from a2tg_jax.appearance.base import check_appearance
from a2tg_jax.appearance.files import arrays_of, with_arrays
from a2tg_jax.base.archive import arrays_below, read_archive, write_archive
from a2tg_jax.base.checks import check_count, check_finite, check_like
from a2tg_jax.base.config_json import config_from_dict, config_to_dict, flatten_config
from a2tg_jax.base.machine import ALONE, Devices, Machine, this_machine
from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.regular_files import expanded, reading
from a2tg_jax.base.text import counted, shortened
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.gaussians import Gaussians, check_gaussians
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import combine, partition
from a2tg_jax.core.table import map_rows
from a2tg_jax.model import Model, check_model
from a2tg_jax.scene import Scene, View
from a2tg_jax.training.corrections import check_corrections, corrected_origin
from a2tg_jax.training.history import COLUMNS, History, check_history
from a2tg_jax.training.options import System
from a2tg_jax.training.recorded_views import RecordedViews
from a2tg_jax.training.registry import system_from_dict, system_to_dict
from a2tg_jax.training.stage import Stage
from a2tg_jax.training.start import continued_state, copied, initial_state, with_room
from a2tg_jax.training.step import EXPLODED, TrainState


@dataclasses.dataclass(frozen=True, eq=False)
class Checkpoint(NamedFields):
    """A training run stopped between two iterations."""

    system: System
    """System that is trained."""
    stage: int
    """Index of the stage in its system, from 0."""
    state: TrainState
    """State of the stage: `state.model`, with spare rows, Adam's moments, and what events and corrections keep."""
    history: History
    """History of this stage."""
    num_restored: int = 0
    """Number of times the stage went back because it diverged; the order of the views depends on it."""
    machine: Machine | None = None
    """Machine on which it was saved; None if unknown or not saved yet."""
    devices: Devices = ALONE
    """Devices that trained it; other devices can resume it."""
    num_refused: int = 0
    """Number of Gaussians so far that were not added for lack of room."""
    views: RecordedViews | None = None
    """The training views, with checksums of their photographs; None if they are unknown."""
    shortened_at: int | None = None
    """Iteration from which the stage is shortened (`Session.is_shortened`); None: it is not."""

    @property
    def iteration(self) -> int:
        """Iterations of the stage done so far."""
        return int(self.state.iteration)

    @property
    def is_at_end(self) -> bool:
        """Whether its stage is finished."""
        return self.iteration == self.system.all_stages()[self.stage].iterations

    @property
    def model(self) -> Model:
        """The Gaussians that exist, and what they show."""
        return self.state.model.live

    def model_in(self, scene: Scene) -> Model:
        """Return the model as of a finished stage: with the scene's cameras, as corrected so far, and a background."""
        corrections = self.system.all_stages()[self.stage].corrections
        origin = corrected_origin(scene.origin, corrections, self.state.corrections)
        return dataclasses.replace(self.model, background=self.system.background_color, origin=origin)

    def __repr__(self) -> str:
        at = f"stage {self.stage + 1}"
        if isinstance(self.state.iteration, jax.Array) and self.state.iteration.is_deleted():
            return f"Checkpoint({type(self.system).__name__}, {at}, its arrays reused by the next iteration)"
        at = f"{at}, iteration {self.iteration:,}"
        return f"Checkpoint({type(self.system).__name__}, {at}, {counted(self.state.model.num, 'Gaussian')})"


class Interrupted(KeyboardInterrupt):
    """Training was stopped between two iterations. The checkpoint resumes it."""

    def __init__(self, checkpoint: Checkpoint):
        """Args:
        checkpoint: the state after the last iteration; `checkpoint.model` is its model.
        """
        super().__init__(
            f"training stopped after iteration {checkpoint.iteration:,} of stage {checkpoint.stage + 1}; the model is "
            "error.checkpoint.model, and fit(scene, system, resume=error.checkpoint) continues"
        )
        self.checkpoint = checkpoint

    def __reduce__(self) -> tuple[type["Interrupted"], tuple[Checkpoint]]:
        return type(self), (self.checkpoint,)  # by default, pickle calls __init__ with the message


def save_checkpoint(path: str | os.PathLike[str], checkpoint: Checkpoint) -> None:
    """Write a checkpoint.

    Args:
      path: the file; an older one is replaced once the new one is complete.
      checkpoint: from `fit`, by `on_checkpoint`.
    """
    state = checkpoint.state
    model = checkpoint.state.model
    header = {
        "system": system_to_dict(checkpoint.system),
        "stage": checkpoint.stage,
        "is_ahead": [event is not None for event in state.events],
        "num_restored": checkpoint.num_restored,
        "shortened_at": checkpoint.shortened_at,
        "machine": config_to_dict(this_machine()),
        "devices": config_to_dict(checkpoint.devices),
        "num_refused": checkpoint.num_refused,
        "terms": [*checkpoint.history.terms],
        "views": None if checkpoint.views is None else checkpoint.views.names,
    }
    of_appearance = arrays_of(model.appearance, model.gaussians.sh_degree)
    arrays = {f"{SHOWN}{name}": array for name, array in of_appearance.items()}
    if checkpoint.views is not None:
        arrays |= {f"{VIEWS}{name}": array for name, array in checkpoint.views.arrays.items()}
    state = dataclasses.replace(state, moments=_packed(model, state.moments))
    rest = _rest(state), dataclasses.asdict(checkpoint.history)
    for place, leaf in jax.tree_util.tree_leaves_with_path((model.gaussians, rest)):
        arrays[jax.tree_util.keystr(place)] = np.asarray(leaf)
    write_archive(expanded(path), header, arrays)


def load_checkpoint(path: str | os.PathLike[str], system: type[System] | None = None) -> Checkpoint:
    """Read what `save_checkpoint` wrote.

    Args:
      path: the file.
      system: class of its system. Only needed for a custom system whose module is not imported.

    Returns:
      The checkpoint, for `resume` of `fit`.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is no checkpoint, is damaged, is of another version, or its system is unknown.
    """
    path = expanded(path)
    header, arrays = read_archive(path)
    with reading(path):
        return _checkpoint_of(header, arrays, system_from_dict(header["system"], str(path), system))


def _checkpoint_of(header: dict[str, Any], arrays: dict[str, np.ndarray], system: System) -> Checkpoint:
    system.check()
    stages = system.all_stages()
    index = header["stage"]
    is_ahead = header["is_ahead"]
    if type(index) is not int or not 0 <= index < len(stages):  # bool is an int
        raise ValueError(f"stage must be a number in 0..{len(stages) - 1}; got {shortened(repr(index))}")
    stage = stages[index]
    if not isinstance(is_ahead, list) or len(is_ahead) != len(stage.events) or {type(x) for x in is_ahead} - {bool}:
        raise ValueError(f"is_ahead must hold true or false for {len(stage.events)} events; got {shortened(is_ahead)}")
    fields: dict[str, Any] = arrays_below(f"{GAUSSIANS}.", arrays)
    gaussians = Gaussians(**fields)
    check_gaussians(gaussians)
    appearance = with_arrays(stage.appearance, arrays_below(SHOWN, arrays), gaussians.sh_degree)
    gaussians = jax.tree.map(jnp.asarray, gaussians)
    check_appearance(appearance, gaussians)
    model = Model(gaussians, appearance, jnp.zeros((), jnp.int32))
    # Only the number of names matters for shapes.
    names = [""] * len(arrays[f"{STATE}[5][0].rows"]) if stage.corrections else []
    # Shapes only; nothing is allocated.
    expected: TrainState = jax.eval_shape(lambda: initial_state(stage, model, names))
    events = (event if ahead else None for event, ahead in zip(expected.events, is_ahead, strict=True))
    expected = dataclasses.replace(expected, events=tuple(events))
    rest: Any = jax.tree_util.tree_map_with_path(
        lambda path, _: jnp.asarray(arrays[f"{STATE}{jax.tree_util.keystr(path)}"]), _rest(expected)
    )
    moments, num_live, *others = rest
    state = TrainState(Model(gaussians, appearance, num_live), moments, *others)
    check_state(state, expected, stage)
    terms = header["terms"]
    if not isinstance(terms, list) or not all(isinstance(name, str) for name in terms):
        raise ValueError(f"terms must be a list of names; got {shortened(terms)}")
    columns: dict[str, Any] = {name: arrays[f"{HISTORY}[{name!r}]"] for name in COLUMNS}
    history = History(**columns, terms={name: arrays[f"{HISTORY}['terms'][{name!r}]"] for name in terms})
    check_history(history)
    counts = {name: header[name] for name in ("num_restored", "num_refused")}
    for name, count in counts.items():
        check_count(name, count, np.iinfo(np.int32).max)
    machine = config_from_dict(Machine, header["machine"], "machine")
    devices = config_from_dict(Devices, header["devices"], "devices")
    views = None
    if header.get("views") is not None:  # Checkpoints of earlier versions do not record them.
        views = RecordedViews.of_arrays(header["views"], arrays_below(VIEWS, arrays))
    shortened_at = header.get("shortened_at")  # Checkpoints of earlier versions do not record it.
    if shortened_at is not None:
        check_count("shortened_at", shortened_at, stage.iterations)
    return Checkpoint(
        system, index, state, history, machine=machine, devices=devices, views=views, shortened_at=shortened_at,
        **counts,
    )  # fmt: skip


LONGEST_DIFFERENCE = 300
"""Largest number of characters of the options that differ from a checkpoint's."""
GAUSSIANS = "[0]"
STATE = "[1][0]"
HISTORY = "[1][1]"
SHOWN = "shown/"
VIEWS = "views/"
"""Prefixes of the names of arrays. The first three are paths in (Gaussians, (rest of the state, history)); the others
are of the appearance, and of records of the training views."""


def _rest(state: TrainState) -> tuple[object, ...]:
    """Return the rest of a checkpoint, after Gaussians and appearance."""
    return state.moments, state.model.num_live, state.events, state.iteration, state.status, state.corrections


def _packed(model: Model, moments: AdamState) -> AdamState:
    """Return moments at the capacity that tables get when they are loaded, which may be less than in training."""
    _, rest = partition(model.appearance)
    rows = np.arange(model.num_rows)

    def packed(moment: Model) -> Model:
        whole = map_rows(
            lambda array: array,
            lambda table: table.take(rows, padding=(0.0,) * len(table.padding)),
            combine(moment.appearance, rest),
        )
        return dataclasses.replace(moment, appearance=partition(whole)[0])

    return dataclasses.replace(moments, mu=packed(moments.mu), nu=packed(moments.nu))


def check_state(state: TrainState, expected: TrainState, stage: Stage) -> None:
    """Raise ValueError, naming the leaf, unless the state of a file, whose model is valid, has the shapes and dtypes of
    the expected one."""
    check_like("state.model.num_live", state.model.num_live, expected.model.num_live)
    for name in ("moments", "events", "iteration", "status", "corrections"):
        check_like(f"state.{name}", getattr(state, name), getattr(expected, name))
    check_model(state.model)
    check_count("state.iteration", state.iteration, stage.iterations)
    check_count("state.status", state.status, EXPLODED)
    for name, moments in (("", state.moments), *((".corrections", each.moments) for each in state.corrections)):
        check_finite(f"state{name}.moments.mu", moments.mu)
        check_finite(f"state{name}.moments.nu", moments.nu, is_signed=False)
        if (np.asarray(moments.count) < 0).any():
            raise ValueError(f"state{name}.moments.count must be at least 0; some are below")
    for correction in state.corrections:
        check_finite("state.corrections.rows", correction.rows)
    for path, leaf in jax.tree_util.tree_leaves_with_path(state.events):
        if np.isnan(np.asarray(leaf)).any():
            raise ValueError(f"state.events{jax.tree_util.keystr(path)} must be numbers; some are NaN")


def check_resume(resume: Checkpoint, system: System) -> None:
    """Raise ValueError, naming the options, unless the checkpoint is of that system, which may have further stages."""
    if resume.system == dataclasses.replace(system, more=system.more[: len(resume.system.more)]):
        return
    trained = type(resume.system)
    given = type(system)
    advice = ""
    values = flatten_config(resume.system)
    others = flatten_config(system)
    if trained is given:
        pairs = {name: (values[name], others[name]) for name in values if values[name] != others[name]}
        differing = ", ".join(f"{name} {value!r}, not {other!r}" for name, (value, other) in pairs.items())
        if any(name.endswith("iterations") for name in pairs):
            advice = "; for further iterations after the last call result.more(scene, iterations)"
    elif (trained.__module__, trained.__qualname__) == (given.__module__, given.__qualname__):
        # A cell of a notebook has run twice.
        differing = f"the class {given.__name__} as it was before it was defined again"
        advice = f", or with load_checkpoint(path, {given.__name__}) of what save_checkpoint wrote, for the new class"
    else:
        differing = f"{trained.__name__}, not {given.__name__}"
    raise ValueError(
        f"the checkpoint was made with another configuration ({shortened(differing, LONGEST_DIFFERENCE)}): resume with "
        f"checkpoint.system{advice}"
    )


def state_of_checkpoint(
    resume: Checkpoint, stages: Sequence[Stage], index: int, views: Sequence[View], num_devices: int
) -> TrainState:
    """Return the state of a checkpoint of a stage, or, of the end of the stage before, the state before the first
    iteration. Raises ValueError unless it was trained on these views."""
    check_corrections(resume.state.corrections, len(views))
    if resume.views is not None:
        resume.views.check(views)
    num = resume.state.model.num_rows
    if num % num_devices:
        warn(
            f"the checkpoint has {num:,} rows, which {num_devices} devices cannot share evenly: each holds all of them "
            "until the stage ends"
        )
    state = copied(resume.state)
    if resume.stage != index:
        state = continued_state(stages[index - 1], stages[index], state)
    return with_room(stages[index], state)
