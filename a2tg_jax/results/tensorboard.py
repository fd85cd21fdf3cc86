"""Histories as files of TensorBoard, which shows them while a run is trained (extra [tensorboard])."""

import importlib
import importlib.util
from typing import Any

import numpy as np

from a2tg_jax.results.folder import RunFolder
from a2tg_jax.training import History

LIBRARY = "tensorboardX"
LEFT_OUT = ("stage", "iteration")
"""Columns of a history that are not written."""


def check_tensorboard() -> None:
    """Raise ValueError unless the library that writes the files is installed."""
    if importlib.util.find_spec(LIBRARY) is None:
        raise ValueError(f"--tensorboard needs {LIBRARY}: pip install 'a2tg-jax[tensorboard]'")


class EventWriter:
    """Writer of a stage's history. Each call adds the rows that the last one did not have."""

    def __init__(self, run: RunFolder, name: str):
        self._run, self._name = run, name
        self._file: Any = None
        self._written = 0

    def skip(self, history: History) -> None:
        """Take the rows of a history for written: those that an earlier process wrote."""
        self._written = len(history.iteration)

    def add(self, history: History) -> None:
        """Write the rows that are new, as LOSS/NAME and so on, by iteration of the stage."""
        rows = range(self._written, len(history.iteration))
        columns = {name: column for name, column in history.to_dict().items() if name not in LEFT_OUT}
        for row in rows:
            for name, column in columns.items():
                if not np.isnan(column[row]):
                    self._writer().add_scalar(f"{name}/{self._name}", float(column[row]), int(history.iteration[row]))
        if rows:
            self._writer().flush()
            self._written = rows.stop

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def _writer(self) -> Any:
        """Return the writer, whose file is noted as the run's own when it is made."""
        if self._file is None:
            folder = self._run.tensorboard
            before = set(folder.glob("events.*"))
            library: Any = importlib.import_module(LIBRARY)
            self._file = library.SummaryWriter(str(folder), filename_suffix=f".{len(before)}.{self._name}")
            self._run.own_all([f"{folder.name}/{path.name}" for path in sorted(set(folder.glob("events.*")) - before)])
        return self._file
