"""Progress of structure from motion: bars of photographs, and a clock for phases without countable progress."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from tqdm import tqdm

TICK = 0.5
"""Seconds between two readings of the clock of a phase without countable progress."""


def photo_bar(phase: str, num_photos: int, progress: bool) -> tqdm:
    """Return a progress bar that counts photographs."""
    return tqdm(total=num_photos, desc=phase, unit="photo", disable=not progress)


@contextmanager
def clock(phase: str, progress: bool) -> Iterator[None]:
    """Show the time since the start of a phase whose progress cannot be counted."""
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
