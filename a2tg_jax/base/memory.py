"""Memory that this process may use, and how it keeps some free.

JAX is imported in functions, so that the command line can answer a mistyped command at once.
"""

import faulthandler
import functools
import sys
from pathlib import Path

import psutil

from a2tg_jax.base.control_groups import memory_left
from a2tg_jax.base.machine import default_device
from a2tg_jax.base.operating_system import keep_one_heap, num_cores, stack_bytes, trim_heap, ulimits
from a2tg_jax.base.text import in_bytes

LARGEST_SHARE = 0.6
"""Share of a process's allowed memory mappings beyond which compiled programs are dropped."""
LEAST_ULIMITS = {"v": 1_800_000_000, "d": 1_000_000_000}
"""Bytes of address space and of data for Python's libraries, JAX and a short training, without stacks of threads."""
STACKS_PER_CORE = 4
"""Threads per core: two pools of XLA, and BLAS in numpy and in scipy."""


def memory_limit(root: Path = Path("/")) -> int:
    """Return the total bytes of memory that this process may use: its own plus what is free now (host).

    Limits of control groups and of `ulimit` count. A group's file cache counts as free.
    """
    process = psutil.Process()
    left: list[int] = [psutil.virtual_memory().available]
    for letter, most in ulimits().items():
        used = process.memory_info()
        left.append(most - (used.vms if letter == "v" else used.data))
    left += memory_left(root)
    return int(process.memory_info().rss) + max(0, min(left))


def allowed_memory(max_memory: int | None, num_devices: int = 1) -> int:
    """Return the bytes a run may use: the given limit, or what the machine or its accelerators have available."""
    if max_memory is not None:
        return max_memory
    # CPUs have no such figures.
    stats = default_device().memory_stats() or {}
    return num_devices * stats.get("bytes_limit", 0) or memory_limit()


def used_memory(num_devices: int = 1) -> int:
    """Return the bytes in use now: of the accelerators, if each uses as much as the default one, or of this process."""
    stats = default_device().memory_stats() or {}
    return num_devices * stats.get("bytes_in_use", 0) or int(psutil.Process().memory_info().rss)


@functools.cache
def check_ulimits() -> None:
    """Check `ulimit` before JAX starts, which would end the process without a message.

    If there is a limit, threads share one heap, and a crash later prints where it was.

    Raises:
      ValueError: if JAX needs more address space or data than this process may reserve.
    """
    limits = ulimits()
    if not limits:
        return
    keep_one_heap()
    stacks = STACKS_PER_CORE * num_cores() * stack_bytes()
    for letter, limit in limits.items():
        needed = LEAST_ULIMITS[letter] + stacks
        if limit < needed:
            kind = {"v": "address space", "d": "data"}[letter]
            raise ValueError(
                f"this process may reserve {in_bytes(limit)} of {kind}, and JAX with its threads needs about "
                f"{in_bytes(needed)}: raise the limit (ulimit -{letter} unlimited), or request more memory for the job"
            )
    if sys.__stderr__ is not None and not faulthandler.is_enabled():
        faulthandler.enable(sys.__stderr__)


def tidy_memory() -> None:
    """Return free memory to the system after compiling, 100 to 200 MB with glibc, and keep room for programs."""
    trim_heap()
    keep_room_for_programs()


def keep_room_for_programs(processes: Path = Path("/proc")) -> bool:
    """Drop all compiled programs of JAX if the process is about to run out of memory mappings.

    Linux allows vm.max_map_count of them, 65,530 by default, and XLA takes hundreds per program. When there are none
    left, XLA waits forever. Programs in use are compiled again.

    Args:
      processes: /proc; without such a folder nothing happens.

    Returns:
      Whether programs were dropped.
    """
    try:
        most = int((processes / "sys/vm/max_map_count").read_text())
        with open(processes / "self/maps", "rb") as maps:
            is_full = sum(1 for _ in maps) > LARGEST_SHARE * most
    except (OSError, ValueError):
        return False
    if is_full:
        import jax

        jax.clear_caches()
    return is_full
