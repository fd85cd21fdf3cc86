"""Limits of Linux's control groups: containers, jobs and services."""

import contextlib
import functools
import itertools
import math
from collections.abc import Iterator
from pathlib import Path

MEMORY_FILES = (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes"))
"""File names of a control group's limit and use, in version 2 and in version 1."""


def control_groups(root: Path, controller: str) -> list[Path]:
    """Return the folders of Linux's control groups (containers, jobs, services) of this process, innermost first.

    A group's limit holds for all groups in it. A container may see its group's path on the host, whose folders do not
    exist; then the limit is at the top.

    Args:
      root: root of the file system, with proc/self/cgroup and sys/fs/cgroup.
      controller: "cpu" or "memory".
    """
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return []
    folders: list[Path] = []
    for line in lines:
        if line.count(":") < 2:
            continue
        _, controllers, path = line.split(":", 2)
        # Version 2 has one hierarchy, which is listed without controllers.
        if not controllers or controller in controllers.split(","):
            top = root / "sys/fs/cgroup" / controllers
            here = top / path.lstrip("/")
            folders += [folder for folder in (here, *here.parents) if folder.is_relative_to(top)]
    return folders


@functools.cache
def cpu_quota(root: Path = Path("/")) -> float:
    """Return the number of processors that control groups grant this process; inf without a limit."""
    quotas = [math.inf]
    for folder in control_groups(root, "cpu"):
        with contextlib.suppress(OSError, ValueError, ZeroDivisionError):  # "max", or unreadable
            if (folder / "cpu.max").is_file():
                quota, period = (folder / "cpu.max").read_text().split()
            else:  # version 1
                quota = (folder / "cpu.cfs_quota_us").read_text()
                period = (folder / "cpu.cfs_period_us").read_text()
            if int(quota) > 0:  # -1 is no limit.
                quotas.append(int(quota) / int(period))
    return min(quotas)


def memory_left(root: Path) -> Iterator[int]:
    """Yield the bytes of memory that each group may still use. Its file cache counts as free."""
    for folder, (limit, usage) in itertools.product(control_groups(root, "memory"), MEMORY_FILES):
        with contextlib.suppress(OSError, ValueError):  # a file of the other version, or "max"
            room = int((folder / limit).read_text()) - int((folder / usage).read_text())
            stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
            # The kernel drops inactive file cache on demand. Version 1 has the sums over subgroups in total_*.
            yield room + int(stat.get("total_inactive_file", stat.get("inactive_file", 0)))
