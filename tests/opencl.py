"""The GPU kernels on the CPU: the same text as OpenCL C, run by PoCL."""

import functools
import math
from importlib import resources

import jax
import numpy as np
import pytest

from a2tg_jax.rasterize.kernels import cuda
from a2tg_jax.rasterize.kernels.cuda.source import C_TYPES, Argument, block_threads, c_function, num_parts, source

cl = pytest.importorskip("pyopencl", reason="the GPU kernels run on CPUs as OpenCL: pip install 'pyopencl[pocl]'")


@functools.cache
def queue():
    """The command queue of the newest CPU device; the test is skipped if there is none."""
    try:
        platforms = sorted(cl.get_platforms(), key=lambda platform: platform.version)
    except cl.LogicError:
        platforms = []
    devices = [
        device for platform in platforms for device in platform.get_devices() if device.type & cl.device_type.CPU
    ]
    if not devices:
        pytest.skip("the GPU kernels run on CPUs as OpenCL, which has no device: pip install 'pyopencl[pocl]'")
    return cl.CommandQueue(cl.Context(devices[-1:]))


@functools.cache
def _kernel(spec, name):
    return cl.Kernel(_program(spec), name)


@functools.cache
def _program(spec):
    # PoCL 3.1's optimiser makes wrong sums of these loops with barriers; Oclgrind, which interprets them, agrees with
    # the code that is not optimised, and reports no races.
    return cl.Program(queue().context, source(spec, "opencl")).build(["-cl-std=CL1.2", "-cl-opt-disable"])


def run(spec, name, num_tiles, inputs, results, totals):
    """Run a kernel on numpy arrays; return results and totals."""
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
    # OpenCL has no empty buffers.
    arrays = [array if array.size else np.zeros(1) for array in (*inputs, *results, *totals)]
    buffers = [cl.Buffer(queue().context, flags, hostbuf=array) for array in arrays]
    threads = block_threads(spec.grid.tile_size)
    blocks = num_tiles * num_parts(spec.grid.tile_size)
    _kernel(spec, name)(queue(), (blocks * threads,), (threads,), *buffers)
    found = [np.array(array) for array in (*results, *totals)]
    for array, buffer in zip(found, buffers[len(inputs) :], strict=True):
        if array.size:
            cl.enqueue_copy(queue(), array, buffer)
    return found


def launch(spec, name, num_tiles, inputs, results, totals=()):
    """Run a kernel on the CPU, with the arguments and results of `kernels.cuda.composite.launch`."""
    _kernel(spec, name)  # Here, for the callback's thread is not in 64-bit mode, and would trace for float32.
    given = _kinds([*inputs, *totals])
    wanted = _kinds([*results, *totals])

    def call(bits):
        arrays = [
            np.ascontiguousarray(x).view(dtype).reshape(shape) for x, (shape, dtype) in zip(bits, given, strict=True)
        ]
        unset = [np.full(shape, np.nan, dtype) for shape, dtype in wanted[: len(results)]]
        found = run(spec, name, num_tiles, arrays[: len(inputs)], unset, arrays[len(inputs) :])
        return [array.reshape(-1).view(np.uint32) for array in found]

    # As bits: JAX would round float64, for the callback's thread is not in 64-bit mode.
    words = [jax.ShapeDtypeStruct((math.prod(shape) * dtype.itemsize // 4,), np.uint32) for shape, dtype in wanted]
    as_bits = [jax.lax.bitcast_convert_type(x, np.uint32).reshape(-1) for x in (*inputs, *totals)]
    found = jax.pure_callback(call, words, as_bits, vmap_method="sequential")
    return [_from_bits(bits, *kind) for bits, kind in zip(found, wanted, strict=True)]


def evaluate(closed, real, *columns):
    """The results, as float64, of a function of scalars that is printed as C, for each row of some columns."""
    inputs = [Argument(f"x{k}", kind=real) for k in range(len(columns))]
    outputs = [Argument(f"y{k}", kind=C_TYPES[aval.dtype.name]) for k, aval in enumerate(closed.out_avals)]
    num = len(outputs)
    header = resources.files(cuda).joinpath("opencl.h").read_text(encoding="utf-8")
    text = f"""#pragma OPENCL EXTENSION cl_khr_fp64 : enable
    typedef {real} real;
    #define IS_FLOAT {int(real == "float")}
    #define THREADS 1
    #define NUM_SUMS 1
    #define NUM_VALUES 1
    {header}
    {c_function("f", closed, inputs, outputs)}
    KERNEL(evaluate)({"".join(f"GLOBAL const real *x{k}, " for k in range(len(columns)))}GLOBAL double *result) {{
      {"".join(f"{output.kind} y{k};" for k, output in enumerate(outputs))}
      f({", ".join([f"x{k}[BLOCK]" for k in range(len(columns))] + [f"&y{k}" for k in range(num)])});
      {"".join(f"result[BLOCK * {num} + {k}] = y{k};" for k in range(num))}
    }}"""
    kernel = cl.Kernel(cl.Program(queue().context, text).build(["-cl-std=CL1.2"]), "evaluate")
    result = np.empty((len(columns[0]), num))
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
    buffers = [cl.Buffer(queue().context, flags, hostbuf=array) for array in (*columns, result)]
    kernel(queue(), (len(result),), (1,), *buffers)
    cl.enqueue_copy(queue(), result, buffers[-1])
    return list(result.T)


def _kinds(arrays):
    return [(array.shape, np.dtype(array.dtype)) for array in arrays]


def _from_bits(bits, shape, dtype):
    return jax.lax.bitcast_convert_type(bits.reshape(-1, 2) if dtype.itemsize == 8 else bits, dtype).reshape(shape)
