"""Words for the command line: arguments quoted for a shell, and defaults in an option's help."""

import shlex
from pathlib import Path
from typing import Any


def as_argument(path: Path) -> str:
    """Return a path quoted for a shell, relative to the current folder if it is inside."""
    here = Path.cwd()
    return shlex.quote(str(path.relative_to(here) if path.is_relative_to(here) else path))


def defaulting_to(text: str, metavar: str | None = None) -> Any:
    """Return tyro's annotation of an option whose help describes its default in words, instead of None."""
    from tyro.conf import arg  # Models are read without it.

    return arg(help_behavior_hint=f"(default: {text})", metavar=metavar)
