"""The way from XLA's threads into Python, closed before Python ends.

XLA may still compute when a program ends, on threads of its own. One that asks for Python's lock then never gets it:
the program crashes or hangs. So these threads pass a gate, in native code. At the end it is closed; whoever comes later
goes back with an error, and whoever is inside is waited for.
"""

import atexit
import ctypes
import os
import time

from llvmlite import ir

from a2tg_jax.rasterize.kernels.native import llvm_modules
from a2tg_jax.rasterize.kernels.native.lanes import INT
from a2tg_jax.rasterize.kernels.native.writer import LONG, POINTER

SIGNATURE = ir.FunctionType(POINTER, [POINTER])
_num_inside, _is_closed = ctypes.c_int32(0), ctypes.c_int32(0)


def gated(entry: int, path: tuple[int, int], message: int) -> int:
    """The address of a function frame → error that calls `entry`, or makes an error where the gate is closed.

    Args:
      entry: the address of a function of this kind.
      path: where the function that makes an error is found: at the first offset in the frame lies the address of a
        structure, at the second offset in that the function's.
      message: the pointer that this is called with.
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
    os.register_at_fork(after_in_child=_empty)  # the parent's threads do not come along


@atexit.register
def _close() -> None:
    """Closes the gate and waits until nobody is inside."""
    _is_closed.value = 1
    while _num_inside.value:
        time.sleep(1e-3)
    # What the gate consists of is used as long as the process lives, longer than Python's objects.
    for kept in (_num_inside, _is_closed, llvm_modules._engine()):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(kept))
