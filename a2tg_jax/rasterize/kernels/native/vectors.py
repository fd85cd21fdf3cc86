"""Arithmetic on vectors of lanes, or on plain scalars, at an LLVM builder's position."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend import core
from jax.typing import DTypeLike
from llvmlite import ir

from a2tg_jax.rasterize.kernels.jaxprs import Untranslatable, Value, Values

FLAGS = ("contract",)
"""Flags that let products and sums fuse; within a lane all other IEEE rules hold."""
INT = ir.IntType(32)
BOOL = ir.IntType(1)


def scalar_type(dtype: DTypeLike) -> ir.Type:
    """Return the LLVM type of a scalar of a numpy dtype.

    Raises:
      Untranslatable: for anything but bool, integers of 8 to 64 bits, float32 and float64.
    """
    dtype = np.dtype(dtype)
    if dtype == np.bool_:
        return BOOL
    if dtype.kind in "iu":
        return ir.IntType(8 * dtype.itemsize)
    if dtype == np.float32:
        return ir.FloatType()
    if dtype == np.float64:
        return ir.DoubleType()
    raise Untranslatable(f"native loops know bool, integers, float32 and float64; a value is {dtype}")


def scalar_of(type_: ir.Type) -> ir.Type:
    """Return the type of one lane."""
    return type_.element if isinstance(type_, ir.VectorType) else type_


def is_float(type_: ir.Type) -> bool:
    return isinstance(scalar_of(type_), (ir.FloatType, ir.DoubleType))


def num_bits(type_: ir.Type) -> int:
    """Return the bits of one lane's type."""
    scalar = scalar_of(type_)
    return {ir.FloatType: 32, ir.DoubleType: 64}.get(type(scalar)) or scalar.width


def suffix(type_: ir.Type) -> str:
    """Return the spelling of a type in the names of intrinsics."""
    one = f"{'f' if is_float(type_) else 'i'}{num_bits(type_)}"
    return f"v{type_.count}{one}" if isinstance(type_, ir.VectorType) else one


class Vectors:
    """Operations at a builder's position on vectors of `width` lanes; `width` 1 means plain scalars."""

    def __init__(self, builder: ir.IRBuilder, width: int):
        self.builder, self.width = builder, width

    def vector(self, scalar: ir.Type) -> ir.Type:
        """Return the type of one value per lane."""
        return scalar if self.width == 1 else ir.VectorType(scalar, self.width)

    def constant(self, value: Any, scalar: ir.Type) -> ir.Constant:
        """Return the same number in every lane."""
        value = float(value) if is_float(scalar) else int(value)
        return ir.Constant(self.vector(scalar), value if self.width == 1 else [value] * self.width)

    def broadcast(self, value: ir.Value) -> ir.Value:
        """Copy a scalar to every lane."""
        if self.width == 1:
            return value
        undefined = ir.Constant(self.vector(value.type), ir.Undefined)
        first = self.builder.insert_element(undefined, value, INT(0))
        return self.builder.shuffle_vector(
            first, undefined, ir.Constant(ir.VectorType(INT, self.width), [0] * self.width)
        )

    def room(self, type_: ir.Type) -> ir.Value:
        """Return the address of a new variable on the stack."""
        with self.builder.goto_entry_block():
            room = self.builder.alloca(type_)
        room.type = ir.PointerType()
        return room

    def intrinsic(self, name: str, operands: Sequence[ir.Value]) -> ir.Value:
        """Call llvm.<name> on operands of one type; the result has that type."""
        flags = FLAGS if is_float(operands[0].type) else ()
        type_ = operands[0].type
        return self.call(f"llvm.{name}.{suffix(type_)}", type_, operands, flags)

    def call(self, name: str, type_: ir.Type, operands: Sequence[ir.Value], flags: Sequence[str] = ()) -> ir.Value:
        """Call a function of the module that returns a value of a type; declare it if needed."""
        module = self.builder.module
        function_type = ir.FunctionType(type_, [operand.type for operand in operands])
        function = module.globals.get(name) or ir.Function(module, function_type, name)
        return self.builder.call(function, operands, fastmath=flags)

    def sum(self, value: ir.Value) -> ir.Value:
        """Sum over lanes, in an order of LLVM's choice."""
        if self.width == 1:
            return value
        scalar = value.type.element
        operands, flags = [ir.Constant(scalar, 0.0), value], ("reassoc", "nsz", "contract")
        return self.call(f"llvm.vector.reduce.fadd.{suffix(value.type)}", scalar, operands, flags)

    def smallest(self, value: ir.Value) -> ir.Value:
        """Return the smallest lane; none may be NaN."""
        return self.fold(value, self.smaller)

    def largest(self, value: ir.Value) -> ir.Value:
        """Return the largest lane; none may be NaN."""
        return self.fold(value, self.larger)

    def fold(self, value: ir.Value, combine: Callable[[ir.Value, ir.Value], ir.Value], to: int = 1) -> ir.Value:
        """Combine the halves of a vector until `to` lanes are left; one lane is a scalar."""
        b, width = self.builder, self.width
        while width > to:
            width //= 2
            masks = (ir.Constant(ir.VectorType(INT, width), list(range(first, first + width))) for first in (0, width))
            value = combine(*(b.shuffle_vector(value, value, mask) for mask in masks))
        return b.extract_element(value, INT(0)) if isinstance(value.type, ir.VectorType) and to == 1 else value

    def any(self, mask: ir.Value) -> ir.Value:
        """Return whether a lane of a mask is set."""
        if self.width == 1:
            return mask
        return self.builder.icmp_unsigned("!=", self.bits(mask), ir.IntType(self.width)(0))

    def bits(self, mask: ir.Value) -> ir.Value:
        """Convert a mask to an integer of `width` bits."""
        return mask if self.width == 1 else self.builder.bitcast(mask, ir.IntType(self.width))

    def larger(self, x: ir.Value, y: ir.Value) -> ir.Value:
        """Return the larger float, in one instruction; y if either is NaN or both are zeros."""
        return self.builder.select(self.builder.fcmp_ordered(">", x, y), x, y)

    def smaller(self, x: ir.Value, y: ir.Value) -> ir.Value:
        """Return the smaller float, in one instruction; y if either is NaN or both are zeros."""
        return self.builder.select(self.builder.fcmp_ordered("<", x, y), x, y)

    def maximum(self, x: ir.Value, y: ir.Value) -> ir.Value:
        """Return IEEE 754's maximum of floats: NaN if either is, and +0 is larger than −0."""
        if _orders_by_compare(y, -1.0):
            return self.larger(y, x)
        if _orders_by_compare(x, -1.0):
            return self.larger(x, y)
        for zero, other in ((x, y), (y, x)):
            if _orders_by_compare(zero, 1.0):
                return self.builder.fadd(self.larger(zero, other), zero)
        # Two orders that agree are both right. Otherwise there is a NaN, or zeros of both signs: the union of the bits,
        # with the signs intersected, is the result.
        b, sign = self.builder, self._sign_bits(x.type)
        one, other = (b.xor(self._as_bits(self.larger(*pair)), sign) for pair in ((x, y), (y, x)))
        return b.bitcast(b.xor(b.or_(one, other), sign), x.type)

    def minimum(self, x: ir.Value, y: ir.Value) -> ir.Value:
        """Return IEEE 754's minimum of floats: NaN if either is, and −0 is smaller than +0."""
        if _orders_by_compare(y, 1.0):
            return self.smaller(y, x)
        if _orders_by_compare(x, 1.0):
            return self.smaller(x, y)
        one, other = (self._as_bits(self.smaller(*pair)) for pair in ((x, y), (y, x)))
        return self.builder.bitcast(self.builder.or_(one, other), x.type)

    def _as_bits(self, x: ir.Value) -> ir.Value:
        return self.builder.bitcast(x, self.vector(ir.IntType(num_bits(x.type))))

    def _sign_bits(self, type_: ir.Type) -> ir.Constant:
        width = num_bits(type_)
        return self.constant(1 << (width - 1), ir.IntType(width))


def _orders_by_compare(value: ir.Value, sign_of_zero: float) -> bool:
    """Return whether one comparison orders this constant and any number: it is not NaN, and a zero only of the
    given sign."""
    if not isinstance(value, ir.Constant):
        return False
    number = value.constant[0] if isinstance(value.type, ir.VectorType) else value.constant
    if isinstance(number, ir.Constant):
        number = number.constant
    return bool(number == number and (number != 0 or np.copysign(1.0, number) == sign_of_zero))


class Translator(Vectors):
    """Tools that translate a primitive: operations on vectors, and the code of another jaxpr."""

    taking_part: ir.Value | None = None
    """Lanes whose values are used, and for which loops continue; None: all."""

    def emit(self, closed: core.ClosedJaxpr, arguments: Sequence[ir.Value]) -> list[ir.Value]:
        """Emit a jaxpr of scalars, given one LLVM value per argument."""
        raise NotImplementedError

    def run(self, jaxpr: core.ClosedJaxpr | core.Jaxpr, arguments: Sequence[Value[ir.Value]]) -> Values[ir.Value]:
        """Emit a jaxpr, closed or without constants."""
        raise NotImplementedError
