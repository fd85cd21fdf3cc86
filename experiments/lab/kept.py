"""Figures kept in a file as soon as they are measured, so that a second call goes on, beside the table made of them."""

import argparse
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from a2tg_jax.host.text import shortened
from a2tg_jax.results.folder import read_json, write_json

Figures = Mapping[str, Any]


def read_kept(path: Path) -> dict[str, Figures]:
    """Return figures by key, as a file keeps them; empty if there is no file.

    Raises:
      ValueError: naming the file, if it is damaged.
    """
    kept = read_figures(path) if path.is_file() else {}
    for key, figures in kept.items():
        if not isinstance(figures, dict):
            raise ValueError(f"{path}: {key!r} must be an object of figures; got {shortened(figures)}")
    return kept


def read_figures(path: Path) -> dict[str, Any]:
    """Return the figures in a file.

    Raises:
      ValueError: naming the file, if it is damaged.
    """
    found = read_json(path)
    if not isinstance(found, dict):
        raise ValueError(f"{path} must hold an object; got {shortened(found)}")
    return found


class KeptFigures:
    """Figures by key in FOLDER/NAME.json, and FOLDER/NAME.md with their table."""

    def __init__(self, folder: Path, name: str, table: Callable[[Mapping[str, Figures]], str]):
        folder.mkdir(parents=True, exist_ok=True)
        self._json, self._table, self._as_text = folder / f"{name}.json", folder / f"{name}.md", table
        self.found: dict[str, Figures] = read_kept(self._json)

    def has_all(self, keys: Iterable[str]) -> bool:
        """Return whether every key was measured before."""
        return self.found.keys() >= set(keys)

    def measure(self, key: str, measured: Callable[[], Figures]) -> None:
        """Measure, print and keep what is not known yet."""
        if key in self.found:
            return
        self.found[key] = measured()
        print(key, _rounded(self.found[key]), flush=True)
        write_json(self._json, self.found)
        self._table.write_text(self.table(), encoding="utf-8")

    def table(self) -> str:
        """Return the table of what is known."""
        return self._as_text(self.found)


def _rounded(figures: Figures) -> dict[str, Any]:
    return {name: round(value, 2) if isinstance(value, float) else value for name, value in figures.items()}


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with `--out`, the folder of kept figures."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of table and figures")
    return parser
