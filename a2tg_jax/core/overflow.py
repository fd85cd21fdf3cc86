"""Warnings of eager renders whose capacity was too small, without a wait for every image."""

import collections
import threading
import warnings
from collections.abc import Hashable
from typing import Any

import jax
from jax import Array

MOST_PENDING = 64
"""Largest number of renders that are remembered until they are done."""


class CapacityWarning(UserWarning):
    """An eager render had too small a capacity: its image is only the background."""


class OverflowWatch:
    """Watch over eager renders. It waits for the first one of a kind; later ones are looked at once they are done."""

    def __init__(self) -> None:
        self._known: set[Hashable] = set()
        self._pending: collections.deque[tuple[Any, int]] = collections.deque(maxlen=MOST_PENDING)
        self._lock = threading.Lock()

    def observe(self, overflow: Array, capacity: int, kind: Hashable) -> None:
        """Warn if this render, or one before it that is done by now, has overflowed; do nothing under jit and vmap.

        Args:
          overflow: [] bool of a render.
          capacity: its capacity.
          kind: a key; renders of one kind have the same settings, image size and number of Gaussians.
        """
        if isinstance(overflow, jax.core.Tracer):
            return
        with self._lock:
            self._pending.append((overflow, capacity))
        if kind not in self._known:
            self._known.add(kind)
            overflow.block_until_ready()
        while (found := self._next_done()) is not None:
            done, had = found
            if not done.is_deleted() and bool(done):
                warnings.warn(
                    f"settings.capacity of {had:,} was too small for a render: its image is only the background. Plan "
                    "it with settings = plan_render(model, cameras), or leave capacity=None outside jit",
                    CapacityWarning,
                    stacklevel=4,
                )

    def _next_done(self) -> tuple[Any, int] | None:
        """Take the oldest render from the watch if it is done; None if it is not, or there is none."""
        with self._lock:
            if self._pending and (self._pending[0][0].is_deleted() or self._pending[0][0].is_ready()):
                return self._pending.popleft()
        return None
