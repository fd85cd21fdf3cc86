"""The machine: calls of each operating system without the modules of the others, signals, and numbers of threads."""

import ast
import gc
import math
import os
import re
import signal
import sys
import time
import weakref
from pathlib import Path
from types import SimpleNamespace

import pytest
from scenes_random import as_camera, as_gaussians, draw_scene

import a2tg_jax
from a2tg_jax import render_image
from a2tg_jax.base import control_groups, machine, operating_system, threads as threads_module
from a2tg_jax.host import signals
from a2tg_jax.rasterize.kernels.native import composite as native, ffi

ROOT = Path(__file__).parents[1]
NOT_LOCKED = None
TAKEN = "taken"
NO_LOCKS = OSError(95, "Operation not supported")


@pytest.fixture
def locking(monkeypatch):
    """Stand-ins for both systems' locks: choose one, and what it answers; the other cannot be imported."""

    def chosen(system, answer):
        calls = []

        def call(*arguments):
            calls.append(arguments)
            if answer is not NOT_LOCKED:
                raise answer if answer is not TAKEN else {"win32": PermissionError, "linux": BlockingIOError}[system]

        monkeypatch.setattr(sys, "platform", system)
        fcntl = SimpleNamespace(flock=call, LOCK_EX=2, LOCK_NB=4) if system == "linux" else None
        monkeypatch.setitem(sys.modules, "fcntl", fcntl)
        msvcrt = SimpleNamespace(locking=call, LK_NBLCK=2) if system == "win32" else None
        monkeypatch.setitem(sys.modules, "msvcrt", msvcrt)
        return calls

    return chosen


@pytest.mark.parametrize("answer, is_ours", [(NOT_LOCKED, True), (TAKEN, False), (NO_LOCKS, True)])
@pytest.mark.parametrize("system", ["linux", "win32"])
def test_a_lock_is_the_system_s(locking, tmp_path, system, answer, is_ours):
    calls = locking(system, answer)
    with open(tmp_path / "marker", "a+") as file:
        assert operating_system.try_lock(file.fileno()) == is_ours
        file.write("still at the end")
        file.flush()
        expected = (file.fileno(), 6) if system == "linux" else (file.fileno(), 2, 1)
    assert calls == [expected] and (tmp_path / "marker").stat().st_size == len("still at the end")


def test_folders_are_flushed_except_on_windows(monkeypatch, tmp_path):
    flushed = []
    monkeypatch.setattr(os, "fsync", flushed.append)
    operating_system.flush_folder(tmp_path)
    assert len(flushed) == (0 if sys.platform == "win32" else 1)
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(os, "open", lambda *_: pytest.fail("Windows cannot open folders"))
    operating_system.flush_folder(tmp_path)
    assert len(flushed) < 2


def test_cores_and_features(monkeypatch, tmp_path):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 7)
    assert operating_system.num_cores() == 7
    assert machine.processor_features(tmp_path / "cpuinfo") == frozenset()
    (tmp_path / "cpuinfo").write_text("processor\t: 0\nflags\t\t: fpu avx2\n\nprocessor\t: 1\nflags\t\t: fpu\n")
    assert machine.processor_features(tmp_path / "cpuinfo") == {"fpu", "avx2"}


@pytest.mark.parametrize("library", [SimpleNamespace(), None])
def test_a_heap_is_trimmed_only_by_a_library_that_can(monkeypatch, library):
    monkeypatch.setattr(operating_system, "c_library", lambda: library)
    operating_system.trim_heap()
    trimmed = []
    monkeypatch.setattr(operating_system, "c_library", lambda: SimpleNamespace(malloc_trim=trimmed.append))
    operating_system.trim_heap()
    assert trimmed == [0]


@pytest.mark.parametrize("variable", [None, "DISPLAY", "WAYLAND_DISPLAY"])
def test_linux_needs_a_display_for_a_browser(monkeypatch, variable):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if variable:
        monkeypatch.setenv(variable, ":0")
    for system in ("linux", "darwin", "win32"):
        monkeypatch.setattr(sys, "platform", system)
        assert operating_system.has_display() == (system != "linux" or variable is not None)


class Deleted:
    """An object that calls a function when it goes."""

    def __init__(self, call):
        self.call = call

    def __del__(self):
        self.call()


def collect_with(call):
    """Collect garbage, with a callback that calls a function when it begins."""

    def callback(phase, info):
        if phase == "start":
            call()

    gc.callbacks.append(callback)
    try:
        gc.collect()
    finally:
        gc.callbacks.remove(callback)


def finalize_with(call):
    """Delete an object whose finalizer calls a function."""
    held = {1}
    weakref.finalize(held, call)


def refer_with(call):
    """Delete an object whose weak reference calls a function."""
    held = {1}
    reference = weakref.ref(held, lambda _: call())
    del held
    assert reference() is None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("run", [collect_with, finalize_with, refer_with, lambda call: Deleted(call) and None])
def test_a_signal_is_not_lost_where_python_ignores_exceptions(number, run):
    """Callbacks of the garbage collector and of weak references, and `__del__`, of which JAX has many."""
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt), signals.raised():
        run(lambda: signal.raise_signal(number))
        time.sleep(20)
    assert time.monotonic() - start < 10, "waiting of the main thread is interrupted"


def without_encoding(path):
    """Lines of a module that read or write text in the encoding of the system, which on Windows is not UTF-8."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and "encoding" not in {each.arg for each in node.keywords}:
            name = ast.unparse(node.func)
            mode = [*map(ast.unparse, node.args[1:2]), "'r'"][0]
            if name.endswith((".read_text", ".write_text")) or (name == "open" and "b" not in mode):
                yield f"{path.name}:{node.lineno}"


def test_text_is_utf8_on_every_system():
    """Except what Linux, and what the package's metadata, say of themselves."""
    of_system = {"control_groups", "machine", "memory", "source_commit"}
    modules = [path for path in (ROOT / "a2tg_jax").rglob("*.py") if path.stem not in of_system]
    assert len(modules) > 100 and not [line for path in modules for line in without_encoding(path)]
    assert list(without_encoding(ROOT / "a2tg_jax" / "base" / "machine.py"))


def test_files_of_the_project_can_lie_on_every_system():
    """macOS and Windows do not distinguish case; Windows has forbidden characters, reserved names and short paths."""
    folders = ("a2tg_jax", "tests", "docs", "experiments", "benchmarks", "notebooks", "web/src")
    names = [path.relative_to(ROOT).as_posix() for folder in folders for path in (ROOT / folder).rglob("*")]
    assert len(names) > 500 and len({name.casefold() for name in names}) == len(names)
    bad = re.compile(r'[:*?"<>|\\]|[. ](/|$)|(^|/)(con|prn|aux|nul|(com|lpt)\d)(\.|/|$)', re.IGNORECASE)
    assert not [name for name in names if bad.search(name) or len(name) > 160]


@pytest.mark.parametrize("num", [1, 2])
def test_a_noted_signal_ends_the_block_and_a_second_one_does_at_once(num):
    with pytest.raises(KeyboardInterrupt), a2tg_jax.stop_on_signals((signal.SIGINT,)) as is_interrupted:
        assert not is_interrupted()
        for _ in range(num):
            signal.raise_signal(signal.SIGINT)
            assert is_interrupted()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


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
    "unreadable": ("0::/", {"cpu.max": "plenty"}, math.inf),
    "no groups": ("", {}, math.inf),
}


@pytest.mark.parametrize("name", CGROUPS)
def test_quotas_of_control_groups(tmp_path, name):
    groups, files, expected = CGROUPS[name]
    for path, text in {"proc/self/cgroup": groups, **{f"sys/fs/cgroup/{k}": v for k, v in files.items()}}.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text + "\n")
    assert control_groups.cpu_quota(tmp_path) == expected
    assert control_groups.cpu_quota(tmp_path / "nowhere") == math.inf


@pytest.mark.parametrize(("quota", "expected"), [(0.2, 1), (1.5, 2), (3.0, 3), (99.0, 8), (math.inf, 8)])
def test_the_default_is_what_the_process_may_use(monkeypatch, threads, quota, expected):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(8), raising=False)
    monkeypatch.setattr(threads_module, "cpu_quota", lambda: quota)
    assert threads_module.num_threads() == expected


def test_a_set_number_precedes_the_environment(monkeypatch, threads):
    monkeypatch.setenv("A2TG_NUM_THREADS", "3")
    for given, expected in ((5, 5), (None, 3)):
        a2tg_jax.set_num_threads(given)
        assert threads_module.num_threads() == expected
    for wrong in (0, -1, 1.5, True, "2"):
        with pytest.raises(ValueError, match=r"num_threads must be a positive integer or None; got"):
            a2tg_jax.set_num_threads(wrong)
    for wrong in ("0", "-1", "two"):
        monkeypatch.setenv("A2TG_NUM_THREADS", wrong)
        with pytest.raises(ValueError, match=rf"A2TG_NUM_THREADS must be a positive integer; got '{wrong}'"):
            a2tg_jax.configure_cpu(use_cache=False)


def test_rendering_uses_that_number_of_threads(monkeypatch, threads):
    parts = []
    run_spans = ffi.run_spans
    scene = draw_scene(3, num=60)
    monkeypatch.setattr(native, "PAIRS_PER_THREAD", 1)
    monkeypatch.setattr(ffi, "run_spans", lambda work, spans: (parts.append(len(spans)), run_spans(work, spans)))
    for num in (1, 3):
        parts.clear()
        a2tg_jax.set_num_threads(num)
        render_image(as_gaussians(scene, "float32"), as_camera(scene, "float32")).color.block_until_ready()
        assert max(parts) == num
