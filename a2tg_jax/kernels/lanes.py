"""Scalar JAX functions as LLVM code, one lane a pixel.

A function of scalars is traced once to a jaxpr; each of its primitives becomes one LLVM instruction (or a few) on
vectors of L lanes, or on plain scalars. What is computed, and its derivative, is thus said once, in JAX.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core
from llvmlite import ir

FLAGS = ("contract",)
"""Products and sums may fuse; nothing else of IEEE arithmetic is given up within a lane."""
INT = ir.IntType(32)
BOOL = ir.IntType(1)


def trace(function: Callable, *examples) -> tuple[core.ClosedJaxpr, Any]:
    """The jaxpr of a function of scalars, and the structure of what it returns.

    Args:
      examples: pytrees of `jax.ShapeDtypeStruct` with shape ().
    """
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*examples)
    return closed, jax.tree.structure(shape)


def scalar_type(dtype) -> ir.Type:
    """The LLVM type of a scalar of a numpy dtype."""
    dtype = np.dtype(dtype)
    if dtype == np.bool_:
        return BOOL
    if dtype == np.int32:
        return INT
    if dtype == np.float32:
        return ir.FloatType()
    if dtype == np.float64:
        return ir.DoubleType()
    raise NotImplementedError(f"native loops know bool, int32, float32 and float64; a value is {dtype}")


class Lanes:
    """Emits scalar jaxprs at a builder's position on vectors of `width` lanes; `width` 1 means plain scalars."""

    def __init__(self, builder: ir.IRBuilder, width: int):
        self.builder, self.width = builder, width

    def vector(self, scalar: ir.Type) -> ir.Type:
        """The type of one value per lane."""
        return scalar if self.width == 1 else ir.VectorType(scalar, self.width)

    def constant(self, value, scalar: ir.Type) -> ir.Constant:
        """The same number in every lane."""
        value = float(value) if isinstance(scalar, (ir.FloatType, ir.DoubleType)) else int(value)
        return ir.Constant(self.vector(scalar), value if self.width == 1 else [value] * self.width)

    def splat(self, value: ir.Value) -> ir.Value:
        """A scalar in every lane."""
        if self.width == 1:
            return value
        undefined = ir.Constant(self.vector(value.type), ir.Undefined)
        first = self.builder.insert_element(undefined, value, INT(0))
        return self.builder.shuffle_vector(
            first, undefined, ir.Constant(ir.VectorType(INT, self.width), [0] * self.width)
        )

    def intrinsic(self, name: str, operands: Sequence[ir.Value]) -> ir.Value:
        """Calls llvm.<name> of floats of one type, which gives a float of that type."""
        type_, module = operands[0].type, self.builder.module
        name = f"llvm.{name}.{_suffix(type_)}"
        function_type = ir.FunctionType(type_, [operand.type for operand in operands])
        function = module.globals.get(name) or ir.Function(module, function_type, name)
        return self.builder.call(function, operands, fastmath=FLAGS)

    def sum(self, value: ir.Value) -> ir.Value:
        """The sum over lanes, in an order of LLVM's choice."""
        if self.width == 1:
            return value
        scalar = value.type.element
        zero = ir.Constant(scalar, 0.0)
        function_type = ir.FunctionType(scalar, [scalar, value.type])
        name = f"llvm.vector.reduce.fadd.{_suffix(value.type)}"
        function = self.builder.module.globals.get(name) or ir.Function(self.builder.module, function_type, name)
        return self.builder.call(function, [zero, value], fastmath=("reassoc", "nsz", "contract"))

    def smallest(self, value: ir.Value) -> ir.Value:
        """The smallest of the lanes, which are numbers."""
        return self.fold(value, self.smaller)

    def largest(self, value: ir.Value) -> ir.Value:
        """The largest of the lanes, which are numbers."""
        return self.fold(value, self.larger)

    def fold(self, value: ir.Value, combine: Callable[[ir.Value, ir.Value], ir.Value], to: int = 1) -> ir.Value:
        """Combines the halves of a vector until `to` lanes are left; one lane is a scalar."""
        b, width = self.builder, self.width
        while width > to:
            width //= 2
            masks = (ir.Constant(ir.VectorType(INT, width), list(range(first, first + width))) for first in (0, width))
            value = combine(*(b.shuffle_vector(value, value, mask) for mask in masks))
        return b.extract_element(value, INT(0)) if isinstance(value.type, ir.VectorType) and to == 1 else value

    def any(self, mask: ir.Value) -> ir.Value:
        """Whether a lane of a mask is set."""
        if self.width == 1:
            return mask
        return self.builder.icmp_unsigned("!=", self.bits(mask), ir.IntType(self.width)(0))

    def bits(self, mask: ir.Value) -> ir.Value:
        """A mask as an integer of `width` bits."""
        return mask if self.width == 1 else self.builder.bitcast(mask, ir.IntType(self.width))

    def emit(self, closed: core.ClosedJaxpr, arguments: Sequence[ir.Value]) -> list[ir.Value]:
        """The values of a jaxpr of scalars, given one LLVM value per argument."""
        return self._emit(closed.jaxpr, closed.consts, arguments)

    def _emit(self, jaxpr: core.Jaxpr, consts, arguments: Sequence[ir.Value]) -> list[ir.Value]:
        values: dict[core.Var, ir.Value] = {}

        def read(atom: Any) -> ir.Value:
            if isinstance(atom, core.Literal):
                return self.constant(atom.val, scalar_type(_dtype(atom)))
            return values[atom]

        for variable, value in zip(jaxpr.constvars, consts, strict=True):
            values[variable] = self.constant(value, scalar_type(_dtype(variable)))
        values.update(zip(jaxpr.invars, arguments, strict=True))
        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _equation(self, equation, operands: list[ir.Value]) -> list[ir.Value]:
        for variable in equation.outvars:
            if variable.aval.shape != ():
                raise NotImplementedError(f"native loops take functions of scalars; {equation.primitive} is not one")
        name, params = equation.primitive.name, equation.params
        inner = params.get("jaxpr", params.get("call_jaxpr"))
        if inner is not None:
            return self.emit(inner, operands) if hasattr(inner, "consts") else self._emit(inner, (), operands)
        if name not in PRIMITIVES:
            raise NotImplementedError(
                f"native loops have no translation for the primitive '{name}': leave this rule to XLA, by "
                "RenderSettings(compositor='xla')"
            )
        return [PRIMITIVES[name](self, operands, equation)]

    def exp(self, x: ir.Value) -> ir.Value:
        """exp to about one unit in the last place: 2^n·p(r) with r = x − n·ln 2, |r| <= ln 2 / 2.

        In float32 the argument is held in [−87, 88], where the result is a normal number.
        """
        if scalar_of(x.type) == ir.DoubleType():
            return self.intrinsic("exp", [x])
        b, number = self.builder, functools.partial(self.constant, scalar=ir.FloatType())
        x = self.smaller(self.larger(x, number(-87.0)), number(88.0))
        n = self.intrinsic("rint", [self._mul(x, number(math.log2(math.e)))])
        r = b.fsub(x, self._mul(n, number(0.693359375)), flags=FLAGS)
        r = b.fsub(r, self._mul(n, number(-2.12194440e-4)), flags=FLAGS)
        p = number(1.9875691500e-4)
        for coefficient in (1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 0.5, 1.0, 1.0):
            p = b.fadd(self._mul(p, r), number(coefficient), flags=FLAGS)
        bits = self.vector(INT)
        shift = b.shl(b.fptosi(n, bits), self.constant(23, INT))
        return b.bitcast(b.add(b.bitcast(p, bits), shift), x.type)

    def _mul(self, x: ir.Value, y: ir.Value) -> ir.Value:
        return self.builder.fmul(x, y, flags=FLAGS)

    def larger(self, x: ir.Value, y: ir.Value) -> ir.Value:
        """max(x, y), lane by lane; x where either is not a number."""
        if not _is_float(x.type):
            return self.builder.select(self.builder.icmp_signed(">", x, y), x, y)
        return self.builder.select(self.builder.fcmp_unordered(">", x, y), x, y)

    def smaller(self, x: ir.Value, y: ir.Value) -> ir.Value:
        """min(x, y), lane by lane; x where either is not a number."""
        if not _is_float(x.type):
            return self.builder.select(self.builder.icmp_signed("<", x, y), x, y)
        return self.builder.select(self.builder.fcmp_unordered("<", x, y), x, y)


def _dtype(atom: Any) -> np.dtype:
    return atom.aval.dtype


def scalar_of(type_: ir.Type) -> ir.Type:
    """The type of one lane."""
    return type_.element if isinstance(type_, ir.VectorType) else type_


def _is_float(type_: ir.Type) -> bool:
    return isinstance(scalar_of(type_), (ir.FloatType, ir.DoubleType))


def _suffix(type_: ir.Type) -> str:
    scalar = scalar_of(type_)
    letter = "f" if _is_float(scalar) else "i"
    bits = {ir.FloatType: 32, ir.DoubleType: 64}.get(type(scalar)) or scalar.width
    return f"v{type_.count}{letter}{bits}" if isinstance(type_, ir.VectorType) else f"{letter}{bits}"


def _binary(for_floats: str, for_integers: str):
    def emit(lanes: Lanes, operands, _):
        if _is_float(operands[0].type):
            return getattr(lanes.builder, for_floats)(*operands, flags=FLAGS)
        return getattr(lanes.builder, for_integers)(*operands)

    return emit


def _comparison(symbol: str):
    def emit(lanes: Lanes, operands, _):
        b = lanes.builder
        if not _is_float(operands[0].type):
            compare = b.icmp_unsigned if scalar_of(operands[0].type) == BOOL else b.icmp_signed
            return compare(symbol, *operands)
        return (b.fcmp_unordered if symbol == "!=" else b.fcmp_ordered)(symbol, *operands)

    return emit


def _bitwise(method: str):
    return lambda lanes, operands, _: getattr(lanes.builder, method)(*operands)


def _intrinsic(name: str):
    return lambda lanes, operands, _: lanes.intrinsic(name, operands)


def _convert(lanes: Lanes, operands, equation) -> ir.Value:
    (x,), b = operands, lanes.builder
    scalar = scalar_type(equation.outvars[0].aval.dtype)
    source, target = scalar_of(x.type), lanes.vector(scalar)
    if source == scalar:
        return x
    if source == BOOL:
        return b.uitofp(x, target) if _is_float(scalar) else b.zext(x, target)
    if _is_float(source):
        if scalar == INT:
            return b.fptosi(x, target)
        if _is_float(scalar):
            return b.fpext(x, target) if scalar == ir.DoubleType() else b.fptrunc(x, target)
    if source == INT and _is_float(scalar):
        return b.sitofp(x, target)
    raise NotImplementedError(f"native loops do not convert {equation.invars[0].aval} to {equation.outvars[0].aval}")


def _select(lanes: Lanes, operands, _) -> ir.Value:
    which, if_false, if_true = operands
    return lanes.builder.select(which, if_true, if_false)


def _power(lanes: Lanes, operands, equation) -> ir.Value:
    (x,), exponent = operands, equation.params["y"]
    one, result = lanes.constant(1, scalar_of(x.type)), None
    for _ in range(abs(exponent)):
        result = x if result is None else lanes._mul(result, x)
    result = one if result is None else result
    return lanes.builder.fdiv(one, result, flags=FLAGS) if exponent < 0 else result


def _negate(lanes: Lanes, operands, _) -> ir.Value:
    (x,) = operands
    return lanes.builder.fneg(x) if _is_float(x.type) else lanes.builder.neg(x)


def _sign(lanes: Lanes, operands, _) -> ir.Value:
    (x,) = operands
    number = functools.partial(lanes.constant, scalar=scalar_of(x.type))
    signed = lanes.intrinsic("copysign", [number(1.0), x])
    return lanes.builder.select(lanes.builder.fcmp_ordered("!=", x, number(0.0)), signed, x)


def _clamp(lanes: Lanes, operands, _) -> ir.Value:
    low, x, high = operands
    return lanes.smaller(lanes.larger(x, low), high)


def _absolute(lanes: Lanes, operands, _) -> ir.Value:
    (x,) = operands
    return lanes.intrinsic("fabs", [x]) if _is_float(x.type) else lanes.larger(x, lanes.builder.neg(x))


def _identity(lanes: Lanes, operands, _) -> ir.Value:
    return operands[0]


PRIMITIVES: dict[str, Callable[[Lanes, list[ir.Value], Any], ir.Value]] = {
    "add": _binary("fadd", "add"),
    "add_any": _binary("fadd", "add"),
    "sub": _binary("fsub", "sub"),
    "mul": _binary("fmul", "mul"),
    "div": _binary("fdiv", "sdiv"),
    "square": lambda lanes, operands, _: lanes._mul(operands[0], operands[0]),
    "neg": _negate,
    "max": lambda lanes, operands, _: lanes.larger(*operands),
    "min": lambda lanes, operands, _: lanes.smaller(*operands),
    "abs": _absolute,
    "sign": _sign,
    "floor": _intrinsic("floor"),
    "ceil": _intrinsic("ceil"),
    "exp": lambda lanes, operands, _: lanes.exp(operands[0]),
    "log": _intrinsic("log"),
    "sqrt": _intrinsic("sqrt"),
    "integer_pow": _power,
    "clamp": _clamp,
    "select_n": _select,
    "and": _bitwise("and_"),
    "or": _bitwise("or_"),
    "xor": _bitwise("xor"),
    "not": lambda lanes, operands, _: lanes.builder.not_(operands[0]),
    "eq": _comparison("=="),
    "ne": _comparison("!="),
    "lt": _comparison("<"),
    "le": _comparison("<="),
    "gt": _comparison(">"),
    "ge": _comparison(">="),
    "convert_element_type": _convert,
    "broadcast_in_dim": _identity,
    "copy": _identity,
    "reshape": _identity,
    "squeeze": _identity,
    "stop_gradient": _identity,
}
