"""Memory that a process has and may have, and what compiled programs leave behind in it."""

import ctypes
import functools
import os
from pathlib import Path
from typing import Any

import jax

from a2tg_jax.host.control_groups import group_folders

LARGEST_SHARE = 0.6
"""Share of the memory mappings allowed to a process beyond which compiled programs are dropped."""
LIMITS = (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes"))
"""File names of a control group's limit and use, in version 2 and in version 1."""


def memory_limit(root: Path = Path("/")) -> int:
    """Return bytes of memory that this process may have in all: what it has and what is free, now (host).

    Limits of control groups count. What a group keeps of files that can be read again is free.

    Args:
      root: of the file system; where Linux's proc is not there, the machine's memory is the answer.
    """
    told = _told(root / "proc/meminfo")
    if "MemAvailable" not in told:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 2**63 - 1
    own = _told(root / "proc/self/status").get("VmRSS", 0)
    groups = (_left_in(folder) for folder in group_folders(root, "memory"))
    return own + max(0, min([told["MemAvailable"], *(left for left in groups if left is not None)]))


def memory_peak(root: Path = Path("/")) -> int:
    """Return bytes of memory that this process had at its peak; 0 if the system does not report it (host)."""
    return _told(root / "proc/self/status").get("VmHWM", 0)


def _told(file: Path) -> dict[str, int]:
    """Return the bytes of a file of lines "Name: 123 kB"; empty without such a file."""
    try:
        lines = [line.replace(":", " ").split() for line in file.read_text().splitlines()]
    except OSError:
        return {}
    return {line[0]: 1024 * int(line[1]) for line in lines if line[2:] == ["kB"] and line[1].isdecimal()}


def _left_in(folder: Path) -> int | None:
    """Return bytes that a control group still has room for; None without a limit."""
    for limit, usage in LIMITS:
        try:
            room = int((folder / limit).read_text()) - int((folder / usage).read_text())
            stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
            return room + int(stat.get("total_inactive_file", stat.get("inactive_file", 0)))
        except (OSError, ValueError):
            continue  # of the other version, or "max"
    return None


def tidy_memory() -> None:
    """Return free memory and keep room for programs, after one was compiled."""
    return_free_memory()
    keep_room_for_programs()


def return_free_memory() -> None:
    """Have the C library return the memory it caches: 100 to 200 MB after a training step was compiled.

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
    """Drop all compiled programs of JAX if the process is about to run out of memory mappings for further ones.

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
