"""Work on photographs that several processes divide: each does its share, and all get the results."""

import contextlib
import dataclasses
import itertools
import pickle
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import jax

from a2tg_jax.data.image_files import map_in_threads
from a2tg_jax.host.text import shortened
from a2tg_jax.parallel.processes import gather, is_of_collectives

ERRORS = (FileNotFoundError, OSError, ValueError)  # _plain takes the first that fits: subclasses first.
"""Errors that are raised in all processes."""
Result = TypeVar("Result")


class SharedError(Exception):
    """Error that all processes raise at the same call. `sharing_errors` raises the error in it instead."""

    def __init__(self, error: Exception):
        super().__init__(str(error))
        self.error = error


@dataclasses.dataclass(frozen=True)
class Division:
    """Processes that work together. All make the same calls in the same order, within `sharing_errors`."""

    index: int
    """Number of this process."""
    count: int
    """Number of processes."""
    gather: Callable[[bytes], list[bytes]]
    """Function that gives each process the bytes of all, in the order of their numbers."""

    def exchange(self, step: str, value: object = None) -> list[Any]:
        """Return the values of all processes, in the order of their numbers.

        Raise SharedError in every process if one sends an error, or is at another step, by name.
        """
        parts = self._gathered((step, value))
        _check_same([[part[0]] for part in parts], "steps of loading")
        return [part[1] for part in parts]

    def send_error(self, error: Exception) -> None:
        """Raise a SharedError in every process: in the others at their next exchange."""
        self._gathered(_plain(error))

    def check_same(self, values: Sequence[str], what: str) -> None:
        """Raise SharedError in every process, with the first difference, unless all have the same values."""
        _check_same(self.exchange(what, list(values)), what)

    def _gathered(self, own: object) -> list[Any]:
        # The processes of one training run each other's programs anyway, so pickles may be trusted.
        return _without_errors([pickle.loads(part) for part in self.gather(pickle.dumps(own))])


def divided(
    division: Division | None,
    names: Sequence[str],
    work: Callable[[int], Result],
) -> list[Result]:
    """Return the results for all items, each made by one process, in threads.

    Args:
      division: processes that call this together; None: only this one.
      names: names of the items, the same in all processes.
      work: function of an item's number. If it fails, all processes raise the error of the first such item.
    """
    if division is None:
        return map_in_threads(work, range(len(names)))
    # Items are dealt by number, so all processes need the same list.
    division.check_same(names, "photographs")

    def attempt(number: int) -> Any:
        try:
            return work(number)
        except ERRORS as error:
            return _plain(error)

    own = map_in_threads(attempt, range(division.index, len(names), division.count))
    parts = division.exchange("photographs read", own)
    # Process p did items p, p + count, p + 2·count, …
    return _without_errors([parts[n % division.count][n // division.count] for n in range(len(names))])


@contextlib.contextmanager
def sharing_errors(division: Division | None) -> Iterator[None]:
    """Raise the error of the first process that has one in all processes of a division (None: one).

    All of them enter the block, and use the division only within it.
    """
    if division is None:
        yield
        return
    try:
        try:
            yield
        except ERRORS as error:
            # If processes cannot reach each other, sending the error would wait for them.
            if not is_of_collectives(error):
                division.send_error(error)
            raise
        # A process that is done waits here, so that it still gets an error of another one.
        division.exchange("end of loading")
    except SharedError as shared:
        raise shared.error from None


def among_processes() -> Division | None:
    """Return the division among the processes of `jax.distributed`; None if there is one."""
    count = jax.process_count()
    return Division(jax.process_index(), count, gather) if count > 1 else None


def _plain(error: Exception) -> Exception:
    """Return an error of the same text and of a class in `ERRORS`, which can be pickled."""
    return next(kind for kind in ERRORS if isinstance(error, kind))(str(error))


def _without_errors(results: list[Any]) -> list[Any]:
    if (error := next((result for result in results if isinstance(result, Exception)), None)) is not None:
        raise SharedError(error)
    return results


def _check_same(values: Sequence[Sequence[str]], what: str) -> None:
    """Raise SharedError with the first difference between the values of each process."""
    number = next((number for number, own in enumerate(values) if own != values[0]), None)
    if number is None:
        return
    pairs = itertools.zip_longest(values[number], values[0], fillvalue="none")
    own, first = next((own, first) for own, first in pairs if own != first)
    message = (
        f"process {number} has other {what} than process 0: {shortened(own, 200)}, not {shortened(first, 200)}; "
        "give all processes the same options and the same files, with the same folders such as images_2"
    )
    raise SharedError(ValueError(message))
