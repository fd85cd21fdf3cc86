"""JAX's element-wise primitives as one or a few LLVM instructions, or as calls of `elementary` and `libm`.

Integers behave as in XLA: sums wrap, x / 0 = −1, x % 0 = x, and shifts by the width or more leave only the sign. A
float out of range becomes the nearest integer in range, and NaN becomes 0.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.extend import core
from llvmlite import ir

from a2tg_jax.rasterize.kernels.jaxprs import Equation, result_of
from a2tg_jax.rasterize.kernels.native import elementary, libm
from a2tg_jax.rasterize.kernels.native.vectors import (
    FLAGS,
    Translator,
    is_float,
    num_bits,
    scalar_of,
    scalar_type,
    suffix,
)
from a2tg_jax.rasterize.kernels.tracing import example, trace

Operands = list[ir.Value]
Emitter = Callable[[Translator, Operands, Equation], ir.Value]
"""Function of (lanes, operands, equation) that emits code and returns its result."""


def _dtype(equation: Equation, operand: int = 0) -> np.dtype:
    aval: Any = equation.invars[operand].aval
    dtype: np.dtype = aval.dtype
    return dtype


def _is_signed(equation: Equation) -> bool:
    return _dtype(equation).kind == "i"


def _binary(for_floats: str, for_integers: str) -> Emitter:
    def emit(lanes: Translator, operands: Operands, _: Equation) -> ir.Value:
        if is_float(operands[0].type):
            return getattr(lanes.builder, for_floats)(*operands, flags=FLAGS)
        return getattr(lanes.builder, for_integers)(*operands)

    return emit


def _comparison(symbol: str) -> Emitter:
    def emit(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
        b = lanes.builder
        if is_float(operands[0].type):
            return (b.fcmp_unordered if symbol == "!=" else b.fcmp_ordered)(symbol, *operands)
        return (b.icmp_signed if _is_signed(equation) else b.icmp_unsigned)(symbol, *operands)

    return emit


def _bitwise(method: str) -> Emitter:
    return lambda lanes, operands, _: getattr(lanes.builder, method)(*operands)


def _intrinsic(name: str) -> Emitter:
    return lambda lanes, operands, _: lanes.intrinsic(name, operands)


def _libm(name: str) -> Emitter:
    return lambda lanes, operands, _: libm.emit_call(lanes, name, operands)


@functools.cache
def _formula(name: str) -> core.ClosedJaxpr:
    return trace(elementary.FORMULAS[name], example(np.float32))[0]


def _elementary(name: str, in_libm: str) -> Emitter:
    """Make an emitter of the formula of `elementary` in float32, and of libm's function in float64."""

    def emit(lanes: Translator, operands: Operands, _: Equation) -> ir.Value:
        if num_bits(operands[0].type) != 32:
            return libm.emit_call(lanes, in_libm, operands)
        (result,) = lanes.emit(_formula(name), operands)
        return result

    return emit


def _trigonometric(name: str) -> Emitter:
    """Make an emitter as `_elementary` does, with libm's function for angles that are too large for the formula."""
    small = _elementary(name, name)

    def emit(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
        result, (x,), b = small(lanes, operands, equation), operands, lanes.builder
        if num_bits(x.type) != 32:
            return result
        limit = lanes.constant(elementary.LARGEST_ANGLE, scalar_of(x.type))
        is_large = b.fcmp_ordered(">", lanes.intrinsic("fabs", [x]), limit)
        room = lanes.room(x.type)
        b.store(result, room)
        with b.if_then(lanes.any(is_large), likely=False):
            b.store(b.select(is_large, libm.emit_call(lanes, name, operands), result), room)
        return b.load(room, typ=x.type)

    return emit


def _one_over_square_root(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
    (x,) = operands
    one = lanes.constant(1, scalar_of(x.type))
    return lanes.builder.fdiv(one, lanes.intrinsic("sqrt", [x]), flags=FLAGS)


def _logistic(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
    (x,), b = operands, lanes.builder
    one = lanes.constant(1, scalar_of(x.type))
    power = PRIMITIVES["exp"](lanes, [b.fneg(x)], equation)
    return b.fdiv(one, b.fadd(one, power, flags=FLAGS), flags=FLAGS)


def _power(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
    x, exponent = operands
    if not is_float(exponent.type):
        signed = _dtype(equation, 1).kind == "i"
        convert = lanes.builder.sitofp if signed else lanes.builder.uitofp
        exponent = convert(exponent, x.type)
    return libm.emit_call(lanes, "pow", [x, exponent])


def _whole_power(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
    """Emit x^y for a whole constant y, by repeated squaring."""
    (power,), left, result = operands, abs(equation.params["y"]), None
    one = lanes.constant(1, scalar_of(power.type))
    while left:
        if left & 1:
            result = power if result is None else _multiply(lanes, [result, power], equation)
        left >>= 1
        power = _multiply(lanes, [power, power], equation) if left else power
    result = one if result is None else result
    return lanes.builder.fdiv(one, result, flags=FLAGS) if equation.params["y"] < 0 else result


_multiply = _binary("fmul", "mul")


def _divide(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
    x, y = operands
    b, type_ = lanes.builder, scalar_of(x.type)
    if is_float(x.type):
        return b.fdiv(x, y, flags=FLAGS)
    number = functools.partial(lanes.constant, scalar=type_)
    is_zero, safe = _safe_divisor(lanes, operands, equation)
    quotient = (b.sdiv if _is_signed(equation) else b.udiv)(x, safe)
    if _is_signed(equation):
        quotient = b.select(b.icmp_signed("==", y, number(-1)), b.neg(x), quotient)
    return b.select(is_zero, number(-1), quotient)


def _remainder(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
    (x, _), b = operands, lanes.builder
    if is_float(x.type):
        return libm.emit_call(lanes, "fmod", operands)
    is_zero, safe = _safe_divisor(lanes, operands, equation)
    remainder = (b.srem if _is_signed(equation) else b.urem)(x, safe)
    return b.select(is_zero, x, remainder)


def _safe_divisor(lanes: Translator, operands: Operands, equation: Equation) -> tuple[ir.Value, ir.Value]:
    """Emit a mask of the divisors 0, and the divisor with 1 in place of 0 and −1, at which processors may trap."""
    b, (_, y) = lanes.builder, operands
    number = functools.partial(lanes.constant, scalar=scalar_of(y.type))
    is_zero = b.icmp_unsigned("==", y, number(0))
    traps = is_zero
    if _is_signed(equation):
        traps = b.or_(is_zero, b.icmp_signed("==", y, number(-1)))
    return is_zero, b.select(traps, number(1), y)


def _shift(method: str) -> Emitter:
    def emit(lanes: Translator, operands: Operands, _: Equation) -> ir.Value:
        (x, amount), b = operands, lanes.builder
        width = num_bits(x.type)
        number = functools.partial(lanes.constant, scalar=scalar_of(x.type))
        is_within = b.icmp_unsigned("<", amount, number(width))
        if method == "ashr":
            return b.ashr(x, b.select(is_within, amount, number(width - 1)))
        shifted = getattr(b, method)(x, b.select(is_within, amount, number(0)))
        return b.select(is_within, shifted, number(0))

    return emit


def _extreme(of_floats: str, symbol: str) -> Emitter:
    def emit(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
        if is_float(operands[0].type):
            return getattr(lanes, of_floats)(*operands)
        return lanes.builder.select(_comparison(symbol)(lanes, operands, equation), *operands)

    return emit


_maximum, _minimum = _extreme("maximum", ">"), _extreme("minimum", "<")


def _clamp(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
    low, x, high = operands
    return _minimum(lanes, [_maximum(lanes, [x, low], equation), high], equation)


def _negate(lanes: Translator, operands: Operands, _: Equation) -> ir.Value:
    (x,) = operands
    return lanes.builder.fneg(x) if is_float(x.type) else lanes.builder.neg(x)


def _absolute(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
    (x,) = operands
    if is_float(x.type):
        return lanes.intrinsic("fabs", [x])
    return _maximum(lanes, [x, lanes.builder.neg(x)], equation) if _is_signed(equation) else x


def _sign(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
    (x,), b = operands, lanes.builder
    number = functools.partial(lanes.constant, scalar=scalar_of(x.type))
    if not is_float(x.type):
        is_positive = b.icmp_unsigned("!=", x, number(0))
        if not _is_signed(equation):
            return b.zext(is_positive, x.type)
        return b.select(b.icmp_signed("<", x, number(0)), number(-1), b.zext(is_positive, x.type))
    signed = lanes.intrinsic("copysign", [number(1.0), x])
    return b.select(b.fcmp_ordered("!=", x, number(0.0)), signed, x)


def _round(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
    is_to_even = equation.params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN
    return lanes.intrinsic("rint" if is_to_even else "round", operands)


def _is_finite(lanes: Translator, operands: Operands, _: Equation) -> ir.Value:
    (x,) = operands
    infinity = lanes.constant(np.inf, scalar_of(x.type))
    return lanes.builder.fcmp_ordered("<", lanes.intrinsic("fabs", [x]), infinity)


def _count_leading_zeros(lanes: Translator, operands: Operands, _: Equation) -> ir.Value:
    (x,) = operands
    return lanes.call(f"llvm.ctlz.{suffix(x.type)}", x.type, [x, ir.IntType(1)(0)])


def _convert(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
    (x,), b = operands, lanes.builder
    source, target = _dtype(equation), result_of(equation).dtype
    type_ = lanes.vector(scalar_type(target))
    if source == target:
        return x
    if target == np.bool_:
        zero = lanes.constant(0, scalar_of(x.type))
        return b.fcmp_unordered("!=", x, zero) if source.kind == "f" else b.icmp_unsigned("!=", x, zero)
    if source.kind == "f" and target.kind == "f":
        return (b.fpext if target.itemsize > source.itemsize else b.fptrunc)(x, type_)
    if source.kind == "f":
        name = f"llvm.fpto{'s' if target.kind == 'i' else 'u'}i.sat.{suffix(type_)}.{suffix(x.type)}"
        return lanes.call(name, type_, [x])
    if target.kind == "f":
        return (b.sitofp if source.kind == "i" else b.uitofp)(x, type_)
    if num_bits(type_) <= num_bits(x.type):
        return b.trunc(x, type_) if num_bits(type_) < num_bits(x.type) else x
    return (b.sext if source.kind == "i" else b.zext)(x, type_)


def _bitcast(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
    return lanes.builder.bitcast(operands[0], lanes.vector(scalar_type(result_of(equation).dtype)))


def _select(lanes: Translator, operands: Operands, equation: Equation) -> ir.Value:
    which, first, *others = operands
    if _dtype(equation) == np.bool_:
        return lanes.builder.select(which, others[0], first)
    for k, other in enumerate(others, start=1):
        is_here = lanes.builder.icmp_signed(">=", which, lanes.constant(k, scalar_of(which.type)))
        first = lanes.builder.select(is_here, other, first)
    return first


def _identity(lanes: Translator, operands: Operands, _: Equation) -> ir.Value:
    return operands[0]


PRIMITIVES: dict[str, Emitter] = {
    "abs": _absolute,
    "acos": _libm("acos"),
    "acosh": _libm("acosh"),
    "add": _binary("fadd", "add"),
    "add_any": _binary("fadd", "add"),
    "and": _bitwise("and_"),
    "asin": _libm("asin"),
    "asinh": _libm("asinh"),
    "atan": _elementary("atan", "atan"),
    "atan2": _libm("atan2"),
    "atanh": _libm("atanh"),
    "bitcast_convert_type": _bitcast,
    "cbrt": _libm("cbrt"),
    "ceil": _intrinsic("ceil"),
    "clamp": _clamp,
    "clz": _count_leading_zeros,
    "convert_element_type": _convert,
    "copy": _identity,
    "copy_p": _identity,
    "cos": _trigonometric("cos"),
    "cosh": _libm("cosh"),
    "div": _divide,
    "eq": _comparison("=="),
    "erf": _elementary("erf", "erf"),
    "erfc": _libm("erfc"),
    "exp": _elementary("exp", "exp"),
    "exp2": _elementary("exp2", "exp2"),
    "expm1": _elementary("expm1", "expm1"),
    "floor": _intrinsic("floor"),
    "ge": _comparison(">="),
    "gt": _comparison(">"),
    "integer_pow": _whole_power,
    "is_finite": _is_finite,
    "le": _comparison("<="),
    "log": _elementary("log", "log"),
    "log1p": _elementary("log1p", "log1p"),
    "logistic": _logistic,
    "lt": _comparison("<"),
    "max": _maximum,
    "min": _minimum,
    "mul": _multiply,
    "ne": _comparison("!="),
    "neg": _negate,
    "nextafter": _libm("nextafter"),
    "not": lambda lanes, operands, _: lanes.builder.not_(operands[0]),
    "or": _bitwise("or_"),
    "population_count": _intrinsic("ctpop"),
    "pow": _power,
    "rem": _remainder,
    "round": _round,
    "rsqrt": _one_over_square_root,
    "select_n": _select,
    "shift_left": _shift("shl"),
    "shift_right_arithmetic": _shift("ashr"),
    "shift_right_logical": _shift("lshr"),
    "sign": _sign,
    "sin": _trigonometric("sin"),
    "sinh": _libm("sinh"),
    "sqrt": _intrinsic("sqrt"),
    "square": lambda lanes, operands, equation: _multiply(lanes, operands * 2, equation),
    "stop_gradient": _identity,
    "sub": _binary("fsub", "sub"),
    "tan": _trigonometric("tan"),
    "tanh": _elementary("tanh", "tanh"),
    "xor": _bitwise("xor"),
}
"""Emitters by the name of the primitive; of small arrays, each applies to every entry."""
