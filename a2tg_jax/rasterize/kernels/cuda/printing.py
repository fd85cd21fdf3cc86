"""Scalar JAX functions as C functions, a line for each primitive.

A function of scalars is traced once to a jaxpr; what it computes, and its derivative, is said once, in JAX. Small
arrays become one variable per entry. Each thread has its own branch: `cond` becomes `if`, `while` becomes `while`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.extend import core

from a2tg_jax.rasterize.kernels.cuda.primitives import C_TYPES, PRIMITIVES, literal
from a2tg_jax.rasterize.kernels.native.control_flow import (
    CALLS,
    MOST_ENTRIES,
    STRUCTURE,
    _scan_sizes,
    array_of,
    entries,
    map_entries,
)
from a2tg_jax.rasterize.kernels.native.vectors import Untranslatable

SHAPES = ("broadcast_in_dim", "concatenate", "optimization_barrier", "reshape", "rev", "slice", "stack", "squeeze", "transpose")
"""Primitives that move entries of arrays about."""
REDUCTIONS = {
    **{"reduce_and": "and", "reduce_or": "or", "reduce_max": "max", "reduce_min": "min"},
    **{"reduce_prod": "mul", "reduce_sum": "add"},
}


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
    kept = [printer.variable(v.aval.dtype, x) for v, x in zip(closed.jaxpr.invars, given, strict=True)]
    results = [entry for value in printer.run(closed, kept) for entry in entries(value)]
    places = [entry if a.num is not None else f"*{entry}" for a in outputs for entry in a.entries()]
    parameters = ", ".join([*(a.read for a in inputs), *(a.written for a in outputs)])
    stores = [f"{place} = {result};" for place, result in zip(places, results, strict=True)]
    body = "\n".join(f"  {line}" for line in [*printer.lines, *stores])
    return f"INLINE void {name}({parameters}) {{\n{body}\n}}\n"


class _Printer:
    """Lines of C that evaluate jaxprs."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._count = 0
        self._types: dict[str, str] = {}

    def run(self, jaxpr: Any, arguments: Sequence[Any]) -> list[Any]:
        """Print a jaxpr, closed or without constants; return names of its results."""
        consts = getattr(jaxpr, "consts", ())
        jaxpr = getattr(jaxpr, "jaxpr", jaxpr)
        values: dict[core.Var, Any] = {}

        def read(atom: Any) -> Any:
            return _constant(atom.val, atom.aval) if isinstance(atom, core.Literal) else values[atom]

        for variable, value in zip(jaxpr.constvars, consts, strict=True):
            values[variable] = _constant(value, variable.aval)
        values.update(zip(jaxpr.invars, arguments, strict=True))
        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def variable(self, dtype: Any, value: str | None = None) -> str:
        """Declare a variable; return its name."""
        name = f"v{self._count}"
        self._count += 1
        self._types[name] = _c_type(dtype)
        self.lines.append(f"{self._types[name]} {name}{'' if value is None else f' = {value}'};")
        return name

    def _equation(self, equation: Any, operands: list[Any]) -> list[Any]:
        name = equation.primitive.name
        if name in CALLS:
            params = equation.params
            return self.run(params["jaxpr"] if "jaxpr" in params else params["call_jaxpr"], operands)
        if name in SHAPES:
            return STRUCTURE[name](None, operands, equation)  # type: ignore[arg-type]
        if name in REDUCTIONS:
            return [self._reduction(REDUCTIONS[name], operands[0], equation)]
        if name in ("cond", "while", "scan"):
            return getattr(self, f"_{name}")(operands, equation)
        if name not in PRIMITIVES:
            raise Untranslatable(f"GPU kernels have no translation for the primitive '{name}'")
        return [map_entries(lambda numbers: self._one(name, numbers, equation), operands)]

    def _one(self, name: str, operands: list[str], equation: Any) -> str:
        return self.variable(equation.outvars[0].aval.dtype, PRIMITIVES[name](operands, equation))

    def _reduction(self, name: str, array: np.ndarray, equation: Any) -> Any:
        axes, aval = equation.params["axes"], equation.outvars[0].aval
        kept = np.moveaxis(array, axes, range(len(axes)))
        columns = kept.reshape(int(np.prod(kept.shape[: len(axes)])), -1).T
        totals = []
        for column in columns:
            # As XLA does, which shows if all that is summed is −0.
            total, *rest = [literal(0, np.dtype(aval.dtype)), *column] if name == "add" else column
            for number in rest:
                total = self._one(name, [total, number], equation)
            totals.append(total)
        return array_of(totals, aval.shape)

    def _cond(self, operands: list[Any], equation: Any) -> list[Any]:
        index, *operands = operands
        results, branches = self._rooms(equation.outvars), equation.params["branches"]
        for k, branch in enumerate(branches):
            symbol = "<=" if k == 0 else (">=" if k == len(branches) - 1 else "==")
            self.lines.append(f"if ({index} {symbol} {k}) {{")
            self._store(results, self.run(branch, operands))
            self.lines.append("}")
        return results

    def _while(self, operands: list[Any], equation: Any) -> list[Any]:
        params = equation.params
        num_cond, num_body = params["cond_nconsts"], params["body_nconsts"]
        cond_consts, body_consts = operands[:num_cond], operands[num_cond : num_cond + num_body]
        carry = self._rooms(equation.outvars)
        self._store(carry, operands[num_cond + num_body :])
        self.lines.append("while (1) {")
        (goes_on,) = self.run(params["cond_jaxpr"], [*cond_consts, *carry])
        self.lines.append(f"if (!{goes_on}) break;")
        self._store(carry, self.run(params["body_jaxpr"], [*body_consts, *carry]))
        self.lines.append("}")
        return carry

    def _scan(self, operands: list[Any], equation: Any) -> list[Any]:
        """A loop; unrolled if it reads or writes arrays."""
        params, length = equation.params, equation.params["length"]
        num_consts, num_carry = _scan_sizes(params)
        consts, carry = operands[:num_consts], operands[num_consts : num_consts + num_carry]
        arrays, written_to = operands[num_consts + num_carry :], equation.outvars[num_carry:]
        if not arrays and not written_to:
            rooms, count = self._rooms(equation.outvars), f"i{self._count}"
            self._count += 1
            self._store(rooms, carry)
            self.lines.append(f"for (int {count} = 0; {count} < {length}; {count}++) {{")
            self._store(rooms, self.run(params["jaxpr"], [*consts, *rooms]))
            self.lines.append("}")
            return rooms
        if length > MOST_ENTRIES:
            raise Untranslatable(f"GPU kernels unroll a scan over arrays for {MOST_ENTRIES} steps at most; got {length}")
        written: list[Any] = [None] * length
        for step in reversed(range(length)) if params["reverse"] else range(length):
            results = self.run(params["jaxpr"], [*consts, *carry, *(array[step] for array in arrays)])
            carry, written[step] = results[:num_carry], results[num_carry:]
        stacked = [
            array_of([entry for row in written for entry in entries(row[k])], variable.aval.shape)
            for k, variable in enumerate(written_to)
        ]
        return [*carry, *stacked]

    def _rooms(self, variables: Sequence[Any]) -> list[Any]:
        """Declare a variable for each entry of some results."""
        return [
            array_of([self.variable(v.aval.dtype) for _ in range(int(np.prod(v.aval.shape)))], v.aval.shape)
            for v in variables
        ]

    def _store(self, rooms: Sequence[Any], values: Sequence[Any]) -> None:
        """Assign values to declared variables; through copies, for a value may be one of the variables."""
        names = [entry for room in rooms for entry in entries(room)]
        numbers = [entry for value in values for entry in entries(value)]
        copies = [f"c{self._count}_{k}" for k in range(len(names))]
        self._count += 1
        for name, number, copy in zip(names, numbers, copies, strict=True):
            self.lines.append(f"const {self._types[name]} {copy} = {number};")
        self.lines += [f"{name} = {copy};" for name, copy in zip(names, copies, strict=True)]


def _c_type(dtype: Any) -> str:
    name = np.dtype(dtype).name
    if name not in C_TYPES:
        raise Untranslatable(f"GPU kernels have no numbers of type {name}")
    return C_TYPES[name]


def _constant(value: Any, aval: Any) -> Any:
    dtype = np.dtype(aval.dtype)
    _c_type(dtype)
    return array_of([literal(number, dtype) for number in np.asarray(value).reshape(-1)], aval.shape)
