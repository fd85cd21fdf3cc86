"""Progress over items: a bar on a terminal, plain lines elsewhere, each a tenth and some seconds after the last."""

import sys
import time
from collections.abc import Iterator, Sequence
from typing import TypeVar

from tqdm import tqdm

PLAIN_SHARE, PLAIN_SECONDS = 0.1, 3.0
"""Share of the whole, and seconds, between plain lines."""

Item = TypeVar("Item")


def has_terminal() -> bool:
    """Return whether stderr can redraw a line: it is a terminal or a notebook."""
    return sys.stderr.isatty() or type(sys.stderr).__module__.startswith("ipykernel")


def progress_over(items: Sequence[Item], title: str, unit: str, *, is_shown: bool = True) -> Iterator[Item]:
    """Yield items, and show how many are done.

    Args:
      items: any.
      title: word before the numbers.
      unit: word for one item.
      is_shown: without, nothing is shown.
    """
    if not is_shown or has_terminal():
        yield from tqdm(items, desc=title, unit=unit, disable=not is_shown)
        return
    total, told, at = len(items), 0, time.perf_counter()
    for done, item in enumerate(items, start=1):
        yield item
        if is_line_due(done, total, told, at):
            print(f"{title}: {done:,} of {total:,}", file=sys.stderr, flush=True)
            told, at = done, time.perf_counter()


def is_line_due(done: int, total: int, told: int, at: float) -> bool:
    """Return whether a plain line is due.

    Args:
      done: items so far.
      total: all of them.
      told: items at the last line.
      at: time of the last line, by `time.perf_counter`.
    """
    is_next = done - told >= PLAIN_SHARE * total and time.perf_counter() - at >= PLAIN_SECONDS
    return is_next or done == total
