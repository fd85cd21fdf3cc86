"""Records that an earlier version of a system made: which they are, in words."""

import collections
import functools
from collections.abc import Iterable, Mapping
from typing import Any

from a2tg_jax.training.registry import find_system

Record = Mapping[str, Any]

FIRST = 1
"""Version of the systems of records that name none."""


def is_from_before(record: Record) -> bool:
    """Return whether an earlier version of its system made a record; systems that are not found count as unchanged."""
    version = record.get("version", FIRST)
    return version != _present_version(record.get("system", ""), version)


def as_text(records: Iterable[Record]) -> str:
    """Return in words which records are from before; empty if none is."""
    old = [record for record in records if is_from_before(record)]
    counts = collections.Counter((record["system"], record.get("version", FIRST)) for record in old)
    return ", ".join(
        f"{num} of {system} (version {version}, now {_present_version(system, version)})"
        for (system, version), num in sorted(counts.items())
    )


@functools.cache
def _present_version(reference: str, default: int) -> int:
    try:
        return find_system(reference).version
    except ValueError:
        return default
