"""Command-line arguments parsed into a dataclass by tyro, which prints help and errors and ends in SystemExit."""

import dataclasses
import inspect
import os
import types
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from docstring_parser import parse_from_object
from tyro.conf import Positional, arg
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructTypeInfo,
)

from a2tg_jax.base.regular_files import expanded
from a2tg_jax.host.command_words import defaulting_to

Parsed = TypeVar("Parsed")


LastModel = Annotated[
    str | None,
    arg(help="Name of a run's model, as a2tg info prints it."),
    defaulting_to("the last model of the main system", "NAME"),
]
RunFolderPath = Annotated[Positional[Path], arg(metavar="RUN", help="Run folder.")]
RunOrFile = Annotated[
    Positional[Path],
    arg(
        metavar="RUN_OR_FILE",
        help="Run folder, model (*.npz), compact scene (*.a2tgz), or splats of other programs (*.ply, *.spz, ...).",
    ),
]
EditFile = Annotated[
    Path | None,
    arg(metavar="FILE", help="Edit (*.json) to apply to the model first, as a2tg view saves it: crop, vertical, ..."),
]
LpipsWeights = Annotated[
    Path | None,
    arg(metavar="FILE", help="Weights (.npz) for LPIPS with AlexNet or SqueezeNet; without them, LPIPS is left out."),
]


Rule = Callable[[StructTypeInfo], StructConstructorSpec | None]
"""Function that returns how tyro fills a class, or None for other classes."""


def parse(
    kind: type[Parsed],
    program: str,
    arguments: Sequence[str],
    default: Parsed | None = None,
    rule: Rule | None = None,
) -> Parsed:
    """Parse arguments into an instance of a dataclass.

    Args:
      kind: the dataclass.
      program: name of the command in the help.
      arguments: arguments without the command's name.
      default: values of the options that are not given; None: the dataclass's own.
      rule: rule for a class in it that knows no command line.

    Raises:
      SystemExit: after help (code 0) or an error (code 2), which tyro has printed.
      ValueError: if a path is a URL.
    """
    if {"-h", "--help"} & set(arguments):  # It takes a second.
        _fill_help(default or kind)
    rules = ConstructorRegistry()
    rules.primitive_rule(_optional_rule)
    if rule is not None:
        rules.struct_rule(rule)
    about = inspect.getdoc(kind) or ""
    given: dict[str, Any] = {}
    if default is not None:
        about = about.split("\n")[0]  # The other lines are the short help.
        given["default"] = default
    command: Parsed = tyro.cli(kind, prog=program, args=arguments, description=about, registry=rules, **given)
    for word in arguments:
        # Raises ValueError for a URL, which would name a folder of this machine.
        expanded(word.partition("=")[2] if word.startswith("--") else word)
    return command


def at_home(word: str) -> str:
    """Return an argument with the home folder for a leading ~, also in --out=~/x, where shells leave it."""
    flag, equals, text = word.partition("=") if word.startswith("--") else ("", "", word)
    return flag + equals + os.path.expanduser(text)


def _fill_help(value: Any) -> None:
    """Make each option's help one paragraph, in a dataclass and those in its fields; tyro would keep the source's line
    breaks."""
    kind = value if isinstance(value, type) else type(value)
    # Bases first, because texts of subclasses replace theirs; the last one is object.
    texts = {}
    for base in kind.__mro__[-2::-1]:
        for param in parse_from_object(base).params:
            if param.description:
                texts[param.arg_name] = " ".join(param.description.split())
    for field in dataclasses.fields(kind):
        if field.name in texts:
            field.metadata = types.MappingProxyType({**field.metadata, "help": texts[field.name]})
        inner = getattr(value, field.name, None)
        if dataclasses.is_dataclass(inner) and not isinstance(inner, type):
            _fill_help(inner)


def _optional_rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Return the rule for a value that may be None: the rule for the value, which also takes the word None.

    tyro's own rule prints {None}|FLOAT in the help.
    """
    kinds = typing.get_args(info.type)
    if typing.get_origin(info.type) not in (typing.Union, types.UnionType) or types.NoneType not in kinds:
        return None
    rest: Any = typing.Union.__getitem__(tuple(kind for kind in kinds if kind is not types.NoneType))
    plain = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(rest, info.markers))
    if not isinstance(plain, PrimitiveConstructorSpec):
        return None
    return dataclasses.replace(
        plain,
        metavar="SIZE" if {float, str} <= set(kinds) else plain.metavar,
        instance_from_str=lambda words: None if words == ["None"] else plain.instance_from_str(words),
        is_instance=lambda value: value is None or plain.is_instance(value),
        str_from_instance=lambda value: ["None"] if value is None else plain.str_from_instance(value),
        choices=None if plain.choices is None else (*plain.choices, "None"),
    )
