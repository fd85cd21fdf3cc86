"""Scalar JAX functions as LLVM code, one lane a pixel.

A function of scalars is traced once to a jaxpr. Each primitive becomes one or a few LLVM instructions on vectors of L
lanes, or on plain scalars, so that a function and its derivative are defined only once, in JAX. The primitives are in
`primitives` and `control_flow`; docs/compiler.md explains more.
"""

import functools
from collections.abc import Callable, Sequence

from jax.extend import core
from jax.typing import ArrayLike, DTypeLike
from llvmlite import ir

from a2tg_jax.rasterize.kernels.jaxprs import Equation, Evaluator, Step, Values
from a2tg_jax.rasterize.kernels.native import control_flow, dump
from a2tg_jax.rasterize.kernels.native.primitives import PRIMITIVES
from a2tg_jax.rasterize.kernels.native.vectors import BOOL, FLAGS, INT, Translator, scalar_of, scalar_type

__all__ = ["BOOL", "FLAGS", "INT", "Lanes", "scalar_of", "scalar_type"]


class Lanes(Evaluator[ir.Value], Translator):
    """Translator of jaxprs at a builder's position, on vectors of `width` lanes; `width` 1 means plain scalars."""

    target = "native loops"

    def emit(self, closed: core.ClosedJaxpr, arguments: Sequence[ir.Value]) -> list[ir.Value]:
        """Emit a jaxpr of scalars, given one LLVM value per argument; return its values.

        Raises:
          Untranslatable: if a primitive or a dtype has no translation.
        """
        if dump.is_wanted():
            dump.write(self.builder.function.name, "jaxpr", f"{closed}\n\n", append=True)
        return self.run(closed, arguments)

    def literal(self, number: ArrayLike, dtype: DTypeLike) -> ir.Constant:
        return self.constant(number, scalar_type(dtype))

    def check_dtype(self, dtype: DTypeLike) -> None:
        scalar_type(dtype)

    def primitive(self, name: str) -> Callable[[list[ir.Value], Equation], ir.Value] | None:
        return functools.partial(PRIMITIVES[name], self) if name in PRIMITIVES else None

    def branches(
        self, index: ir.Value, branches: Sequence[core.ClosedJaxpr], operands: Values[ir.Value], equation: Equation
    ) -> Values[ir.Value]:
        return control_flow.branches(self, index, branches, operands)

    def loop(
        self, carry: Values[ir.Value], test: Callable[[Values[ir.Value]], ir.Value], step: Step[ir.Value]
    ) -> Values[ir.Value]:
        return control_flow.loop(self, carry, test, step)

    def counted(self, length: int, carry: Values[ir.Value], step: Step[ir.Value]) -> Values[ir.Value]:
        return control_flow.fixed_loop(self, length, carry, step)
