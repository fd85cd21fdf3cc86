"""Short texts for messages."""

import difflib
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import Any

SLACK = 10
"""Number of letters to read for each printed letter, because runs of spaces print as one."""


def shortened(value: Any, most: int = 80) -> str:
    """Return a value as errors print it: one line of bounded length, without quotes around texts or terminal control
    characters."""
    text = (value if isinstance(value, str) else repr(value))[: SLACK * most]  # Words of it all would take memory.
    text = " ".join(text.split())
    text = "".join(letter if letter.isprintable() else "\ufffd" for letter in text[: most + 1])
    return text if len(text) <= most else f"{text[: most - 1]}…"


def as_argument(path: Path) -> str:
    """Return a path as a shell takes it, relative to the current folder if it lies there."""
    here = Path.cwd()
    return shlex.quote(str(path.relative_to(here) if path.is_relative_to(here) else path))


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean KNOWN?" for the known name nearest to a misspelt one; empty if none is near."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]}?" if close else ""
