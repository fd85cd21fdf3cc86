"""Tests that compare bits between programs of different layout, which hold with XLA's own fusions only."""

import os
import subprocess
import sys

from xla_flags import UNOPTIMISED


def passes_in_its_own_process(request) -> bool:
    """Run a test in a process with XLA's own fusions; False, if this is that process."""
    if "fusion_emitters=false" not in os.environ["XLA_FLAGS"]:
        return False
    flags = {"XLA_FLAGS": UNOPTIMISED}
    name = f"{request.node.path}::{request.node.name}"
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "--long", name]
    done = subprocess.run(command, env=os.environ | flags, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stdout + done.stderr
    return True
