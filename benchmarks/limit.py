"""Best possible time of the processor."""

import concurrent.futures
import os

import jax
import jax.numpy as jnp
import numpy as np
from llvmlite import ir

from a2tg_jax.rasterize.kernels.jaxprs import trace
from a2tg_jax.rasterize.kernels.native import lanes, llvm_code
from a2tg_jax.rasterize.kernels.native.llvm_code import LONG, Writer
from benchmarks.timing import timed


def measure_limit(case: dict) -> dict:
    """Return the time of a number of multiply-adds and one exp per pixel and splat, and nothing else."""
    module = ir.Module("limit")
    width = llvm_code.num_lanes("float32")
    writer = Writer(module, "limit", ("data",), ("num",), "float32")
    at = lanes.Lanes(writer.b, width)
    reals = at.vector(writer.real)
    number = jax.ShapeDtypeStruct((), jnp.float32)

    def work(x, y):
        sums = [x, y, x + 1, y + 1, x + 2, y + 2, x + 3, y + 3]
        for k in range(case["multiply_adds"]):
            sums[k % 8] = sums[k % 8] * y + x
        return sum(sums) * 1e-3 + jnp.exp(x)

    traced, _ = trace(work, number, number)
    total = writer.variable(reals)
    writer.b.store(at.constant(0.0, writer.real), total)
    x, y = (writer.load(writer.arguments["data"], k, reals) for k in range(2))
    with writer.loop(LONG(0), writer.long(writer.arguments["num"])) as (k, _):
        moved = writer.b.fadd(x, at.broadcast(writer.b.sitofp(k, writer.real)))
        (result,) = at.emit(traced, [moved, y])
        writer.b.store(writer.b.fadd(result, writer.b.load(total, typ=reals)), total)
    writer.store(writer.b.load(total, typ=reals), writer.arguments["data"], 0)
    writer.b.ret_void()
    (run,) = llvm_code.compiled(module, {"limit": (1, 1)})
    threads = len(os.sched_getaffinity(0))
    pool = concurrent.futures.ThreadPoolExecutor(threads)
    vectors = int(case["pairs"] / width / threads)

    def everywhere():
        data = [np.full(2 * width, 0.5, np.float32) for _ in range(threads)]
        list(pool.map(lambda own: run(own.ctypes.data, vectors), data))

    return {"limit": timed(everywhere)}
