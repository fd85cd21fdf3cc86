"""Scalar JAX functions as C functions, a line for each primitive.

A function of scalars is traced once to a jaxpr; what it computes, and its derivative, is said once, in JAX. Small
arrays become one variable per entry. Each thread has its own branch: `cond` becomes `if`, `while` becomes `while`.
"""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jax.extend import core
from jax.typing import ArrayLike, DTypeLike

from a2tg_jax.rasterize.kernels.cuda.primitives import C_TYPES, PRIMITIVES, literal
from a2tg_jax.rasterize.kernels.jaxprs import (
    Equation,
    Evaluator,
    Step,
    Untranslatable,
    Value,
    Values,
    array_of,
    aval_of,
    entries,
    map_entries,
    result_of,
)


class Argument:
    """A parameter of a C function: `num` numbers of a C type, or a scalar."""

    def __init__(self, name: str, num: int | None = None, kind: str = "real"):
        self.name, self.num, self.kind = name, num, kind

    @property
    def read(self) -> str:
        """Declaration where it is read only."""
        return f"{self.kind} {self.name}" if self.num is None else f"const {self.kind} *{self.name}"

    @property
    def written(self) -> str:
        """Declaration where it is written."""
        return f"{self.kind} *{self.name}"

    def entries(self) -> list[str]:
        """Return its numbers as C expressions; those of a scalar that is written are `*name`."""
        return [self.name] if self.num is None else [f"{self.name}[{k}]" for k in range(self.num)]


def c_function(name: str, closed: core.ClosedJaxpr, inputs: Sequence[Argument], outputs: Sequence[Argument]) -> str:
    """Return a C function that evaluates a jaxpr of scalars.

    Args:
      name: name of the function.
      closed: the jaxpr.
      inputs: parameters that hold its arguments, one number each, in order.
      outputs: parameters that receive its results, in order.

    Raises:
      Untranslatable: if a primitive or a dtype has no translation.
    """
    printer = _Printer()
    given = [entry for argument in inputs for entry in argument.entries()]
    # A result may lie where an argument does.
    kept = [printer.variable(aval_of(v).dtype, x) for v, x in zip(closed.jaxpr.invars, given, strict=True)]
    results = [entry for value in printer.run(closed, kept) for entry in entries(value)]
    places = [entry if a.num is not None else f"*{entry}" for a in outputs for entry in a.entries()]
    parameters = ", ".join([*(a.read for a in inputs), *(a.written for a in outputs)])
    stores = [f"{place} = {result};" for place, result in zip(places, results, strict=True)]
    body = "\n".join(f"  {line}" for line in [*printer.lines, *stores])
    return f"INLINE void {name}({parameters}) {{\n{body}\n}}\n"


class _Printer(Evaluator[str]):
    """Lines of C that evaluate jaxprs; a value is the name of a variable, or a literal."""

    target = "GPU kernels"

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._types: dict[str, str] = {}
        """C type of each variable and literal."""

    def variable(self, dtype: DTypeLike, value: str | None = None) -> str:
        """Declare a variable; return its name."""
        return self._declare(_c_type(dtype), "" if value is None else f" = {value}")

    def _declare(self, c_type: str, value: str) -> str:
        name = f"v{len(self._types)}"
        self._types[name] = c_type
        self.lines.append(f"{c_type} {name}{value};")
        return name

    def literal(self, number: ArrayLike, dtype: DTypeLike) -> str:
        text = literal(number, np.dtype(dtype))
        self._types[text] = _c_type(dtype)
        return text

    def check_dtype(self, dtype: DTypeLike) -> None:
        _c_type(dtype)

    def primitive(self, name: str) -> Callable[[list[str], Equation], str] | None:
        if name not in PRIMITIVES:
            return None
        return lambda operands, equation: self.variable(result_of(equation).dtype, PRIMITIVES[name](operands, equation))

    def branches(
        self, index: Value[str], branches: Sequence[core.ClosedJaxpr], operands: Values[str], equation: Equation
    ) -> Values[str]:
        avals = [result_of(equation, k) for k in range(len(equation.outvars))]
        results = [array_of([self.variable(a.dtype) for _ in range(math.prod(a.shape))], a.shape) for a in avals]
        for k, branch in enumerate(branches):
            symbol = "<=" if k == 0 else (">=" if k == len(branches) - 1 else "==")
            with self._block(f"if ({index} {symbol} {k})"):
                self._assign(results, self.run(branch, operands))
        return results

    def loop(self, carry: Values[str], test: Callable[[Values[str]], Value[str]], step: Step[str]) -> Values[str]:
        rooms = self._copies(carry)
        with self._block("while (1)"):
            self.lines.append(f"if (!{test(rooms)}) break;")
            self._assign(rooms, step(rooms))
        return rooms

    def counted(self, length: int, carry: Values[str], step: Step[str]) -> Values[str]:
        rooms, count = self._copies(carry), self.variable(np.int32, "0")
        with self._block(f"for (; {count} < {length}; {count}++)"):
            self._assign(rooms, step(rooms))
        return rooms

    @contextlib.contextmanager
    def _block(self, head: str) -> Iterator[None]:
        self.lines.append(f"{head} {{")
        yield
        self.lines.append("}")

    def _assign(self, rooms: Values[str], values: Values[str]) -> None:
        """Assign values to declared variables. Copies come first, for a value may be one of the variables."""
        names = [entry for room in rooms for entry in entries(room)]
        copies = [entry for value in self._copies(values) for entry in entries(value)]
        self.lines += [f"{name} = {copy};" for name, copy in zip(names, copies, strict=True)]

    def _copies(self, values: Values[str]) -> Values[str]:
        """Declare a variable for each entry of some values, and set it to the entry."""
        copy = lambda x: self._declare(self._types[x[0]], f" = {x[0]}")  # noqa: E731
        return [map_entries(copy, [value]) for value in values]


def _c_type(dtype: DTypeLike) -> str:
    name = np.dtype(dtype).name
    if name not in C_TYPES:
        raise Untranslatable(f"GPU kernels have no numbers of type {name}")
    return C_TYPES[name]
