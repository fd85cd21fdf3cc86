"""Compilations by JAX, which reports them as monitoring events."""

import contextlib
import threading
from collections.abc import Iterator

import jax

COMPILED = "/jax/core/compile/backend_compile_duration"
"""Event after each compilation, also if the program comes from JAX's cache on disk."""


@contextlib.contextmanager
def compilations() -> Iterator[list[float]]:
    """Return a list to which the seconds of each compilation by this thread are added until the block ends."""
    thread = threading.get_ident()
    durations: list[float] = []

    def add(event: str, duration_secs: float, **_: str | int) -> None:
        if event == COMPILED and threading.get_ident() == thread:
            durations.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(add)
    try:
        yield durations
    finally:
        jax.monitoring.unregister_event_duration_listener(add)
