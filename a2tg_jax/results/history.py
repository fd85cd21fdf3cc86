"""History of a stage as CSV, one line per logged iteration."""

import csv
import dataclasses
from pathlib import Path

import numpy as np

from a2tg_jax.io.atomic import replacing
from a2tg_jax.training import History

NAMES = tuple(field.name for field in dataclasses.fields(History))


def write_history(path: Path, history: History) -> None:
    """Writes the columns of a history, named in the first line."""
    columns = [np.asarray(getattr(history, name)).tolist() for name in NAMES]
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([NAMES, *zip(*columns, strict=True)])


def read_history(path: Path) -> History:
    """The history that `write_history` wrote.

    Raises:
      ValueError: if the file has other columns.
    """
    with open(path, newline="", encoding="utf-8") as file:
        first, *rows = csv.reader(file)
    if tuple(first) != NAMES:
        raise ValueError(f"{path}: has the columns {', '.join(first)}; {', '.join(NAMES)} are wanted")
    values = np.asarray(rows, np.float64).reshape(len(rows), len(NAMES))
    integers = {"stage", "iteration", "num_gaussians"}
    return History(
        **{name: values[:, i].astype(np.int64 if name in integers else np.float64) for i, name in enumerate(NAMES)}
    )
