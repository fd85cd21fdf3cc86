"""Command-line arguments parsed into a dataclass by tyro, with every error on one line."""

import contextlib
import io
import os
import re
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

import tyro

Parsed = TypeVar("Parsed")

WIDE = "1000"
"""Terminal width at which no error message is wrapped."""


def parse(kind: type[Parsed], program: str, arguments: Sequence[str], **options: Any) -> Parsed:
    """Parse arguments into an instance of `kind`. Help is printed and ends in SystemExit.

    Args:
      kind: a dataclass.
      program: name of the command in the help.
      arguments: without the command's name.
      options: further arguments of `tyro.cli`.

    Raises:
      ValueError: if an argument is missing, unknown or of another type.
    """
    errors = io.StringIO()
    width = contextlib.nullcontext() if {"-h", "--help"} & set(arguments) else _columns(WIDE)
    try:
        with width, contextlib.redirect_stderr(errors):
            parsed: Parsed = tyro.cli(kind, prog=program, args=arguments, **options)
            return parsed
    except SystemExit as end:
        if not end.code:
            raise
        raise ValueError(f"{one_line(errors.getvalue())} (see {program} --help)") from None


def one_line(box: str) -> str:
    """Return the first message of a tyro error and the flags it suggests, without title, frame and colours."""
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line).strip("│╭╰╮╯ ") for line in box.splitlines()]
    parts: list[list[str]] = [[]]
    for line in [line for line in lines if line][1:]:
        if line.strip("─-"):
            parts[-1].append(line)
        else:
            parts.append([])
    said, *others = [part for part in parts if part] or [[box]]
    suggested = [part for part in others if part[0].startswith("Perhaps")]
    flags = [re.split(r"[ ,]", line)[0] for part in suggested for line in part if line.startswith("--")]
    told = " ".join(" ".join(said).split()).rstrip(".")
    return f"{told}; did you mean {' or '.join(flags)}?" if flags else told


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
