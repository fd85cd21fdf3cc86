"""Log of a training: loss, PSNR and sizes, every 10 iterations."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from a2tg_jax.base.named_fields import NamedFields
from a2tg_jax.base.text import counted


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

    prefix: ClassVar[str] = "loss_"
    """Beginning of the names of columns of `terms`."""

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
        return columns | {f"{self.prefix}{name}": values for name, values in self.terms.items()}

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
        terms = {name.removeprefix(History.prefix): column for name, column in columns.items() if name not in COLUMNS}
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


def check_history(history: History) -> None:
    """Raise ValueError, naming the column, unless its columns are numbers of one length.

    dB may be infinite, and loss terms NaN.
    """
    columns = {name: np.asarray(column) for name, column in history.to_dict().items()}
    num = columns["iteration"].shape
    for name, column in columns.items():
        if column.ndim != 1 or column.shape != num or column.dtype.kind not in "iuf":
            raise ValueError(f"history.{name} must be numbers {list(num)}; got {column.dtype} {list(column.shape)}")
        is_term = name.startswith(History.prefix)
        if (np.isnan(column).any() and not is_term) or (name != "psnr" and np.isinf(column).any()):
            raise ValueError(f"history.{name} must be finite; some are not")
        if name not in ("loss", "psnr") and not is_term and (column < 0).any():
            raise ValueError(f"history.{name} must be at least 0; some are below")
