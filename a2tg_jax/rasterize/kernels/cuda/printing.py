"""Scalar JAX functions as C functions, in the dialect that CUDA C++ and OpenCL C share.

A function of scalars is traced once to a jaxpr; what it computes, and its derivative, is said once, in JAX. Each
primitive becomes a line. Native loops (`native.lanes`) translate the same primitives, plus those of their own formulas.

Operands are names of variables or literals. Flags are `int`, 0 or 1. Integers behave as XLA's: x / 0 = −1. Functions
that are spelled `a2tg_…` are defined in `cuda.h` and `opencl.h`.
"""

import functools
from collections.abc import Callable, Sequence

import numpy as np
from jax.extend import core
from jax.typing import ArrayLike, DTypeLike

from a2tg_jax.rasterize.kernels.jaxprs import Equation, Untranslatable, make_code, operand_dtype, result_dtype

Emitter = Callable[[list[str], Equation], str]
"""(operands, equation) to an expression."""
C_TYPES = {"float32": "float", "float64": "double", "bool": "int", "int32": "int", "int64": "long"}


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
    lines: list[str] = []

    def variable(dtype: DTypeLike, value: str) -> str:
        lines.append(f"{_c_type(dtype)} v{len(lines)} = {value};")
        return f"v{len(lines) - 1}"

    def assign(emit: Emitter, operands: list[str], equation: Equation) -> str:
        return variable(result_dtype(equation), emit(operands, equation))

    given = [entry for argument in inputs for entry in argument.entries()]
    # Copies of the arguments, since a result may have the same address as one of them.
    kept = [variable(aval.dtype, x) for aval, x in zip(closed.in_avals, given, strict=True)]
    primitives = {name: functools.partial(assign, emit) for name, emit in PRIMITIVES.items()}
    results = make_code(closed, kept, literal, primitives, "GPU kernels")
    places = [entry if a.num is not None else f"*{entry}" for a in outputs for entry in a.entries()]
    parameters = ", ".join([*(a.read for a in inputs), *(a.written for a in outputs)])
    stores = [f"{place} = {result};" for place, result in zip(places, results, strict=True)]
    body = "\n".join(f"  {line}" for line in [*lines, *stores])
    return f"INLINE void {name}({parameters}) {{\n{body}\n}}\n"


def _c_type(dtype: DTypeLike) -> str:
    name = np.dtype(dtype).name
    if name not in C_TYPES:
        raise Untranslatable(f"GPU kernels have no numbers of type {name}")
    return C_TYPES[name]


def literal(value: ArrayLike, dtype: DTypeLike) -> str:
    """Return a number as a C literal, exact to the last bit."""
    kind, dtype = _c_type(dtype), np.dtype(dtype)
    if dtype.kind in "bi":
        number, suffix = int(value), "l" if dtype.itemsize == 8 else ""  # type: ignore[arg-type]
        # C reads −2³¹ as minus a number that does not fit.
        is_least = dtype.kind == "i" and number == np.iinfo(dtype).min
        return f"({number + 1}{suffix} - 1)" if is_least else f"({number}{suffix})"
    real = float(value)  # type: ignore[arg-type]
    if real != real:
        return f"a2tg_nan_{kind}()"
    if abs(real) == np.inf:
        return f"({'-' if real < 0 else ''}a2tg_inf_{kind}())"
    # Hexadecimal floats are read without rounding.
    return f"({real.hex()}{'f' if dtype.itemsize == 4 else ''})"


def _is_float(equation: Equation) -> bool:
    return operand_dtype(equation).kind == "f"


def _infix(symbol: str) -> Emitter:
    return lambda x, _: f"{x[0]} {symbol} {x[1]}"


def _call(name: str) -> Emitter:
    return lambda x, _: f"{name}({', '.join(x)})"


def _extreme(symbol: str) -> Emitter:
    """Make an emitter of the larger or smaller of two numbers; NaN if one is NaN."""

    def emit(x: list[str], equation: Equation) -> str:
        or_nan = f" || {x[0]} != {x[0]}" if _is_float(equation) else ""
        return f"({x[0]} {symbol} {x[1]}{or_nan}) ? {x[0]} : {x[1]}"

    return emit


def _whole_power(x: list[str], equation: Equation) -> str:
    exponent = equation.params["y"]
    one = literal(1, operand_dtype(equation))
    product = " * ".join(x * abs(exponent)) or one
    return f"{one} / ({product})" if exponent < 0 else product


def _divide(x: list[str], equation: Equation) -> str:
    if _is_float(equation):
        return f"{x[0]} / {x[1]}"
    # Processors may trap at the least integer over −1.
    return f"{x[1]} == 0 ? -1 : {x[1]} == -1 ? -{x[0]} : {x[0]} / {x[1]}"


def _sign(x: list[str], equation: Equation) -> str:
    sign = f"({_c_type(operand_dtype(equation))})(({x[0]} > 0) - ({x[0]} < 0))"
    return f"{x[0]} != 0 && {x[0]} == {x[0]} ? {sign} : {x[0]}" if _is_float(equation) else sign


def _convert(x: list[str], equation: Equation) -> str:
    source, target = operand_dtype(equation), result_dtype(equation)
    if target == np.bool_:
        return f"{x[0]} != 0"
    cast = f"({_c_type(target)}){x[0]}"
    if source.kind == "f" and target.kind == "i":
        info = np.iinfo(target)
        # The floats at and beyond which a conversion gives the least and the largest integer.
        low, high = (literal(bound, source) for bound in (float(info.min), float(source.type(info.max))))
        least, most = literal(info.min, target), literal(info.max, target)
        return f"{x[0]} != {x[0]} ? 0 : {x[0]} <= {low} ? {least} : {x[0]} >= {high} ? {most} : {cast}"
    return cast


def _select(x: list[str], equation: Equation) -> str:
    which, first, *others = x
    if operand_dtype(equation) == np.bool_:
        return f"{which} ? {others[0]} : {first}"
    cases = [f"{which} <= {k} ? {value} : " for k, value in enumerate([first, *others[:-1]])]
    return "".join(cases) + (others[-1] if others else first)


def _logistic(x: list[str], equation: Equation) -> str:
    one = literal(1, operand_dtype(equation))
    return f"{one} / ({one} + exp(-{x[0]}))"


PRIMITIVES: dict[str, Emitter] = {
    **{name: _call(name) for name in ("ceil", "cos", "exp", "floor", "log", "pow", "sin", "sqrt", "tanh")},
    **{"add": _infix("+"), "add_any": _infix("+"), "sub": _infix("-"), "mul": _infix("*")},
    **{"eq": _infix("=="), "ne": _infix("!="), "lt": _infix("<"), "le": _infix("<="), "gt": _infix(">")},
    **{"ge": _infix(">="), "and": _infix("&"), "or": _infix("|"), "max": _extreme(">"), "min": _extreme("<")},
    "abs": lambda x, equation: f"fabs({x[0]})" if _is_float(equation) else f"({x[0]} < 0 ? -{x[0]} : {x[0]})",
    "convert_element_type": _convert,
    "div": _divide,
    "integer_pow": _whole_power,
    "logistic": _logistic,
    "neg": lambda x, _: f"-{x[0]}",
    "not": lambda x, equation: f"!{x[0]}" if operand_dtype(equation) == np.bool_ else f"~{x[0]}",
    "select_n": _select,
    "sign": _sign,
    "square": lambda x, _: f"{x[0]} * {x[0]}",
    "stop_gradient": lambda x, _: x[0],
}
"""Emitters by the name of the primitive."""
