"""Time of a call and peak memory. Needs nothing but numpy, so that other programs are timed by the same rule."""

import contextlib
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


def timed(function: Callable, *args: Any, wait: Callable[[Any], Any] = lambda result: result) -> dict[str, float]:
    """Return seconds of the first call, and the median and least milliseconds of the following ones.

    Those are at least five, and up to 40 while they take less than a second together.

    Args:
      function: called with `args`.
      wait: called with its result; returns when that is computed.
    """

    def seconds() -> float:
        start = time.perf_counter()
        wait(function(*args))
        return time.perf_counter() - start

    first = seconds()
    times: list[float] = []
    while len(times) < 5 or (sum(times) < 1.0 and len(times) < 40):
        times.append(seconds())
    return {"first_s": first, "ms": float(np.median(times)) * 1e3, "least_ms": min(times) * 1e3}


def memory_peak() -> int:
    """Return the peak memory of this process in bytes (host)."""
    # On Linux not by getrusage, which also counts the program that started this one.
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # Bytes on macOS.
