"""Tests that compare bits between programs of different layout. They hold with the flags that `configure_cpu` sets on
all processors, but not in the unoptimised code of other tests."""

import os
import subprocess
import sys

import jax
from xla_flags import UNOPTIMISED

from a2tg_jax.host.startup import cpu_flags


def passes_in_its_own_process(request) -> bool:
    """Run a test in a process with optimised code; False, if this is that process."""
    if UNOPTIMISED not in os.environ["XLA_FLAGS"]:
        return False
    flags = {"XLA_FLAGS": " ".join(cpu_flags(frozenset(), jax.__version_info__[:2]))}
    name = f"{request.node.path}::{request.node.name}"
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "--long", name]
    done = subprocess.run(command, env=os.environ | flags, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stdout + done.stderr
    return True
