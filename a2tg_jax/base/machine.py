"""The machine of this process: its threads, memory and processor.

JAX is imported in functions, so that the command line can answer a mistyped command at once.
"""

import contextlib
import dataclasses
import faulthandler
import functools
import hashlib
import itertools
import math
import os
import platform
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
from jaxlib.version import __version__ as jaxlib_version

from a2tg_jax.base.operating_system import keep_one_heap, num_cores, stack_bytes, trim_heap, ulimits
from a2tg_jax.base.text import in_bytes

if TYPE_CHECKING:
    import jax

VARIABLE = "A2TG_NUM_THREADS"
LARGEST_SHARE = 0.6
"""Share of a process's allowed memory mappings beyond which compiled programs are dropped."""
MEMORY_FILES = (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes"))
"""File names of a control group's limit and use, in version 2 and in version 1."""
LEAST_ULIMITS = {"v": 1_800_000_000, "d": 1_000_000_000}
"""Bytes of address space and of data for Python's libraries, JAX and a short training, without stacks of threads."""
STACKS_PER_CORE = 4
"""Threads per core: two pools of XLA, and BLAS in numpy and in scipy."""

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


def memory_limit(root: Path = Path("/")) -> int:
    """Return the total bytes of memory that this process may use: its own plus what is free now (host).

    Limits of control groups and of `ulimit` count. A group's file cache counts as free.
    """
    process = psutil.Process()
    left: list[int] = [psutil.virtual_memory().available]
    for letter, most in ulimits().items():
        used = process.memory_info()
        left.append(most - (used.vms if letter == "v" else used.data))
    for folder, (limit, usage) in itertools.product(control_groups(root, "memory"), MEMORY_FILES):
        with contextlib.suppress(OSError, ValueError):  # a file of the other version, or "max"
            room = int((folder / limit).read_text()) - int((folder / usage).read_text())
            stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
            # The kernel drops inactive file cache on demand. Version 1 has the sums over subgroups in total_*.
            left.append(room + int(stat.get("total_inactive_file", stat.get("inactive_file", 0))))
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


def processor_features(file: Path = Path("/proc/cpuinfo")) -> frozenset[str]:
    """Return the processor's features as Linux lists them; macOS and Windows list none."""
    for line in file.read_text().splitlines() if file.exists() else ():
        if line.startswith("flags"):
            return frozenset(line.partition(":")[2].split())
    return frozenset()


def processor_key() -> str:
    """Return a hash that is equal for processors that can run each other's compiled code."""
    processor = f"{platform.machine()} {platform.processor()} {' '.join(sorted(processor_features()))}"
    return hashlib.sha256(processor.encode()).hexdigest()[:12]


@dataclasses.dataclass(frozen=True)
class Machine:
    """Machine and software that computed a result. Like the options, they affect its last bits."""

    jax: str
    """Version."""
    jaxlib: str
    """Version."""
    device: str
    """JAX's platform and the kind of device."""
    processor: str
    """Hash that is equal for processors that can run each other's compiled code."""
    threads: int
    """Number of threads of native loops, which divide sums among them."""

    def differences(self, now: "Machine") -> list[str]:
        """Return the differences to another machine that affect the last bits, with a remedy if there is one."""
        differences = []
        for name in ("jax", "jaxlib", "device", "processor"):
            before = getattr(self, name)
            if before != getattr(now, name):
                differences.append(f"{name} is {getattr(now, name)} and was {before}")
        if self.threads != now.threads and now.device.startswith("cpu"):
            remedy = f"{VARIABLE}={self.threads} keeps them"
            differences.append(f"there are {now.threads} threads and were {self.threads} ({remedy})")
        return differences


@dataclasses.dataclass(frozen=True)
class Devices:
    """Numbers of devices and processes that train one scene together."""

    each: int = 1
    """Devices of each process."""
    processes: int = 1


ALONE = Devices()


def default_device() -> "jax.Device":
    """Return JAX's device on which new arrays are placed."""
    import jax

    # jax.default_device may name another one than the first.
    (device,) = jax.numpy.zeros(()).devices()
    return device


def default_platform() -> str:
    """Return JAX's platform of the device on which new arrays are placed ("cpu" or "gpu")."""
    return default_device().platform


def this_machine() -> Machine:
    """Return the machine of this process. This starts JAX's devices."""
    import jax

    device = jax.devices()[0]
    kind = f"{device.platform} {device.device_kind}"
    return Machine(jax.__version__, jaxlib_version, kind, processor_key(), num_threads())


def cache_folder() -> Path:
    """Return the cache folder: $XDG_CACHE_HOME/a2tg-jax, or ~/.cache/a2tg-jax."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "a2tg-jax"
