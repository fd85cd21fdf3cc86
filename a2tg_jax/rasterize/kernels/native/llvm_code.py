"""LLVM code: functions with memory and loops, and modules compiled for this processor.

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

import llvmlite.binding as llvm
import numpy as np
from jax.typing import DTypeLike
from llvmlite import ir

from a2tg_jax.rasterize.kernels.jaxprs import Untranslatable

FLAGS = ("contract",)
"""Flags that let products and sums fuse; within a lane all other IEEE rules hold."""
ALIGNMENT = 128
"""Bytes to which slots on the stack and tables are aligned, the size of the largest vectors: loads of these need it."""
BOOL, INT, LONG = (ir.IntType(bits) for bits in (1, 32, 64))
POINTER = ir.PointerType()
CompiledFunction = Callable[..., None]
"""Compiled function void(pointer…, int32…), which releases the GIL as it runs."""
_LOCK = threading.Lock()


def scalar_type(dtype: DTypeLike) -> ir.Type:
    """Return the LLVM type of a scalar of a numpy dtype; Untranslatable if there is none."""
    types = {"bool": BOOL, "int32": INT, "int64": LONG, "float32": ir.FloatType(), "float64": ir.DoubleType()}
    name = np.dtype(dtype).name
    if name not in types:
        raise Untranslatable(f"native loops compute with {', '.join(types)}; a value is {name}")
    return types[name]


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
        self.real = scalar_type(dtype)
        self.alignment = np.dtype(dtype).itemsize

    def variable(self, type_: ir.Type, count: int = 1) -> ir.Value:
        """Return the address of `count` values on the stack."""
        # In the entry block: within a loop, the stack would grow at every turn.
        with self.b.goto_entry_block():
            slot = self.b.alloca(type_, count)
            slot.align = ALIGNMENT
            slot.type = POINTER
        return slot

    def at(self, base: ir.Value, index: ir.Value, type_: ir.Type) -> ir.Value:
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
        test = self.b.append_basic_block("test")
        body = self.b.append_basic_block("body")
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
def add_libm_symbol(name: str) -> None:
    """Give compiled code the address of a function of the C library."""
    library = ctypes.CDLL("ucrtbase" if os.name == "nt" else ctypes.util.find_library("m"))
    llvm.add_symbol(name, ctypes.cast(getattr(library, name), ctypes.c_void_p).value)


@functools.cache
def register_bytes() -> int:
    """Return the width of the processor's vector registers in bytes: 64 with AVX-512, 32 with AVX, else 16."""
    features = llvm.get_host_cpu_features()
    if features.get("avx512f"):
        return 64
    return 32 if features.get("avx") else 16


def num_lanes(dtype: DTypeLike) -> int:
    return register_bytes() // np.dtype(dtype).itemsize


_numbers = itertools.count()


def unique(name: str) -> str:
    """Return a unique name for a function: all modules share one namespace."""
    return f"{name}_{next(_numbers)}"


def compile_text(code: str, names: Sequence[str]) -> dict[str, int]:
    """Optimise and compile LLVM assembly; return the addresses of functions, valid as long as the process lives."""
    with _LOCK:
        parsed = llvm.parse_assembly(code)
        parsed.triple = llvm.get_default_triple()
        parsed.data_layout = str(_machine().target_data)
        parsed.verify()
        dump(names[0], "ll", lambda: str(parsed))
        # Higher levels take half as long again and make no loop faster: pixels are in vectors already.
        options = llvm.create_pipeline_tuning_options(speed_level=1)
        options.slp_vectorization = options.loop_unrolling = False
        builder = llvm.create_pass_builder(_machine(), options)
        builder.getModulePassManager().run(parsed, builder)
        dump(names[0], "optimised.ll", lambda: str(parsed))
        dump(names[0], "s", lambda: _machine().emit_assembly(parsed))
        engine().add_module(parsed)
        engine().finalize_object()
        return {name: engine().get_function_address(name) for name in names}


def compiled(module: ir.Module, signatures: dict[str, tuple[int, int]]) -> list[CompiledFunction]:
    """Compile a module; return its functions void(pointer…, int32…) as Python callables, which release the GIL.

    The signatures are the number of pointers and of integers of each function, by name.
    """
    addresses = compile_text(str(module), list(signatures))
    functions = list[CompiledFunction]()
    for name, (pointers, integers) in signatures.items():
        types = [ctypes.c_void_p] * pointers + [ctypes.c_int32] * integers
        functions.append(ctypes.CFUNCTYPE(None, *types)(addresses[name]))
    return functions


def dump(name: str, kind: str, make_text: Callable[[], str]) -> None:
    """Write a text to <folder>/<name>.<kind> if the environment variable A2TG_DUMP names a folder."""
    folder = os.environ.get("A2TG_DUMP")
    if folder:
        path = Path(folder) / f"{name}.{kind}"
        path.parent.mkdir(parents=True, exist_ok=True)
        # A function has several jaxprs.
        with path.open("a" if kind == "jaxpr" else "w", encoding="utf-8") as file:
            file.write(make_text())
