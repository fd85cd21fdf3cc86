"""Untrusted JSON and TOML: size is checked before parsing, depth after it, and numbers must be finite."""

import contextlib
import json
import math
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax.base.regular_files import read_regular
from a2tg_jax.base.text import shortened

LARGEST_FLOAT = float(np.finfo(np.float32).max)
MOST_BYTES = 1 << 25
"""Largest JSON text; a scene of 10,000 photographs has a third of that."""
MOST_TOML_BYTES = 1 << 18
"""Largest TOML text; the record of a run has 3 kB."""
MOST_DIGITS = 25
"""Largest number of digits of an integer; 2^64 has 20."""
DEEPEST = 64
"""Largest depth of nested lists and objects, and number of names in one key."""
MOST_BRACKETS = 500_000
"""Largest number of lists and objects: each takes up to 232 bytes of memory for 6 of text. A scene of 10,000
photographs has about 60,000."""


def parse_json(text: str | bytes, *, allow_nan: bool = False) -> Any:
    """Return the value of a JSON text.

    Args:
      text: the text, or its bytes in UTF-8, UTF-16 or UTF-32.
      allow_nan: whether to accept floats that overflow, NaN and infinities, which are not JSON but which Python's own
        library writes.

    Raises:
      ValueError: with a short reason.
    """
    data = text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text
    _check_size(data, MOST_BYTES)
    # Brackets in texts count as well: a bound that needs no parsing.
    num_brackets = data.count(b"[") + data.count(b"{")
    if num_brackets > MOST_BRACKETS:
        raise ValueError(f"it has {num_brackets:,} brackets; the limit is {MOST_BRACKETS:,}")

    def number(digits: str) -> float:
        value = float(digits)
        if not (allow_nan or math.isfinite(value)):
            raise ValueError(f"{digits} is not JSON")
        return value

    def integer(digits: str) -> int:
        # int takes quadratic time, and has its own error from 4,300 digits on.
        if len(digits) > MOST_DIGITS:
            raise ValueError(f"a number of {len(digits)} digits is too large")
        return int(digits)

    # Of bytes, json detects the encoding, and skips a byte order mark.
    return _parsed(lambda: json.loads(data, parse_constant=number, parse_int=integer, parse_float=number))


def read_json(file: Path, *, allow_nan: bool = True) -> Any:
    """Return the value in a JSON file.

    Args:
      file: the file.
      allow_nan: as in `parse_json`. Our own files have infinities: the PSNR of equal images.

    Raises:
      OSError: if the file cannot be read.
      ValueError: naming the file, if it is too large, or not JSON.
    """
    data = read_regular(file, MOST_BYTES)
    try:
        return parse_json(data, allow_nan=allow_nan)
    except ValueError as error:
        raise ValueError(f"{file}: cannot be read as JSON ({error})") from None


def read_object(file: Path) -> dict[str, Any]:
    """Return the object in a JSON file. Raises as `read_json`, and ValueError if it holds another value."""
    values = read_json(file, allow_nan=False)
    if not isinstance(values, dict):
        raise ValueError(f"{file}: must hold an object; got {shortened(values)}")
    return values


def lenient_number(value: object, name: str) -> float:
    """Return a number in a file, which some programs write as a text, such as "105.6". Raises ValueError, with its
    name, for any other value."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            number = float(value)
            if math.isfinite(number):
                return number
    raise ValueError(f"{name} must be a number; got {shortened(repr(value))}")


def parse_toml(data: bytes) -> dict[str, Any]:
    """Return the table of a TOML text.

    Args:
      data: UTF-8.

    Raises:
      ValueError: with a short reason.
    """
    _check_size(data, MOST_TOML_BYTES)
    # The parser takes quadratic time for a key of many names.
    if max(word.count(b".") for word in re.split(rb"[\[\]{}=,\n]", data)) >= DEEPEST:
        raise ValueError(f"a key is nested more than {DEEPEST} deep")
    return _parsed(lambda: tomllib.loads(data.decode("utf-8")))


def read_toml(file: Path) -> dict[str, Any]:
    """Return the table in a TOML file. Raises as `read_regular`, and ValueError, naming the file, if it is not TOML."""
    try:
        return parse_toml(read_regular(file, MOST_TOML_BYTES))
    except ValueError as error:
        raise ValueError(f"{file}: is not valid TOML: {shortened(str(error), 200)}") from error


def _check_size(data: bytes, most: int) -> None:
    if len(data) > most:
        raise ValueError(f"it has {len(data):,} bytes; the limit is {most:,}")


def _parsed(parse: Callable[[], Any]) -> Any:
    """Return a parsed value. Raises ValueError if its lists and mappings are nested more than `DEEPEST` deep."""
    with contextlib.suppress(RecursionError):  # json and tomllib recurse.
        value = parse()
        # Level by level, because a recursive walk might overflow the stack itself.
        level = [value] if isinstance(value, dict | list) else []
        for _ in range(DEEPEST):
            deeper: list[Any] = []
            for container in level:
                deeper += container.values() if isinstance(container, dict) else container
            level = [inner for inner in deeper if isinstance(inner, dict | list)]
            if not level:
                return value
    raise ValueError(f"its brackets are nested more than {DEEPEST} deep")


def number_array(values: object, count: int | None, name: str, *, null: float | None = None) -> np.ndarray:
    """Return a list of numbers in JSON as float64 [n].

    Args:
      values: the list.
      count: its length; None: at least 1.
      name: what errors call it.
      null: the number that null stands for; None: null is an error.

    Raises:
      ValueError: if it is anything else, or a number is beyond the range of float32.
    """

    def is_number(value: object) -> bool:
        if value is None:
            return null is not None
        # Not isinstance, because JSON's true is an int in Python.
        return type(value) in (int, float) and abs(value) <= LARGEST_FLOAT  # type: ignore[arg-type]

    if (
        not isinstance(values, list)
        or count not in (None, len(values))
        or not values
        or not all(map(is_number, values))
    ):
        wanted = f"{count or 'a list of'} finite numbers{'' if null is None else ' or null'}"
        raise ValueError(f"{name} must be {wanted}; got {shortened(values)}")
    return np.array([null if value is None else value for value in values], np.float64)


def number_rows(values: object, width: int, name: str) -> np.ndarray:
    """Return lists of numbers in JSON, or of texts of numbers, as float64 [N, width].

    Raises:
      ValueError: with the name, if they are anything else, or a number is not finite.
    """
    try:
        rows = np.asarray(values, np.float64)
    except (TypeError, ValueError, OverflowError):
        rows = np.empty(0)
    if rows.ndim != 2 or rows.shape[1] != width or not np.isfinite(rows).all():
        raise ValueError(f"{name} must be rows of {width} finite numbers; got {shortened(values)}")
    return rows
