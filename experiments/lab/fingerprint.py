"""Fingerprints of stages: texts in the keys of records, equal for systems that train a stage alike."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

import a2tg_jax as a2tg
from a2tg_jax.results.plan import common_options

PACKAGE = "a2tg_jax"
LATER_FIELDS = {"continues", "extent", "num_coarse"}
"""Fields that came after the first records, which keep their keys: at their default they are no part of a fingerprint.
"""
TILE_SIZE = 8
"""Tile size in all fingerprints, the one of the first records: it changes results only by rounding."""


def fingerprint(system: a2tg.System, index: int) -> str:
    """Return a text shared by two systems that train a stage alike from the same start, in any process.

    It tells classes and functions apart by module and name, and is another one for another version's options.

    Raises:
      ValueError: if a stage holds a function without such a name, or a value that nothing is known of.
    """
    system = dataclasses.replace(system, tile_size=TILE_SIZE)
    return repr((common_options(system), _described(system.stages()[index])))


def _described(value: Any) -> Any:
    """Return a value of a stage as numbers, texts and tuples, the same in every process."""
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [
            field
            for field in dataclasses.fields(value)
            if field.name not in LATER_FIELDS or getattr(value, field.name) != field.default
        ]
        return _name_of(type(value)), tuple((field.name, _described(getattr(value, field.name))) for field in fields)
    if isinstance(value, tuple | list):
        return _name_of(type(value)), *map(_described, value)
    if isinstance(value, Mapping):
        return tuple((_described(key), _described(value[key])) for key in value)
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return np.asarray(value).tolist()
    if isinstance(value, type) or callable(value):
        return _name_of(value)
    raise ValueError(f"a stage holds {value!r}, which has no name that another process could know it by")


def _name_of(value: Any) -> str:
    """Return the module and name of a class or function; the name alone for this package, whose modules may move."""
    name = getattr(value, "__qualname__", "<nameless>")
    if "<" in name and not isinstance(value, type):
        raise ValueError(f"a stage holds {value!r}: make it a function of a module, which has a name of its own")
    module = value.__module__
    return f"{PACKAGE if module.partition('.')[0] == PACKAGE else module}.{name}"
