"""Time of a training without what JAX compiles meanwhile."""

import time
from collections.abc import Iterable
from typing import Self

import jax
import numpy as np

from a2tg_jax.core.compilations import Phase, compilations
from a2tg_jax.host.progress_bars import ticking

SAMPLING_SECONDS = 0.05


class TrainingTime:
    """Measures the time of a block, all of it but compiling.

    On CPUs it is the processor time of this process, which programs beside it do not lengthen, and which equals the
    time on the wall for a job of one core that has it to itself. On GPUs it is the time on the wall.

    Examples:
      >>> with TrainingTime() as training:
      ...     total = sum(range(1000))
      >>> 0 <= training.seconds < 60
      True
    """

    def __init__(self, earlier: float = 0.0):
        self.earlier = earlier
        """Seconds of an interrupted training that the block continues."""
        self._clock = time.process_time if jax.default_backend() == "cpu" else time.perf_counter
        self._samples: list[tuple[float, float]] = []
        self._phases: list[Phase] = []
        self._compiling = compilations()
        self._sampling = ticking(self._sample, SAMPLING_SECONDS)
        self._is_over = False

    def __enter__(self) -> Self:
        self._sample()
        self._phases = self._compiling.__enter__()
        self._sampling.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._sampling.__exit__(None, None, None)
        self._sample()
        self._is_over = True
        self._compiling.__exit__(None, None, None)

    @property
    def seconds(self) -> float:
        """Time so far."""
        if not self._is_over:
            self._sample()
        samples = list(self._samples)
        at, used = np.array(sorted(samples)).T
        compiled = union((phase.start, phase.end) for phase in self._phases)
        # Compilations are known by the time on the wall; samples say what the clock showed then.
        compiling = sum(np.interp(end, at, used) - np.interp(start, at, used) for start, end in compiled)
        return self.earlier + float(used[-1] - used[0] - compiling)

    def _sample(self) -> None:
        self._samples.append((time.perf_counter(), self._clock()))


def union(intervals: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return intervals that cover the same points as the given ones, and do not overlap.

    Examples:
      >>> union([(0.0, 2.0), (5.0, 6.0), (1.0, 3.0)])
      [(0.0, 3.0), (5.0, 6.0)]
    """
    joined: list[tuple[float, float]] = []
    for start, end in sorted(intervals):
        if joined and start <= joined[-1][1]:
            first, last = joined.pop()
            start = first
            end = max(last, end)
        joined.append((start, end))
    return joined
