"""JAX's element-wise primitives as C expressions, in the dialect that CUDA C++ and OpenCL C share.

Operands are names of variables or literals. Flags are `int`, 0 or 1. Integers behave as XLA's: x / 0 = −1, x % 0 = x,
shifts by the width or more leave only the sign. Functions that are spelled `a2tg_…` are defined in `cuda.h` and
`opencl.h`.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from a2tg_jax.rasterize.kernels.jaxprs import Equation, aval_of, result_of

Emitter = Callable[[list[str], Equation], str]
"""(operands, equation) to an expression."""

C_TYPES = {
    **{"float32": "float", "float64": "double", "bool": "int"},
    **{"int8": "signed char", "int16": "short", "int32": "int", "int64": "long"},
    **{"uint8": "unsigned char", "uint16": "unsigned short", "uint32": "unsigned int", "uint64": "unsigned long"},
}


def literal(value: Any, dtype: np.dtype) -> str:
    """Return a number as a C literal, exact to the last bit."""
    if dtype == np.bool_:
        return str(int(value))
    if dtype.kind in "iu":
        suffix = {4: "", 8: "l"}.get(dtype.itemsize, "") + ("u" if dtype.kind == "u" else "")
        least = dtype.kind == "i" and value == np.iinfo(dtype).min
        return f"({int(value) + 1}{suffix} - 1)" if least else f"({int(value)}{suffix})"
    number = float(value)
    if number != number:
        return f"a2tg_nan_{C_TYPES[dtype.name]}()"
    if abs(number) == np.inf:
        return f"({'-' if number < 0 else ''}a2tg_inf_{C_TYPES[dtype.name]}())"
    return f"({number.hex()}{'f' if dtype.itemsize == 4 else ''})"


def _dtype(equation: Equation, operand: int = 0) -> np.dtype:
    return np.dtype(aval_of(equation.invars[operand]).dtype)


def _is_float(equation: Equation) -> bool:
    return _dtype(equation).kind == "f"


def _infix(symbol: str) -> Emitter:
    return lambda x, _: f"{x[0]} {symbol} {x[1]}"


def _call(name: str) -> Emitter:
    return lambda x, _: f"{name}({', '.join(x)})"


def _extreme(symbol: str) -> Emitter:
    """Make an emitter of the larger or smaller of two numbers; NaN if one is NaN."""

    def emit(x: list[str], equation: Equation) -> str:
        or_nan = f" || {_is_nan(x[0])}" if _is_float(equation) else ""
        return f"({x[0]} {symbol} {x[1]}{or_nan}) ? {x[0]} : {x[1]}"

    return emit


def _is_nan(x: str) -> str:
    return f"{x} != {x}"


def _clamp(x: list[str], equation: Equation) -> str:
    low, number, high = x
    nan = f"{_is_nan(number)} ? {number} : " if _dtype(equation, 1).kind == "f" else ""
    return f"{nan}({number} < {low} ? {low} : {number}) < {high} ? ({number} < {low} ? {low} : {number}) : {high}"


def _whole_power(x: list[str], equation: Equation) -> str:
    exponent = equation.params["y"]
    one = literal(1, _dtype(equation))
    product = " * ".join(x * abs(exponent)) or one
    return f"{one} / ({product})" if exponent < 0 else product


def _power(x: list[str], equation: Equation) -> str:
    return f"pow({x[0]}, ({C_TYPES[_dtype(equation).name]}){x[1]})"


def _divide(x: list[str], equation: Equation) -> str:
    if _is_float(equation):
        return f"{x[0]} / {x[1]}"
    minus = f"{x[1]} == -1 ? -{x[0]} : " if _dtype(equation).kind == "i" else ""
    return f"{x[1]} == 0 ? ({_c_type(equation)})-1 : {minus}{x[0]} / {x[1]}"


def _remainder(x: list[str], equation: Equation) -> str:
    if _is_float(equation):
        return f"fmod({x[0]}, {x[1]})"
    minus = f"{x[1]} == -1 ? 0 : " if _dtype(equation).kind == "i" else ""
    return f"{x[1]} == 0 ? {x[0]} : {minus}{x[0]} % {x[1]}"


def _c_type(equation: Equation) -> str:
    return C_TYPES[np.dtype(result_of(equation).dtype).name]


def _shift(symbol: str) -> Emitter:
    def emit(x: list[str], equation: Equation) -> str:
        dtype = _dtype(equation)
        width = dtype.itemsize * 8
        signed, unsigned = C_TYPES[f"int{width}"], C_TYPES[f"uint{width}"]
        amount = f"({unsigned}){x[1]}"
        if symbol == "arithmetic":
            return f"({signed}){x[0]} >> ({amount} < {width} ? {amount} : {width - 1})"
        return f"{amount} < {width} ? ({_c_type(equation)})(({unsigned}){x[0]} {symbol} {amount}) : 0"

    return emit


def _bitwise_not(x: list[str], equation: Equation) -> str:
    return f"!{x[0]}" if _dtype(equation) == np.bool_ else f"~{x[0]}"


def _absolute(x: list[str], equation: Equation) -> str:
    return f"fabs({x[0]})" if _is_float(equation) else f"({x[0]} < 0 ? -{x[0]} : {x[0]})"


def _sign(x: list[str], equation: Equation) -> str:
    sign = f"({_c_type(equation)})(({x[0]} > 0) - ({x[0]} < 0))"
    return f"{x[0]} != 0 && {x[0]} == {x[0]} ? {sign} : {x[0]}" if _is_float(equation) else sign


def _round(x: list[str], equation: Equation) -> str:
    to_even = equation.params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN
    return f"{'rint' if to_even else 'round'}({x[0]})"


def _convert(x: list[str], equation: Equation) -> str:
    source, target = _dtype(equation), np.dtype(result_of(equation).dtype)
    if target == np.bool_:
        return f"{x[0]} != 0"
    if source.kind == "f" and target.kind in "iu":
        low, high = (literal(bound, source) for bound in _limits(source, target))
        least, most = literal(np.iinfo(target).min, target), literal(np.iinfo(target).max, target)
        cast = f"({C_TYPES[target.name]}){x[0]}"
        return f"{_is_nan(x[0])} ? 0 : {x[0]} <= {low} ? {least} : {x[0]} >= {high} ? {most} : {cast}"
    return f"({C_TYPES[target.name]}){x[0]}"


def _limits(source: np.dtype, target: np.dtype) -> tuple[float, float]:
    """Return the floats at and beyond which a conversion gives the least and the largest integer."""
    info = np.iinfo(target)
    return float(info.min), float(source.type(info.max))


def _bitcast(x: list[str], equation: Equation) -> str:
    return f"a2tg_{C_TYPES[_dtype(equation).name]}_as_{_c_type(equation)}({x[0]})".replace(" ", "_")


def _select(x: list[str], equation: Equation) -> str:
    which, first, *others = x
    if _dtype(equation) == np.bool_:
        return f"{which} ? {others[0]} : {first}"
    cases = [f"{which} <= {k} ? {value} : " for k, value in enumerate([first, *others[:-1]])]
    return "".join(cases) + (others[-1] if others else first)


def _identity(x: list[str], _: Equation) -> str:
    return x[0]


def _minus(x: list[str], _: Equation) -> str:
    return f"-{x[0]}"


PRIMITIVES: dict[str, Emitter] = {
    **{name: _call(name) for name in ("acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil")},
    **{name: _call(name) for name in ("cos", "cosh", "erf", "erfc", "exp", "exp2", "expm1", "floor", "log", "log1p")},
    **{name: _call(name) for name in ("nextafter", "sin", "sinh", "sqrt", "tan", "tanh")},
    **{"add": _infix("+"), "add_any": _infix("+"), "sub": _infix("-"), "mul": _infix("*"), "neg": _minus},
    **{"eq": _infix("=="), "ne": _infix("!="), "lt": _infix("<"), "le": _infix("<="), "gt": _infix(">")},
    **{"ge": _infix(">="), "and": _infix("&"), "or": _infix("|"), "xor": _infix("^"), "not": _bitwise_not},
    **{"copy": _identity, "copy_p": _identity, "stop_gradient": _identity},
    "abs": _absolute,
    "bitcast_convert_type": _bitcast,
    "clamp": _clamp,
    "convert_element_type": _convert,
    "div": _divide,
    "integer_pow": _whole_power,
    "is_finite": lambda x, _: f"fabs({x[0]}) < {literal(np.inf, _dtype(_))}",
    "logistic": lambda x, equation: f"{literal(1, _dtype(equation))} / ({literal(1, _dtype(equation))} + exp(-{x[0]}))",
    "max": _extreme(">"),
    "min": _extreme("<"),
    "pow": _power,
    "rem": _remainder,
    "round": _round,
    "rsqrt": _call("rsqrt"),
    "select_n": _select,
    "shift_left": _shift("<<"),
    "shift_right_arithmetic": _shift("arithmetic"),
    "shift_right_logical": _shift(">>"),
    "sign": _sign,
    "square": lambda x, _: f"{x[0]} * {x[0]}",
}
