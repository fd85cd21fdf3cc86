"""Checkpoints: the whole state of a training run, on disk and back, bit for bit."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
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
from a2tg_jax.base.regular_files import reading
from a2tg_jax.base.text import counted, shortened
from a2tg_jax.core.gaussians import Gaussians, check_gaussians
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import combine, partition
from a2tg_jax.core.table import map_rows
from a2tg_jax.model import Model, check_model
from a2tg_jax.training.corrections import initial_corrections
from a2tg_jax.training.options import System
from a2tg_jax.training.recorded_views import RecordedViews
from a2tg_jax.training.registry import system_from_dict, system_to_dict
from a2tg_jax.training.stage import Stage
from a2tg_jax.training.step import EXPLODED, TrainState, initial_state


@dataclasses.dataclass(frozen=True, eq=False)
class History(NamedFields):
    """Log of a training, one entry every 10 iterations; arrays of one length."""

    stage: np.ndarray
    """Stage, from 1."""
    iteration: np.ndarray
    """Iteration within its stage, from 1."""
    loss: np.ndarray
    """Loss of that iteration, the sum of `terms`."""
    psnr: np.ndarray
    """PSNR of the training views of that iteration, in dB."""
    num_gaussians: np.ndarray
    """Live Gaussians."""
    megabytes: np.ndarray
    """Reported memory in 10⁶ bytes."""
    seconds: np.ndarray
    """Training time of the stage so far."""
    terms: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Summands of the loss, weighted, by name: l1, ssim, and other terms of the stage. NaN where there is none."""

    @staticmethod
    def empty() -> "History":
        counts = np.zeros(0, np.int64)
        values = np.zeros(0)
        return History(counts, counts, values, values, counts, values, values)

    def __repr__(self) -> str:
        rows = counted(len(self.iteration), "row")
        if not len(self.iteration):
            return f"History({rows})"
        return f"History({rows} to iteration {self.iteration[-1]:,} of stage {self.stage[-1]}, {self.psnr[-1]:.2f} dB)"

    def to_dict(self) -> dict[str, np.ndarray]:
        """Return the columns by name, as `pandas.DataFrame` takes them; loss terms as loss_l1 and so on."""
        columns = {name: getattr(self, name) for name in COLUMNS}
        return columns | {f"{TERM}{name}": values for name, values in self.terms.items()}

    @property
    def last_seconds(self) -> float:
        return float(self.seconds[-1]) if len(self.seconds) else 0.0

    @staticmethod
    def of_rows(rows: Sequence[Mapping[str, float]]) -> "History":
        """Return the history of rows, which map column names to values; NaN for a loss term that a row lacks."""
        names = dict.fromkeys([*COLUMNS, *(name for row in rows for name in row)])
        empty = History.empty().to_dict()
        columns = {}
        for name in names:
            dtype = empty[name].dtype if name in empty else np.float64
            columns[name] = np.asarray([row.get(name, np.nan) for row in rows], dtype)
        return History.of_columns(columns)

    @staticmethod
    def of_columns(columns: Mapping[str, np.ndarray]) -> "History":
        """Return the history of columns, the inverse of `to_dict`."""
        terms = {name.removeprefix(TERM): column for name, column in columns.items() if name not in COLUMNS}
        fields: dict[str, Any] = {name: columns[name] for name in COLUMNS}
        return History(**fields, terms=terms)

    def followed_by(self, other: "History") -> "History":
        """Return this history, continued by another."""
        first = self.to_dict()
        second = other.to_dict()
        missing = np.full(len(self.iteration), np.nan)
        other_missing = np.full(len(other.iteration), np.nan)
        columns = {}
        for name in first | second:
            columns[name] = np.concatenate([first.get(name, missing), second.get(name, other_missing)])
        return History.of_columns(columns)


COLUMNS = tuple(field.name for field in dataclasses.fields(History) if field.name != "terms")
"""Columns that each history has."""
TERM = "loss_"
"""Beginning of the names of the others."""


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
    write_archive(path, header, arrays)


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
    # Any leaves: only the paths of the fields count.
    (gaussians,) = _filled((Gaussians(*range(5)),), arrays)
    check_gaussians(gaussians)
    appearance = with_arrays(stage.appearance, arrays_below(SHOWN, arrays), gaussians.sh_degree)
    gaussians = jax.tree.map(jnp.asarray, gaussians)
    check_appearance(appearance, gaussians)
    model = Model(gaussians, appearance, jnp.zeros((), jnp.int32))
    # Shapes only; nothing is allocated.
    expected: TrainState = jax.eval_shape(lambda: initial_state(stage, model, [""]))
    events = (event if ahead else None for event, ahead in zip(expected.events, is_ahead, strict=True))
    expected = dataclasses.replace(expected, events=tuple(events))
    terms = header["terms"]
    if not isinstance(terms, list) or not all(isinstance(name, str) for name in terms):
        raise ValueError(f"terms must be a list of names; got {shortened(terms)}")
    template = _rest(expected), dict.fromkeys(COLUMNS, 0) | {"terms": dict.fromkeys(terms, 0)}
    _, (rest, columns) = _filled((gaussians, template), arrays)
    moments, num_live, *others = jax.tree.map(jnp.asarray, rest)
    state = TrainState(Model(gaussians, appearance, num_live), moments, *others)
    history = History(**columns)
    check_state(state, expected, stage)
    check_history(history)
    counts = {name: header[name] for name in ("num_restored", "num_refused")}
    for name, count in counts.items():
        check_count(name, count, np.iinfo(np.int32).max)
    machine = config_from_dict(Machine, header["machine"], "machine")
    devices = config_from_dict(Devices, header["devices"], "devices")
    views = None
    if header.get("views") is not None:  # Checkpoints of earlier versions do not record them.
        views = RecordedViews.of_arrays(header["views"], arrays_below(VIEWS, arrays))
    return Checkpoint(system, index, state, history, machine=machine, devices=devices, views=views, **counts)


LONGEST_DIFFERENCE = 300
"""Largest number of characters of the options that differ from a checkpoint's."""
SHOWN = "shown/"
"""Prefix of the names of appearance arrays."""
VIEWS = "views/"
"""Prefix of the names of arrays about the training views."""


def _rest(state: TrainState) -> tuple[object, ...]:
    """Return the rest of a checkpoint, after Gaussians and appearance."""
    return state.moments, state.model.num_live, state.events, state.iteration, state.status, state.corrections


def _packed(model: Model, moments: AdamState) -> AdamState:
    """Return moments at the capacity that tables get when they are loaded, which may be less than in training."""
    _, rest = partition(model.appearance)
    rows = np.arange(model.gaussians.num)

    def packed(moment: Model) -> Model:
        whole = map_rows(
            lambda array: array,
            lambda table: table.take(rows, padding=(0.0,) * len(table.padding)),
            combine(moment.appearance, rest),
        )
        return dataclasses.replace(moment, appearance=partition(whole)[0])

    return dataclasses.replace(moments, mu=packed(moments.mu), nu=packed(moments.nu))


def _filled(template: object, arrays: dict[str, np.ndarray]) -> Any:
    """Return a tree of the template's structure with the array of its path at each leaf."""
    return jax.tree_util.tree_map_with_path(lambda path, _: arrays[jax.tree_util.keystr(path)], template)


def check_state(state: TrainState, expected: TrainState, stage: Stage) -> None:
    """Raise ValueError, naming the leaf, unless the state of a file, whose model is valid, has the shapes and dtypes of
    the expected one."""
    check_like("state.model.num_live", state.model.num_live, expected.model.num_live)
    for name in ("moments", "events", "iteration", "status"):
        check_like(f"state.{name}", getattr(state, name), getattr(expected, name))
    check_model(state.model)
    check_count("state.iteration", state.iteration, stage.iterations)
    check_count("state.status", state.status, EXPLODED)
    check_count("state.moments.count", state.moments.count, np.iinfo(np.int32).max)
    check_finite("state.moments.mu", state.moments.mu)
    check_finite("state.moments.nu", state.moments.nu, is_signed=False)
    # Only the number of names matters for shapes.
    names = [""] * len(state.corrections[0].rows) if state.corrections else []
    dtype = state.model.gaussians.means.dtype
    neutral = jax.eval_shape(lambda: initial_corrections(stage.corrections, names, None, dtype))
    check_like("state.corrections", state.corrections, neutral)
    for correction in state.corrections:
        check_finite("state.corrections.rows", correction.rows)
        check_finite("state.corrections.mu", correction.moments.mu)
        check_finite("state.corrections.nu", correction.moments.nu, is_signed=False)
        if (np.asarray(correction.moments.count) < 0).any():
            raise ValueError("state.corrections.count must be at least 0; some are below")
    for path, leaf in jax.tree_util.tree_leaves_with_path(state.events):
        if np.isnan(np.asarray(leaf)).any():
            raise ValueError(f"state.events{jax.tree_util.keystr(path)} must be numbers; some are NaN")


def check_history(history: History) -> None:
    """Raise ValueError, naming the column, unless its columns are numbers of one length.

    dB may be infinite, and loss terms NaN.
    """
    columns = {name: np.asarray(column) for name, column in history.to_dict().items()}
    num = columns["iteration"].shape
    for name, column in columns.items():
        if column.ndim != 1 or column.shape != num or column.dtype.kind not in "iuf":
            raise ValueError(f"history.{name} must be numbers {list(num)}; got {column.dtype} {list(column.shape)}")
        is_term = name.startswith(TERM)
        if (np.isnan(column).any() and not is_term) or (name != "psnr" and np.isinf(column).any()):
            raise ValueError(f"history.{name} must be finite; some are not")
        if name not in ("loss", "psnr") and not is_term and (column < 0).any():
            raise ValueError(f"history.{name} must be at least 0; some are below")


def check_resume(resume: Checkpoint, system: System, index: int) -> None:
    """Raise ValueError unless the checkpoint is of that stage of that system, which may have further stages, or of the
    end of the stage that it continues."""
    if resume.stage != index:
        stages = system.all_stages()
        if resume.stage != index - 1 or not stages[index].continues:
            raise ValueError(f"the checkpoint is of stage {resume.stage + 1}, but stage {index + 1} was to be resumed")
        if not resume.is_at_end:
            raise ValueError(
                f"the checkpoint is of iteration {resume.iteration:,} of {stages[resume.stage].iterations:,} of stage "
                f"{resume.stage + 1}, which stage {index + 1} continues: resume that one first"
            )
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
