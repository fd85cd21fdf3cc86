"""Dataclasses whose constructor suggests a field for a misspelt one."""

import dataclasses
import inspect
from typing import Any, Self

from a2tg_jax.base.text import counted, did_you_mean


class FieldError(TypeError, ValueError):
    """A constructor was called with a field that its class does not have: TypeError as for any function of Python, and
    ValueError as for all arguments of this library."""


class NamedFields:
    """Base class of dataclasses of this library, and of subclasses that users define."""

    # Not a wrapper of `__init__`, which each dataclass makes itself after its base could change it.
    def __new__(cls, /, *args: object, **values: object) -> Self:
        """Check the names of the fields.

        Raises:
          FieldError: naming the field, and the nearest one that exists.
        """
        if dataclasses.is_dataclass(cls):
            _check_call(cls, args, values)
        return object.__new__(cls)


def _check_call(cls: Any, args: tuple[object, ...], values: dict[str, object]) -> None:
    fields = [field for field in dataclasses.fields(cls) if field.init]
    names = [field.name for field in fields]
    unknown = [name for name in values if name not in names]
    num_by_position = sum(not field.kw_only for field in fields)
    if not unknown and len(args) <= num_by_position:
        return
    _, *parameters = inspect.signature(cls.__init__).parameters
    if set(parameters) != set(names):
        return  # The class has a custom constructor.
    if unknown and unknown[0] in inspect.get_annotations(cls):
        raise FieldError(
            f"{cls.__name__} does not take {unknown[0]}: decorate the class with "
            "@dataclasses.dataclass(frozen=True, kw_only=True), or a pytree with @a2tg_jax.pytree"
        )
    if unknown:
        near = did_you_mean(unknown[0], names) or f": it has {', '.join(names)}"
        raise FieldError(f"{cls.__name__} has no field {unknown[0]!r}{near}")
    if len(args) > num_by_position:
        preset = f", and presets as {cls.__name__}.preset({args[0]!r})" if hasattr(cls, "preset") else ""
        taken = f"up to {counted(num_by_position, 'value')}" if num_by_position else "no values"
        raise FieldError(
            f"{cls.__name__} takes {taken} by position; got {len(args)}: give fields by name, such as "
            f"{names[num_by_position] if num_by_position < len(names) else names[0]}=…{preset}"
        )
