"""JSON of strangers: what is read is finite, of bounded depth, and small enough to be a number."""

import json
import math
from typing import Any

MOST_BYTES = 1 << 28
MOST_DIGITS = 25
"""Of an integer; 2^64 has 20."""
DEEPEST = 64
"""Lists and objects within each other."""


def parse_json(text: str | bytes, *, allow_nan: bool = False) -> Any:
    """The value of a JSON text.

    Args:
      text: the text, or UTF-8.
      allow_nan: take NaN and infinities, which are not JSON but are written by Python's own library, and floats that
        are too large to be finite.

    Raises:
      ValueError: saying in a few words what is wrong.
    """
    if len(text) > MOST_BYTES:
        raise ValueError(f"it has {len(text)} bytes; {MOST_BYTES} are the most that is read")

    def constant(name: str) -> float:
        if not allow_nan:
            raise ValueError(f"{name} is not JSON")
        return float(name)

    def number(digits: str) -> float:
        value = float(digits)
        return value if math.isfinite(value) else constant(digits)

    try:
        value = json.loads(text, parse_constant=constant, parse_int=_integer, parse_float=number)
    except RecursionError:
        raise ValueError("its brackets are nested too deeply") from None
    check_depth(value)
    return value


def _integer(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits is too large")
    return int(digits)


def check_depth(value: Any) -> None:
    """Raises ValueError if lists and mappings are nested more than `DEEPEST` deep.

    Goes level by level, as what is nested too deeply cannot be walked by recursion.
    """
    level = [value]
    for _ in range(DEEPEST):
        level = [inner for held in level for inner in _held(held)]
        if not level:
            return
    raise ValueError(f"its brackets are nested more than {DEEPEST} deep")


def _held(value: Any) -> Any:
    """The lists and objects in one."""
    values = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return (inner for inner in values if isinstance(inner, dict | list))
