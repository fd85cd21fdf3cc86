"""Number of threads of native loops."""

import functools
import math
import os
from pathlib import Path

from a2tg_jax.host.control_groups import group_folders
from a2tg_jax.host.operating_system import has_control_groups, num_cores

VARIABLE = "A2TG_NUM_THREADS"

_chosen: int | None = None


def set_num_threads(num_threads: int | None) -> None:
    """Set the number of threads of native loops, from their next call on; XLA's own threads are not affected.

    Only the last bits of gradients depend on it.

    Args:
      num_threads: at least 1; None: A2TG_NUM_THREADS of the environment, or else all cores that the process may use.

    Raises:
      ValueError: if the number is not a positive integer.
    """
    global _chosen
    if num_threads is not None and (
        not isinstance(num_threads, int) or isinstance(num_threads, bool) or num_threads < 1
    ):
        raise ValueError(f"num_threads must be a positive integer or None; got {num_threads!r}")
    _chosen = num_threads


def num_threads() -> int:
    """Return the number of threads: the one set, that of the environment, or one per available core.

    Raises:
      ValueError: if the environment's is not a positive integer.
    """
    if _chosen is not None:
        return _chosen
    wanted = os.environ.get(VARIABLE)
    if not wanted:
        return _usable_cores()
    if not wanted.isdecimal() or int(wanted) < 1:
        raise ValueError(f"the environment's {VARIABLE} must be a positive integer; got {wanted!r}")
    return int(wanted)


def _usable_cores() -> int:
    """Return the number of usable cores, which the quota of a control group (a container) may reduce."""
    return max(1, math.ceil(min(num_cores(), _own_quota())))


@functools.cache
def _own_quota() -> float:
    return cpu_quota(Path("/")) if has_control_groups() else math.inf


def cpu_quota(root: Path) -> float:
    """Return the number of processors that control groups grant this process; inf without a limit.

    Args:
      root: root of the file system, as for `host.control_groups.group_folders`.
    """
    return min([math.inf, *map(_folder_quota, group_folders(root, "cpu"))])


def _folder_quota(folder: Path) -> float:
    """Return the limit of one group: cpu.max of version 2, or the files of version 1."""
    try:
        if (folder / "cpu.max").is_file():
            quota, period = (folder / "cpu.max").read_text().split()
        else:
            quota, period = ((folder / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        return int(quota) / int(period) if int(quota) > 0 else math.inf
    except (OSError, ValueError, ZeroDivisionError):
        return math.inf  # "max", or no limit that can be read
