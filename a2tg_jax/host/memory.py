"""Memory of the process: its use, its limit, and the leftovers of compiled programs."""

from pathlib import Path

import jax

from a2tg_jax.host.control_groups import group_folders
from a2tg_jax.host.operating_system import machine_memory, memory_mappings, memory_numbers, trim_heap

LARGEST_SHARE = 0.6
"""Share of the memory mappings allowed to a process beyond which compiled programs are dropped."""
LIMITS = (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes"))
"""File names of a control group's limit and use, in version 2 and in version 1."""


def memory_limit(root: Path = Path("/")) -> int:
    """Return the bytes of memory that this process may use in all: its own and the free memory, now (host).

    Limits of control groups count. A group's cache of files counts as free.

    Args:
      root: of the file system. Without Linux's /proc the answer is the machine's memory.
    """
    told = memory_numbers(root / "proc/meminfo")
    if "MemAvailable" not in told:
        return machine_memory()
    own = memory_numbers(root / "proc/self/status").get("VmRSS", 0)
    groups = (_left_in(folder) for folder in group_folders(root, "memory"))
    return own + max(0, min([told["MemAvailable"], *(left for left in groups if left is not None)]))


def memory_peak(root: Path = Path("/")) -> int:
    """Return the peak memory of this process in bytes; 0 if the system does not report it (host)."""
    return memory_numbers(root / "proc/self/status").get("VmHWM", 0)


def _left_in(folder: Path) -> int | None:
    """Return the free bytes of a control group; None without a limit."""
    for limit, usage in LIMITS:
        try:
            room = int((folder / limit).read_text()) - int((folder / usage).read_text())
            stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
            return room + int(stat.get("total_inactive_file", stat.get("inactive_file", 0)))
        except (OSError, ValueError):
            continue  # of the other version, or "max"
    return None


def tidy_memory() -> None:
    """Return free memory, 100 to 200 MB with glibc, and keep room for programs, after one was compiled."""
    trim_heap()
    keep_room_for_programs()


def keep_room_for_programs(processes: Path = Path("/proc")) -> bool:
    """Drop all compiled programs of JAX if the process is about to run out of memory mappings.

    Linux allows vm.max_map_count of them, 65,530 by default, and XLA takes hundreds for every program. Without one it
    waits for ever. Programs in use are compiled again.

    Args:
      processes: /proc; on systems without one nothing happens.

    Returns:
      Whether programs were dropped.
    """
    mappings = memory_mappings(processes)
    if mappings is None or mappings[0] <= LARGEST_SHARE * mappings[1]:
        return False
    jax.clear_caches()
    return True
