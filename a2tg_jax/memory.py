"""What compiled programs leave behind: memory that is free, and pieces of memory that are few."""

import ctypes
import functools
from pathlib import Path
from typing import Any

import jax

LARGEST_SHARE = 0.6
"""Of the pieces of memory that a process may have; beyond it compiled programs are dropped."""


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


def keep_room_for_programs(processes: Path = Path("/proc")) -> bool:
    """Drops all of JAX's compiled programs where the process is about to run out of pieces of memory for further ones.

    Linux allows vm.max_map_count of them, 65,530 by default, and XLA takes hundreds for every program. Where it gets
    none it waits for ever. What is still needed is compiled again.

    Args:
      processes: where the system tells about processes; nothing happens where it does not.

    Returns:
      Whether programs were dropped.
    """
    try:
        limit = int((processes / "sys/vm/max_map_count").read_text())
        with open(processes / "self/maps", "rb") as maps:
            count = sum(1 for _ in maps)
    except (OSError, ValueError):
        return False
    if count <= LARGEST_SHARE * limit:
        return False
    jax.clear_caches()
    return True
