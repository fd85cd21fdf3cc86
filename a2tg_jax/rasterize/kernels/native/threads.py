"""Thread pool of native loops, started on first use."""

import concurrent.futures
import functools
import itertools
from collections.abc import Callable, Sequence

from a2tg_jax.host.machine import num_threads as num_threads

Span = tuple[int, int]
"""First item, and the end, which is excluded."""


def even_spans(num: int, least_items: int) -> list[Span]:
    """Split 0..num into even spans, one per thread, of at least `least_items` each if there is more than one."""
    count = max(1, min(num_threads(), num // max(1, least_items)))
    return list(itertools.pairwise(num * k // count for k in range(count + 1)))


def run_spans(work: Callable[[int, int, int], None], spans: Sequence[Span]) -> None:
    """Call work(first, last, index) for every span: the first one on this thread, the others on the pool's."""
    others: list[concurrent.futures.Future[None]] = []
    try:
        for index, span in enumerate(spans[1:], start=1):
            others.append(_pool(num_threads()).submit(work, *span, index))
        work(*spans[0], 0)
    finally:
        # Also after an exception: nobody may write to XLA's buffers once they are given back.
        concurrent.futures.wait(others)
    for other in others:
        other.result()


@functools.cache
def _pool(size: int) -> concurrent.futures.ThreadPoolExecutor:
    return concurrent.futures.ThreadPoolExecutor(size, thread_name_prefix="a2tg")
