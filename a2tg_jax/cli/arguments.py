"""Command-line arguments parsed into a dataclass by tyro, with every error on one line."""

import contextlib
import dataclasses
import difflib
import io
import itertools
import os
import re
import shlex
import types
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Annotated, Any, TypeVar

import tyro
from docstring_parser import parse_from_object
from tyro.conf import arg

from a2tg_jax.cli.errors import UNRECOGNIZED, plain, told_unknown, unknown_words
from a2tg_jax.cli.values import registry
from a2tg_jax.host.remote_files import is_url, without_secrets

Parsed = TypeVar("Parsed")

WIDE = "1000"
"""Terminal width at which no error message is wrapped."""
LEAST_LIKENESS = 0.75
"""Smallest similarity, of 1, of an unknown flag and one that is suggested instead."""
NEARLY_AS_LIKE = 0.05
"""Difference in similarity from the likest flag up to which others are suggested as well."""
MOST_SUGGESTED = 3


def defaulting_to(text: str, metavar: str | None = None) -> Any:
    """Return the annotation of an option whose help tells its default in words, in place of None."""
    return arg(help_behavior_hint=f"(default: {text})", metavar=metavar)


LastModel = Annotated[str | None, defaulting_to("the last model of the main system", "NAME")]
"""Name of a model of a run; None: the last one of its main system."""


def flag_of(name: str) -> str:
    """Return the flag of an option."""
    return "--" + name.replace("_", "-")


def flag_with_value(name: str, value: object) -> str:
    """Return the flag of an option with its value, as it is typed."""
    if isinstance(value, bool):
        group, dot, own = name.rpartition(".")
        return flag_of(name if value else f"{group}{dot}no_{own}")
    words = value if isinstance(value, list | tuple) else [value]
    return shlex.join([flag_of(name), *map(str, words)])


def check_path(text: str) -> None:
    """Raise ValueError if a path is a URL, which would name a folder of this machine."""
    if is_url(text):
        told = without_secrets(text)
        raise ValueError(f"{told}: only SCENE of a2tg train may be a URL; copy it here, or mount the bucket")


def typed_paths(arguments: Sequence[str]) -> set[str]:
    """Return the paths of the options that were typed as flags."""
    flags = (word.partition("=")[0] for word in arguments if word.startswith("--"))
    return {flag[2:].replace("-", "_") for flag in flags}


def in_flags(message: str, paths: Iterable[str]) -> str:
    """Return a message with flags in place of the paths of options.

    A path of one word is replaced at the beginning only, for it may be a word of the message.
    """
    for path in sorted(paths, key=len, reverse=True):
        before = r"(?<![\w./-])" if re.search(r"[._]", path) else "^"
        message = re.sub(rf"{before}{re.escape(path)}(?!\w|\.\w)", flag_of(path), message)
    return message


def parse(
    kind: type[Parsed],
    program: str,
    arguments: Sequence[str],
    *,
    hint: Callable[[str], str] = lambda flag: "",
    **options: Any,
) -> Parsed:
    """Parse arguments into an instance of `kind`. Help is printed and ends in SystemExit.

    Args:
      kind: a dataclass.
      program: name of the command in the help.
      arguments: without the command's name.
      hint: gives what to say of an unknown flag, or an empty text if it knows nothing of it.
      options: further arguments of `tyro.cli`.

    Raises:
      ValueError: if an argument is missing, unknown or of another type.
    """
    errors, is_help = io.StringIO(), bool({"-h", "--help"} & set(arguments))
    if is_help:
        _tell_in_paragraphs(kind, options.get("default"))
    width = contextlib.nullcontext() if is_help else _columns(WIDE)
    try:
        with registry(), width, contextlib.redirect_stderr(errors):
            parsed: Parsed = tyro.cli(kind, prog=program, args=arguments, **options)
            return parsed
    except SystemExit as end:
        if not end.code:
            raise
        told = plain(one_line(errors.getvalue()))
    if told.startswith(UNRECOGNIZED):
        told = told_unknown(unknown_words(told), lambda flag: hint(flag) or _suggested(flag, kind, options))
    raise ValueError(f"{told} (see {program} --help)")


def _tell_in_paragraphs(kind: type, default: object) -> None:
    """Have the help of a dataclass, and of those in its default, fill its lines; tyro breaks them where the docstrings
    in the source do."""
    params = itertools.chain.from_iterable(parse_from_object(one).params for one in kind.__mro__[-2::-1])
    told = {param.arg_name: " ".join(param.description.split()) for param in params if param.description}
    for field in dataclasses.fields(kind):
        if field.name in told:
            field.metadata = types.MappingProxyType({**field.metadata, "help": told[field.name]})
        value = getattr(default, field.name, None)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            _tell_in_paragraphs(type(value), value)


def one_line(box: str) -> str:
    """Return the first message of a tyro error, without title, frame and colours."""
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line).strip("│╭╰╮╯ ") for line in box.splitlines()]
    parts: list[list[str]] = [[]]
    for line in [line for line in lines if line][1:]:
        if line.strip("─-"):
            parts[-1].append(line)
        else:
            parts.append([])
    said, *_ = [part for part in parts if part] or [[box]]
    return " ".join(" ".join(said).split()).rstrip(".")


def nearest(flag: str, known: Iterable[str]) -> list[str]:
    """Return the known flags most like an unknown one, as a whole or by their last words, the likest first."""
    likeness = {name: max(_likeness(flag, tail) for tail in _tails(name)) for name in known}
    least = max(LEAST_LIKENESS, max(likeness.values(), default=0.0) - NEARLY_AS_LIKE)
    near = sorted((name for name in likeness if likeness[name] >= least), key=lambda name: -likeness[name])
    return near[:MOST_SUGGESTED]


def _likeness(flag: str, tail: str) -> float:
    return difflib.SequenceMatcher(None, flag.removeprefix("--"), tail).ratio()


def _tails(name: str) -> list[str]:
    """Return a flag without its dashes, and what follows each of its dots and dashes."""
    words = name.removeprefix("--")
    return [words, *(words[match.end() :] for match in re.finditer(r"[.-]", words))]


def _suggested(flag: str, kind: type, options: dict[str, Any]) -> str:
    """Return "; did you mean FLAG?" for an unrecognised flag; empty if none is near."""
    near = nearest(flag, _flags(kind, options))
    return f"; did you mean {' or '.join(near)}?" if near else ""


def _flags(kind: type, options: dict[str, Any]) -> list[str]:
    """Return every flag of a command, as its help lists them."""
    text = io.StringIO()
    with registry(), contextlib.suppress(SystemExit), contextlib.redirect_stdout(text):
        tyro.cli(kind, args=["--help"], **options)
    return re.findall(r"^[│ ]*(--[\w.-]+)", text.getvalue(), flags=re.MULTILINE)


@contextlib.contextmanager
def _columns(width: str) -> Iterator[None]:
    """Set the terminal width in the environment for the duration of the block."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = width
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
