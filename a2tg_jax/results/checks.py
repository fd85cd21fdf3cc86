"""Checks before any work: places to write to, weights, and models of views that are held out."""

import os
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

from a2tg_jax.data import Scene
from a2tg_jax.host.text import counted
from a2tg_jax.measure.metrics import load_lpips
from a2tg_jax.model import Model
from a2tg_jax.results.folder import RunFolder

EXPORTS = (".a2tgz", ".glb")
"""Suffixes of what `a2tg compress` and `a2tg mesh` write into the folder of a run, which needs none of it."""


def check_output(path: Path) -> None:
    """Raise if a file or folder cannot be made.

    If that makes more than one level of folders outside the current folder, such as at a misspelt drive, it is said on
    stderr.

    Raises:
      ValueError: naming what is in the way.
    """
    place = Path(os.path.abspath(path))
    missing = [folder for folder in (place, *place.parents) if not folder.exists()]
    existing = place.parent if not missing else missing[-1].parent
    if not missing and place.is_dir():
        existing = place
    if not existing.exists():
        raise ValueError(f"{path} cannot be made, for there is no {existing}")
    if not existing.is_dir():
        raise ValueError(f"{path} cannot be made, for {existing} is a file")
    try:
        os.rmdir(tempfile.mkdtemp(dir=existing))
    except OSError as error:
        raise ValueError(f"{path} cannot be made, for nothing can be written in {existing}: {error.strerror}") from None
    if len(missing) > 1 and not existing.is_relative_to(os.getcwd()):
        print(f"a2tg: {missing[-1]} does not exist and will be made", file=sys.stderr)


def check_apart(out: Path, other: Path) -> None:
    """Raise ValueError if one of two paths, at least one of which is written, is in the other."""
    one, two = out.resolve(), other.resolve()
    if one.is_relative_to(two) or two.is_relative_to(one):
        raise ValueError(f"{out} and {other} overlap: choose an output folder outside it")


def check_new(path: Path, flag: str, *, overwrite: bool) -> None:
    """Raise if a file must not be replaced, naming it and the flag it comes from.

    Raises:
      FileExistsError: if it exists, and `overwrite` is not set.
      ValueError: if it is one that a run, and no export, wrote into its folder.
    """
    if not path.is_file():
        return
    run = _run_that_wrote(path)
    if run is not None and path.suffix.lower() not in EXPORTS:
        raise ValueError(f"{path} belongs to the run in {run}; choose another {flag}")
    if not overwrite:
        raise FileExistsError(f"{path} exists; add --overwrite to replace it, or choose another {flag}")


def check_export(path: Path, default: Path, flag: str, *, overwrite: bool) -> None:
    """Call `check_new`, unless the path is the default and the same command wrote it into a run folder before."""
    if path.resolve() != default.resolve() or _run_that_wrote(path) is None:
        check_new(path, flag, overwrite=overwrite)


def _run_that_wrote(path: Path) -> Path | None:
    """Return the folder of the run that lists a file as its own, or None."""
    path = path.resolve()
    names = {folder: path.relative_to(folder).as_posix() for folder in path.parents}
    return next((folder for folder, name in names.items() if name in RunFolder(folder).written()), None)


def check_not_source(files: Iterable[Path], source: Path, flag: str) -> None:
    """Raise ValueError if one of the files to write is the file that is read, naming it and its flag."""
    for file in files:
        if file.exists() and source.exists() and file.samefile(source):
            raise ValueError(f"{file} is the model itself; choose another {flag}")


def check_weights(lpips_weights: Path | None) -> None:
    """Raise ValueError or FileNotFoundError unless these are LPIPS weights, or None."""
    if lpips_weights is not None:
        load_lpips(lpips_weights)


def check_held_out(model: Model, scene: Scene, path: Path) -> None:
    """Raise ValueError if a model was trained on views that its scene holds out: their figures would be too good.

    Args:
      model: a model of a run; without an origin its views are unknown, and it passes.
      scene: the scene of the run, as it is read now.
      path: the file of the model.
    """
    if model.origin is None:
        return
    trained = {name for name, is_test in zip(model.origin.names, model.origin.is_test, strict=True) if not is_test}
    leaked = sorted(trained & {view.name for view in scene.test} - {view.name for view in scene.train})
    if leaked:
        raise ValueError(
            f"{path} was trained on {counted(len(leaked), 'view')} that {scene.name} now holds out, such as "
            f"{leaked[0]}: the photographs have changed, or views of panoramas, which are held out together since, are "
            "among them; train in a new folder"
        )
