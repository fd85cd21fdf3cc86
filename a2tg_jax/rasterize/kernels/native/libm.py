"""Functions of the C library's libm, called lane by lane if `elementary` has no vector code."""

import ctypes
import ctypes.util
import functools
import os

import llvmlite.binding as llvm
from llvmlite import ir

from a2tg_jax.rasterize.kernels.native.vectors import INT, Vectors, num_bits, scalar_of


def emit_call(lanes: Vectors, name: str, operands: list[ir.Value]) -> ir.Value:
    """Call a function of libm, such as "erf", on floats; its error is about one unit in the last place."""
    name = f"{name}f" if num_bits(operands[0].type) == 32 else name
    if lanes.width == 1:
        return lanes.call(_symbol(name), operands[0].type, operands)
    return lanes.builder.call(_of_vectors(lanes, name, operands), operands)


def _of_vectors(lanes: Vectors, name: str, operands: list[ir.Value]) -> ir.Function:
    """Return the function of the module that applies one of libm to each lane, written on first use."""
    module, type_ = lanes.builder.module, operands[0].type
    key = f"{name}.{lanes.width}"
    if key in module.globals:
        return module.globals[key]
    function = ir.Function(module, ir.FunctionType(type_, [type_] * len(operands)), key)
    function.linkage = "internal"
    function.attributes.add("noinline")
    builder = ir.IRBuilder(function.append_basic_block())
    scalars, result = Vectors(builder, 1), ir.Constant(type_, ir.Undefined)
    for lane in range(lanes.width):
        numbers = [builder.extract_element(argument, INT(lane)) for argument in function.args]
        result = builder.insert_element(result, scalars.call(_symbol(name), scalar_of(type_), numbers), INT(lane))
    builder.ret(result)
    return function


@functools.cache
def _symbol(name: str) -> str:
    """Return the name under which compiled code finds a function of libm."""
    address = ctypes.cast(getattr(_library(), name), ctypes.c_void_p).value
    llvm.add_symbol(f"libm.{name}", address)
    return f"libm.{name}"


@functools.cache
def _library() -> ctypes.CDLL:
    return ctypes.CDLL("ucrtbase" if os.name == "nt" else ctypes.util.find_library("m"))
