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

name = ffi.registered("test", None, lambda: handler)
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


def run_script(part: str, error: str, more: str = "0") -> subprocess.CompletedProcess:
    script = SCRIPT.format(part=part, error=error, more=more)
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=120)


@pytest.mark.parametrize("index", [0, 1])
def test_an_error_is_told_with_type_message_and_place_whatever_the_hook_does(index):
    done = run_script(f"if index == {index}: raise ValueError('no such thing')", "Exception")
    assert "met INTERNAL" in done.stdout and "ValueError: no such thing" in done.stdout
    assert "in part" in done.stdout
    assert done.returncode == 0 and done.stderr == ""


def test_an_error_that_cannot_be_written_is_told_all_the_same():
    class Silent(Exception):
        def __str__(self):
            raise TypeError

    def handler(arguments, results):
        raise Silent

    name = ffi.registered("test silent", None, lambda: handler)
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"Silent: .*failed"):
        jax.block_until_ready(jax.ffi.ffi_call(name, jax.ShapeDtypeStruct((3,), jnp.float32))(jnp.zeros(1)))


@pytest.mark.parametrize("more", ["0", "0 * (jnp.ones((2000, 2000)) @ jnp.ones((2000, 2000)))[0, :3]"])
def test_ctrl_c_while_a_function_runs_is_one_for_the_caller(more):
    """On the caller's thread, and on one of XLA's, which runs what waits for another result."""
    part = "time.sleep(0.1); index or os.kill(os.getpid(), signal.SIGINT); time.sleep(0.2)"
    done = run_script(part, "KeyboardInterrupt", more)
    assert done.stdout.split() == ["met"], done.stdout + done.stderr
    assert done.returncode == 0 and done.stderr == ""


def test_ctrl_c_goes_to_the_handler_that_the_program_has_set():
    part = """if index == 0:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)"""
    done = run_script(part, "ZeroDivisionError", "0; signal.signal(signal.SIGINT, lambda *_: print('noticed'))")
    assert done.stdout.split() == ["noticed", "[7.", "7.", "7.]"], done.stdout + done.stderr


@pytest.mark.parametrize("index", [0, 1])
def test_an_interrupt_that_is_raised_is_one_for_the_caller(index):
    done = run_script(f"if index == {index}: raise KeyboardInterrupt", "KeyboardInterrupt")
    assert done.stdout.split() == ["met"], done.stdout + done.stderr
    assert done.returncode == 0 and done.stderr == ""


def test_results_are_views_of_the_buffers():
    def handler(arguments, results):
        results[0][...] = 2 * arguments[0]

    name = ffi.registered("test double", None, lambda: handler)
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

begun, name = threading.Event(), ffi.registered("test", None, lambda: handler)
call = jax.ffi.ffi_call(name, jax.ShapeDtypeStruct((3,), jnp.float32))
run = jax.jit(hundred)
run(jnp.zeros(3)).block_until_ready()
x = jnp.ones(3) + 0 * (jnp.ones((1500, 1500)) @ jnp.ones((1500, 1500)))[0, :3]
{waiting}
raise SystemExit(3)
"""


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
