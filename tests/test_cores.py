"""How many threads native loops run on: what is set, the environment, and the limits of control groups."""

import math
import os

import pytest
from scenes_random import as_camera, as_gaussians, draw_scene

import a2tg_jax
from a2tg_jax import render_image
from a2tg_jax.host import machine
from a2tg_jax.rasterize.kernels.native import composite as native, ffi

CGROUPS = {
    "version 2, in a container": ("0::/", {"cpu.max": "150000 100000"}, 1.5),
    "version 2, without a limit": ("0::/", {"cpu.max": "max 100000"}, math.inf),
    "version 2, the group around it": (
        "0::/user/job",
        {"user/cpu.max": "200000 100000", "user/job/cpu.max": "300000 100000"},
        2.0,
    ),
    "version 1": (
        "4:memory:/job\n3:cpu,cpuacct:/job",
        {"cpu,cpuacct/job/cpu.cfs_quota_us": "50000", "cpu,cpuacct/job/cpu.cfs_period_us": "100000"},
        0.5,
    ),
    "version 1, path of the host": (
        "3:cpu:/docker/0123\n0::/",
        {"cpu/cpu.cfs_quota_us": "400000", "cpu/cpu.cfs_period_us": "100000"},
        4.0,
    ),
    "version 1, without a limit": (
        "3:cpu:/",
        {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"},
        math.inf,
    ),
    "what cannot be read": ("0::/", {"cpu.max": "plenty"}, math.inf),
}


@pytest.fixture(autouse=True)
def untouched(monkeypatch):
    monkeypatch.setattr(machine, "_chosen", None)
    monkeypatch.delenv(machine.VARIABLE, raising=False)


@pytest.mark.parametrize("name", CGROUPS)
def test_quotas_of_control_groups(tmp_path, name):
    groups, files, expected = CGROUPS[name]
    for path, text in {"proc/self/cgroup": groups, **{f"sys/fs/cgroup/{k}": v for k, v in files.items()}}.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text + "\n")
    assert machine.cpu_quota(tmp_path) == expected


def test_without_control_groups_there_is_no_quota(tmp_path):
    assert machine.cpu_quota(tmp_path) == math.inf


@pytest.mark.parametrize(("quota", "expected"), [(0.2, 1), (1.5, 2), (3.0, 3), (99.0, 8), (math.inf, 8)])
def test_the_default_is_what_the_process_may_use(monkeypatch, quota, expected):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(8), raising=False)
    monkeypatch.setattr(machine, "cpu_quota", lambda: quota)
    assert machine.num_threads() == expected


def test_what_is_set_precedes_the_environment(monkeypatch):
    monkeypatch.setenv(machine.VARIABLE, "3")
    assert machine.num_threads() == 3
    a2tg_jax.set_num_threads(5)
    assert machine.num_threads() == 5
    a2tg_jax.set_num_threads(None)
    assert machine.num_threads() == 3


@pytest.mark.parametrize("wrong", [0, -1, 1.5, True, "2"])
def test_wrong_numbers_are_refused(wrong):
    with pytest.raises(ValueError, match=r"num_threads must be a positive integer or None; got"):
        a2tg_jax.set_num_threads(wrong)


@pytest.mark.parametrize("wrong", ["0", "-1", "two"])
def test_a_wrong_environment_is_named(monkeypatch, wrong):
    monkeypatch.setenv(machine.VARIABLE, wrong)
    with pytest.raises(ValueError, match=rf"A2TG_NUM_THREADS must be a positive integer; got '{wrong}'"):
        a2tg_jax.configure_cpu(use_cache=False)


@pytest.mark.parametrize("num", [1, 2, 3])
def test_as_many_threads_render_as_are_set(monkeypatch, num):
    parts = []
    run_spans = ffi.run_spans
    monkeypatch.setattr(native, "PAIRS_PER_THREAD", 1)
    monkeypatch.setattr(ffi, "run_spans", lambda work, spans: (parts.append(len(spans)), run_spans(work, spans)))
    scene = draw_scene(3, num=60)
    a2tg_jax.set_num_threads(num)
    render_image(as_gaussians(scene, "float32"), as_camera(scene, "float32")).color.block_until_ready()
    assert max(parts) == num
