"""Docstrings under the fields of a class, added to the docstring of the class for `help` and notebooks; and errors of
assignments to frozen dataclasses."""

import dataclasses
import inspect
import sys
import textwrap

from a2tg_jax.host.text import name_replace

_known: set[str] = set()


def list_fields() -> None:
    """Add the docstrings of fields to each class of this package imported so far, and name `dataclasses.replace` in the
    errors of its frozen dataclasses."""
    for name in {name for name in sys.modules if name.startswith("a2tg_jax.")} - _known:
        _known.add(name)
        if name.startswith("a2tg_jax.cli."):
            continue  # These fields are options, which the help lists.
        for found in list(vars(sys.modules[name]).values()):
            own = vars(found).get("__doc__") if isinstance(found, type) and found.__module__ == name else None
            if isinstance(own, str):
                found.__doc__ = _WithFields(own)
                if dataclasses.is_dataclass(found) and "__setattr__" in vars(found):
                    name_replace(found)


class _WithFields:
    """Docstring of a class that is completed when it is read, because reading the sources takes time."""

    def __init__(self, text: str):
        self._text = text
        self._whole: str | None = None

    def __get__(self, instance: object, owner: type) -> str:
        if self._whole is None:
            from docstring_parser import parse_from_object  # takes longer to import than this whole library

            self._whole = self._text  # The parser reads this docstring, too.
            bases = [base for base in reversed(owner.__mro__) if base.__module__.startswith("a2tg_jax.")]
            params = [param for base in bases for param in parse_from_object(base).params]
            # Bases come first: the text of a subclass replaces theirs.
            fields = {p.arg_name: inspect.cleandoc(p.description or "") for p in params if p.args[0] == "attribute"}
            # Names are indented by 2, further lines by 4.
            lines = [textwrap.indent(f"{name}: {text}", "    ")[2:] for name, text in fields.items()]
            self._whole = "\n".join([inspect.cleandoc(self._text), *(["", "Attributes:", *lines] if lines else [])])
        return self._whole
