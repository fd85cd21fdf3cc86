"""Short texts for messages."""

import difflib
from collections.abc import Iterable, Sequence

PROGRAM = "a2tg-jax"
"""Name of this program in files that it writes, as in the tag Software of pictures."""


def shortened(value: object, most: int = 80) -> str:
    """Return a value as errors print it: one line of bounded length, without quotes around texts or terminal control
    characters."""
    # Runs of spaces print as one, so ten letters are read for each printed one; splitting a huge text takes memory.
    text = " ".join((value if isinstance(value, str) else repr(value))[: 10 * most].split())
    text = "".join(letter if letter.isprintable() else "\ufffd" for letter in text[: most + 1])
    return text if len(text) <= most else f"{text[: most - 1]}…"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean KNOWN?" for the known name closest to a misspelt one, or several that are as close; empty
    if none is close."""
    likeness = {}
    for close in sorted(difflib.get_close_matches(name, known, n=3)):
        likeness[close] = difflib.SequenceMatcher(None, close, name).ratio()
    closest = [close for close, ratio in likeness.items() if ratio == max(likeness.values())]
    return f"; did you mean {' or '.join(closest)}?" if closest else ""


def counted(num: int, noun: str) -> str:
    """Return a number and its noun, such as "1 view" and "8,412 points"."""
    return f"{num:,} {noun}{'' if num == 1 else 's'}"


def first_names(names: Sequence[str], most: int = 5) -> str:
    """Return the first few of some names, and an ellipsis if there are more."""
    return ", ".join([*names[:most], *["…"] * (len(names) > most)])


def in_bytes(num: float) -> str:
    """Return a number of bytes with three digits in bytes, kB, MB or GB (10^9 bytes)."""
    if num < 999.5:  # 999.5 is printed as 1,000.
        return counted(round(num), "byte")
    size = float(num)
    for unit in ("kB", "MB"):
        size /= 1e3
        if size < 999.5:
            return f"{_three_digits(size)} {unit}"
    return f"{_three_digits(size / 1e3)} GB"


def _three_digits(number: float) -> str:
    # Numbers are rounded up to 10.0 from 9.995 on, and to 100 from 99.95 on.
    if number < 9.995:
        return f"{number:.2f}"
    if number < 99.95:
        return f"{number:.1f}"
    return f"{number:,.0f}"
