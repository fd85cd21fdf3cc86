"""Number of threads of native loops."""

import math
import os

from a2tg_jax.base.control_groups import cpu_quota
from a2tg_jax.base.operating_system import num_cores

VARIABLE = "A2TG_NUM_THREADS"
_chosen: int | None = None


def set_num_threads(num_threads: int | None) -> None:
    """Set the number of threads of native loops, from their next call on; XLA's own threads are not affected.

    Only the last bits of gradients depend on it.

    Args:
      num_threads: number of threads, at least 1; None: the environment variable A2TG_NUM_THREADS, or else all cores
        that the process may use.

    Raises:
      ValueError: if the number is not a positive integer.
    """
    global _chosen
    # isinstance would accept True.
    if num_threads is not None and (type(num_threads) is not int or num_threads < 1):
        raise ValueError(f"num_threads must be a positive integer or None; got {num_threads!r}")
    _chosen = num_threads


def num_threads() -> int:
    """Return the number of threads: the one set, the one in the environment, or one per usable core.

    Raises:
      ValueError: if the environment's is not a positive integer.
    """
    if _chosen is not None:
        return _chosen
    wanted = os.environ.get(VARIABLE)
    if not wanted:
        return max(1, math.ceil(min(num_cores(), cpu_quota())))
    if not wanted.isdecimal() or int(wanted) < 1:
        raise ValueError(f"the environment's {VARIABLE} must be a positive integer; got {wanted!r}")
    return int(wanted)
