"""Compilations by JAX, which reports them as monitoring events."""

import contextlib
import threading
import time
from collections.abc import Iterator
from typing import NamedTuple

import jax

CODE = "/jax/core/compile/backend_compile_duration"
"""Event after the code of a program was made, or read from JAX's cache on disk."""
PHASES = ("/jax/core/compile/jaxpr_trace_duration", "/jax/core/compile/jaxpr_to_mlir_module_duration", CODE)


class Phase(NamedTuple):
    """Phase of a compilation. One can be within another."""

    start: float
    """Time by `time.perf_counter`."""
    end: float
    makes_code: bool
    """Whether it is the last phase of a program."""


@contextlib.contextmanager
def compilations() -> Iterator[list[Phase]]:
    """Return a list to which the phases of compilations by this thread are added until the block ends."""
    thread = threading.get_ident()
    phases: list[Phase] = []

    def add(event: str, duration_secs: float, **_: str | int) -> None:
        if event in PHASES and threading.get_ident() == thread:
            now = time.perf_counter()
            phases.append(Phase(now - duration_secs, now, event == CODE))

    jax.monitoring.register_event_duration_secs_listener(add)
    try:
        yield phases
    finally:
        jax.monitoring.unregister_event_duration_listener(add)
