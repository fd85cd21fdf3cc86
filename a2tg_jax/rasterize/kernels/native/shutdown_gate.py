"""Gate between XLA's threads and Python, closed before Python ends.

XLA may still compute on its own threads when a program ends. A thread that then asks for Python's GIL never gets it:
the program crashes or hangs. So these threads pass a gate in native code, which closes at the end. Threads that come
later return with an error; the gate waits for those inside. The same holds for daemon threads of Python that wait for
arrays in native code: the program ends once XLA has computed what they wait for, or met the error.
"""

import atexit
import contextlib
import ctypes
import os
import threading
import time

import jax
from llvmlite import ir

from a2tg_jax.rasterize.kernels.native import llvm_modules
from a2tg_jax.rasterize.kernels.native.lanes import INT
from a2tg_jax.rasterize.kernels.native.writer import LONG, POINTER

SIGNATURE = ir.FunctionType(POINTER, [POINTER])
SECONDS_TO_RETURN = 0.1
"""Time for daemon threads to return from native code to Python, where the end of the program is harmless."""
_num_inside, _is_closed = ctypes.c_int32(0), ctypes.c_int32(0)


def gated(entry: int, path: tuple[int, int], message: int) -> int:
    """Return the address of a function frame → error that calls `entry`, or makes an error if the gate is closed.

    Args:
      entry: address of a function of this kind.
      path: offsets that lead to the function that makes an error. The first one, in the frame, holds the address of a
        structure; the second one, in that structure, holds the address of the function.
      message: pointer that this function is called with.
    """
    module, name = ir.Module("gate"), llvm_modules.unique("gate")
    function = ir.Function(module, SIGNATURE, name)
    b = ir.IRBuilder(function.append_basic_block("come"))
    inside, outside = function.append_basic_block("inside"), function.append_basic_block("outside")
    (frame,) = function.args
    num_inside, is_closed = (_pointer(b, ctypes.addressof(number)) for number in (_num_inside, _is_closed))
    b.atomic_rmw("add", num_inside, INT(1), "seq_cst")
    b.cbranch(b.icmp_signed("==", b.load_atomic(is_closed, "seq_cst", 4, typ=INT), INT(0)), inside, outside)

    def leave_with(result: ir.Value) -> None:
        b.atomic_rmw("sub", num_inside, INT(1), "seq_cst")
        b.ret(result)

    b.position_at_end(inside)
    leave_with(_call(b, LONG(entry), frame))
    b.position_at_end(outside)
    structure = b.load(b.gep(frame, [LONG(path[0])], source_etype=ir.IntType(8)), typ=POINTER)
    make = b.load(b.gep(structure, [LONG(path[1])], source_etype=ir.IntType(8)), typ=LONG)
    leave_with(_call(b, make, _pointer(b, message)))
    return llvm_modules.compile_module(module)[name]


def _pointer(b: ir.IRBuilder, address: int) -> ir.Value:
    return b.inttoptr(LONG(address), POINTER)


def _call(b: ir.IRBuilder, address: ir.Value, argument: ir.Value) -> ir.Value:
    return b.call(b.inttoptr(address, SIGNATURE.as_pointer()), [argument])


def _empty() -> None:
    _num_inside.value = 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_empty)  # the child has none of the parent's threads


@atexit.register
def _close() -> None:
    """Close the gate, and wait until no thread is inside and none waits for arrays."""
    # The gate is used as long as the process lives, so that its parts must outlive Python's shutdown.
    for kept in (_num_inside, _is_closed, llvm_modules._engine()):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(kept))
    _is_closed.value = 1
    while _num_inside.value:
        time.sleep(1e-3)
    if threading.active_count() > 1:
        _wait_for_arrays()


def _wait_for_arrays() -> None:
    """Wait until all arrays on the CPU are computed or have failed, and other threads have had time to see it."""
    with contextlib.suppress(RuntimeError):  # no CPU among JAX's platforms
        for array in jax.live_arrays("cpu"):
            with contextlib.suppress(RuntimeError):
                array.block_until_ready()
    time.sleep(SECONDS_TO_RETURN)
