"""Each system's way of a call, with the modules and functions of the others taken away."""

import gc
import os
import signal
import sys
import time
from types import SimpleNamespace

import pytest

from a2tg_jax.host import machine, operating_system, signals

SYSTEMS = ("linux", "darwin", "win32")
NOT_LOCKED, TAKEN, NO_LOCKS = None, "taken", OSError(95, "Operation not supported")


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


def test_cores_and_features_without_linux(monkeypatch, tmp_path):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 7)
    assert operating_system.num_cores() == 7
    assert machine.processor_features(tmp_path / "cpuinfo") == frozenset()


def test_features_are_those_of_the_first_processor(tmp_path):
    (tmp_path / "cpuinfo").write_text("processor\t: 0\nflags\t\t: fpu avx2\n\nprocessor\t: 1\nflags\t\t: fpu\n")
    assert machine.processor_features(tmp_path / "cpuinfo") == {"fpu", "avx2"}


@pytest.mark.parametrize("library", [SimpleNamespace(), None])
def test_a_heap_is_trimmed_only_by_a_library_that_can(monkeypatch, library):
    monkeypatch.setattr(operating_system, "_c_library", lambda: library)
    operating_system.trim_heap()
    trimmed = []
    monkeypatch.setattr(operating_system, "_c_library", lambda: SimpleNamespace(malloc_trim=trimmed.append))
    operating_system.trim_heap()
    assert trimmed == [0]


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("variable", [None, "DISPLAY", "WAYLAND_DISPLAY"])
def test_linux_needs_a_display_for_a_browser(monkeypatch, system, variable):
    monkeypatch.setattr(sys, "platform", system)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if variable:
        monkeypatch.setenv(variable, ":0")
    assert operating_system.has_display() == (system != "linux" or variable is not None)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_within_a_callback_of_the_garbage_collector_is_not_lost(number):
    """Python prints and ignores what such a callback raises; JAX has one, which runs often while modules load."""
    sent = []

    def callback(phase, info):
        if not sent:
            sent.append(number)
            signal.raise_signal(number)

    gc.callbacks.append(callback)
    try:
        start = time.monotonic()
        with pytest.raises(KeyboardInterrupt), signals.raised():
            gc.collect()
            assert sent
            time.sleep(20)
        assert time.monotonic() - start < 10, "waiting of the main thread is interrupted"
    finally:
        gc.callbacks.remove(callback)
