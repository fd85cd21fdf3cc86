"""Short texts for messages, and numbers of bytes as texts."""

import decimal
import difflib
import math
import re
from collections.abc import Iterable, Sequence

PROGRAM = "a2tg-jax"
"""Name of this program in files that it writes, as in the tag Software of pictures."""
MEGABYTE = 10**6
# As text, for Decimal.
MEGABYTES = {
    "": "1", "kb": "1e-3", "mb": "1", "gb": "1e3", "kib": "0.001024", "mib": "1.048576", "gib": "1073.741824",
}  # fmt: skip
"""Megabytes of each unit; a number without a unit is in megabytes."""


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


def megabytes_of(budget: float | str | None, name: str = "memory_budget") -> float | None:
    """Return a budget in MB (10^6 bytes), from "1.5MB", "800 kB", "2GB" or a number of MB; None stays None.

    Raises:
      ValueError: if it is none of these, or not positive.
    """
    if budget is None or budget == "None":
        return None
    match = re.fullmatch(r"\s*([0-9.]+(?:e[+-]?[0-9]+)?)\s*([a-z]*)\s*", str(budget).lower())
    try:
        number, unit = match.groups() if match else ("", "")
        # As floats, 33.3 kB would be 0.033299999999999996 MB, in messages as well.
        megabytes = float(decimal.Decimal(number) * decimal.Decimal(MEGABYTES[unit]))
    except (KeyError, decimal.DecimalException):
        raise ValueError(
            f"{name} must be a number of MB (10^6 bytes), or one with a unit, such as 1.5MB, 800kB or 2GB; "
            f"got {shortened(budget)}"
        ) from None
    if not 0 < megabytes < math.inf:
        raise ValueError(f"{name} must be positive and finite; got {shortened(budget)}")
    return megabytes


def bytes_of(megabytes: float) -> int:
    """Return the whole bytes of a budget in MB."""
    return round(megabytes * MEGABYTE)


def budget_in_bytes(budget: float | str | None, name: str) -> int | None:
    """Return the whole bytes of a budget; None stays None. Raises as `megabytes_of`."""
    megabytes = megabytes_of(budget, name)
    return None if megabytes is None else bytes_of(megabytes)


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
    # Numbers are rounded up to 100 from 99.95 on.
    return f"{number:#.3g}" if number < 99.95 else f"{number:,.0f}"
