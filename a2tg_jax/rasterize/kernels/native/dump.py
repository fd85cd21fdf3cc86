"""What becomes of a compiled function, written to the folder that the environment variable A2TG_DUMP names."""

import os
from pathlib import Path


def write(name: str, kind: str, text: str, *, append: bool = False) -> None:
    """Writes <folder>/<name>.<kind>; nothing without the variable."""
    if not (folder := os.environ.get("A2TG_DUMP")):
        return
    path = Path(folder) / f"{name}.{kind}"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a" if append else "w", encoding="utf-8") as file:
        file.write(text)


def is_wanted() -> bool:
    return bool(os.environ.get("A2TG_DUMP"))
