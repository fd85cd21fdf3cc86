"""The GPU kernels on the CPU: the same text as OpenCL C, run by PoCL."""

import functools

import jax
import numpy as np
import pytest

from a2tg_jax.rasterize.kernels.cuda.source import num_parts, num_threads, source

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
    # the code that is not optimised, and reports neither races nor reads of what was never written.
    return cl.Program(queue().context, source(spec, "opencl")).build(["-cl-std=CL1.2", "-cl-opt-disable"])


def run(spec, name, num_tiles, inputs, results, totals):
    """Run a kernel on numpy arrays; return results and totals."""
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
    # OpenCL has no empty buffers.
    arrays = [array if array.size else np.zeros(1) for array in (*inputs, *results, *totals)]
    buffers = [cl.Buffer(queue().context, flags, hostbuf=array) for array in arrays]
    threads, blocks = num_threads(spec.tile_size), num_tiles * num_parts(spec.tile_size)
    _kernel(spec, name)(queue(), (blocks * threads,), (threads,), *buffers)
    found = [np.array(array) for array in (*results, *totals)]
    for array, buffer in zip(found, buffers[len(inputs) :], strict=True):
        if array.size:
            cl.enqueue_copy(queue(), array, buffer)
    return found


def launch(spec, name, num_tiles, inputs, results, totals=()):
    """As `kernels.cuda.launch.launch`."""
    shapes = [*results, *(jax.ShapeDtypeStruct(total.shape, total.dtype) for total in totals)]

    def call(inputs, totals):
        contiguous = lambda arrays: [np.ascontiguousarray(array) for array in arrays]  # noqa: E731
        unset = [np.full(result.shape, np.nan, result.dtype) for result in results]
        return run(spec, name, num_tiles, contiguous(inputs), unset, contiguous(totals))

    return jax.pure_callback(call, shapes, list(inputs), list(totals), vmap_method="sequential")
