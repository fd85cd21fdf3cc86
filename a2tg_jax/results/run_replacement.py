"""Replacement of a run in its folder. The old run is kept until the new one has its report.

    1. Before the new run's first checkpoint, nothing of the old one is touched.
    2. Then the old one moves to RUN/.a2tg-old, a run folder too, and the new one's checkpoint and run.toml are written.
    3. Once the new one has its report, the old one is deleted.

A process killed within step 2 leaves no run.toml, or a folder .a2tg-old.partial: the old run is put back.
"""

import os
from pathlib import Path

from a2tg_jax.host.operating_system import flush_folder
from a2tg_jax.results.folder import RunFolder

OLD = ".a2tg-old"
MOVING = f"{OLD}.partial"


def old_run(run: RunFolder) -> RunFolder | None:
    """Return the run that this one is about to replace, or None."""
    old = RunFolder(run.path / OLD)
    return old if old.path.is_dir() else None


def set_aside(run: RunFolder) -> None:
    """Move what runs wrote into a folder, as its marker lists it, to RUN/.a2tg-old.

    If a finished run lies there already, because the run that was to replace it never ended, that one is kept and this
    one deleted.
    """
    if old_run(run) is None:
        moving = RunFolder(run.path / MOVING)
        names = run.written()
        moving.own_all(names)
        _move(run, moving, names)
        os.replace(moving.path, run.path / OLD)
        flush_folder(run.path)
    run.clear()


def drop_old(run: RunFolder) -> None:
    """Delete the run that was set aside, if there is one."""
    old = old_run(run)
    if old is not None:
        _delete(old)


def is_unfinished(run: RunFolder) -> bool:
    """Return whether a process was killed while it set a run aside."""
    is_recorded = run.record.is_file()
    return (run.path / MOVING).is_dir() or (old_run(run) is not None and not is_recorded)


def undo_unfinished(run: RunFolder) -> None:
    """Put back a run that was being set aside when its process was killed."""
    moving, old = RunFolder(run.path / MOVING), old_run(run)
    if moving.path.is_dir():
        _put_back(moving, run)
    elif old is not None and is_unfinished(run):
        run.clear()
        _put_back(old, run)


def _put_back(old: RunFolder, run: RunFolder) -> None:
    names = old.written()
    run.own_all(names)
    _move(old, run, names)
    _delete(old)


def _delete(old: RunFolder) -> None:
    """Delete a run and its folder, if there is nothing else in it."""
    old.clear()
    old.marker.unlink(missing_ok=True)
    if not any(old.path.iterdir()):
        old.path.rmdir()


def _move(source: RunFolder, target: RunFolder, names: list[str]) -> None:
    """Move the files that exist, and remove folders left empty."""
    for path in source.own_files(names):
        moved = target.path / path.relative_to(source.path)
        moved.parent.mkdir(parents=True, exist_ok=True)
        os.replace(path, moved)
        remove_if_empty(path.parent, source.path)


def remove_if_empty(folder: Path, root: Path) -> None:
    """Remove a folder below another, if it is empty."""
    if folder != root and folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
