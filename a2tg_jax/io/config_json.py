"""Configuration dataclasses as JSON-able dictionaries, and back."""

import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from a2tg_jax.core.checks import check_kind
from a2tg_jax.host.text import did_you_mean, shortened

ConfigT = TypeVar("ConfigT")
LARGEST_INTEGER = 2**64
NONE = "None"
"""Text for None in formats that lack it, such as TOML."""


def config_to_dict(config: Any) -> dict[str, Any]:
    """Return a dataclass of numbers, texts, tuples and dataclasses as nested dictionaries, with lists for tuples and
    arrays."""
    return {field.name: _to_json(getattr(config, field.name)) for field in dataclasses.fields(config)}


def config_from_dict(
    kind: type[ConfigT],
    data: Mapping[str, Any],
    where: str = "config",
    *,
    given: Mapping[str, Any] | None = None,
    is_written: bool = True,
) -> ConfigT:
    """Return the dataclass `kind` that `config_to_dict` was given.

    Args:
      kind: the dataclass.
      data: an entry per field. A field that has a default may be missing, as those are that an older version lacked.
      where: what the errors call this place, such as the name of the file.
      given: values of fields that are not among the data.
      is_written: whether this program wrote the data, so that a missing field means another version.

    Raises:
      ValueError: if a field is missing or unknown, or has a value of another type; the field is named.
    """
    if not isinstance(data, Mapping):
        raise ValueError(f"{where} must hold the fields of {kind.__name__}; got {shortened(repr(data))}")
    hints = typing.get_type_hints(kind)
    given = given or {}
    names = [field.name for field in dataclasses.fields(kind) if field.name not in given]  # type: ignore[arg-type]
    for name in data:
        if name not in names:
            raise ValueError(f"{_within(where, shortened(name))} is an unknown key{_instead(name, names)}")
    optional = {field.name for field in dataclasses.fields(kind) if has_default(field)}  # type: ignore[arg-type]
    for name in names:
        if name not in data and name not in optional:
            raise ValueError(f"{_within(where, name)} is missing{'; another version wrote it' if is_written else ''}")
    values = {name: _from_json(hints[name], data[name], _within(where, name)) for name in names if name in data}
    return kind(**values, **given)


def changed_config(config: ConfigT, changes: Mapping[str, Any], where: str) -> ConfigT:
    """Return a dataclass with some fields changed, those of nested dataclasses by nested dictionaries.

    Raises:
      ValueError: naming the field, if it is unknown or of another type.
    """
    return config_from_dict(type(config), merged(config_to_dict(config), _plain(changes)), where)


def check_config(config: Any, prefix: str = "") -> None:
    """Raise ValueError, naming the field, if a group, number, text or choice of a dataclass is of another type.

    Fields of other types are not looked at, nor dataclasses whose annotations cannot be resolved, such as those of a
    class within a function.
    """
    try:
        hints = typing.get_type_hints(type(config))
    except NameError:
        return
    for field in dataclasses.fields(config):
        name, hint, value = prefix + field.name, hints[field.name], getattr(config, field.name)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            given = ", ".join(f"{key}={item!r}" for key, item in value.items()) if isinstance(value, Mapping) else "…"
            check_kind(name, value, hint, f"say {hint.__name__}({shortened(given)})")
            check_config(value, f"{name}.")
        elif _is_plain(hint):
            _from_json(hint, _to_json(value), name)


def _is_plain(hint: object) -> bool:
    """Return whether a type is one of numbers, texts and choices, None, or a union or tuple of them."""
    if typing.get_origin(hint) is typing.Literal or hint is ...:
        return True
    parts = typing.get_args(hint)
    return all(map(_is_plain, parts)) if parts else hint in (int, float, bool, str, type(None))


def _plain(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return changes with the values in nested dictionaries as JSON has them."""
    return {name: _plain(value) if isinstance(value, Mapping) else _to_json(value) for name, value in changes.items()}


def merged(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested options with some of them changed."""
    result = dict(values)
    for name, change in changes.items():
        is_group = isinstance(change, Mapping) and isinstance(values.get(name), Mapping)
        result[name] = merged(values[name], change) if is_group else change
    return result


def has_default(field: dataclasses.Field[Any]) -> bool:
    """Return whether a field of a dataclass need not be given."""
    return field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING


def _within(where: str, name: str) -> str:
    """Return the name of a field in errors: where.name, or "FILE: name" if the place is "FILE:"."""
    return f"{where} {name}" if where.endswith(":") else f"{where}.{name}"


def _instead(name: str, names: list[str]) -> str:
    group, _, option = name.partition(".")
    if option and group in names:
        return f"; say {group}={{{option!r}: …}}"
    return did_you_mean(name, names) or f"; it has {', '.join(names)}"


def flatten_config(config: Any, prefix: str = "") -> dict[str, Any]:
    """Return the leaves of a configuration by dotted name, as the command line calls them: {"texture.cap": 4, ...}."""
    leaves: dict[str, Any] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        name = prefix + field.name
        leaves |= flatten_config(value, f"{name}.") if dataclasses.is_dataclass(value) else {name: value}
    return leaves


def _to_json(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return config_to_dict(value)
    if isinstance(value, tuple):
        return [_to_json(item) for item in value]
    return value.tolist() if hasattr(value, "tolist") else value


def _from_json(hint: Any, value: Any, where: str) -> Any:
    """Return `value` as the type that the annotation asks for; what a dict holds is not looked at."""
    if dataclasses.is_dataclass(hint):
        return config_from_dict(typing.cast(type, hint), value, where)
    is_union = isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union
    alternatives = typing.get_args(hint) if is_union else (hint,)
    if value == NONE and type(None) in alternatives and str not in alternatives:
        return None
    for alternative in alternatives:
        if _fits(alternative, value):
            return _converted(alternative, value)
    raise ValueError(f"{where} must be {_told(hint)}; got {shortened(repr(value))}")


def _told(hint: Any) -> str:
    """Return a type as a user reads it; a tuple is a list, as files have it."""
    origin, inner = typing.get_origin(hint), [item for item in typing.get_args(hint) if item is not ...]
    if origin is typing.Literal:
        return f"one of {', '.join(map(str, inner))}"
    if origin in (dict, Mapping):
        return "dict"
    if origin is tuple:
        same = len(set(inner)) == 1 and len(inner) > 1
        return f"list of {len(inner)} {_told(inner[0])}" if same else f"list of {', '.join(map(_told, inner))}"
    if inner:
        return " | ".join(map(_told, inner))
    return "None" if hint is type(None) else hint.__name__


def _fits(hint: Any, value: Any) -> bool:
    """Return whether a JSON value is of a plain type; an integer is a good float, a truth value is not a number."""
    origin = typing.get_origin(hint)
    if origin is typing.Literal:
        return value in typing.get_args(hint)
    if origin in (dict, Mapping):
        return isinstance(value, dict)
    if origin is tuple:
        return isinstance(value, list) and all(map(_fits, _item_hints(hint, value), value))
    if isinstance(value, bool):
        return hint is bool
    if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
        return False
    return isinstance(value, (int, float) if hint is float else hint)


def _converted(hint: Any, value: Any) -> Any:
    """Return a value that fits, as the type itself."""
    if typing.get_origin(hint) is tuple:
        return tuple(map(_converted, _item_hints(hint, value), value))
    return float(value) if hint is float else value


def _item_hints(hint: Any, value: list[Any]) -> tuple[Any, ...]:
    """Return the types of the items of a tuple; too few or too many match no list of that length."""
    first, *rest = typing.get_args(hint)
    if rest == [...]:
        return (first,) * len(value)
    return (first, *rest) if len(value) == 1 + len(rest) else (type(None),) * len(value)
