"""One scene on several devices: those of a CPU, in a process that is told to have four (`on_devices`)."""

import os
import pathlib
import subprocess
import sys

import jax
import pytest

from a2tg_jax.training import Session

SCRIPT = pathlib.Path(__file__).with_name("on_devices.py")
FOUR = "--xla_force_host_platform_device_count=4"


LONG = [
    pytest.param(what, marks=pytest.mark.long) for what in ("overflowing", "textures", "memory", "lenses", "balance")
]


@pytest.mark.parametrize("what", ["rendering", "batches", "training", "events", *LONG])
def test_several_devices_do_what_one_does(what, tmp_path, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", f"{os.environ['XLA_FLAGS']} {FOUR}")
    command = [sys.executable, str(SCRIPT), what, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr[-3000:]


def test_devices_of_a_session_are_several():
    with pytest.raises(ValueError, match="devices must be two or more; got 1: for one"):
        Session(devices=jax.devices()[:1])
    assert Session().num_devices == 1 and Session().exchange is None
