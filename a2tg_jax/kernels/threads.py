"""The threads that native loops run on: as many as the process has cores, made at the first need."""

import concurrent.futures
import functools
import itertools
import os
from collections.abc import Callable, Sequence

Span = tuple[int, int]
"""First item, and the one after the last."""


def num_threads() -> int:
    """The cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def even_spans(num: int, least_items: int) -> list[Span]:
    """0..num in one span for each thread that gets at least so many items; at least one span."""
    count = max(1, min(num_threads(), num // max(1, least_items)))
    return list(itertools.pairwise(num * k // count for k in range(count + 1)))


def run_spans(work: Callable[[int, int, int], None], spans: Sequence[Span]) -> None:
    """work(first, last, index) for every span, the first one on this thread, the others on the pool's."""
    others: list[concurrent.futures.Future] = []
    try:
        for index, span in enumerate(spans[1:], start=1):
            others.append(_pool().submit(work, *span, index))
        work(*spans[0], 0)
    finally:
        # Whatever happens, nobody may write to XLA's buffers once they are given back.
        concurrent.futures.wait(others)
    for other in others:
        other.result()


@functools.cache
def _pool() -> concurrent.futures.ThreadPoolExecutor:
    return concurrent.futures.ThreadPoolExecutor(num_threads(), thread_name_prefix="a2tg")
