"""Untrusted JSON and TOML: sizes are checked before parsing, depth after it, and numbers must be finite."""

import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any

from a2tg_jax.host.regular_files import read_regular
from a2tg_jax.host.text import shortened

MOST_BYTES = 1 << 25
"""Largest JSON text; a scene of 10,000 photographs has a third of that."""
MOST_TOML_BYTES = 1 << 18
"""Largest TOML text; the record of a run has 3 kB."""
MOST_DIGITS = 25
"""Largest number of digits of an integer; 2^64 has 20."""
DEEPEST = 64
"""Largest number of lists and objects within each other, and of names in one key."""
MOST_BRACKETS = 500_000
"""Largest number of lists and objects: one takes up to 232 bytes of memory for 6 of text. A scene of 10,000
photographs has about 60,000."""


def parse_json(text: str | bytes, *, allow_nan: bool = False) -> Any:
    """Return the value of a JSON text.

    Args:
      text: the text, or UTF-8.
      allow_nan: accept NaN and infinities, which Python's own library writes although they are not JSON, and floats
        that overflow.

    Raises:
      ValueError: saying in a few words what is wrong.
    """
    data = text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text
    _check_size(data, MOST_BYTES)
    if (found := data.count(b"[") + data.count(b"{")) > MOST_BRACKETS:
        raise ValueError(f"it has {found:,} brackets; {MOST_BRACKETS:,} are the most that is read")

    def constant(name: str) -> float:
        if not allow_nan:
            raise ValueError(f"{name} is not JSON")
        return float(name)

    def number(digits: str) -> float:
        value = float(digits)
        return value if math.isfinite(value) else constant(digits)

    text = data.decode("utf-8-sig", "surrogatepass")
    try:
        value = json.loads(text, parse_constant=constant, parse_int=_integer, parse_float=number)
    except RecursionError:
        value = _too_deep()
    _check_depth(value)
    return value


def read_object(file: Path) -> dict[str, Any]:
    """Return the object in a JSON file.

    Raises:
      OSError: if the file cannot be read.
      ValueError: naming the file, if it is no such JSON.
    """
    try:
        values = parse_json(read_regular(file, MOST_BYTES))
    except ValueError as error:
        raise ValueError(f"{file}: cannot be read as JSON ({error})") from None
    if not isinstance(values, dict):
        raise ValueError(f"{file}: must hold an object; got {shortened(values)}")
    return values


def parse_toml(data: bytes) -> dict[str, Any]:
    """Return the table of a TOML text.

    Args:
      data: UTF-8.

    Raises:
      ValueError: saying in a few words what is wrong.
    """
    _check_size(data, MOST_TOML_BYTES)
    # The parser takes quadratic time for a key of many names.
    if max(word.count(b".") for word in re.split(rb"[\[\]{}=,\n]", data)) >= DEEPEST:
        raise ValueError(f"a key is nested more than {DEEPEST} deep")
    try:
        table = tomllib.loads(data.decode("utf-8"))
    except RecursionError:
        table = _too_deep()
    _check_depth(table)
    return table


def _integer(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits is too large")
    return int(digits)


def _check_size(data: bytes, most: int) -> None:
    if len(data) > most:
        raise ValueError(f"it has {len(data):,} bytes; {most:,} are the most that is read")


def _check_depth(value: object) -> None:
    """Raise ValueError if lists and mappings are nested more than `DEEPEST` deep."""
    level = [value]
    for _ in range(DEEPEST):
        lists = [list(held.values()) if isinstance(held, dict) else held for held in level]
        level = [inner for held in lists if isinstance(held, list) for inner in held if isinstance(inner, dict | list)]
        if not level:
            return
    _too_deep()


def _too_deep() -> Any:
    raise ValueError(f"its brackets are nested more than {DEEPEST} deep") from None
