"""What happens in functions that XLA calls reaches the caller: results, errors, and Ctrl-C."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from a2tg_jax.rasterize.kernels.native import ffi

SCRIPT = """
import os, signal, sys, threading, time
import jax, jax.numpy as jnp
from a2tg_jax.rasterize.kernels.native import ffi

# A program that a shell runs in the background ignores Ctrl-C, and so do those that it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)

def part(first, last, index):
    {part}

def handler(arguments, results):
    results[0][...] = 7
    if arguments[0][0] > 0:
        ffi.run_spans(part, [(0, 1), (1, 2)])

def refuse(*_):
    raise RuntimeError("refused to print")

name = ffi.registered("test", None, 1, lambda: handler)
run = jax.jit(jax.ffi.ffi_call(name, jax.ShapeDtypeStruct((3,), jnp.float32)))
run(jnp.zeros(3)).block_until_ready()  # compiled: no step of Python lies between the caller and the handler now
x = jnp.ones(3) + {more}
sys.excepthook = refuse
try:
    try:
        print(run(x).block_until_ready())
    finally:
        time.sleep(0)  # a step of Python, where a signal is looked for
except {error} as error:
    print("met", error)
"""


ON_XLA = "0 * (jnp.ones((2000, 2000)) @ jnp.ones((2000, 2000)))[0, :3]"
"""Zeros for which a call waits, so that one of XLA's threads runs it."""
CTRL_C = "time.sleep(0.1); index or os.kill(os.getpid(), signal.SIGINT); time.sleep(0.2)"
NOTICED = "0; signal.signal(signal.SIGINT, lambda *_: print('noticed'))"
CASES = {
    "an error": ("if index == 1: raise ValueError('no such thing')", "Exception", "0", "met INTERNAL"),
    "Ctrl-C on the caller's thread": (CTRL_C, "KeyboardInterrupt", "0", "met"),
    "Ctrl-C on a thread of XLA's": (CTRL_C, "KeyboardInterrupt", ON_XLA, "met"),
    "Ctrl-C with a handler": (CTRL_C, "ZeroDivisionError", NOTICED, "noticed\n[7. 7. 7.]"),
    "an interrupt that is raised": ("if index == 0: raise KeyboardInterrupt", "KeyboardInterrupt", "0", "met"),
}


@pytest.mark.parametrize(
    "name", [name if name == "an error" else pytest.param(name, marks=pytest.mark.long) for name in CASES]
)
def test_the_caller_meets_what_happens_in_a_function_whatever_the_hook_does(name):
    part, error, more, printed = CASES[name]
    script = SCRIPT.format(part=part, error=error, more=more)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    assert done.stdout.startswith(printed)
    if name == "an error":  # Type, message and place.
        assert "ValueError: no such thing" in done.stdout and "in part" in done.stdout
    else:
        assert done.stdout.strip() == printed


def test_an_error_that_cannot_be_written_is_told_all_the_same():
    class Silent(Exception):
        def __str__(self):
            raise TypeError

    def handler(arguments, results):
        raise Silent

    name = ffi.registered("test silent", None, 1, lambda: handler)
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"Silent: .*failed"):
        jax.block_until_ready(jax.ffi.ffi_call(name, jax.ShapeDtypeStruct((3,), jnp.float32))(jnp.zeros(1)))


def test_results_are_views_of_the_buffers():
    def handler(arguments, results):
        results[0][...] = 2 * arguments[0]

    name = ffi.registered("test double", None, 1, lambda: handler)
    x = jnp.arange(6, dtype=jnp.float32).reshape(2, 3)
    np.testing.assert_array_equal(jax.ffi.ffi_call(name, jax.ShapeDtypeStruct((2, 3), jnp.float32))(x), 2 * x)


ENDING = """
import threading, time
import jax, jax.numpy as jnp
from a2tg_jax.rasterize.kernels.native import ffi

def handler(arguments, results):
    if arguments[0][0] > 0:
        begun.set()
        time.sleep(0.02)
    results[0][...] = 7

def hundred(x):
    for _ in range(100):
        x = call(x)
    return x

begun, name = threading.Event(), ffi.registered("test", None, 1, lambda: handler)
call = jax.ffi.ffi_call(name, jax.ShapeDtypeStruct((3,), jnp.float32))
run = jax.jit(hundred)
run(jnp.zeros(3)).block_until_ready()
x = jnp.ones(3) + 0 * (jnp.ones((1500, 1500)) @ jnp.ones((1500, 1500)))[0, :3]
{waiting}
raise SystemExit(3)
"""


@pytest.mark.long
@pytest.mark.parametrize(
    "waiting",
    [
        "threading.Thread(target=lambda: run(x).block_until_ready(), daemon=True).start(); begun.wait()",
        """for power in range(1, 9):
    y = jnp.linalg.matrix_power(jnp.ones((1000, 1000)), 2**power)
    threading.Thread(target=y.block_until_ready, daemon=True).start()""",
    ],
    ids=["for functions that run and are still to run", "for XLA"],
)
def test_a_program_ends_well_while_threads_wait(waiting):
    script = ENDING.replace("{waiting}", waiting)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 3, done.stderr
