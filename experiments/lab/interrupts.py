"""Ctrl-C: how a program of experiments ends. Imports nothing but the standard library."""

import contextlib
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

INTERRUPTED = 128 + 2
"""Exit code after Ctrl-C."""


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """End the program with one line and exit code 130 if Ctrl-C comes within the block."""
    try:
        yield
    except KeyboardInterrupt:
        command = shlex.join([Path(sys.executable).name, *sys.argv])
        print(f"\ninterrupted; what is finished is kept; continue with: {command}", file=sys.stderr)
        sys.exit(INTERRUPTED)
