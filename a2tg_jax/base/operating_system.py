"""Calls that differ between Linux, macOS and Windows. No other module checks the operating system."""

import contextlib
import ctypes
import functools
import os
import sys
from pathlib import Path
from typing import Any

LOCKED_BYTE = 1 << 30
"""Position of the byte that Windows locks: past the file's end, because others cannot read a locked byte."""
M_ARENA_MAX = -8
"""Number of glibc's option for the largest number of heaps, in malloc.h."""
STACK_BYTES = 8 << 20
"""Usual size of a thread's stack."""


def try_lock(number: int) -> bool:
    """Lock an open file for this process, without waiting, until the file is closed or the process ends.

    Args:
      number: file descriptor.

    Returns:
      False if another process has the lock. True if this one has it, or if the file system has no locks.
    """
    refusal = PermissionError if sys.platform == "win32" else BlockingIOError  # EACCES and EWOULDBLOCK.
    try:
        if sys.platform == "win32":
            import msvcrt

            os.lseek(number, LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(number, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return not isinstance(error, refusal)  # Otherwise there are no locks.
    return True


def flush_folder(folder: Path) -> None:
    """Flush the names of a folder's files to disk. Windows cannot open folders and writes names itself."""
    if sys.platform == "win32":
        return
    number = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # Some network file systems refuse it.
            os.fsync(number)
    finally:
        os.close(number)


def num_cores() -> int:
    """Return the number of cores that this process may use; on macOS and Windows all cores of the machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def trim_heap() -> None:
    """Return the C library's cached free memory to the system. Only glibc has a function for that."""
    trim = getattr(c_library(), "malloc_trim", None)
    if trim is not None:
        trim(0)


def keep_one_heap() -> None:
    """Let the threads that start from now on share one heap. glibc reserves 64 MB of address space for each other."""
    set_option = getattr(c_library(), "mallopt", None)
    if set_option is not None:
        set_option(M_ARENA_MAX, 1)


def ulimits() -> dict[str, int]:
    """Return the bytes that this process may reserve, by the letter of `ulimit`: v for address space, d for data.
    Unlimited ones are left out; macOS does not enforce them, and Windows has none."""
    if sys.platform != "linux":
        return {}
    import resource

    soft = {"v": resource.getrlimit(resource.RLIMIT_AS)[0], "d": resource.getrlimit(resource.RLIMIT_DATA)[0]}
    return {letter: limit for letter, limit in soft.items() if limit != resource.RLIM_INFINITY}


def stack_bytes() -> int:
    """Return the bytes of a new thread's stack on Linux."""
    import resource

    soft = resource.getrlimit(resource.RLIMIT_STACK)[0]
    return STACK_BYTES if soft == resource.RLIM_INFINITY else soft


@functools.cache
def c_library() -> Any:
    """Return the C library, by ctypes; None if there is none, as on Windows."""
    try:
        return ctypes.CDLL(None)
    except (OSError, TypeError):
        return None


def has_display() -> bool:
    """Return whether a browser can open: always on macOS and Windows, on Linux with X or Wayland."""
    variables = ("DISPLAY", "WAYLAND_DISPLAY")
    return sys.platform in ("win32", "darwin") or any(os.environ.get(name) for name in variables)


def cuda_of_driver() -> tuple[int, int] | None:
    """Return the newest CUDA version that the NVIDIA driver supports; None without a driver."""
    number = ctypes.c_int()
    library = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    try:
        ctypes.CDLL(library).cuDriverGetVersion(ctypes.byref(number))
    except (OSError, AttributeError):
        return None
    return number.value // 1000, number.value % 1000 // 10  # 13020 is 13.2.
