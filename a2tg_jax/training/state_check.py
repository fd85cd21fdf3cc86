"""Checks that a checkpoint holds a valid state of training (host)."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from a2tg_jax.host.text import shortened
from a2tg_jax.io.validate import check_count, check_finite, check_like, check_model
from a2tg_jax.training.corrections import initial_corrections
from a2tg_jax.training.options import System
from a2tg_jax.training.stage import Stage
from a2tg_jax.training.step import EXPLODED, TrainState


def find_stage(system: System, index: Any) -> Stage:
    """Return the stage of a header's number. Raise ValueError if there is none."""
    stages = system.stages()
    if type(index) is not int or not 0 <= index < len(stages):
        raise ValueError(f"stage must be a number in 0..{len(stages) - 1}; got {shortened(index)}")
    return stages[index]


def check_is_ahead(is_ahead: Any, stage: Stage) -> Sequence[bool]:
    """Return a header's list of the events that are still ahead. Raise ValueError if it does not fit the stage."""
    if not isinstance(is_ahead, list) or len(is_ahead) != len(stage.events) or {type(x) for x in is_ahead} - {bool}:
        raise ValueError(
            f"is_ahead must say true or false of {len(stage.events)} events; got {shortened(is_ahead)}. Where an older "
            "version made the checkpoint, whose stages had other events, train anew"
        )
    return is_ahead


def check_state(state: TrainState, wanted: TrainState, stage: Stage) -> None:
    """Raise ValueError, naming the leaf, unless a state fits a stage.

    Args:
      state: state from the file; the arrays of its model fit each other.
      wanted: shapes and dtypes of a state of that model.
      stage: stage of both states.
    """
    check_like("state.model.num_live", state.model.num_live, wanted.model.num_live)
    for name in ("moments", "events", "iteration", "status"):
        check_like(f"state.{name}", getattr(state, name), getattr(wanted, name))
    check_model(state.model)
    check_count("state.iteration", state.iteration, stage.iterations)
    check_count("state.status", state.status, EXPLODED)
    check_count("state.moments.count", state.moments.count, np.iinfo(np.int32).max)
    check_finite("state.moments.mu", state.moments.mu)
    check_finite("state.moments.nu", state.moments.nu, is_signed=False)
    _check_corrections(state, stage)
    for path, leaf in jax.tree_util.tree_leaves_with_path(state.events):
        if np.isnan(np.asarray(leaf)).any():
            raise ValueError(f"state.events{jax.tree_util.keystr(path)} must be numbers; some are NaN")


def _check_corrections(state: TrainState, stage: Stage) -> None:
    """Raise ValueError unless each correction of a stage has finite rows, all for the same number of views."""
    names, dtype = [""] * len(state.corrections[0].rows) if state.corrections else [], state.model.gaussians.means.dtype
    wanted = jax.eval_shape(lambda: initial_corrections(stage.corrections, names, None, dtype))
    check_like("state.corrections", state.corrections, wanted)
    for known in state.corrections:
        check_finite("state.corrections.rows", known.rows)
        check_finite("state.corrections.mu", known.moments.mu)
        check_finite("state.corrections.nu", known.moments.nu, is_signed=False)
        if (np.asarray(known.moments.count) < 0).any():
            raise ValueError("state.corrections.count must be at least 0; some are below")


def check_history(history: Any) -> None:
    """Raise ValueError, naming the column, unless its columns are numbers of one length.

    dB may be infinite, and loss terms NaN.
    """
    columns = {name: np.asarray(column) for name, column in history.to_dict().items()}
    num = columns["iteration"].shape
    for name, column in columns.items():
        if column.ndim != 1 or column.shape != num or column.dtype.kind not in "iuf":
            raise ValueError(f"history.{name} must be numbers {list(num)}; got {column.dtype} {list(column.shape)}")
        is_term = name.startswith("loss_")
        if (np.isnan(column).any() and not is_term) or (name != "psnr" and np.isinf(column).any()):
            raise ValueError(f"history.{name} must be finite; some are not")
        if name not in ("loss", "psnr") and not is_term and (column < 0).any():
            raise ValueError(f"history.{name} must be at least 0; some are below")
