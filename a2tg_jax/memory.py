"""Memory that compilers have freed, given back to the system."""

import ctypes
import functools
from typing import Any


def return_free_memory() -> None:
    """Has the C library give back what it keeps for itself: 100 to 200 MB after a training step was compiled.

    With other C libraries than glibc nothing happens.
    """
    trim = getattr(_c_library(), "malloc_trim", None)
    if trim is not None:
        trim(0)


@functools.cache
def _c_library() -> Any:
    try:
        return ctypes.CDLL(None)
    except (OSError, TypeError):  # Windows has no such library
        return None
