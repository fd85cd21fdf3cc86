"""Scalar JAX functions as LLVM code, one lane a pixel.

A function of scalars is traced once to a jaxpr. Each primitive becomes one or a few LLVM instructions on vectors of L
lanes, or on plain scalars, so that a function and its derivative are defined only once, in JAX. The primitives are in
`primitives` and `control_flow`; docs/compiler.md explains more.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.extend import core
from llvmlite import ir

from a2tg_jax.rasterize.kernels.native import dump
from a2tg_jax.rasterize.kernels.native.control_flow import STRUCTURE, array_of, map_entries
from a2tg_jax.rasterize.kernels.native.primitives import PRIMITIVES
from a2tg_jax.rasterize.kernels.native.vectors import (
    BOOL,
    FLAGS,
    INT,
    Equation,
    Translator,
    Untranslatable,
    result_of,
    scalar_of,
    scalar_type,
)

__all__ = ["BOOL", "FLAGS", "INT", "Lanes", "Untranslatable", "scalar_of", "scalar_type"]


class Lanes(Translator):
    """Translator of jaxprs at a builder's position, on vectors of `width` lanes; `width` 1 means plain scalars."""

    def emit(self, closed: core.ClosedJaxpr, arguments: Sequence[ir.Value]) -> list[ir.Value]:
        """Emit a jaxpr of scalars, given one LLVM value per argument; return its values.

        Raises:
          Untranslatable: if a primitive or a dtype has no translation.
        """
        if dump.is_wanted():
            dump.write(self.builder.function.name, "jaxpr", f"{closed}\n\n", append=True)
        return self.run(closed, arguments)

    def run(self, jaxpr: Any, arguments: Sequence[Any]) -> list[Any]:
        """Emit a jaxpr, closed or without constants, and return its values; arrays are those of `control_flow`."""
        consts = getattr(jaxpr, "consts", ())
        jaxpr = getattr(jaxpr, "jaxpr", jaxpr)
        values: dict[core.Var, Any] = {}

        def read(atom: Any) -> Any:
            return self._constant(atom.val, atom.aval) if isinstance(atom, core.Literal) else values[atom]

        for variable, value in zip(jaxpr.constvars, consts, strict=True):
            values[variable] = self._constant(value, variable.aval)
        values.update(zip(jaxpr.invars, arguments, strict=True))
        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _constant(self, value: Any, aval: Any) -> Any:
        scalar = scalar_type(aval.dtype)
        numbers = np.asarray(value).reshape(-1)
        return array_of([self.constant(number, scalar) for number in numbers], aval.shape)

    def _equation(self, equation: Equation, operands: list[Any]) -> list[Any]:
        name = equation.primitive.name
        for index in range(len(equation.outvars)):
            scalar_type(result_of(equation, index).dtype)
        if name in STRUCTURE:
            return STRUCTURE[name](self, operands, equation)
        if name not in PRIMITIVES:
            raise Untranslatable.of(name)
        return [map_entries(lambda numbers: PRIMITIVES[name](self, numbers, equation), operands)]
