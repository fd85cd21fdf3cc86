"""Children by fork of a process that uses JAX: without the threads of its devices, no computation ends."""

import os

from jax._src import xla_bridge

_is_child = _has_devices = False


def check_process() -> None:
    """Raise RuntimeError, rather than hang, if this process was forked after JAX had started its devices."""
    if _is_child:
        raise RuntimeError(
            "this process was forked from one in which JAX had started, and waits for its threads forever: start "
            'processes by spawn, as in multiprocessing.get_context("spawn").Pool(), with functions of a module, not of '
            "a notebook"
        )


def _look() -> None:
    global _has_devices
    _has_devices = getattr(xla_bridge, "backends_are_initialized", bool)()  # not public; without it, nothing is checked


def _mark() -> None:
    global _is_child
    _is_child = _is_child or _has_devices


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_look, after_in_child=_mark)
