"""History of a stage as CSV, one line per logged iteration, and as TensorBoard files (extra [tensorboard])."""

import csv
import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax import History
from a2tg_jax.base.atomic import replacing
from a2tg_jax.base.regular_files import is_regular, open_regular
from a2tg_jax.base.text import shortened
from a2tg_jax.host.optional import optional
from a2tg_jax.results.folder import RunFolder

NAMES = tuple(History.empty().to_dict())
"""Columns of each file; loss terms such as loss_l1 follow."""
INTEGERS = ("stage", "iteration", "num_gaussians")
LARGEST = 1e15
"""Largest number in a history; larger ones would overflow integers and axes."""
MOST_BYTES = 1 << 26
"""Largest file; about a million rows."""


def write_history(path: Path, history: History) -> None:
    columns = {name: np.asarray(column).tolist() for name, column in history.to_dict().items()}
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def read_history(path: Path) -> History:
    """Return the history in a file. Raises FileNotFoundError if there is none, and ValueError, naming the file, if it
    has other columns, or values that are not numbers. Only PSNR may be infinite, and only loss terms NaN."""
    again = f"delete models/{path.stem}.npz to train the stage again by a2tg train --resume"
    if not is_regular(path):
        raise FileNotFoundError(f"{path} is missing: put it back, or {again}")
    with io.TextIOWrapper(open_regular(path, MOST_BYTES), encoding="utf-8", newline="") as file:
        try:
            names = file.readline().rstrip("\r\n").split(",")
            columns = _read_columns(file, names)
        except ValueError as error:
            raise ValueError(f"{path}: {shortened(str(error), 200)}; {again}") from error
    for name in INTEGERS:
        columns[name] = columns[name].astype(np.int64)
    return History.of_columns(columns)


def _read_columns(file: io.TextIOBase, names: list[str]) -> dict[str, np.ndarray]:
    """Return the columns below the first line. Raises ValueError with a reason."""
    terms = names[len(NAMES) :]
    if tuple(names[: len(NAMES)]) != NAMES or not all(name.startswith(History.prefix) for name in terms):
        raise ValueError(f"has the columns {shortened(', '.join(names))}; {', '.join(NAMES)} are expected")
    if len(set(terms)) < len(terms):
        raise ValueError(f"has a column twice: {shortened(', '.join(terms))}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # A history may be empty.
        # comments=None: "#" in a damaged file is an error, not a comment.
        values = np.loadtxt(file, delimiter=",", comments=None, ndmin=2)
    if values.size and values.shape[1] != len(names):
        raise ValueError(f"has rows of {values.shape[1]} numbers; {len(names)} are expected")
    columns = dict(zip(names, values.reshape(-1, len(names)).T, strict=True))
    for name, column in columns.items():
        # PSNR of equal images is infinite.
        is_large = name != "psnr" and (np.abs(column) > LARGEST).any()
        if is_large or (name in NAMES and np.isnan(column).any()):
            raise ValueError("has numbers that are not finite")
    return columns


def tensorboard_library() -> Any:
    """Return the library that writes the files. Raises ValueError if it is not installed."""
    return optional("tensorboardX", "`tensorboard` needs tensorboardX", "tensorboard")


class EventWriter:
    """Writer of a stage's history for TensorBoard. Each call adds the rows since the last one."""

    def __init__(self, run: RunFolder, name: str):
        self._run = run
        self._name = name
        self._file: Any = None
        self._num_written = 0

    def skip(self, history: History) -> None:
        """Mark the rows of a history as written by an earlier process."""
        self._num_written = len(history.iteration)

    def add(self, history: History) -> None:
        """Write the new rows, as LOSS/NAME and so on, by iteration of the stage."""
        rows = range(self._num_written, len(history.iteration))
        if not rows:
            return
        if self._file is None:
            self._file = self._new_file()
        for name, column in history.to_dict().items():
            if name not in ("stage", "iteration"):
                for row in rows:
                    # A loss term that a stage lacks is NaN.
                    if not np.isnan(column[row]):
                        self._file.add_scalar(f"{name}/{self._name}", float(column[row]), int(history.iteration[row]))
        self._file.flush()
        self._num_written = rows.stop

    def _new_file(self) -> Any:
        folder = self._run.tensorboard
        # tensorboardX chooses the name: what is new afterwards is this writer's.
        before = set(folder.glob("events.*"))
        # The suffix keeps files of several stages and processes apart.
        file = tensorboard_library().SummaryWriter(str(folder), filename_suffix=f".{len(before)}.{self._name}")
        new = sorted(set(folder.glob("events.*")) - before)
        self._run.own_all([path.relative_to(self._run.path).as_posix() for path in new])
        return file

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
