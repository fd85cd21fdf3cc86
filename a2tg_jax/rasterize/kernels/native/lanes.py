"""Scalar JAX functions as LLVM code, one lane a pixel.

A function of scalars is traced once to a jaxpr. Each primitive becomes one or a few LLVM instructions on vectors of L
lanes, or on plain scalars, so that a function and its derivative are defined only once, in JAX. The primitives are the
ones that the package's own appearances, tile lists and losses use, and a few others that appearances are likely to
have; XLA composites what needs more (docs/compiler.md).

Integers behave as in XLA: sums wrap, x / 0 = −1, and shifts by the width or more leave only the sign. A float out of
range becomes the nearest integer in range, and NaN becomes 0.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core
from jax.typing import ArrayLike, DTypeLike
from llvmlite import ir

from a2tg_jax.rasterize.kernels.jaxprs import Equation, example, make_code, operand_dtype, result_dtype, trace
from a2tg_jax.rasterize.kernels.native.llvm_code import BOOL, FLAGS, INT, add_libm_symbol, dump, scalar_type

Operands = list[ir.Value]
Emitter = Callable[["Lanes", Operands, Equation], ir.Value]
"""Function of (lanes, operands, equation) that emits code and returns its result."""


def scalar_of(type_: ir.Type) -> ir.Type:
    return type_.element if isinstance(type_, ir.VectorType) else type_


def is_float(type_: ir.Type) -> bool:
    return isinstance(scalar_of(type_), (ir.FloatType, ir.DoubleType))


def num_bits(type_: ir.Type) -> int:
    scalar = scalar_of(type_)
    return {ir.FloatType: 32, ir.DoubleType: 64}.get(type(scalar)) or scalar.width


def suffix(type_: ir.Type) -> str:
    """Return the spelling of a type in the names of intrinsics."""
    scalar = f"{'f' if is_float(type_) else 'i'}{num_bits(type_)}"
    return f"v{type_.count}{scalar}" if isinstance(type_, ir.VectorType) else scalar


@functools.cache
def _constant(number: str, scalar: ir.Type, width: int) -> ir.Constant:
    """Return a number in every lane; as a text it keeps the sign of zero. Making the text of a vector takes long."""
    value = float(number) if is_float(scalar) else int(number)
    return ir.Constant(scalar, value) if width == 1 else ir.Constant(ir.VectorType(scalar, width), [value] * width)


class Lanes:
    """Operations at a builder's position on vectors of `width` lanes; `width` 1 means plain scalars."""

    def __init__(self, builder: ir.IRBuilder, width: int):
        self.builder = builder
        self.width = width

    def emit(self, closed: core.ClosedJaxpr, arguments: Sequence[ir.Value]) -> list[ir.Value]:
        """Emit a jaxpr of scalars, given one LLVM value per argument; return its values.

        Raises:
          Untranslatable: if a primitive or a dtype has no translation.
        """
        dump(self.builder.function.name, "jaxpr", lambda: f"{closed}\n\n")

        def literal(number: ArrayLike, dtype: DTypeLike) -> ir.Constant:
            return self.constant(number, scalar_type(dtype))

        primitives = {name: functools.partial(emit, self) for name, emit in PRIMITIVES.items()}
        return make_code(closed, arguments, literal, primitives, "native loops")

    def vector(self, scalar: ir.Type) -> ir.Type:
        """Return the type of one value per lane."""
        return scalar if self.width == 1 else ir.VectorType(scalar, self.width)

    def constant(self, value: Any, scalar: ir.Type) -> ir.Constant:
        """Return the same number in every lane."""
        value = float(value) if is_float(scalar) else int(value)
        return _constant(str(value), scalar, self.width)

    def broadcast(self, value: ir.Value) -> ir.Value:
        """Copy a scalar to every lane."""
        if self.width == 1:
            return value
        # LLVM's idiom: insert into the first lane, then shuffle it to all; it becomes one broadcast.
        undefined = ir.Constant(self.vector(value.type), ir.Undefined)
        first = self.builder.insert_element(undefined, value, INT(0))
        return self.builder.shuffle_vector(first, undefined, self.constant(0, INT))

    def intrinsic(self, name: str, operands: Sequence[ir.Value]) -> ir.Value:
        """Call llvm.<name> on operands of one type; the result has that type."""
        type_ = operands[0].type
        return self.call(f"{name}.{suffix(type_)}", type_, operands, FLAGS if is_float(type_) else ())

    def call(self, name: str, type_: ir.Type, operands: Sequence[ir.Value], flags: Sequence[str] = ()) -> ir.Value:
        """Call the intrinsic llvm.<name>, which returns a value of a type."""
        module = self.builder.module
        function_type = ir.FunctionType(type_, [operand.type for operand in operands])
        function = module.globals.get(f"llvm.{name}") or ir.Function(module, function_type, f"llvm.{name}")
        return self.builder.call(function, operands, fastmath=flags)

    def sums(self, values: Sequence[ir.Value]) -> list[ir.Value]:
        """Return the sum over lanes of each vector."""
        sums: list[ir.Value] = []
        for first in range(0, len(values), self.width):
            some = values[first : first + self.width]
            vector = self.sums_in_lanes(some)
            sums += [self.builder.extract_element(vector, INT(k)) for k in range(len(some))]
        return sums

    def sums_in_lanes(self, values: Sequence[ir.Value]) -> ir.Value:
        """Return a vector with the sum over lanes of vector k in lane k, for up to `width` vectors.

        It has as many lanes as vectors, rounded up to a power of two.
        """
        b = self.builder
        count = 1 << (len(values) - 1).bit_length()
        values = [*values, *[ir.Constant(values[0].type, None)] * (count - len(values))]
        stride = 1
        while len(values) > 1:
            # Two vectors become one of half their lanes' sums: lanes whose index has the bit `stride` are the second's.
            # Nine instructions for four vectors of four lanes, where separate sums would take sixteen.
            lanes = np.arange(self.width)
            is_second = lanes & stride != 0
            mask_type = ir.VectorType(INT, self.width)
            low, high = (
                ir.Constant(mask_type, np.where(is_second, self.width + of_second, of_first).tolist())
                for of_first, of_second in ((lanes, lanes - stride), (lanes + stride, lanes))
            )
            pairs = zip(values[::2], values[1::2], strict=True)
            values = [b.fadd(b.shuffle_vector(x, y, low), b.shuffle_vector(x, y, high)) for x, y in pairs]
            stride *= 2
        (total,) = values
        width = self.width
        while width > count:
            width //= 2
            masks = [ir.Constant(ir.VectorType(INT, width), [*range(k, k + width)]) for k in (0, width)]
            total = b.fadd(*(b.shuffle_vector(total, total, mask) for mask in masks))
        return total

    def fold(self, value: ir.Value, combine: Callable[[ir.Value, ir.Value], ir.Value], to: int = 1) -> ir.Value:
        """Combine the halves of a vector until `to` lanes are left; one lane is a scalar."""
        b = self.builder
        width = self.width
        while width > to:
            width //= 2
            masks = (ir.Constant(ir.VectorType(INT, width), list(range(first, first + width))) for first in (0, width))
            value = combine(*(b.shuffle_vector(value, value, mask) for mask in masks))
        return b.extract_element(value, INT(0)) if isinstance(value.type, ir.VectorType) and to == 1 else value

    def any(self, mask: ir.Value) -> ir.Value:
        """Return whether a lane of a mask is set."""
        if self.width == 1:
            return mask
        # As one integer of L bits: a single test of a register, where a fold would take log L steps.
        bits = self.builder.bitcast(mask, ir.IntType(self.width))
        return self.builder.icmp_unsigned("!=", bits, ir.IntType(self.width)(0))

    def larger(self, x: ir.Value, y: ir.Value) -> ir.Value:
        """Return the larger float, in one instruction; y if either is NaN or both are zeros."""
        return self.builder.select(self.builder.fcmp_ordered(">", x, y), x, y)

    def smaller(self, x: ir.Value, y: ir.Value) -> ir.Value:
        """Return the smaller float, in one instruction; y if either is NaN or both are zeros."""
        return self.builder.select(self.builder.fcmp_ordered("<", x, y), x, y)

    def maximum(self, x: ir.Value, y: ir.Value) -> ir.Value:
        """Return IEEE 754's maximum of floats: NaN if either is, and +0 is larger than −0."""
        # LLVM's own llvm.maximum made whole steps 7 % slower with AVX-512.
        if _orders_by_compare(y, -1.0):
            return self.larger(y, x)
        if _orders_by_compare(x, -1.0):
            return self.larger(x, y)
        # Against +0, a comparison takes −0 as equal: +0 + −0 = +0 corrects that, and adds nothing to others.
        for zero, other in ((x, y), (y, x)):
            if _orders_by_compare(zero, 1.0):
                return self.builder.fadd(self.larger(zero, other), zero)
        # What `larger` gives in both orders is right. If they differ, there is a NaN, or zeros of both signs, and the
        # result is the union of the bits, with the signs intersected.
        b = self.builder
        width = num_bits(x.type)
        sign = self.constant(1 << (width - 1), ir.IntType(width))
        x_first = b.xor(self._as_bits(self.larger(x, y)), sign)
        y_first = b.xor(self._as_bits(self.larger(y, x)), sign)
        return b.bitcast(b.xor(b.or_(x_first, y_first), sign), x.type)

    def minimum(self, x: ir.Value, y: ir.Value) -> ir.Value:
        """Return IEEE 754's minimum of floats: NaN if either is, and −0 is smaller than +0."""
        if _orders_by_compare(y, 1.0):
            return self.smaller(y, x)
        if _orders_by_compare(x, 1.0):
            return self.smaller(x, y)
        # As in `maximum`, but the union of the signs is the right one: −0 is the smaller zero.
        x_first = self._as_bits(self.smaller(x, y))
        y_first = self._as_bits(self.smaller(y, x))
        return self.builder.bitcast(self.builder.or_(x_first, y_first), x.type)

    def _as_bits(self, x: ir.Value) -> ir.Value:
        return self.builder.bitcast(x, self.vector(ir.IntType(num_bits(x.type))))


def _orders_by_compare(value: ir.Value, sign_of_zero: float) -> bool:
    """Return whether one comparison orders this constant and any number: it is not NaN, and a zero only of the
    given sign."""
    if not isinstance(value, ir.Constant):
        return False
    number = value.constant[0] if isinstance(value.type, ir.VectorType) else value.constant
    if isinstance(number, ir.Constant):
        number = number.constant
    return bool(number == number and (number != 0 or np.copysign(1.0, number) == sign_of_zero))


def _binary(for_floats: str, for_integers: str) -> Emitter:
    def emit(lanes: Lanes, operands: Operands, _: Equation) -> ir.Value:
        if is_float(operands[0].type):
            return getattr(lanes.builder, for_floats)(*operands, flags=FLAGS)
        return getattr(lanes.builder, for_integers)(*operands)

    return emit


def _comparison(symbol: str) -> Emitter:
    def emit(lanes: Lanes, operands: Operands, _: Equation) -> ir.Value:
        b = lanes.builder
        type_ = operands[0].type
        if is_float(type_):
            # NaN differs from everything, itself included, and is neither less nor greater.
            return (b.fcmp_unordered if symbol == "!=" else b.fcmp_ordered)(symbol, *operands)
        # As one bit with a sign, True would be −1 and less than False.
        return (b.icmp_unsigned if scalar_of(type_) == BOOL else b.icmp_signed)(symbol, *operands)

    return emit


def _extreme(of_floats: str, symbol: str) -> Emitter:
    def emit(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
        if is_float(operands[0].type):
            return getattr(lanes, of_floats)(*operands)
        return lanes.builder.select(_comparison(symbol)(lanes, operands, equation), *operands)

    return emit


def _intrinsic(name: str) -> Emitter:
    return lambda lanes, operands, _: lanes.intrinsic(name, operands)


def _libm(name: str) -> Emitter:
    """Make an emitter of a function of the C library; its error is about one unit in the last place."""

    def emit(lanes: Lanes, operands: Operands, _: Equation) -> ir.Value:
        # LLVM calls it lane by lane. It needs the address, because on Windows it does not find all functions itself.
        add_libm_symbol(name if num_bits(operands[0].type) == 64 else f"{name}f")
        return lanes.intrinsic(name, operands)

    return emit


def _divide(lanes: Lanes, operands: Operands, _: Equation) -> ir.Value:
    x, y = operands
    b = lanes.builder
    if is_float(x.type):
        return b.fdiv(x, y, flags=FLAGS)
    number = functools.partial(lanes.constant, scalar=scalar_of(x.type))
    is_zero = b.icmp_signed("==", y, number(0))
    is_minus_one = b.icmp_signed("==", y, number(-1))
    # Processors may trap at a divisor of 0, and of −1 for the least integer: these get 1 instead.
    quotient = b.sdiv(x, b.select(b.or_(is_zero, is_minus_one), number(1), y))
    return b.select(is_zero, number(-1), b.select(is_minus_one, b.neg(x), quotient))


def _shift_right(lanes: Lanes, operands: Operands, _: Equation) -> ir.Value:
    x, amount = operands
    b = lanes.builder
    most = lanes.constant(num_bits(x.type) - 1, scalar_of(x.type))
    # LLVM leaves shifts by the width or more undefined. As unsigned numbers, negative amounts are too large as well.
    return b.ashr(x, b.select(b.icmp_unsigned("<", amount, most), amount, most))


def _absolute(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
    (x,) = operands
    if is_float(x.type):
        return lanes.intrinsic("fabs", [x])
    return PRIMITIVES["max"](lanes, [x, lanes.builder.neg(x)], equation)


def _convert(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
    (x,) = operands
    b = lanes.builder
    source = operand_dtype(equation)
    target = result_dtype(equation)
    type_ = lanes.vector(scalar_type(target))
    if source == target:
        return x
    if target == np.bool_:
        zero = lanes.constant(0, scalar_of(x.type))
        return b.fcmp_unordered("!=", x, zero) if source.kind == "f" else b.icmp_unsigned("!=", x, zero)
    if source.kind == "f" and target.kind == "f":
        return (b.fpext if target.itemsize > source.itemsize else b.fptrunc)(x, type_)
    if source.kind == "f":
        return lanes.call(f"fptosi.sat.{suffix(type_)}.{suffix(x.type)}", type_, [x])
    if target.kind == "f":
        return (b.uitofp if source == np.bool_ else b.sitofp)(x, type_)
    if target.itemsize < source.itemsize:
        return b.trunc(x, type_)
    return (b.zext if source == np.bool_ else b.sext)(x, type_)


def _bitcast(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
    return lanes.builder.bitcast(operands[0], lanes.vector(scalar_type(result_dtype(equation))))


def _select(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
    index, result, *others = operands
    if operand_dtype(equation) == np.bool_:
        return lanes.builder.select(index, others[0], result)
    # XLA clamps the index: the last case holds from its number on, the first one below 1.
    for k, other in enumerate(others, start=1):
        is_reached = lanes.builder.icmp_signed(">=", index, lanes.constant(k, scalar_of(index.type)))
        result = lanes.builder.select(is_reached, other, result)
    return result


# exp and log of float32 from arithmetic, as JAX functions: traced once, then translated as all others. libm would take
# several times as long, lane by lane. Errors are in units in the last place (ulp), measured against float64 over the
# whole range. Results below 2⁻¹²⁵ may be zero, and arguments below 2⁻¹²⁶ count as zero, as XLA flushes subnormal
# numbers on CPUs. The coefficients are minimax fits of this project.

LN2_HIGH = 0.693359375
"""Most of ln 2, with trailing zeros, so that its product with a small integer is exact."""
LN2_LOW = -2.12194440e-4
"""The rest of ln 2."""


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
    n = shifted - magic
    bits = lax.bitcast_convert_type(shifted, jnp.int32)
    r = (x - n * LN2_HIGH) - n * LN2_LOW
    tail = _polynomial(r, 0.99999988079, 0.33333042264, 0.08333677798, 0.01673742011, 0.00276292209)
    twice_exp = (tail * r + 2.0) * r + 2.0
    # Bits 23 to 30 hold the exponent plus 127: moved there by a product that wraps, this is 2^(n − 1), or 0 for
    # n = −126. At n = 128, 2ⁿ itself would overflow.
    return twice_exp * lax.bitcast_convert_type(bits * 2**23, jnp.float32)


def log(x: Array) -> Array:
    """Return the natural logarithm to 1 ulp."""
    # x = 2ⁿ·(1 + f) with 1 + f in [√½, √2]; 0x3F3504F3 are the bits of √½.
    bits = lax.bitcast_convert_type(x, jnp.int32)
    exponent = (bits - 0x3F3504F3) >> 23
    f = lax.bitcast_convert_type(bits - exponent * 2**23, jnp.float32) - 1.0
    n = exponent.astype(jnp.float32)
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


def _elementary(formula: Callable[[Array], Array]) -> Emitter:
    """Make an emitter of a formula in float32, and of libm's function of its name in float64."""
    of_libm = _libm(formula.__name__)
    jaxpr = functools.cache(lambda: trace(formula, example(np.float32))[0])

    def emit(lanes: Lanes, operands: Operands, equation: Equation) -> ir.Value:
        if num_bits(operands[0].type) == 64:
            return of_libm(lanes, operands, equation)
        return lanes.emit(jaxpr(), operands)[0]

    return emit


PRIMITIVES: dict[str, Emitter] = {
    **{"add": _binary("fadd", "add"), "add_any": _binary("fadd", "add"), "sub": _binary("fsub", "sub")},
    **{"mul": _binary("fmul", "mul"), "max": _extreme("maximum", ">"), "min": _extreme("minimum", "<")},
    **{"eq": _comparison("=="), "ne": _comparison("!="), "lt": _comparison("<"), "le": _comparison("<=")},
    **{"gt": _comparison(">"), "ge": _comparison(">="), "exp": _elementary(exp), "log": _elementary(log)},
    **{name: _intrinsic(name) for name in ("ceil", "floor", "sqrt")},
    **{name: _libm(name) for name in ("cos", "pow", "sin", "tanh")},
    "abs": _absolute,
    "and": lambda lanes, operands, _: lanes.builder.and_(*operands),
    "bitcast_convert_type": _bitcast,
    "convert_element_type": _convert,
    "div": _divide,
    "neg": lambda lanes, x, _: lanes.builder.fneg(*x) if is_float(x[0].type) else lanes.builder.neg(*x),
    "not": lambda lanes, operands, _: lanes.builder.not_(operands[0]),
    "or": lambda lanes, operands, _: lanes.builder.or_(*operands),
    "select_n": _select,
    "shift_right_arithmetic": _shift_right,
    "stop_gradient": lambda lanes, operands, _: operands[0],
}
"""Emitters by the name of the primitive; `jaxprs.FORMULAS` has the others."""
