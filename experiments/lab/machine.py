"""Memory, GPUs and cores of this machine."""

import functools
import os
import subprocess
import sys
from pathlib import Path

CGROUP_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
UNKNOWN_BYTES = 16e9
"""Memory assumed if the system does not report it."""


def memory_bytes() -> float:
    """Return the memory of the machine or of the container, whichever is less."""
    try:
        total = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        total = UNKNOWN_BYTES
    limits = [Path(path).read_text().strip() for path in CGROUP_LIMITS if Path(path).is_file()]
    return min([total, *(float(limit) for limit in limits if limit.isdigit())])


@functools.cache
def num_gpus() -> int:
    """Return the number of GPUs that JAX sees. Another process looks, since JAX would take their memory in this one."""
    script = "import jax; print(len(jax.devices()) if jax.default_backend() == 'gpu' else 0)"
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False).stdout.split()
    return int(found[-1]) if found and found[-1].isdigit() else 0


def num_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_jobs() -> int:
    """Return one job a GPU, whose memory jobs would share, else one a core."""
    return num_gpus() or num_cores()
