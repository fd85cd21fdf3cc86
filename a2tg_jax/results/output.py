"""Places to write to, checked before any work."""

import os
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path


def check_output(path: Path) -> None:
    """Raise if a file or folder cannot be made.

    If that makes more than one level of folders outside the current folder, such as at a misspelt drive, it is said on
    stderr.

    Raises:
      ValueError: naming what stands in the way.
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


def check_new(path: Path, flag: str, *, overwrite: bool) -> None:
    """Raise FileExistsError if a file would be replaced without --overwrite, naming it and the flag it comes from."""
    if path.is_file() and not overwrite:
        raise FileExistsError(f"{path} exists; add --overwrite to replace it, or choose another {flag}")


def check_not_source(files: Iterable[Path], source: Path, flag: str) -> None:
    """Raise ValueError if one of the files to write is the file that is read, naming it and its flag."""
    for file in files:
        if file.exists() and source.exists() and file.samefile(source):
            raise ValueError(f"{file} is the model itself; choose another {flag}")
