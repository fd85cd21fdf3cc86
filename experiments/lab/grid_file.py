"""Tables of grid files, of `grids/scales.toml` and of `grids/methods.toml`, with their keys and types."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

from a2tg_jax.base.config_json import config_from_dict
from a2tg_jax.base.json_text import read_toml
from a2tg_jax.base.text import did_you_mean, shortened

GRIDS = Path(__file__).resolve().parents[1] / "grids"
SUFFIX = ".toml"
SCALES = ("claims", "full", "full_size", "half_size", "long", "paper160", "protocol160", "small", "smoke")
ONE_BYTE = 1e-6
"""A byte in MB."""
LEAST = {
    "gaussians": 1, "budgets": ONE_BYTE, "bytes_per_pixel": ONE_BYTE, "seeds": 0, "folds": 0, "iterations": 0,
    "downscale": 1, "floats": 1, "most": 1,
}  # fmt: skip
"""Smallest numbers in the tables."""
SIZES = ("gaussians", "budgets", "bytes_per_pixel")
"""Ways to give the size of models, of which a block has one."""
TableT = TypeVar("TableT")


@dataclasses.dataclass(frozen=True)
class Block:
    """Sizes, seeds, lengths and scenes of cells; None for those of the scale."""

    gaussians: tuple[int, ...] | None = None
    budgets: tuple[float, ...] | None = None
    bytes_per_pixel: tuple[float, ...] | None = None
    """Budgets in bytes for each pixel of a photograph."""
    seeds: tuple[int, ...] | None = None
    folds: tuple[int, ...] | None = None
    """Splits into few training views and scored ones (`scenes.few_views`)."""
    iterations: tuple[int, int] | None = None
    only: tuple[str, ...] | None = None
    downscale: int | None = None


@dataclasses.dataclass(frozen=True)
class Scale(Block):
    """Table of a scale in a grid file, or in `scales.toml`."""

    preset: str | None = None
    scenes: dict[str, Any] | None = None
    blocks: tuple[dict, ...] | None = None
    methods: tuple[str, ...] | None = None
    variants: tuple[str, ...] | None = None
    at_equal_bytes: tuple[str, ...] | None = None
    at_equal_time: tuple[str, ...] | None = None

    def changed(self, other: Block) -> "Scale":
        """Return the scale with what another table sets; Gaussians take the place of budgets, and budgets theirs."""
        own = {name: value for name, value in vars(other).items() if value is not None}
        sizes = dict.fromkeys(SIZES)
        return dataclasses.replace(self, **{**(sizes if sizes.keys() & own.keys() else {}), **own})


@dataclasses.dataclass(frozen=True)
class GridFile:
    """Content of a grid file."""

    title: str
    reference: str
    table: Literal["quality", "gains", "choices"] = "quality"
    """Kind of its tables."""
    methods: tuple[str, ...] = ()
    at_equal_bytes: tuple[str, ...] = ()
    at_equal_time: tuple[str, ...] = ()
    variants: dict[str, Any] = dataclasses.field(default_factory=dict)
    scales: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Tables of the scales that it has, which the file calls by their names, such as [smoke]."""

    def scale(self, name: str, place: str) -> Scale:
        """Return the table of a scale.

        Raises:
          ValueError: if there is none, or it has a mistake.
        """
        if name not in self.scales:
            found = ", ".join(f"[{known}]" for known in self.scales) or "none"
            raise ValueError(f"{place} has no table of --scale {name}, [{name}]; it has {found}")
        return part_as(Scale, self.scales[name], f"{place}: {name}")


@dataclasses.dataclass(frozen=True)
class MethodTable:
    """Table of a method."""

    like: str | None = None
    system: str | None = None
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    floats: int | None = None
    most: int | None = None
    by_number: bool = False
    chosen_in: str | None = None
    """JSON file beside the grids with the label of a method for each scene."""


def table_as(kind: type[TableT], table: Any, where: str, **given: Any) -> TableT:
    """Return a table as a dataclass, whose fields are the known keys with their types.

    Args:
      kind: the dataclass. A field that has a default may be missing.
      table: value in a TOML file.
      where: file and table, as in "mine.toml: small", or "mine.toml:" for the whole file.
      given: values of fields that are not in the table.

    Raises:
      ValueError: naming file, table and key, if it is no table, or a key is missing, unknown or of another type.
    """
    if not isinstance(table, Mapping):
        raise ValueError(f"{where} must be a table; got {shortened(table)}")
    return config_from_dict(kind, table, where, given=given)


def read_grid_file(path: Path) -> GridFile:
    """Read a grid file; the tables within it are read when they are needed.

    Raises:
      FileNotFoundError: if there is none.
      ValueError: naming file and key, if a key is missing, unknown or of another type.
    """
    table = read_toml(path)
    known = [*SCALES, *(field.name for field in dataclasses.fields(GridFile) if field.name != "scales")]
    for key in table:
        if key not in known:
            raise ValueError(f"{path.name}: {shortened(key)} is an unknown key{did_you_mean(key, known)}")
    scales = {name: table.pop(name) for name in SCALES if name in table}
    return table_as(GridFile, table, f"{path.name}:", scales=scales)


def shared_scale(name: str) -> Scale:
    """Return what all grids have at a scale."""
    return part_as(Scale, read_toml(GRIDS / "scales.toml")[name], f"scales.toml: {name}")


def blocks_of(scale: Scale, where: str) -> list[Scale]:
    """Return the scale with each of its blocks, or itself if it has none."""
    if scale.blocks is None:
        return [scale]
    blocks = (part_as(Block, table, f"{where}.blocks[{index}]") for index, table in enumerate(scale.blocks))
    return [scale.changed(block) for block in blocks]


def method_tables(tables: Mapping[str, Any], where: str) -> dict[str, MethodTable]:
    """Return the tables of methods by label."""
    return {label: part_as(MethodTable, table, f"{where}{label!r}") for label, table in tables.items()}


def part_as(kind: type[TableT], table: Any, where: str) -> TableT:
    """Return a table within a file.

    Raises:
      ValueError: naming file, table and key, as `table_as` does, or if a number is out of range, a list of numbers is
        empty, or Gaussians stand beside budgets.
    """
    part = table_as(kind, table, where)
    values = {name: value for name, value in vars(part).items() if value is not None}
    for name in LEAST.keys() & values.keys():
        _check_numbers(values[name], LEAST[name], f"{where}.{name}")
    given = [name for name in SIZES if name in values]
    if len(given) > 1:
        raise ValueError(f"{where} has {' and '.join(given)}: leave one out")
    return part


def _check_numbers(value: Any, least: float, name: str) -> None:
    numbers = value if isinstance(value, tuple) else (value,)
    if not numbers:
        raise ValueError(f"{name} must not be empty")
    for number in numbers:
        if not least <= number < math.inf:
            raise ValueError(f"{name} must be at least {least}; got {number}")
