"""Command-line arguments parsed into a dataclass by tyro, which prints help and errors and ends in SystemExit."""

import dataclasses
import functools
import inspect
import os
import types
import typing
import webbrowser
from collections.abc import Mapping, Sequence
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
    StructFieldSpec,
    StructTypeInfo,
)

from a2tg_jax.base.operating_system import has_display
from a2tg_jax.base.regular_files import expanded
from a2tg_jax.results.folder import open_run

Parsed = TypeVar("Parsed")


FLAGS: dict[type, Mapping[str, tuple[Any, ...]]] = {}
"""Annotations for tyro of the fields of classes outside the command line; modules of commands add them."""


SCENE_IS_MISSING = "SCENE is missing: a folder, or built in, synthetic or cells: a2tg train SCENE --out RUN"
RESUMES_OR_REPLACES = "--resume continues a run and --overwrite replaces it: give one of them"
print_now = functools.partial(print, flush=True)
"""Print a line that is read while the program works."""


def defaulting_to(text: str, metavar: str | None = None) -> Any:
    """Return the annotation of an option whose help describes its default in words, instead of None."""
    return arg(help_behavior_hint=f"(default: {text})", metavar=metavar)


LastModel = Annotated[
    str | None,
    arg(help="Name of a run's model, as a2tg info prints it; of an unfinished stage, its newest checkpoint."),
    defaulting_to("the last finished model of the main system, or else the newest checkpoint", "NAME"),
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


def parse(kind: type[Parsed], program: str, arguments: Sequence[str], default: Parsed | None = None) -> Parsed:
    """Parse arguments into an instance of a dataclass.

    Args:
      kind: the dataclass.
      program: name of the command in the help.
      arguments: arguments without the command's name.
      default: values of the options that are not given; None: the dataclass's own.

    Raises:
      SystemExit: after help (code 0) or an error (code 2), which tyro has printed.
      ValueError: if a path is a URL.
    """
    rules = ConstructorRegistry()
    rules.primitive_rule(_optional_rule)
    rules.struct_rule(_dataclass_rule)
    about = inspect.getdoc(kind) or ""
    given: dict[str, Any] = {} if default is None else {"default": default}
    command: Parsed = tyro.cli(kind, prog=program, args=arguments, description=about, registry=rules, **given)
    values: list[Any] = []
    for value in vars(command).values():
        values += value if isinstance(value, tuple) else [value]
    for word in arguments:
        text = word.partition("=")[2] if word.startswith("--") else word
        if Path(text) in values:
            expanded(text)  # Raises ValueError for a URL, which would name a folder of this machine.
    return command


@dataclasses.dataclass(frozen=True)
class DecidingOptions:
    """Options that determine the defaults of the others."""

    config: str = ""
    system: str = ""
    preset: str = ""
    out: str = ""
    coordinator: str = ""
    resume: bool = False
    overwrite: bool = False

    @property
    def takes_run(self) -> bool:
        """Whether the defaults are the options of the run to resume."""
        return bool(self.out) and self.resume


def deciding_options(arguments: Sequence[str]) -> DecidingOptions:
    """Return the options of `a2tg train` that determine the defaults of the others.

    Raises:
      ValueError, FileNotFoundError: if there are no arguments, a path is a URL, or there is no run to resume.
    """
    if not arguments:
        raise ValueError(SCENE_IS_MISSING)
    given, _ = tyro.cli(DecidingOptions, prog="a2tg train", args=arguments, return_unknown_args=True, add_help=False)
    for path in (given.config, given.out):
        expanded(path)  # Raises ValueError for a URL.
    if given.resume and given.overwrite:
        raise ValueError(RESUMES_OR_REPLACES)
    if given.resume and given.config:
        raise ValueError("--resume takes every option from the run folder: leave out --config")
    if given.takes_run:
        open_run(Path(given.out))
    return given


def at_home(word: str) -> str:
    """Return an argument with the home folder for a leading ~, also in --out=~/x, where shells leave it."""
    flag, equals, text = word.partition("=") if word.startswith("--") else ("", "", word)
    return flag + equals + os.path.expanduser(text)


@functools.cache
def _texts_of(kind: type) -> dict[str, str]:
    """Return the help of each option of a dataclass as one paragraph; tyro would keep the source's line breaks."""
    texts = {}
    # Bases first, because texts of subclasses replace theirs; the last one is object.
    for base in kind.__mro__[-2::-1]:
        for param in parse_from_object(base).params:
            if param.description:
                texts[param.arg_name] = " ".join(param.description.split())
    return texts


def _dataclass_rule(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Return the rule for a dataclass, whose fields are annotated as in `FLAGS`; None for other classes."""
    kind = info.type
    if not dataclasses.is_dataclass(kind):
        return None
    annotations = FLAGS.get(kind, {})
    hints = typing.get_type_hints(kind, include_extras=True)
    fields = []
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        for annotation in annotations.get(field.name, ()):
            hint = Annotated[hint, annotation]
        # Only a help text needs the docstrings, whose parsing takes a second.
        help_text = functools.partial(_help_text, kind, field.name)
        fields.append(StructFieldSpec(field.name, hint, _default_of(field, info.default), help_text))
    return StructConstructorSpec(kind, tuple(fields))


def _help_text(kind: type, name: str) -> str | None:
    return _texts_of(kind).get(name)


def _default_of(field: dataclasses.Field[Any], whole: Any) -> Any:
    """Return the default of a field, given the default of its dataclass, which may be missing."""
    if dataclasses.is_dataclass(whole):
        return getattr(whole, field.name)
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return tyro.MISSING if field.default is dataclasses.MISSING else field.default


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


def open_browser(address: str) -> None:
    """Open a page if the machine has a display."""
    if has_display():
        webbrowser.open(address)
