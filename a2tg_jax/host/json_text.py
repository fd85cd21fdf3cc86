"""Untrusted JSON and TOML: size and depth are checked before parsing, and numbers must be finite."""

import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

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
MOST_BRACKETS = 2_000_000
"""Largest number of lists and objects: an empty one takes 64 bytes of memory for 3 of text."""

TOML_STRING = re.compile(
    rb'"""(?:[^\\]|\\(?:.|\Z))*?(?:"""|\Z)'
    rb"|'''.*?(?:'''|\Z)"
    rb'|"[^"\\\n]*(?:\\[^\n][^"\\\n]*)*"?'
    rb"|'[^'\n]*'?|#[^\n]*",
    re.DOTALL,
)
TOML_WORD = re.compile(rb"[\[\]{}=,\n]")
STEPS = np.zeros(256, np.int8)
STEPS[[*b"[{"]], STEPS[[*b"]}"]] = 1, -1
"""Change of depth by each byte."""


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
    _check_brackets(_outside_strings(data))

    def constant(name: str) -> float:
        if not allow_nan:
            raise ValueError(f"{name} is not JSON")
        return float(name)

    def number(digits: str) -> float:
        value = float(digits)
        return value if math.isfinite(value) else constant(digits)

    text = data.decode("utf-8-sig", "surrogatepass")
    return json.loads(text, parse_constant=constant, parse_int=_integer, parse_float=number)


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
    outside = TOML_STRING.sub(b"", data)
    _check_brackets(np.frombuffer(outside, np.uint8))
    if max(word.count(b".") for word in TOML_WORD.split(outside)) >= DEEPEST:
        raise ValueError(f"a key is nested more than {DEEPEST} deep")
    table = tomllib.loads(data.decode("utf-8"))
    _check_depth(table)
    return table


def _integer(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits is too large")
    return int(digits)


def _check_size(data: bytes, most: int) -> None:
    if len(data) > most:
        raise ValueError(f"it has {len(data):,} bytes; {most:,} are the most that is read")


def _outside_strings(data: bytes) -> np.ndarray:
    """Return the bytes of a JSON text outside its strings, brackets included."""
    letters = np.frombuffer(data.replace(b"\\\\", b"").replace(b'\\"', b""), np.uint8)
    num_quotes = np.cumsum(letters == ord('"'), dtype=np.uint8)  # Wraps, which keeps it even or odd.
    outside: np.ndarray = letters[num_quotes % 2 == 0]
    return outside


def _check_brackets(outside: np.ndarray) -> None:
    """Raise ValueError if there are too many brackets, or more than `DEEPEST` nested ones.

    The parser refuses unmatched ones.
    """
    steps = STEPS[outside]
    steps = steps[steps != 0]
    if len(steps) > MOST_BRACKETS:
        raise ValueError(f"it has {len(steps):,} brackets; {MOST_BRACKETS:,} are the most that is read")
    if np.cumsum(steps, dtype=np.int32).max(initial=0) > DEEPEST:
        raise ValueError(f"its brackets are nested too deeply, more than {DEEPEST} deep")


def _check_depth(value: object) -> None:
    """Raise ValueError if lists and mappings, by brackets or dots, are nested more than `DEEPEST` deep."""
    level = [value]
    for _ in range(DEEPEST):
        level = [inner for held in level for inner in _held(held)]
        if not level:
            return
    raise ValueError(f"its brackets are nested more than {DEEPEST} deep")


def _held(value: Any) -> Any:
    """Return the lists and objects in one."""
    values = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return (inner for inner in values if isinstance(inner, dict | list))
