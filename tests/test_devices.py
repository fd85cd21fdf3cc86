"""One scene on several devices: four devices of a CPU, in another process (`on_devices`)."""

import os
import pathlib
import subprocess
import sys

import jax
import pytest

from a2tg_jax.training import Session

SCRIPT = pathlib.Path(__file__).with_name("on_devices.py")
LONG = ("xla", "batches", "training", "events", "shared", "overflowing", "textures", "memory", "lenses", "balance")
"""Names that one process takes, since they share what it compiles."""


@pytest.mark.parametrize("names", [("rendering",), pytest.param(LONG, marks=pytest.mark.long)], ids=["quick", "all"])
def test_several_devices_do_what_one_does(names, tmp_path, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=4")
    command = [sys.executable, str(SCRIPT), *names, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=1800)
    assert done.returncode == 0, done.stderr[-9000:]


def test_devices_of_a_session_are_several():
    with pytest.raises(ValueError, match="devices must be two or more; got 1: for one"):
        Session(devices=jax.devices()[:1])
    assert Session().num_devices == 1 and Session().exchange is None
