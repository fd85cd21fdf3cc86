"""Work on photographs that several processes divide: each does its share and tells the others the results."""

import contextlib
import dataclasses
import hashlib
import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax

from a2tg_jax.data.images import map_in_threads
from a2tg_jax.data.masks import Mask
from a2tg_jax.host.text import shortened
from a2tg_jax.parallel.processes import gather, is_of_collectives

ERRORS = {"FileNotFoundError": FileNotFoundError, "OSError": OSError, "ValueError": ValueError}
"""Errors of which all processes are told."""


class SharedError(Exception):
    """Error that all processes raise at the same call. `sharing_errors` raises the error in it instead."""

    def __init__(self, error: Exception):
        super().__init__(str(error))
        self.error = error


@dataclasses.dataclass(frozen=True)
class Division:
    """Processes that do some work together, seen from one of them. All make the same calls in the same order, within
    `sharing_errors`."""

    index: int
    """Number of this process."""
    count: int
    """Number of processes."""
    gather: Callable[[bytes], list[bytes]]
    """Function that gives each process the bytes of all, in the order of their numbers."""

    def exchange(self, step: str, value: Any = None) -> list[Any]:
        """Return the values of all processes, in the order of their numbers.

        Args:
          step: name of what is exchanged, the same in all processes.
          value: of this process; it can be written as JSON.

        Raises:
          SharedError: in every process, if one tells of an error or is at another step.
        """
        parts = self._all({"step": step, "value": value})
        if any(part["step"] != parts[0]["step"] for part in parts):
            raise SharedError(_difference([[part["step"]] for part in parts], "steps of loading"))
        return [part["value"] for part in parts]

    def tell(self, error: Exception) -> None:
        """Tell the other processes of an error, at their next exchange.

        Raises:
          SharedError: always, in every process.
        """
        self._all(_error_to_json(error))

    def check_same(self, values: Sequence[str], what: str) -> None:
        """Compare the values of all processes.

        Raises:
          SharedError: in every process, with the first value that differs and the number of the process.
        """
        digest = hashlib.sha256(json.dumps(values).encode()).hexdigest()
        if len(set(self.exchange(f"digest of {what}", digest))) > 1:
            raise SharedError(_difference(self.exchange(what, values), what))

    def results(
        self, names: Sequence[str], work: Callable[[int], Any], what: str, num_threads: int | None = None
    ) -> list[Any]:
        """Return the results for all items, each found by one process.

        Args:
          names: of the items, the same in all processes.
          work: function of an item's number; its result can be written as JSON.
          what: plural noun for the items.
          num_threads: number of threads, as in `map_in_threads`.

        Raises:
          SharedError: in every process, with the error of the first item whose work fails, or if names differ.
        """
        self.check_same(names, what)

        def attempt(number: int) -> dict[str, Any]:
            try:
                return {"value": work(number)}
            except (ValueError, OSError) as error:
                return _error_to_json(error)

        own = map_in_threads(attempt, range(self.index, len(names), self.count), num_threads)
        parts = self.exchange(f"results of {what}", own)
        found = [parts[number % self.count][number // self.count] for number in range(len(names))]
        _raise_first(found)
        return [each["value"] for each in found]

    def _all(self, own: dict[str, Any]) -> list[dict[str, Any]]:
        """Return the messages of all processes. Raise SharedError if one of them is an error."""
        parts = [json.loads(part) for part in self.gather(json.dumps(own).encode())]
        _raise_first(parts)
        return parts


@contextlib.contextmanager
def sharing_errors(division: Division | None) -> Iterator[None]:
    """Raise an error of one process in all of them. Each enters the block, and uses the division within it only.

    Args:
      division: processes that enter the block; None: one.

    Raises:
      FileNotFoundError, ValueError, OSError: the error of the first process that has one.
    """
    if division is None:
        yield
        return
    try:
        try:
            yield
        except (ValueError, OSError) as error:
            if not is_of_collectives(error):
                division.tell(error)
            raise
        division.exchange("end of loading")
    except SharedError as shared:
        raise shared.error from None


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

    def mask_to_json(number: int) -> Any:
        mask = mask_of(number)
        return None if mask is None else mask.to_json()

    found = division.results(names, mask_to_json, "views")
    return [None if mask is None else Mask.from_json(mask) for mask in found]


def _error_to_json(error: Exception) -> dict[str, Any]:
    """Return a message of an error in `ERRORS`."""
    kind = next(name for name, known in ERRORS.items() if isinstance(error, known))
    return {"error": kind, "text": str(error)}


def _raise_first(messages: Sequence[dict[str, Any]]) -> None:
    """Raise SharedError with the first error among messages, if there is one."""
    failed = next((message for message in messages if "error" in message), None)
    if failed is not None:
        raise SharedError(ERRORS[failed["error"]](failed["text"]))


def _difference(values: Sequence[Sequence[str]], what: str) -> ValueError:
    """Return an error that names the first difference between the values of each process."""
    number = next(number for number, own in enumerate(values) if own != values[0])
    pairs = itertools.zip_longest(values[number], values[0], fillvalue="none")
    own, first = next((own, first) for own, first in pairs if own != first)
    return ValueError(
        f"process {number} has other {what} than process 0: {shortened(own, 200)}, not {shortened(first, 200)}; "
        "give all processes the same options and the same files, with the same folders such as images_2"
    )
