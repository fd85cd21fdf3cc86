"""One scene on several devices: four devices of a CPU, in another process (`on_devices`)."""

import os
import pathlib
import subprocess
import sys

import jax
import pytest

from a2tg_jax import Session
from a2tg_jax.cli import main as cli

SCRIPT = pathlib.Path(__file__).with_name("on_devices.py")
LONG = ("lenses", "training", "textures", "events", "details", "shared", "memory")
"""Names that one process takes, since they share what it compiles."""


@pytest.mark.parametrize("names", [("gradients",), pytest.param(LONG, marks=pytest.mark.long)], ids=["quick", "all"])
def test_several_devices_do_what_one_does(names, tmp_path, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=4")
    command = [sys.executable, str(SCRIPT), *names, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=1800)
    assert done.returncode == 0, done.stderr[-9000:]


def test_devices_of_a_session_are_several():
    with pytest.raises(ValueError, match="devices must be two or more; got 1: for one"):
        Session(devices=jax.devices()[:1])
    assert Session().num_devices == 1 and Session().mesh is None


def test_views_that_devices_cannot_share_are_refused():
    session = Session()
    session.check_batch_size(1)
    session.num_devices = 4
    session.check_batch_size(8)
    with pytest.raises(ValueError, match=r"of the 4 devices, .*; got 1: take 4 or a multiple of it, or 1 of"):
        session.check_batch_size(1)


@pytest.mark.long
def test_the_command_takes_a_view_for_each_device(tmp_path, monkeypatch):
    """And continues on fewer devices, but not on a number that does not divide the views."""
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=4"
    monkeypatch.setenv("XLA_FLAGS", flags)
    small = ["--system", "gaussians-2d", "--preset", "smoke", "--downscale", "8", "--stage1-iterations", "4"]

    def run(*words):
        command = [sys.executable, "-m", "a2tg_jax", "train", *words, "--out", str(tmp_path / "run")]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)

    first = run("synthetic", *small, "--devices", "4")
    assert first.returncode == 0, first.stderr
    assert "4 devices: 4 views a step (--batch-size)" in first.stdout
    assert "batch_size = 4" in (tmp_path / "run" / "run.toml").read_text()
    refused = run("--resume", "--more", "4", "--devices", "3")
    assert refused.returncode == 2 and "must be a multiple of the 3 devices" in refused.stderr
    again = run("--resume", "--more", "4", "--devices", "2")
    assert again.returncode == 0, again.stderr


def test_the_command_needs_as_many_devices(tmp_path, capsys):
    assert cli.main(["train", "synthetic", "--out", str(tmp_path / "run"), "--devices", "9"]) == 2
    assert "--devices must be all, or a number from 1 to" in capsys.readouterr().err
