"""Lock of a run folder: one process writes at a time, and leftovers of killed ones are removed."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from a2tg_jax.host.atomic import left_over
from a2tg_jax.host.operating_system import try_lock
from a2tg_jax.results.folder import RunFolder, open_run
from a2tg_jax.results.run_replacement import is_unfinished, undo_unfinished


@contextlib.contextmanager
def claimed(run: RunFolder) -> Iterator[None]:
    """Keep other processes from training and measuring in a run folder. The folder is made if it does not exist.

    The lock is the operating system's, on the marker: it ends with the process, however that ends. Some file systems
    have no locks. Partial files of a killed process are removed, and a run that it was about to replace is put back.

    Raises:
      FileExistsError: if another process is at it.
      ValueError: if the marker is not this program's.
    """
    run.written()
    run.path.mkdir(parents=True, exist_ok=True)
    with open(run.marker, "a", encoding="utf-8") as file:
        if not try_lock(file.fileno()):
            raise FileExistsError(
                f"another process is training or measuring in {run.path}: wait until it ends, or choose another --out"
            )
        run.own(run.marker)
        undo_unfinished(run)
        remove_left_over(run)
        yield


@contextlib.contextmanager
def opened(path: str | os.PathLike[str]) -> Iterator[RunFolder]:
    """Claim an existing run folder.

    Raises:
      FileNotFoundError: if there is none at `path`.
      FileExistsError, ValueError: as `claimed` does.
    """
    run = RunFolder(Path(path))
    if not is_unfinished(run):
        open_run(path)
    with claimed(run):
        yield open_run(path)


def remove_left_over(run: RunFolder) -> None:
    """Remove partial files of a killed process of this run."""
    own = {run.path / name for name in run.written()}
    for folder in {path.parent for path in own}:
        for partial, path in left_over(folder).items():
            if path in own:
                partial.unlink(missing_ok=True)
