"""Progress over items: a bar on a terminal, and in a notebook as one output of its cell; elsewhere plain lines, at most
one per tenth and per three seconds."""

import datetime
import io
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from tqdm import tqdm

PLAIN_SHARE = 0.1
"""Least share of the whole between plain lines."""
PLAIN_SECONDS = 3.0
"""Least time between plain lines, in seconds."""

TICK = 0.5
"""Seconds between looks at what another program has done."""

Item = TypeVar("Item")


def has_terminal() -> bool:
    """Return whether a line can be redrawn: stderr is a terminal or a notebook."""
    return sys.stderr.isatty() or _is_notebook()


def _is_notebook() -> bool:
    return type(sys.stderr).__module__.startswith("ipykernel")


def new_bar(**options: Any) -> tqdm:
    """Return a bar with options of tqdm, for a terminal or a notebook."""
    return NotebookBar(**options, file=io.StringIO(), ascii=False) if _is_notebook() else tqdm(**options)


class NotebookBar(tqdm):  # type: ignore[misc]
    """Bar in one output of a notebook's cell.

    Each line that tqdm writes to stderr would be a further output of a saved notebook.
    """

    _shown: Any = None

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        """Show the line instead of the last one; its place among other lines, `pos`, does not apply."""
        from IPython.display import display

        line = {"text/plain": str(self) if msg is None else msg}
        if self._shown is None:
            self._shown = display(line, raw=True, display_id=True)
        else:
            self._shown.update(line, raw=True)
        return True


def progress_over(items: Sequence[Item], title: str, unit: str, *, is_shown: bool = True) -> Iterator[Item]:
    """Yield items and show the number of finished ones, with `counting`."""
    with counting(title, len(items), unit, is_shown=is_shown) as counter:
        for item in items:
            yield item
            counter.update(1)


@contextmanager
def counting(title: str, total: int | None, unit: str, *, is_shown: bool = True) -> Iterator["tqdm | PlainCounter"]:
    """Show the number of finished items, which the caller counts by `update(number)` of the result.

    Args:
      title: word before the numbers.
      total: number of items; None if it is not known.
      unit: word for one item.
      is_shown: whether to show anything.
    """
    if is_shown and not has_terminal():
        yield PlainCounter(title, total)
        return
    with new_bar(total=total, desc=title, unit=unit, disable=not is_shown) as bar:
        yield bar


@contextmanager
def clock(title: str, *, is_shown: bool = True) -> Iterator[None]:
    """Show the time since the start of a phase whose progress cannot be counted."""
    if is_shown and not has_terminal():
        print(f"{title} …", file=sys.stderr, flush=True)
        is_shown = False
    with new_bar(desc=title, bar_format="{desc}: {elapsed}", disable=not is_shown) as bar, ticking(bar.refresh):
        yield


@contextmanager
def ticking(act: Callable[[], object], seconds: float = TICK) -> Iterator[None]:
    """Call a function repeatedly in a thread, after a pause of `seconds` each time, until the block ends."""
    ended = threading.Event()

    def tick() -> None:
        while not ended.wait(seconds):
            act()

    thread = threading.Thread(target=tick, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


class PlainCounter:
    """Number `n` of finished items, as tqdm has it, in plain lines on stderr."""

    def __init__(self, title: str, total: int | None):
        self.n = 0
        self._title = title
        self._total = total
        self._began = time.perf_counter()
        self._printed = 0
        self._printed_at = self._began

    def update(self, num: int = 1) -> None:
        """Count items."""
        self.n += num
        if is_line_due(self.n, self._total or 0, self._printed, self._printed_at):
            of_total = f" of {self._total:,}" if self._total else ""
            print(f"{self._title}: {self.n:,}{of_total}{self._left}", file=sys.stderr, flush=True)
            self._printed = self.n
            self._printed_at = time.perf_counter()

    @property
    def _left(self) -> str:
        """Remaining time in words; empty at the end, or if the total is not known."""
        if self._total is None or self.n >= self._total:
            return ""
        seconds = (time.perf_counter() - self._began) / self.n * (self._total - self.n)
        return f", about {datetime.timedelta(seconds=round(seconds))} left"


def is_line_due(done: int, total: int, printed: int, at: float) -> bool:
    """Return whether a plain line is due.

    Args:
      done: number of items so far.
      total: number of all items; 0 if it is not known.
      printed: number of items at the last line.
      at: time of the last line, by `time.perf_counter`.
    """
    # Without a total (0), the seconds alone decide.
    is_next = done - printed >= PLAIN_SHARE * total and time.perf_counter() - at >= PLAIN_SECONDS
    return is_next or done == total
