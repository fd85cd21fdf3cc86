"""Checkpoints: the whole state of a training run, on disk and back, bit for bit."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from a2tg_jax.appearance import Appearance
from a2tg_jax.appearance.base import check_appearance
from a2tg_jax.appearance.files import arrays_of, with_arrays
from a2tg_jax.core.gaussians import Gaussians, check_gaussians
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.partition import combine, partition
from a2tg_jax.core.table import Table, is_table
from a2tg_jax.host.machine import ALONE, Devices, Machine, this_machine
from a2tg_jax.host.text import counted, shortened
from a2tg_jax.io.archive import read_archive, write_archive
from a2tg_jax.io.config_json import config_from_dict, config_to_dict, flatten_config
from a2tg_jax.io.model_file import LONGEST_REASON
from a2tg_jax.io.validate import check_count
from a2tg_jax.model import Model
from a2tg_jax.training.options import System
from a2tg_jax.training.registry import system_from_dict, system_to_dict
from a2tg_jax.training.stage import Stage
from a2tg_jax.training.state_check import check_history, check_is_ahead, check_state, find_stage
from a2tg_jax.training.step import TrainState, initial_state


@dataclasses.dataclass(frozen=True, eq=False)
class History:
    """Log of a training, one entry every so many iterations; arrays of one length."""

    stage: np.ndarray
    """Stage, from 1."""
    iteration: np.ndarray
    """Iteration within its stage, from 1."""
    loss: np.ndarray
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
        counts, values = np.zeros(0, np.int64), np.zeros(0)
        return History(counts, counts, values, values, counts, values, values)

    def __repr__(self) -> str:
        rows = counted(len(self.iteration), "row")
        if not len(self.iteration):
            return f"History({rows})"
        return f"History({rows} to iteration {self.iteration[-1]:,} of stage {self.stage[-1]}, {self.psnr[-1]:.2f} dB)"

    @staticmethod
    def row(values: Sequence[Any], terms: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of `COLUMNS` and those of loss terms by the names of their columns, such as loss_l1."""
        return dict(zip(COLUMNS, values, strict=True)) | {f"{TERM}{name}": value for name, value in terms.items()}

    def to_dict(self) -> dict[str, np.ndarray]:
        """Return the columns by name, as `pandas.DataFrame` takes them; loss terms as loss_l1 and so on."""
        return self.row([getattr(self, name) for name in COLUMNS], self.terms)

    @property
    def last_seconds(self) -> float:
        return float(self.seconds[-1]) if len(self.seconds) else 0.0

    def with_point(self, /, *point: float, **terms: float) -> "History":
        """One more row, its values in the order of the fields, and those of loss terms by name."""
        log = HistoryLog(self)
        log.add(*point, **terms)
        return log.history

    @staticmethod
    def of_columns(columns: Mapping[str, np.ndarray]) -> "History":
        """Return the history whose `to_dict` the columns are."""
        terms = {name.removeprefix(TERM): column for name, column in columns.items() if name not in COLUMNS}
        known: dict[str, Any] = {name: columns[name] for name in COLUMNS}
        return History(**known, terms=terms)

    def followed_by(self, other: "History") -> "History":
        """This history and then another."""
        both = [(history.to_dict(), np.full(len(history.iteration), np.nan)) for history in (self, other)]
        names = {**both[0][0], **both[1][0]}
        return History.of_columns(
            {name: np.concatenate([columns.get(name, none) for columns, none in both]) for name in names}
        )


COLUMNS = tuple(field.name for field in dataclasses.fields(History) if field.name != "terms")
"""Columns that each history has."""
TERM = "loss_"
"""Beginning of the names of the others."""


class HistoryLog:
    """History that grows row by row, in amortised constant time."""

    def __init__(self, history: History):
        """Args:
        history: the rows so far; its arrays stay as they are.
        """
        self._num = len(history.iteration)
        self._columns = {name: np.array(column) for name, column in history.to_dict().items()}

    @property
    def history(self) -> History:
        """The rows so far. Later rows do not change it."""
        return History.of_columns({name: column[: self._num] for name, column in self._columns.items()})

    def add(self, /, *point: float, **terms: float) -> None:
        """Add a row, its values in the order of the fields, and those of loss terms by name."""
        size = len(self._columns["iteration"])
        if self._num == size:
            size = 2 * self._num + FIRST_ROWS
            self._columns = {name: np.resize(column, size) for name, column in self._columns.items()}
        row = History.row(point, terms)
        for name in row:  # In their order, which that of a set would not be.
            if name not in self._columns:
                self._columns[name] = np.full(size, np.nan)
        for name, column in self._columns.items():
            column[self._num] = row.get(name, np.nan)
        self._num += 1


FIRST_ROWS = 16
"""Number of rows that an empty log has room for."""


@dataclasses.dataclass(frozen=True, eq=False)
class Checkpoint:
    """A training run stopped between two iterations."""

    system: System
    stage: int
    """Index of the stage in its system, from 0."""
    state: TrainState
    history: History
    """History of this stage."""
    num_restored: int = 0
    """Number of times the stage went back because it diverged; it decides the order of the views."""
    machine: Machine | None = None
    """Machine on which it was saved; None if unknown or not saved yet."""
    devices: Devices = ALONE
    """Devices that trained it; it can go on with others."""
    num_refused: int = 0
    """Number of Gaussians so far that were not added for lack of room."""

    @property
    def iteration(self) -> int:
        """Iterations of the stage done so far."""
        return int(self.state.iteration)

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
    """Training was stopped between two iterations. It can go on from the checkpoint."""

    def __init__(self, checkpoint: Checkpoint):
        """Args:
        checkpoint: the state after the last iteration; `checkpoint.model` is its model.
        """
        super().__init__(
            f"training stopped after iteration {checkpoint.iteration:,} of stage {checkpoint.stage + 1}; the model is "
            "error.checkpoint.model, and fit(scene, system, resume=error.checkpoint) goes on"
        )
        self.checkpoint = checkpoint

    def __reduce__(self) -> tuple[type["Interrupted"], tuple[Checkpoint]]:
        return type(self), (self.checkpoint,)


def save_checkpoint(path: str | os.PathLike[str], checkpoint: Checkpoint) -> None:
    """Write a checkpoint; an older file of that name is replaced once the new one is whole."""
    state, model = checkpoint.state, checkpoint.state.model
    header = {
        "system": system_to_dict(checkpoint.system),
        "stage": checkpoint.stage,
        "is_ahead": [event is not None for event in state.events],
        "num_restored": checkpoint.num_restored,
        "machine": config_to_dict(this_machine()),
        "devices": config_to_dict(checkpoint.devices),
        "num_refused": checkpoint.num_refused,
        "terms": [*checkpoint.history.terms],
    }
    shown = arrays_of(model.appearance, model.gaussians.sh_degree)
    arrays = {f"{SHOWN}{name}": array for name, array in shown.items()}
    state = dataclasses.replace(state, moments=_packed(model, state.moments))
    rest = _rest(state), dataclasses.asdict(checkpoint.history)
    write_archive(path, header, arrays | _named_arrays((model.gaussians, rest)))


def load_checkpoint(path: str | os.PathLike[str], system: type[System] | None = None) -> Checkpoint:
    """Read what `save_checkpoint` wrote.

    Args:
      path: the file.
      system: class of its system. Only needed for a system of your own whose module is not imported.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if it is no checkpoint, is damaged, is of another version, or its system is unknown.
    """
    header, arrays = read_archive(path)
    try:
        return _checkpoint_of(header, arrays, str(path), system)
    except KeyError as error:
        raise ValueError(f"{path}: the checkpoint lacks {error}; it is damaged or of another version") from error
    except (TypeError, IndexError, AttributeError, OverflowError) as error:
        reason = shortened(str(error))
        raise ValueError(f"{path}: the checkpoint is damaged or of another version ({reason})") from error
    except ValueError as error:
        reason = shortened(str(error), LONGEST_REASON)
        raise ValueError(reason if str(path) in reason else f"{path}: {reason}") from error


def _checkpoint_of(
    header: dict[str, Any], arrays: dict[str, np.ndarray], where: str, system: type[System] | None
) -> Checkpoint:
    options = system_from_dict(header["system"], where, system)
    options.check()
    stage = find_stage(options, header["stage"])
    is_ahead = check_is_ahead(header["is_ahead"], stage)
    (gaussians,) = _filled((Gaussians(*range(5)),), arrays)
    check_gaussians(gaussians)
    shown = {name.removeprefix(SHOWN): array for name, array in arrays.items() if name.startswith(SHOWN)}
    appearance = with_arrays(stage.appearance, shown, gaussians.sh_degree)
    gaussians = jax.tree.map(jnp.asarray, gaussians)
    check_appearance(appearance, gaussians)
    wanted = _wanted(stage, gaussians, appearance, is_ahead)
    terms = header.get("terms", [])  # no history of an older version has them
    if not isinstance(terms, list) or not all(isinstance(name, str) for name in terms):
        raise ValueError(f"terms must be a list of names; got {shortened(terms)}")
    kept = _rest(wanted), dict.fromkeys(COLUMNS, 0) | {"terms": dict.fromkeys(terms, 0)}
    _, (rest, columns) = _filled((gaussians, kept), arrays)
    moments, num_live, *others = jax.tree.map(jnp.asarray, rest)
    model = Model(gaussians, appearance, num_live)
    state, history = TrainState(model, moments, *others), History(**columns)
    check_state(state, wanted, stage)
    check_history(history)
    counts = {name: header.get(name, 0) for name in ("num_restored", "num_refused")}
    for name, count in counts.items():
        check_count(name, count, MOST_COUNTED)
    machine = config_from_dict(Machine, header["machine"], "machine") if "machine" in header else None
    devices = config_from_dict(Devices, header.get("devices", {}), "devices")
    return Checkpoint(options, header["stage"], state, history, machine=machine, devices=devices, **counts)


MOST_COUNTED = 2**31 - 1
SHOWN = "shown/"
"""Prefix of the names of appearance arrays."""


def _rest(state: TrainState) -> tuple[Any, ...]:
    """Return the part of a checkpoint beside Gaussians and appearance."""
    return state.moments, state.model.num_live, state.events, state.iteration, state.status, state.corrections


def _packed(model: Model, moments: AdamState) -> AdamState:
    """Return moments at the capacity that tables get when they are loaded, which may be less than in training."""
    _, rest = partition(model.appearance)
    rows = np.arange(model.gaussians.num)

    def smaller(leaf: Any) -> Any:
        return leaf.take(rows, padding=(0.0,) * len(leaf.padding)) if isinstance(leaf, Table) else leaf

    def packed(moment: Model) -> Model:
        whole = combine(moment.appearance, rest)
        whole = jax.tree.map(smaller, whole, is_leaf=is_table)
        return dataclasses.replace(moment, appearance=partition(whole)[0])

    return dataclasses.replace(moments, mu=packed(moments.mu), nu=packed(moments.nu))


def _named_arrays(tree: Any, *, only_names: bool = False) -> dict[str, Any]:
    """Return the leaves of a pytree under the names of their paths, in the order of the tree."""
    paths = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path): None if only_names else np.asarray(leaf) for path, leaf in paths}


def _filled(template: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Return a tree of the template's structure with the array of its name at each leaf."""
    leaves = [arrays[name] for name in _named_arrays(template, only_names=True)]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def _wanted(stage: Stage, gaussians: Gaussians, appearance: Appearance, is_ahead: Sequence[bool]) -> TrainState:
    """Return the shapes and dtypes of a state of a stage, some of whose events may be past."""
    model = Model(gaussians, appearance, jnp.zeros((), jnp.int32))
    state: TrainState = jax.eval_shape(lambda: initial_state(stage, model, [""]))
    events = (event if ahead else None for event, ahead in zip(state.events, is_ahead, strict=True))
    return dataclasses.replace(state, events=tuple(events))


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


MOST_TOLD = 300
"""Largest number of characters of the options that differ from a checkpoint's."""
