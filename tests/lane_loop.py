"""Functions of scalars compiled as native loops over arrays, to be compared with what XLA makes of them."""

import jax
import numpy as np
from llvmlite import ir

from a2tg_jax.rasterize.kernels.jaxprs import trace
from a2tg_jax.rasterize.kernels.native import llvm_code
from a2tg_jax.rasterize.kernels.native.lanes import Lanes
from a2tg_jax.rasterize.kernels.native.llvm_code import BOOL, LONG, Writer, scalar_type


class _Loop(Writer):
    def __init__(self, module: ir.Module, name: str, closed, width: int):
        dtypes = [aval.dtype for aval in (*closed.in_avals, *closed.out_avals)]
        names = [f"array{k}" for k in range(len(dtypes))]
        super().__init__(module, name, names, ("num",), "float32")
        num_in = len(closed.in_avals)
        b = self.b
        at = Lanes(b, width)
        with self.loop(LONG(0), self.long(self.arguments["num"])) as (k, _):
            places = [self.at(self.arguments[one], k, at.vector(_stored(of))) for one, of in zip(names, dtypes)]  # noqa: B905
            inputs = []
            for place, dtype in zip(places[:num_in], dtypes, strict=False):
                value = b.load(place, typ=at.vector(_stored(dtype)), align=1)
                inputs.append(b.trunc(value, at.vector(BOOL)) if dtype == np.bool_ else value)
            results = at.emit(closed, inputs)
            for place, dtype, value in zip(places[num_in:], dtypes[num_in:], results, strict=True):
                value = b.zext(value, at.vector(_stored(dtype))) if dtype == np.bool_ else value
                b.store(value, place, align=1)
        b.ret_void()


def _stored(dtype) -> ir.Type:
    return ir.IntType(8) if dtype == np.bool_ else scalar_type(dtype)


def run_native(function, arrays, width: int) -> list[np.ndarray]:
    """The flat results of a function of scalars for every entry of arrays, whose length `width` divides."""
    closed, _ = trace(function, *(jax.ShapeDtypeStruct((), array.dtype) for array in arrays))
    name = llvm_code.unique("looped")
    module = ir.Module("test")
    _Loop(module, name, closed, width)
    (run,) = llvm_code.compiled(module, {name: (len(closed.in_avals) + len(closed.out_avals), 1)})
    results = [np.empty(len(arrays[0]), aval.dtype) for aval in closed.out_avals]
    run(*(array.ctypes.data for array in (*arrays, *results)), len(arrays[0]) // width)
    return results


def run_xla(function, arrays) -> list[np.ndarray]:
    """The same by XLA."""
    return [np.asarray(result) for result in jax.tree.leaves(jax.jit(jax.vmap(function))(*arrays))]
