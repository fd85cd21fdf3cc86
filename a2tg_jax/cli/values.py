"""Values of options on the command line: how help names them, and what is said of wrong ones."""

import types
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

WANTED: dict[type, tuple[str, str]] = {
    int: ("INT", "a whole number"),
    float: ("FLOAT", "a number"),
    Path: ("PATH", "a path"),
    str: ("TEXT", "a text"),
}
"""Name in the help, and in errors, of each type of a value, in the order in which they are tried."""
SIZE = "SIZE"
"""Name in the help of a number with or without a unit."""
NONE = "None"


def registry() -> ConstructorRegistry:
    """Return rules for numbers, and for values that may be None, in place of those of tyro."""
    rules = ConstructorRegistry()
    rules.primitive_rule(_value_rule)
    rules.primitive_rule(_numbers_rule)
    return rules


def _value_rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Return the rule for a number, and for None or a value of some types."""
    kinds, is_optional = _alternatives(info.type)
    tried = [kind for kind in WANTED if kind in kinds]
    if not tried or set(tried) != kinds or not (is_optional or info.type in (int, float)):
        return None

    def read(words: list[str]) -> Any:
        return None if is_optional and words[0] == NONE else _read(tried, words[0])

    metavar = SIZE if len(tried) > 1 else WANTED[tried[0]][0]
    return PrimitiveConstructorSpec(1, metavar, read, _is_of(tried, is_optional), lambda value: [str(value)])


def _numbers_rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Return the rule for None or any number of numbers."""
    kinds, is_optional = _alternatives(info.type)
    if not is_optional or kinds != {tuple[float, ...]}:
        return None

    def read(words: list[str]) -> Any:
        return None if words == [NONE] else tuple(_read([float], word) for word in words)

    def written(value: Any) -> list[str]:
        return [NONE] if value is None else [str(number) for number in value]

    return PrimitiveConstructorSpec("*", "[FLOAT ...]", read, _is_of([tuple], True), written)


def _alternatives(kind: Any) -> tuple[set[Any], bool]:
    """Return the types of a union without None, and whether None is one of them."""
    is_union = typing.get_origin(kind) in (typing.Union, types.UnionType)
    kinds = set(typing.get_args(kind)) if is_union else {kind}
    return kinds - {types.NoneType}, types.NoneType in kinds


def _read(kinds: Sequence[Callable[[str], Any]], word: str) -> Any:
    """Return a word as the first of some types that it can be.

    Raises:
      ValueError: if it is of none.
    """
    for kind in kinds:
        try:
            return kind(word)
        except ValueError:
            continue
    raise ValueError(f"wants {WANTED[kinds[-1]][1]}; got {word!r}")  # type: ignore[index]


def _is_of(kinds: Sequence[type], is_optional: bool) -> Callable[[Any], bool]:
    allowed = (*kinds, *((int,) if float in kinds else ()), *((types.NoneType,) if is_optional else ()))
    return lambda value: isinstance(value, allowed)
