"""A clock for phases of structure from motion that cannot count their progress."""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from tqdm import tqdm

from a2tg_jax.host.progress_bars import has_terminal

TICK = 0.5
"""Seconds between two readings of the clock of a phase without countable progress."""


@contextmanager
def clock(phase: str, progress: bool) -> Iterator[None]:
    """Show the time since the start of a phase whose progress cannot be counted."""
    if progress and not has_terminal():
        print(f"{phase} …", file=sys.stderr, flush=True)
        progress = False
    ended = threading.Event()
    with tqdm(desc=phase, bar_format="{desc}: {elapsed}", disable=not progress) as bar:

        def tick() -> None:
            while not ended.wait(TICK):
                bar.refresh()

        ticking = threading.Thread(target=tick, daemon=True)
        ticking.start()
        try:
            yield
        finally:
            ended.set()
            ticking.join()
