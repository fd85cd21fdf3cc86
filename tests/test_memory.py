"""What compiled programs leave behind."""

import shutil
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import psutil
import pytest

from a2tg_jax import Gaussians2dMcmc, Session, fit, synthetic_scene
from a2tg_jax.base import memory, operating_system
from a2tg_jax.base.memory import keep_room_for_programs, memory_limit, tidy_memory
from a2tg_jax.base.operating_system import trim_heap
from a2tg_jax.host.errors import error_text
from a2tg_jax.training.step import jitted_step


def proc(folder, count: int, limit: str):
    """A /proc of a process with this number of memory mappings."""
    for name in ("self", "sys/vm"):
        (folder / name).mkdir(parents=True)
    (folder / "self/maps").write_text("00-01 rw-p\n" * count)
    (folder / "sys/vm/max_map_count").write_text(limit)
    return folder


@pytest.mark.parametrize("count, limit, is_dropped", [(59, "100\n", False), (61, "100\n", True), (61, "many", False)])
def test_programs_are_dropped_before_there_is_no_room_for_more(tmp_path, count, limit, is_dropped):
    double = jax.jit(lambda x: 2 * x)
    double(jnp.ones(3))
    assert keep_room_for_programs(proc(tmp_path, count, limit)) == is_dropped
    assert double._cache_size() == (0 if is_dropped else 1)
    assert float(double(jnp.ones(3))[0]) == 2


def test_without_proc_nothing_happens(tmp_path):
    assert not keep_room_for_programs(tmp_path / "nowhere")
    trim_heap()


@pytest.mark.long
def test_training_calls_its_session_after_compiling(monkeypatch):
    """A limit of 0 memory mappings makes every compilation exceed it."""
    monkeypatch.setattr(memory, "LARGEST_SHARE", 0)
    scene = synthetic_scene(num_views=3, width=24, height=16, num_points=40)
    dropped = []
    double = jax.jit(lambda x: 2 * x)
    double(jnp.ones(3))

    def tidy():
        dropped.append(double._cache_size())
        tidy_memory()
        dropped.append(double._cache_size())

    jitted_step().clear_cache()
    fit(scene, Gaussians2dMcmc(stage1_iterations=2), session=Session(tidy))
    assert dropped[:2] == [1, 0]


USED = "job/memory.max=900000; job/memory.current=600000"
GROUPS = {
    "none": ("", "", 1000),
    "version 2": ("0::/job", USED, 100 + 293),
    "version 2, what can be read again is free": (
        "0::/job", f"{USED}; job/memory.stat=anon 7\ninactive_file 102400", 100 + 293 + 100,
    ),
    "version 2, the group around it": (
        "0::/user/job",
        "user/memory.max=512000; user/memory.current=307200; user/job/memory.max=max; user/job/memory.current=307200",
        100 + 200,
    ),
    "version 1": (
        "4:memory:/job\n3:cpu:/",
        "memory/job/memory.limit_in_bytes=409600; memory/job/memory.usage_in_bytes=307200", 100 + 100,
    ),
    "a limit beyond the machine's": (
        "4:memory:/job",
        f"memory/job/memory.limit_in_bytes={2**63 - 4096}; memory/job/memory.usage_in_bytes=0", 1000,
    ),
    "over its limit": ("0::/", "memory.max=1024; memory.current=102400", 100),
}  # fmt: skip
"""Groups of a process, files of their limits, and the kilobytes that it may have."""


@pytest.mark.parametrize("name", GROUPS)
def test_memory_that_a_process_may_have(tmp_path, monkeypatch, name):
    groups, limits, kilobytes = GROUPS[name]
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=900 * 1024))
    process = SimpleNamespace(memory_info=lambda: SimpleNamespace(rss=100 * 1024))
    monkeypatch.setattr(psutil, "Process", lambda: process)
    files = {"proc/self/cgroup": groups}
    for path, _, text in (line.partition("=") for line in limits.split("; ") if line):
        files[f"sys/fs/cgroup/{path}"] = text
        files.setdefault(f"sys/fs/cgroup/{path}".rpartition("/")[0] + "/memory.stat", "anon 0")
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text + "\n")
    assert abs(memory_limit(tmp_path) / 1024 - kilobytes) < 1


def test_the_memory_of_this_process():
    assert 2**26 < psutil.Process().memory_info().rss <= memory_limit()


@pytest.mark.parametrize("letter, used", [("v", 300 * 1024), ("d", 200 * 1024)])
def test_a_ulimit_counts_what_is_reserved(tmp_path, monkeypatch, letter, used):
    monkeypatch.setattr(memory, "ulimits", lambda: {letter: used + 50 * 1024})
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=900 * 1024))
    used_now = SimpleNamespace(rss=100 * 1024, vms=300 * 1024, data=200 * 1024)
    monkeypatch.setattr(psutil, "Process", lambda: SimpleNamespace(memory_info=lambda: used_now))
    assert memory_limit(tmp_path) == 150 * 1024


SMALL_FIT = """
import a2tg_jax as a2tg
scene = a2tg.synthetic_scene(num_views=3, width=24, height=16, num_points=40)
print(a2tg.fit(scene, a2tg.Gaussians2dMcmc(stage1_iterations=2)))
"""


def limited(option: str, limit: int, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python with a limit of its address space ("as") or data ("data")."""
    program = shutil.which("prlimit")
    if program is None:
        pytest.skip("prlimit, of util-linux, is not installed")
    command = [program, f"--{option}={limit}", sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.parametrize("option, limit", [("as", 500), ("as", 1000), ("as", 1700), ("data", 200), ("data", 600)])
def test_too_small_a_ulimit_is_refused_before_jax_crashes(option, limit):
    """JAX ends such a process with SIGSEGV or SIGABRT, or waits forever."""
    letter, kind = {"as": ("v", "address space"), "data": ("d", "data")}[option]
    wanted = f"{limit / 1000:.2f} GB" if limit >= 1000 else f"{limit} MB"
    command = limited(option, limit * 10**6, "-m", "a2tg_jax", "train", "synthetic", "--out", "never")
    assert command.returncode == 2
    assert command.stderr.startswith(f"a2tg: error: this process may reserve {wanted} of {kind}, and JAX")
    assert f"ulimit -{letter} unlimited" in command.stderr and command.stderr.count("\n") == 1
    library = limited(option, limit * 10**6, "-c", SMALL_FIT)
    assert library.returncode == 1 and f"ValueError: this process may reserve {wanted} of {kind}" in library.stderr


def test_what_needs_no_jax_runs_within_a_small_ulimit():
    done = limited("as", 1_000_000_000, "-m", "a2tg_jax", "download", "--list")
    assert done.returncode == 0 and "garden" in done.stdout, done.stderr
    assert limited("as", 1_000_000_000, "-m", "a2tg_jax", "train", "--help").returncode == 0


@pytest.mark.long
@pytest.mark.parametrize("option, letter", [("as", "v"), ("data", "d")])
def test_the_least_ulimit_is_enough(option, letter):
    stacks = memory.STACKS_PER_CORE * operating_system.num_cores() * operating_system.stack_bytes()
    done = limited(option, memory.LEAST_ULIMITS[letter] + stacks, "-c", SMALL_FIT)
    assert done.returncode == 0 and "FitResult(" in done.stdout, done.stderr


def test_a_library_without_room_is_a_lack_of_memory():
    error = ImportError("libzstd.so.1: failed to map segment from shared object")
    assert error_text(error, "close other programs").startswith("not enough memory to load a library (libzstd.so.1")
    assert error_text(ImportError("no module named x"), "") is None
