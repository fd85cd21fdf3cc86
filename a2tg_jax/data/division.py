"""Work on photographs that several processes divide: each does its share and tells the others the results."""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Sequence
from typing import Any

import jax

from a2tg_jax.data.images import map_in_threads
from a2tg_jax.data.masks import Mask
from a2tg_jax.host.processes import gather

ERRORS = {"FileNotFoundError": FileNotFoundError, "OSError": OSError, "ValueError": ValueError}
"""Errors of which all processes are told."""


@dataclasses.dataclass(frozen=True)
class Division:
    """Processes that do some work together, seen from one of them. All make the same calls in the same order."""

    index: int
    """Number of this process."""
    count: int
    """Number of processes."""
    gather: Callable[[bytes], list[bytes]]
    """Function that gives each process the bytes of all, in the order of their numbers."""

    def check_same(self, value: Any, what: str) -> None:
        """Raise ValueError in every process whose value differs from the first one's. All of them call it."""
        digest = hashlib.sha256(json.dumps(value).encode()).digest()
        if self.gather(digest)[0] != digest:
            raise ValueError(f"this process has other {what} than the first: start all with the same scene")

    def results(self, names: Sequence[str], work: Callable[[int], Any], num_threads: int | None = None) -> list[Any]:
        """Return the results for all items, each found by one process.

        Args:
          names: of the items, the same in all processes.
          work: function of an item's number; its result can be written as JSON.
          num_threads: number of threads, as in `map_in_threads`.

        Raises:
          ValueError, OSError: that of the first item whose work fails, in every process.
          ValueError: if the names differ from the first process's.
        """
        self.check_same(list(names), "photographs")

        def attempt(number: int) -> dict[str, Any]:
            try:
                return {"value": work(number)}
            except (ValueError, OSError) as error:
                kind = next(name for name, known in ERRORS.items() if isinstance(error, known))
                return {"error": kind, "text": str(error)}

        own = map_in_threads(attempt, range(self.index, len(names), self.count), num_threads)
        parts = [json.loads(part) for part in self.gather(json.dumps(own).encode())]
        found = [parts[number % self.count][number // self.count] for number in range(len(names))]
        failed = next((each for each in found if "error" in each), None)
        if failed is not None:
            raise ERRORS[failed["error"]](failed["text"])
        return [each["value"] for each in found]


def among_processes() -> Division | None:
    """Return the division among the processes of `jax.distributed`; None if there is one."""
    count = jax.process_count()
    return Division(jax.process_index(), count, gather) if count > 1 else None


def divided_masks(
    names: Sequence[str], mask_of: Callable[[int], Mask | None], division: Division | None
) -> list[Mask | None]:
    """Return a mask for each photograph, or None, of its pixels; each process reads its share of them.

    Args:
      names: of the photographs.
      mask_of: function of a photograph's number.
      division: processes that call this together; None: one.
    """
    if division is None:
        return [mask_of(number) for number in range(len(names))]

    def told(number: int) -> Any:
        mask = mask_of(number)
        return None if mask is None else mask.told()

    found = division.results(names, told)
    return [None if mask is None else Mask.of_told(mask) for mask in found]
