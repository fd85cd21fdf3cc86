"""Tables of TOML files as dataclasses: their fields are the known keys with their types."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from a2tg_jax.host.json_text import MOST_TOML_BYTES, parse_toml
from a2tg_jax.host.regular_files import read_regular
from a2tg_jax.host.text import shortened
from a2tg_jax.io.config_json import config_from_dict

TableT = TypeVar("TableT")


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file.

    Raises:
      FileNotFoundError: if there is none.
      ValueError: naming the file, if it is no TOML.
    """
    try:
        return parse_toml(read_regular(path, MOST_TOML_BYTES))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def table_as(kind: type[TableT], table: Any, where: str, **given: Any) -> TableT:
    """Return a table as a dataclass.

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
