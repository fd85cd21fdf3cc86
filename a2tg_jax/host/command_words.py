"""Arguments of a command line, quoted for a shell."""

import shlex
from pathlib import Path


def as_argument(path: Path) -> str:
    """Return a path quoted for a shell, relative to the current folder if it is inside."""
    here = Path.cwd()
    return shlex.quote(str(path.relative_to(here) if path.is_relative_to(here) else path))
