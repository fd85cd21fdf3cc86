"""Scalar JAX functions as LLVM code, one lane a pixel.

A function of scalars is traced once to a jaxpr. Each primitive becomes one or a few LLVM instructions on vectors of L
lanes, or on plain scalars, so that a function and its derivative are defined only once, in JAX. The primitives are
those that the package's own appearances, tile lists and losses use, and a few others that appearances are likely to
have; XLA composites what needs more (docs/compiler.md).

Integers behave as in XLA: sums wrap, x / 0 = −1, and shifts by the width or more leave only the sign. A float out of
range becomes the nearest integer in range, and NaN becomes 0.
"""

import functools
import math
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core
from jax.typing import ArrayLike, DTypeLike
from llvmlite import ir

from a2tg_jax.rasterize.kernels.jaxprs import Equation, example, make_code, operand_dtype, result_dtype, trace
from a2tg_jax.rasterize.kernels.native.llvm_code import (
    FLAGS,
    Vectors,
    dump,
    is_float,
    num_bits,
    scalar_of,
    scalar_type,
    suffix,
)

Operands = list[ir.Value]
Emitter = Callable[["Lanes", Operands, Equation], ir.Value]
"""Function of (lanes, operands, equation) that emits code and returns its result."""


class Lanes(Vectors):
    """Translator of jaxprs at a builder's position, on vectors of `width` lanes; `width` 1 means plain scalars."""

    def emit(self, closed: core.ClosedJaxpr, arguments: Sequence[ir.Value]) -> list[ir.Value]:
        """Emit a jaxpr of scalars, given one LLVM value per argument; return its values.

        Raises:
          Untranslatable: if a primitive or a dtype has no translation.
        """
        dump(self.builder.function.name, "jaxpr", lambda: f"{closed}\n\n")
        primitives = {name: functools.partial(emit, self) for name, emit in PRIMITIVES.items()}
        return make_code(closed, arguments, self._literal, primitives, "native loops")

    def _literal(self, number: ArrayLike, dtype: DTypeLike) -> ir.Constant:
        return self.constant(number, scalar_type(dtype))


def _binary(for_floats: str, for_integers: str) -> Emitter:
    def emit(lanes: Lanes, operands: Operands, _: Equation) -> ir.Value:
        if is_float(operands[0].type):
            return getattr(lanes.builder, for_floats)(*operands, flags=FLAGS)
        return getattr(lanes.builder, for_integers)(*operands)

    return emit


def _comparison(symbol: str) -> Emitter:
    def emit(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
        b = lanes.builder
        if is_float(operands[0].type):
            # NaN differs from everything, itself included, and is neither less nor greater.
            return (b.fcmp_unordered if symbol == "!=" else b.fcmp_ordered)(symbol, *operands)
        # As one bit with a sign, True would be −1 and less than False.
        return (b.icmp_unsigned if operand_dtype(equation) == np.bool_ else b.icmp_signed)(symbol, *operands)

    return emit


def _bitwise(method: str) -> Emitter:
    return lambda lanes, operands, _: getattr(lanes.builder, method)(*operands)


def _intrinsic(name: str) -> Emitter:
    return lambda lanes, operands, _: lanes.intrinsic(name, operands)


def _libm(name: str) -> Emitter:
    return lambda lanes, operands, _: lanes.libm(name, operands)


def _whole_power(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
    """Emit x^y for a whole constant y, by repeated squaring."""
    (power,), left, result = operands, abs(equation.params["y"]), None
    one = lanes.constant(1, scalar_of(power.type))
    # Bits of y from the lowest on: power runs through x, x², x⁴, …
    while left:
        if left & 1:
            result = power if result is None else _multiply(lanes, [result, power], equation)
        left >>= 1
        power = _multiply(lanes, [power, power], equation) if left else power
    result = one if result is None else result
    return lanes.builder.fdiv(one, result, flags=FLAGS) if equation.params["y"] < 0 else result


_multiply = _binary("fmul", "mul")


def _divide(lanes: Lanes, operands: Operands, _: Equation) -> ir.Value:
    (x, y), b = operands, lanes.builder
    if is_float(x.type):
        return b.fdiv(x, y, flags=FLAGS)
    number = functools.partial(lanes.constant, scalar=scalar_of(x.type))
    is_zero, is_minus_one = (b.icmp_signed("==", y, number(divisor)) for divisor in (0, -1))
    # Processors may trap at a divisor of 0, and of −1 for the least integer: these get 1 instead.
    quotient = b.sdiv(x, b.select(b.or_(is_zero, is_minus_one), number(1), y))
    return b.select(is_zero, number(-1), b.select(is_minus_one, b.neg(x), quotient))


def _shift(method: str) -> Emitter:
    def emit(lanes: Lanes, operands: Operands, _: Equation) -> ir.Value:
        (x, amount), b = operands, lanes.builder
        width = num_bits(x.type)
        number = functools.partial(lanes.constant, scalar=scalar_of(x.type))
        # LLVM leaves shifts by the width or more undefined.
        is_within = b.icmp_unsigned("<", amount, number(width))
        if method == "ashr":
            return b.ashr(x, b.select(is_within, amount, number(width - 1)))
        return b.select(is_within, b.shl(x, b.select(is_within, amount, number(0))), number(0))

    return emit


def _extreme(of_floats: str, symbol: str) -> Emitter:
    def emit(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
        if is_float(operands[0].type):
            return getattr(lanes, of_floats)(*operands)
        return lanes.builder.select(_comparison(symbol)(lanes, operands, equation), *operands)

    return emit


def _negate(lanes: Lanes, operands: Operands, _: Equation) -> ir.Value:
    (x,) = operands
    return lanes.builder.fneg(x) if is_float(x.type) else lanes.builder.neg(x)


def _absolute(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
    (x,) = operands
    if is_float(x.type):
        return lanes.intrinsic("fabs", [x])
    return PRIMITIVES["max"](lanes, [x, lanes.builder.neg(x)], equation)


def _sign(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
    (x,), b = operands, lanes.builder
    number = functools.partial(lanes.constant, scalar=scalar_of(x.type))
    if not is_float(x.type):
        least_one = PRIMITIVES["min"](lanes, [x, number(1)], equation)
        return PRIMITIVES["max"](lanes, [least_one, number(-1)], equation)
    # Zeros keep their sign, and NaN stays NaN.
    return b.select(b.fcmp_ordered("!=", x, number(0.0)), lanes.intrinsic("copysign", [number(1.0), x]), x)


def _logistic(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
    (x,), b = operands, lanes.builder
    one = lanes.constant(1, scalar_of(x.type))
    power = PRIMITIVES["exp"](lanes, [b.fneg(x)], equation)
    return b.fdiv(one, b.fadd(one, power, flags=FLAGS), flags=FLAGS)


def _convert(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
    (x,), b = operands, lanes.builder
    source, target = operand_dtype(equation), result_dtype(equation)
    type_ = lanes.vector(scalar_type(target))
    if source == target:
        return x
    if target == np.bool_:
        zero = lanes.constant(0, scalar_of(x.type))
        return b.fcmp_unordered("!=", x, zero) if source.kind == "f" else b.icmp_unsigned("!=", x, zero)
    if source.kind == "f" and target.kind == "f":
        return (b.fpext if target.itemsize > source.itemsize else b.fptrunc)(x, type_)
    if source.kind == "f":
        return lanes.call(f"llvm.fptosi.sat.{suffix(type_)}.{suffix(x.type)}", type_, [x])
    if target.kind == "f":
        return (b.uitofp if source == np.bool_ else b.sitofp)(x, type_)
    if target.itemsize < source.itemsize:
        return b.trunc(x, type_)
    return (b.zext if source == np.bool_ else b.sext)(x, type_)


def _bitcast(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
    return lanes.builder.bitcast(operands[0], lanes.vector(scalar_type(result_dtype(equation))))


def _select(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
    which, first, *others = operands
    if operand_dtype(equation) == np.bool_:
        return lanes.builder.select(which, others[0], first)
    # XLA clamps the index: the last case holds from its number on, the first one below 1.
    for k, other in enumerate(others, start=1):
        is_here = lanes.builder.icmp_signed(">=", which, lanes.constant(k, scalar_of(which.type)))
        first = lanes.builder.select(is_here, other, first)
    return first


# exp and log of float32 from arithmetic, as JAX functions: traced once, then translated as all others. libm would take
# several times as long, lane by lane. Errors are in units in the last place (ulp), measured against float64 over the
# whole range. Results below 2⁻¹²⁵ may be zero, and arguments below 2⁻¹²⁶ count as zero, as XLA flushes subnormal
# numbers on CPUs. The coefficients are minimax fits of this project.

LN2_HIGH, LN2_LOW = 0.693359375, -2.12194440e-4
"""ln 2 in two parts; the first has trailing zeros, so that its product with a small integer is exact."""


def _polynomial(x: Array, *coefficients: float) -> Array:
    """Return Σ coefficients[k]·xᵏ."""
    total = coefficients[-1] * jnp.ones_like(x)
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total


def exp(x: Array) -> Array:
    """Return exp(x) to 0.9 ulp: 2ⁿ·exp(r) with r = x − n·ln 2."""
    # Clipped to where the result is neither 0 nor ∞; NaN stays NaN.
    x = jnp.where(x < -87.5, -87.5, x)
    x = jnp.where(x > 89.0, 89.0, x)
    # At 1.5·2²³ floats are whole numbers: the sum rounds, and n + 126 is in its lowest bits.
    magic = 1.5 * 2**23 + 126
    shifted = x * math.log2(math.e) + magic
    n, bits = shifted - magic, lax.bitcast_convert_type(shifted, jnp.int32)
    r = (x - n * LN2_HIGH) - n * LN2_LOW
    tail = _polynomial(r, 0.99999988079, 0.33333042264, 0.08333677798, 0.01673742011, 0.00276292209)
    twice_exp = (tail * r + 2.0) * r + 2.0
    # Bits 23 to 30 hold the exponent plus 127: this is 2^(n − 1), or 0 for n = −126. At n = 128, 2ⁿ itself would
    # overflow.
    return twice_exp * lax.bitcast_convert_type(bits << 23, jnp.float32)


def log(x: Array) -> Array:
    """Return the natural logarithm to 1 ulp."""
    # x = 2ⁿ·(1 + f) with 1 + f in [√½, √2]; 0x3F3504F3 are the bits of √½.
    bits = lax.bitcast_convert_type(x, jnp.int32)
    exponent = (bits - 0x3F3504F3) >> 23
    f, n = lax.bitcast_convert_type(bits - (exponent << 23), jnp.float32) - 1.0, exponent.astype(jnp.float32)
    tail = _polynomial(
        f, 0.33333313465, -0.25000008941, 0.20002119243, -0.16667996347, 0.14219550789,
        -0.12405591458, 0.11888174713, -0.11675640941, 0.06746601313,
    )  # fmt: skip
    square = f * f
    # Through 0.0, n·LN2_LOW is rounded before it is added: it cannot fuse with the sum.
    low = tail * f * square - 0.5 * square + (0.0 + n * LN2_LOW)
    result = (f + low) + n * LN2_HIGH
    result = jnp.where(x < np.finfo(np.float32).tiny, jnp.where(x < 0, np.nan, -np.inf), result)
    return jnp.where(x < np.inf, result, x)


@functools.cache
def _jaxpr_of(formula: Callable[[Array], Array]) -> core.ClosedJaxpr:
    return trace(formula, example(np.float32))[0]


def _elementary(formula: Callable[[Array], Array]) -> Emitter:
    """Make an emitter of a formula in float32, and of libm's function of its name in float64."""

    def emit(lanes: Lanes, operands: Operands, _: Equation) -> ir.Value:
        if num_bits(operands[0].type) == 64:
            return lanes.libm(formula.__name__, operands)
        return lanes.emit(_jaxpr_of(formula), operands)[0]

    return emit


PRIMITIVES: dict[str, Emitter] = {
    "abs": _absolute,
    "add": _binary("fadd", "add"),
    "add_any": _binary("fadd", "add"),
    "and": _bitwise("and_"),
    "bitcast_convert_type": _bitcast,
    "ceil": _intrinsic("ceil"),
    "convert_element_type": _convert,
    "cos": _libm("cos"),
    "div": _divide,
    "eq": _comparison("=="),
    "exp": _elementary(exp),
    "floor": _intrinsic("floor"),
    "ge": _comparison(">="),
    "gt": _comparison(">"),
    "integer_pow": _whole_power,
    "le": _comparison("<="),
    "log": _elementary(log),
    "logistic": _logistic,
    "lt": _comparison("<"),
    "max": _extreme("maximum", ">"),
    "min": _extreme("minimum", "<"),
    "mul": _multiply,
    "ne": _comparison("!="),
    "neg": _negate,
    "not": lambda lanes, operands, _: lanes.builder.not_(operands[0]),
    "or": _bitwise("or_"),
    "pow": _libm("pow"),
    "select_n": _select,
    "shift_left": _shift("shl"),
    "shift_right_arithmetic": _shift("ashr"),
    "sign": _sign,
    "sin": _libm("sin"),
    "sqrt": _intrinsic("sqrt"),
    "square": lambda lanes, operands, equation: _multiply(lanes, operands * 2, equation),
    "stop_gradient": lambda lanes, operands, _: operands[0],
    "sub": _binary("fsub", "sub"),
    "tanh": _libm("tanh"),
}
"""Emitters by the name of the primitive."""
