"""Short texts for messages."""

import difflib
from collections.abc import Iterable
from typing import Any

SLACK = 10
"""Multiple of the told letters that is looked at, since runs of spaces are told as one."""


def shortened(value: Any, most: int = 80) -> str:
    """Return a value as an error tells it, on one line of bounded length; texts without quotes, nor what steers a
    terminal."""
    text = (value if isinstance(value, str) else repr(value))[: SLACK * most]  # Words of it all would take memory.
    text = " ".join(text.split())
    text = "".join(letter if letter.isprintable() else "\ufffd" for letter in text[: most + 1])
    return text if len(text) <= most else f"{text[: most - 1]}…"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean KNOWN?" for the known name nearest to a misspelt one; empty if none is near."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]}?" if close else ""
