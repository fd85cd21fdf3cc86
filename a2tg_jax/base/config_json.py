"""Configuration dataclasses as JSON-able dictionaries, and back."""

import contextlib
import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from a2tg_jax.base.checks import check_kind
from a2tg_jax.base.text import did_you_mean, shortened

ConfigT = TypeVar("ConfigT")
LARGEST_INTEGER = 2**64  # JSON's integers have no bound in Python; NumPy and JAX take 64 bits.
NONE = "None"
"""Text for None in formats that lack it, such as TOML."""


def config_to_dict(config: Any) -> dict[str, Any]:
    """Return a dataclass of numbers, texts, tuples and dataclasses as nested dictionaries, with lists for tuples and
    arrays."""
    return {field.name: _to_json(getattr(config, field.name)) for field in dataclasses.fields(config)}


def config_from_dict(
    kind: type[ConfigT], data: Mapping[str, object], where: str = "config", *, given: Mapping[str, object] | None = None
) -> ConfigT:
    """Return the dataclass `kind` that `config_to_dict` was given.

    Args:
      kind: the dataclass.
      data: an entry per field. A field that has a default may be missing.
      where: name of this place in errors, such as the name of the file.
      given: values of fields that `data` lacks.

    Raises:
      ValueError: if a field is missing or unknown, or has a value of another type; the field is named.
    """
    if not isinstance(data, Mapping):
        raise ValueError(f"{where} must hold the fields of {kind.__name__}; got {shortened(repr(data))}")
    # Annotations may be strings (PEP 563): `field.type` would not do.
    hints = typing.get_type_hints(kind)
    values = dict(given or {})
    fields = {field.name: field for field in dataclasses.fields(kind) if field.name not in values}  # type: ignore[arg-type]
    within = f"{where} " if where.endswith(":") else f"{where}."
    for name in data:
        if name not in fields:
            # Dotted names are the command line's; files nest tables.
            group, _, option = name.partition(".")
            instead = did_you_mean(name, fields) or f"; it has {', '.join(fields)}"
            if option and group in fields:
                instead = f"; use {group}={{{option!r}: …}}"
            raise ValueError(f"{within}{shortened(name)} is an unknown key{instead}")
    for name, field in fields.items():
        if name in data:
            values[name] = _from_json(hints[name], data[name], f"{within}{name}")
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise ValueError(f"{within}{name} is missing")
    return kind(**values)


def changed_config(config: ConfigT, changes: Mapping[str, object], where: str) -> ConfigT:
    """Return a dataclass with some fields changed, fields of nested dataclasses by nested dictionaries. ValueError,
    naming the field: it is unknown or of another type."""
    return config_from_dict(type(config), merged(config_to_dict(config), _to_json(changes)), where)


def check_config(config: Any, prefix: str = "") -> None:
    """Raise ValueError, naming the field, if a group, number, text or choice of a dataclass is of another type.

    Fields of other types are not checked, nor dataclasses with unresolvable annotations, such as local classes.
    """
    try:
        hints = typing.get_type_hints(type(config))
    except NameError:
        return
    for field in dataclasses.fields(config):
        name = prefix + field.name
        hint = hints[field.name]
        value = getattr(config, field.name)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            given = ", ".join(f"{key}={item!r}" for key, item in value.items()) if isinstance(value, Mapping) else "…"
            check_kind(name, value, hint, f"use {hint.__name__}({shortened(given)})")
            check_config(value, f"{name}.")
        # The round trip through JSON's types is the check; its result is not needed.
        elif _is_plain(hint):
            _from_json(hint, _to_json(value), name)


def merged(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested options with some of them changed."""
    result = dict(values)
    for name, change in changes.items():
        is_group = isinstance(change, Mapping) and isinstance(values.get(name), Mapping)
        result[name] = merged(values[name], change) if is_group else change
    return result


def flatten_config(config: Any, prefix: str = "") -> dict[str, Any]:
    """Return the leaves of a configuration by dotted name, as the command line calls them: {"texture.cap": 4, ...}."""
    leaves: dict[str, Any] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        name = prefix + field.name
        leaves |= flatten_config(value, f"{name}.") if dataclasses.is_dataclass(value) else {name: value}
    return leaves


def _is_plain(hint: object) -> bool:
    """Return whether a type is a number, text, choice or None, or a union or tuple of these."""
    if typing.get_origin(hint) is typing.Literal or hint is ...:
        return True
    parts = typing.get_args(hint)
    return all(map(_is_plain, parts)) if parts else hint in (int, float, bool, str, type(None))


def _to_json(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return config_to_dict(value)
    if isinstance(value, Mapping):
        return {name: _to_json(item) for name, item in value.items()}
    if isinstance(value, tuple):
        return [_to_json(item) for item in value]
    # JSON has no NumPy scalars and arrays.
    return value.tolist() if hasattr(value, "tolist") else value


def _from_json(hint: object, value: Any, where: str) -> Any:
    """Return `value` as the type of the annotation; the contents of a dict are not checked."""
    if dataclasses.is_dataclass(hint):
        return config_from_dict(typing.cast(type, hint), value, where)
    alternatives = typing.get_args(hint)
    # Where a field may hold text, "None" is text.
    if value == NONE and type(None) in alternatives and str not in alternatives:
        return None
    try:
        return _as(hint, value)
    except TypeError:
        raise ValueError(f"{where} must be {_type_name(hint)}; got {shortened(repr(value))}") from None


def _as(hint: Any, value: object) -> Any:
    """Return a JSON value as a plain type; an integer may be a float, a bool is no number. TypeError: its type is
    another."""
    origin = typing.get_origin(hint)
    inner = typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        for alternative in inner:
            with contextlib.suppress(TypeError):
                return _as(alternative, value)
    elif origin is typing.Literal:
        if value in inner:
            return value
    elif origin is tuple and isinstance(value, list):
        hints = inner[:1] * len(value) if inner[-1] is ... else inner
        if len(hints) == len(value):
            return tuple(map(_as, hints, value))
    # bool is a subclass of int: without this branch, true would pass for 1.
    elif isinstance(value, bool):
        if hint is bool:
            return value
    elif isinstance(value, int) and abs(value) > LARGEST_INTEGER:
        pass  # It would overflow as a float.
    elif hint is float and isinstance(value, int | float):
        return float(value)
    elif isinstance(value, dict if origin is Mapping else origin or hint):
        return value
    raise TypeError


def _type_name(hint: Any) -> str:
    """Return a type in words; tuples are lists, as in files."""
    origin = typing.get_origin(hint)
    inner = [item for item in typing.get_args(hint) if item is not ...]
    if origin is typing.Literal:
        return f"one of {', '.join(map(str, inner))}"
    if origin in (dict, Mapping):
        return "dict"
    names = list(map(_type_name, inner))
    if origin is tuple and len(names) > 1 and len(set(names)) == 1:
        return f"list of {len(names)} {names[0]}"
    if origin is tuple:
        return f"list of {', '.join(names)}"
    if names:
        return " | ".join(names)
    return "None" if hint is type(None) else hint.__name__
