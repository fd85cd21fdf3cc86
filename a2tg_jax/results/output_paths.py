"""Checks of paths to write, before any work: whether a file can be made there, and whether it may replace another."""

import os
import tempfile
from collections.abc import Iterable
from pathlib import Path

from a2tg_jax.base.atomic import file_to_write
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.results.folder import RunFolder

EXPORTS = (".a2tgz", ".glb")
"""Suffixes of optional files that `a2tg compress` and `a2tg mesh` write into a run folder."""


def check_output(path: Path) -> None:
    """Raise ValueError, or OSError of a link, if a file or folder cannot be made, naming the obstacle.

    Warns of several levels of new folders outside the current one, such as on a misspelt drive.
    """
    place = Path(os.path.abspath(file_to_write(path)))
    missing = [folder for folder in (place, *place.parents) if not folder.exists()]
    existing = place if place.is_dir() else place.parent
    if missing:
        existing = missing[-1].parent
    if not existing.exists():
        raise ValueError(f"{path} cannot be made, because there is no {existing}")
    if not existing.is_dir():
        raise ValueError(f"{path} cannot be made, because {existing} is a file")
    try:
        # Trying is the only sure test: permissions, read-only mounts and network drives differ.
        os.rmdir(tempfile.mkdtemp(dir=existing))
    except OSError as error:
        raise ValueError(f"{path} cannot be made, because {existing} is not writable: {error.strerror}") from None
    if len(missing) > 1 and not existing.is_relative_to(os.getcwd()):
        warn(f"{missing[-1]} does not exist and will be made")


def check_apart(out: Path, other: Path) -> None:
    """Raise ValueError if one of two paths, at least one of which is written, is in the other."""
    # Links resolved: names alone do not show an overlap.
    one = Path(os.path.realpath(out))
    two = Path(os.path.realpath(other))
    if one.is_relative_to(two) or two.is_relative_to(one):
        raise ValueError(f"{out} and {other} overlap: choose an output folder outside it")


def check_new(path: Path, option: str, *, overwrite: bool) -> None:
    """Raise if a file must not be replaced, naming it and its option: FileExistsError if it exists and `overwrite` is
    not set, ValueError if it belongs to a run and is no export, or is a folder."""
    if path.is_dir():
        raise ValueError(f"{path} is a folder; give the path of a file, or choose another {option}")
    if not path.is_file():
        return
    run = _run_that_wrote(path)
    if run is not None and path.suffix.lower() not in EXPORTS:
        raise ValueError(f"{path} belongs to the run in {run}; choose another {option}")
    if not overwrite:
        raise FileExistsError(f"{path} exists; add `overwrite` to replace it, or choose another {option}")


def check_export(path: Path, default: Path, option: str, *, overwrite: bool) -> None:
    """Call `check_new`, unless the path is the default and an earlier call wrote it into a run folder."""
    if os.path.realpath(path) != os.path.realpath(default) or _run_that_wrote(path) is None:
        check_new(path, option, overwrite=overwrite)


def _run_that_wrote(path: Path) -> Path | None:
    """Return the folder of the run that lists a file as its own, or None."""
    path = Path(os.path.realpath(path))
    for folder in path.parents:
        if path.relative_to(folder).as_posix() in RunFolder(folder).written():
            return folder
    return None


def check_not_source(files: Iterable[Path], source: Path, option: str) -> None:
    """Raise ValueError, naming the file and its option, if a file to write is the source."""
    for file in files:
        if file.exists() and source.exists() and file.samefile(source):
            raise ValueError(f"{file} is the model itself; choose another {option}")
