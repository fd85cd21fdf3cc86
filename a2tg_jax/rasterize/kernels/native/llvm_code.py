"""LLVM code: arithmetic on vectors of lanes, functions with memory and loops, and modules compiled for this processor.

With A2TG_DUMP=folder in the environment, compiled functions leave their code in that folder.
"""

import contextlib
import ctypes
import ctypes.util
import functools
import itertools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from jax.typing import DTypeLike
from llvmlite import ir

from a2tg_jax.rasterize.kernels.jaxprs import Untranslatable

FLAGS = ("contract",)
"""Flags that let products and sums fuse; within a lane all other IEEE rules hold."""
BOOL, INT, LONG = (ir.IntType(bits) for bits in (1, 32, 64))
POINTER = ir.PointerType()
CompiledFunction = Callable[..., None]
"""Compiled function void(pointer…, int32…), which releases the GIL as it runs."""
_LOCK = threading.Lock()


def scalar_type(dtype: DTypeLike) -> ir.Type:
    """Return the LLVM type of a scalar of a numpy dtype.

    Raises:
      Untranslatable: for anything but bool, int32, int64, float32 and float64.
    """
    types = {"bool": BOOL, "int32": INT, "int64": LONG, "float32": ir.FloatType(), "float64": ir.DoubleType()}
    name = np.dtype(dtype).name
    if name not in types:
        raise Untranslatable(f"native loops compute with {', '.join(types)}; a value is {name}")
    return types[name]


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
        # LLVM's idiom: insert into the first lane, then shuffle it to all; it becomes one broadcast.
        undefined = ir.Constant(self.vector(value.type), ir.Undefined)
        first = self.builder.insert_element(undefined, value, INT(0))
        return self.builder.shuffle_vector(
            first, undefined, ir.Constant(ir.VectorType(INT, self.width), [0] * self.width)
        )

    def intrinsic(self, name: str, operands: Sequence[ir.Value]) -> ir.Value:
        """Call llvm.<name> on operands of one type; the result has that type."""
        flags = FLAGS if is_float(operands[0].type) else ()
        type_ = operands[0].type
        return self.call(f"llvm.{name}.{suffix(type_)}", type_, operands, flags)

    def libm(self, name: str, operands: Sequence[ir.Value]) -> ir.Value:
        """Call a function of the C library on floats; its error is about one unit in the last place."""
        # LLVM calls it lane by lane. It needs the address, because on Windows it does not find all functions itself.
        _add_libm_symbol(name if num_bits(operands[0].type) == 64 else f"{name}f")
        return self.intrinsic(name, operands)

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
        if _orders_by_compare(y, -1.0):
            return self.larger(y, x)
        if _orders_by_compare(x, -1.0):
            return self.larger(x, y)
        # Against +0, a comparison takes −0 as equal: +0 + −0 = +0 corrects that, and adds nothing to others.
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
        # As in `maximum`, but the union of the signs is the right one: −0 is the smaller zero.
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


class Writer:
    """Function void(buffer…, int32…) of a module, under construction at the builder `b`."""

    def __init__(self, module: ir.Module, name: str, buffers: Sequence[str], integers: Sequence[str], dtype: DTypeLike):
        types = [POINTER] * len(buffers) + [INT] * len(integers)
        function = ir.Function(module, ir.FunctionType(ir.VoidType(), types), name)
        # LLVM may keep what it has read from one buffer while it writes to another.
        for argument in function.args[: len(buffers)]:
            argument.add_attribute("noalias")
        self.arguments = dict(zip((*buffers, *integers), function.args, strict=True))
        self.b = ir.IRBuilder(function.append_basic_block("entry"))
        self.real, self.alignment = scalar_type(dtype), np.dtype(dtype).itemsize

    def variable(self, type_: ir.Type, count: int = 1) -> ir.Value:
        """Return the address of `count` values on the stack."""
        # In the entry block: within a loop, the stack would grow at every turn.
        with self.b.goto_entry_block():
            room = self.b.alloca(type_, count)
            room.align, room.type = vector_bytes(), POINTER
        return room

    def at(self, base: ir.Value, index: ir.Value, type_: ir.Type) -> ir.Value:
        """Return the address of entry `index` of an array."""
        return self.b.gep(base, [index], source_etype=type_)

    def load(self, base: ir.Value, index: ir.Value | int, type_: ir.Type) -> ir.Value:
        """Load entry `index` of an array, aligned only as its numbers are."""
        index = LONG(index) if isinstance(index, int) else index
        alignment = 4 if type_ == INT else self.alignment
        return self.b.load(self.at(base, index, type_), align=alignment, typ=type_)

    def store(self, value: ir.Value, base: ir.Value, index: ir.Value | int) -> None:
        """Store entry `index` of an array, aligned only as its numbers are."""
        index = LONG(index) if isinstance(index, int) else index
        alignment = 4 if value.type == INT else self.alignment
        self.b.store(value, self.at(base, index, value.type), align=alignment)

    def product(self, x: ir.Value, y: ir.Value) -> ir.Value:
        return self.b.fmul(x, y, flags=FLAGS)

    def sum(self, x: ir.Value, y: ir.Value) -> ir.Value:
        return self.b.fadd(x, y, flags=FLAGS)

    def long(self, value: ir.Value) -> ir.Value:
        return self.b.sext(value, LONG)

    def times(self, value: ir.Value, factor: int) -> ir.Value:
        return self.b.mul(value, LONG(factor))

    @contextlib.contextmanager
    def loop(self, first: ir.Value, last: ir.Value) -> Iterator[tuple[ir.Value, ir.Block]]:
        """Write a loop over a 64-bit index in range(first, last); yield the index and the block after the loop."""
        # The index is a variable on the stack, which LLVM's passes turn into a register.
        counter = self.variable(LONG)
        self.b.store(first, counter)
        test, body = self.b.append_basic_block("test"), self.b.append_basic_block("body")
        after = self.b.append_basic_block("after")
        self.b.branch(test)
        self.b.position_at_end(test)
        index = self.b.load(counter, typ=LONG)
        self.b.cbranch(self.b.icmp_signed("<", index, last), body, after)
        self.b.position_at_end(body)
        yield index, after
        self.b.store(self.b.add(index, LONG(1)), counter)
        self.b.branch(test)
        self.b.position_at_end(after)


@functools.cache
def _machine() -> llvm.TargetMachine:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    features = llvm.get_host_cpu_features().flatten()
    return target.create_target_machine(cpu=llvm.get_host_cpu_name(), features=features, opt=3, jit=True)


@functools.cache
def engine() -> llvm.ExecutionEngine:
    """Return the owner of all compiled code."""
    return llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())


@functools.cache
def _add_libm_symbol(name: str) -> None:
    """Give compiled code the address of a function of the C library."""
    library = ctypes.CDLL("ucrtbase" if os.name == "nt" else ctypes.util.find_library("m"))
    llvm.add_symbol(name, ctypes.cast(getattr(library, name), ctypes.c_void_p).value)


@functools.cache
def vector_bytes() -> int:
    """Return the width of the processor's vectors in bytes: 64 with AVX-512, 32 with AVX, else 16."""
    features = llvm.get_host_cpu_features()
    if features.get("avx512f"):
        return 64
    return 32 if features.get("avx") else 16


def num_lanes(dtype: DTypeLike) -> int:
    """Return the number L of numbers in a vector."""
    return vector_bytes() // np.dtype(dtype).itemsize


_numbers = itertools.count()


def unique(name: str) -> str:
    """Return a unique name for a function: all modules share one namespace."""
    return f"{name}_{next(_numbers)}"


def compile_module(module: ir.Module) -> dict[str, int]:
    """Optimise and compile a module; return the addresses of its functions, valid for the life of the process."""
    with _LOCK:
        module.triple = llvm.get_default_triple()
        module.data_layout = str(_machine().target_data)
        names = [function.name for function in module.functions if not function.is_declaration]
        parsed = llvm.parse_assembly(str(module))
        parsed.verify()
        dump(names[0], "ll", lambda: str(parsed))
        options = llvm.create_pipeline_tuning_options(speed_level=3)
        # Code is in vectors already. Vectorising straight-line code once more finds nothing and takes its time.
        options.slp_vectorization = False
        builder = llvm.create_pass_builder(_machine(), options)
        builder.getModulePassManager().run(parsed, builder)
        dump(names[0], "optimised.ll", lambda: str(parsed))
        dump(names[0], "s", lambda: _machine().emit_assembly(parsed))
        engine().add_module(parsed)
        engine().finalize_object()
        return {name: engine().get_function_address(name) for name in names}


def compiled(module: ir.Module, signatures: dict[str, tuple[int, int]]) -> list[CompiledFunction]:
    """Compile a module; return its functions void(pointer…, int32…) as Python callables, which release the GIL.

    Args:
      module: the module.
      signatures: number of pointers and of integers of each function, by name.
    """
    addresses = compile_module(module)
    types = ([ctypes.c_void_p] * pointers + [ctypes.c_int32] * integers for pointers, integers in signatures.values())
    return [
        ctypes.CFUNCTYPE(None, *arguments)(addresses[name]) for name, arguments in zip(signatures, types, strict=True)
    ]


def dump(name: str, kind: str, make_text: Callable[[], str]) -> None:
    """Write a text to <folder>/<name>.<kind> if the environment variable A2TG_DUMP names a folder."""
    if folder := os.environ.get("A2TG_DUMP"):
        path = Path(folder) / f"{name}.{kind}"
        path.parent.mkdir(parents=True, exist_ok=True)
        # A function has several jaxprs.
        with path.open("a" if kind == "jaxpr" else "w", encoding="utf-8") as file:
            file.write(make_text())
