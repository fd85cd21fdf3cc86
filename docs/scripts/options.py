"""Writes docs/options.md from the help of the program: python docs/scripts/options.py"""

import contextlib
import io
import os
import re
from pathlib import Path
from typing import NamedTuple

from a2tg_jax.cli import main as command_line
from a2tg_jax.results.record import DEFAULT_SYSTEM
from a2tg_jax.training import SYSTEMS

PAGE = Path(__file__).resolve().parents[1] / "options.md"
OPENING = """# Options

Arguments and options of every command, with their defaults, as `a2tg COMMAND --help-all` prints them. This page
is written by `python docs/scripts/options.py`. [The command line](command-line.md) explains what they
are for. Options that are on or off have a second form, `--no-…`.
"""
OF_SYSTEMS = """
## Options of systems

`a2tg train --system NAME --help-all` lists them with the defaults of the preset `paper`, as here;
`--preset NAME` sets others. Options that all systems share are listed above, with `a2tg train`.
"""
WIDTH = "110"
"""Columns of a terminal in which the help has one column of boxes."""
HEAD = re.compile(r" (-\S+(?: \S+)*?|[A-Z_.]+(?: [A-Z_.]+)*)(?: {2,}(\S.*))?$")
"""First line of an option: its name and value, and where there is room its text."""


class Option(NamedTuple):
    group: str
    name: str
    value: str
    text: str
    default: str


def help_of(*words: str) -> str:
    """Return the help of a command as the program prints it in one column."""
    told = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = WIDTH
    try:
        with contextlib.redirect_stdout(told):
            command_line.main([*words, "--help-all"])
    finally:
        os.environ.pop("COLUMNS") if before is None else os.environ.update(COLUMNS=before)
    return re.sub(r"\x1b\[[0-9;]*m", "", _text(told))


def _text(file: io.TextIOWrapper) -> str:
    file.seek(0)
    return file.read()


def options_of(*words: str) -> list[Option]:
    """Return the options of a command in the order of its help."""
    found: list[Option] = []
    group = ""
    for line in help_of(*words).splitlines():
        if title := re.match(r"╭─ (.+?) ─", line):
            group = title[1]
        inside = line.strip("│").rstrip()
        if found and found[-1].value.count("{") > found[-1].value.count("}"):  # choices of more than a line
            found[-1] = found[-1]._replace(value=found[-1].value + inside.strip())
        elif head := HEAD.match(inside):
            name, _, value = re.sub(r", --\S*no-\S+", "", head[1]).partition(" ")
            found.append(Option(group, name, value, head[2] or "", ""))
        elif found and re.match(r" {3,}\S", inside):
            found[-1] = found[-1]._replace(text=f"{found[-1].text} {inside.strip()}".strip())
    return [_with_default(option) for option in found if option.name not in ("-h,", "-h")]


def _with_default(option: Option) -> Option:
    """Return an option with its default apart from its text."""
    text, default = re.fullmatch(r"(.*?)(?: \((?:default: )?([^()]*)\))?", option.text).groups()
    return option._replace(text=text, default=default or "")


def table(options: list[Option]) -> str:
    if not options:
        return "No options.\n"
    rows = [f"| {_code(o)} | {_cell(o.default)} | {_cell(o.text)} |" for o in options]
    return "\n".join(["| option | default | |", "| --- | --- | --- |", *rows]) + "\n"


def _code(option: Option) -> str:
    return f"`{f'{option.name} {option.value}'.strip()}`".replace("|", "\\|")


def _cell(text: str) -> str:
    """Return text for a cell; what stands in angles is no HTML."""
    return text.replace("|", "\\|").replace("<", "&lt;")


def page() -> str:
    """Return the whole page."""
    parts = [OPENING]
    of_train = {system: options_of("train", "--system", system) for system in SYSTEMS}
    own = own_options(of_train)
    for name in command_line.COMMANDS:
        options = options_of(name)
        if name == "train":
            options = [option for option in options if option not in own[DEFAULT_SYSTEM]]
        parts.append(f"\n## `a2tg {name}`\n\n{table(options)}")
    parts.append(OF_SYSTEMS)
    parts += [f"\n### `{name}`\n\n{table(options)}" for name, options in own.items() if options]
    return "".join(parts)


def own_options(of_train: dict[str, list[Option]]) -> dict[str, list[Option]]:
    """Return, for each system, the options that others lack or that have another default there."""
    shared = set.intersection(*(set(options) for options in of_train.values()))
    return {
        name: [option for option in options if option not in shared and option.name != "--system"]
        for name, options in of_train.items()
    }


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
