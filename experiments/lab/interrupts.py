"""Ctrl-C and SIGTERM: how a program of experiments ends. Imports nothing but the standard library."""

import contextlib
import os
import shlex
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

INTERRUPTED, TERMINATED = 128 + 2, 128 + 15
"""Exit codes after Ctrl-C and SIGTERM."""


class Terminated(KeyboardInterrupt):
    """SIGTERM, which ends a program as Ctrl-C does."""


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """End the program with one line and exit code 130 if Ctrl-C comes within the block, 143 if SIGTERM does.

    A second SIGTERM ends it at once, without waiting for the end of running jobs.
    """
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    except KeyboardInterrupt as interrupt:
        is_terminated = isinstance(interrupt, Terminated)
        print(_advice("terminated" if is_terminated else "interrupted"), file=sys.stderr)
        sys.exit(TERMINATED if is_terminated else INTERRUPTED)
    finally:
        signal.signal(signal.SIGTERM, before)


def _advice(wording: str) -> str:
    command = shlex.join([Path(sys.executable).name, *sys.argv])
    return f"\n{wording}; what is finished is kept; continue with: {command}"


def _terminate(*_: Any) -> None:
    signal.signal(signal.SIGTERM, _end_at_once)
    raise Terminated


def _end_at_once(*_: Any) -> None:
    """End this process; those of its jobs see that and end too."""
    os.write(2, f"{_advice('terminated')}\n".encode())
    os._exit(TERMINATED)
