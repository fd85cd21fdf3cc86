"""Calls that differ between Linux, macOS and Windows. No other module of the host asks which system it runs on."""

import contextlib
import ctypes
import functools
import os
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

UNKNOWN_MEMORY = 2**63 - 1
"""Memory of a machine that does not report it."""
LOCKED_BYTE = 1 << 30
"""Position of the byte that Windows locks: past the end, as Windows keeps others from reading what is locked."""
HANDLER_SIZE = 1024
"""Bytes with room for C's struct sigaction, whose size depends on the system; glibc's has 152."""


def try_lock(number: int) -> bool:
    """Lock an open file for this process, without waiting, until the file is closed or the process ends.

    Linux and macOS lock the file, Windows one byte past its end. Some file systems have no locks; there nothing keeps
    two processes apart.

    Args:
      number: the file's descriptor.

    Returns:
      False if another process has the lock.
    """
    refusal = PermissionError if sys.platform == "win32" else BlockingIOError
    try:
        if sys.platform == "win32":
            import msvcrt

            os.lseek(number, LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(number, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return not isinstance(error, refusal)
    return True


def flush_folder(folder: Path) -> None:
    """Flush the names of a folder's files to disk. Windows cannot open folders and writes names itself."""
    if sys.platform == "win32":
        return
    number = os.open(folder, os.O_RDONLY)
    try:
        # Some file systems of networks refuse it; they keep names in another way.
        with contextlib.suppress(OSError):
            os.fsync(number)
    finally:
        os.close(number)


def reading_flags() -> int:
    """Return the flags to open a file for reading bytes: never waiting for a pipe's writer, never changing newlines."""
    return os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


def allow_recent_port(listening: socket.socket) -> None:
    """Let a socket bind to the port of a program that has just ended.

    Windows allows that anyway; there the option would let two programs share the port.
    """
    if sys.platform != "win32":
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)


def ending_signals() -> tuple[int, ...]:
    """Return the signals, besides Ctrl-C's, that ask a process to end. Windows has no SIGHUP."""
    return tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


@contextlib.contextmanager
def signal_handlers_kept() -> Iterator[None]:
    """Restore the C handlers of all signals after the block, in which a library may replace them.

    Python's `signal.getsignal` does not see those. Windows has no sigaction; there nothing is restored.
    """
    sigaction: Any = getattr(_c_library(), "sigaction", None)
    before = {}
    for signum in signal.valid_signals() if sigaction else ():
        handler = ctypes.create_string_buffer(HANDLER_SIZE)
        if sigaction(int(signum), None, handler) == 0:
            before[int(signum)] = handler
    try:
        yield
    finally:
        for number, handler in before.items():
            sigaction(number, handler, None)


def num_cores() -> int:
    """Return the number of cores that this process may run on. macOS and Windows report all cores of the machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def has_control_groups() -> bool:
    """Return whether the system limits processes by control groups, as Linux does."""
    return sys.platform == "linux"


def machine_memory() -> int:
    """Return bytes of memory of the machine. Windows does not report them here."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else UNKNOWN_MEMORY


def memory_numbers(file: Path) -> dict[str, int]:
    """Return the bytes in a file of Linux's /proc with lines "Name: 123 kB"; empty without such a file."""
    try:
        lines = [line.replace(":", " ").split() for line in file.read_text().splitlines()]
    except OSError:
        return {}
    return {line[0]: 1024 * int(line[1]) for line in lines if line[2:] == ["kB"] and line[1].isdecimal()}


def memory_mappings(processes: Path) -> tuple[int, int] | None:
    """Return the number of memory mappings of this process, and Linux's limit; None if the system reports neither.

    Args:
      processes: /proc.
    """
    try:
        limit = int((processes / "sys/vm/max_map_count").read_text())
        with open(processes / "self/maps", "rb") as maps:
            return sum(1 for _ in maps), limit
    except (OSError, ValueError):
        return None


def trim_heap() -> None:
    """Have the C library return the free memory that it caches. Only glibc has a function for that."""
    trim = getattr(_c_library(), "malloc_trim", None)
    if trim is not None:
        trim(0)


def wait_in_abort() -> None:
    """Have abort() wait some seconds before it ends the process, so that another thread can tell why and end it.

    XLA aborts the process once it hears of the end of another one. Windows keeps its abort().
    """
    library = _c_library()
    if library is not None:
        library.signal.argtypes, library.signal.restype = [ctypes.c_int, ctypes.c_void_p], ctypes.c_void_p
        # C's sleep takes the number of the signal, 6, for seconds.
        library.signal(signal.SIGABRT, ctypes.cast(library.sleep, ctypes.c_void_p))


def own_output_only() -> None:
    """Drop what C++ libraries write to stdout and stderr; `sys.stdout` and `sys.stderr` keep their places."""
    sys.stdout, sys.stderr = (_moved(stream, number) for number, stream in ((1, sys.stdout), (2, sys.stderr)))


def _moved(stream: TextIO, number: int) -> TextIO:
    """Return the stream on a descriptor of its own, and leave its old one to be dropped."""
    stream.flush()
    kept = os.fdopen(os.dup(number), "w", buffering=1, encoding=stream.encoding, errors=stream.errors)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, number)
    os.close(nowhere)
    return kept


@functools.cache
def _c_library() -> Any:
    try:
        return ctypes.CDLL(None)
    except (OSError, TypeError):  # Windows has no such library.
        return None


def processor_features(file: Path = Path("/proc/cpuinfo")) -> frozenset[str]:
    """Return the processor's features as Linux lists them; macOS and Windows list none."""
    try:
        lines = file.read_text().splitlines()
    except OSError:
        return frozenset()
    return frozenset(next((line.split(":", 1)[1].split() for line in lines if line.startswith("flags")), []))


def has_display() -> bool:
    """Return whether a browser can open: macOS and Windows always have a display, Linux with X or Wayland."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def cuda_of_driver() -> tuple[int, int] | None:
    """Return the newest CUDA version that the NVIDIA driver supports; None without a driver."""
    number, library = ctypes.c_int(), "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    try:
        ctypes.CDLL(library).cuDriverGetVersion(ctypes.byref(number))
    except (OSError, AttributeError):
        return None
    return number.value // 1000, number.value % 1000 // 10
