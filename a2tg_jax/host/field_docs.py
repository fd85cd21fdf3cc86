"""Docstrings under the fields of classes, where `help` and notebooks find them: in the docstring of the class."""

import ast
import contextlib
import inspect
import itertools
import sys
import textwrap
from collections.abc import Iterator
from typing import Any

_known: set[str] = set()
_is_off = False


def tell_fields() -> None:
    """Have each class of this package that was imported so far list its fields in its docstring.

    The sources are read when a docstring is asked for.
    """
    for name in [name for name in sys.modules if name.startswith("a2tg_jax.") and name not in _known]:
        _known.add(name)
        for found in list(vars(sys.modules[name]).values()):
            own = vars(found).get("__doc__") if isinstance(found, type) and found.__module__ == name else None
            if isinstance(own, str):
                found.__doc__ = _WithFields(own)


@contextlib.contextmanager
def without_fields() -> Iterator[None]:
    """Leave the fields out of docstrings for the duration of the block, in which a command prints them as options."""
    global _is_off
    before, _is_off = _is_off, True
    try:
        yield
    finally:
        _is_off = before


class _WithFields:
    """Docstring of a class that is completed when it is read."""

    def __init__(self, text: str):
        self._text = text
        self._whole: str | None = None

    def __get__(self, instance: Any, owner: type) -> str:
        if _is_off:
            return self._text
        if self._whole is None:
            told: dict[str, str] = {}
            for base in reversed(owner.__mro__):
                told |= field_docs(base) if base.__module__.startswith("a2tg_jax.") else {}
            lines = [textwrap.indent(f"{name}: {text}", "    ")[2:] for name, text in told.items()]
            self._whole = "\n".join([inspect.cleandoc(self._text), *(["", "Attributes:", *lines] if lines else [])])
        return self._whole


def field_docs(kind: type) -> dict[str, str]:
    """Return the docstrings under the fields that a class itself declares, by name; none without its source."""
    try:
        body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0].body  # type: ignore[attr-defined]
    except (OSError, TypeError, SyntaxError):
        return {}
    return {
        field.target.id: inspect.cleandoc(text.value.value)
        for field, text in itertools.pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
        and isinstance(text.value.value, str)
    }
