"""Writer of one LLVM function: its arguments, its memory and its loops."""

import contextlib
from collections.abc import Iterator, Sequence

import numpy as np
from jax.typing import DTypeLike
from llvmlite import ir

from a2tg_jax.rasterize.kernels.native import llvm_modules
from a2tg_jax.rasterize.kernels.native.lanes import FLAGS, INT, scalar_type

LONG = ir.IntType(64)
POINTER = ir.PointerType()


class Writer:
    """Function void(buffer…, int32…) of a module, under construction at the builder `b`."""

    def __init__(self, module: ir.Module, name: str, buffers: Sequence[str], integers: Sequence[str], dtype: DTypeLike):
        types = [POINTER] * len(buffers) + [INT] * len(integers)
        function = ir.Function(module, ir.FunctionType(ir.VoidType(), types), name)
        for argument in function.args[: len(buffers)]:
            argument.add_attribute("noalias")
        self.arguments = dict(zip((*buffers, *integers), function.args, strict=True))
        self.b = ir.IRBuilder(function.append_basic_block("entry"))
        self.real, self.alignment = scalar_type(dtype), np.dtype(dtype).itemsize

    def variable(self, type_: ir.Type, count: int = 1) -> ir.Value:
        """Return the address of `count` values on the stack."""
        with self.b.goto_entry_block():
            room = self.b.alloca(type_, count)
            room.align, room.type = llvm_modules.vector_bytes(), POINTER
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
