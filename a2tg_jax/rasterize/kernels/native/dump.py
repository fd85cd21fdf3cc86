"""Dumps of compiled functions, into the folder that the environment variable A2TG_DUMP names."""

import os
from pathlib import Path


def write(name: str, kind: str, text: str, *, append: bool = False) -> None:
    """Write <folder>/<name>.<kind>, or nothing without the variable."""
    if not (folder := os.environ.get("A2TG_DUMP")):
        return
    path = Path(folder) / f"{name}.{kind}"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a" if append else "w", encoding="utf-8") as file:
        file.write(text)


def is_wanted() -> bool:
    """Return whether the variable is set."""
    return bool(os.environ.get("A2TG_DUMP"))
