"""LLVM modules compiled for this processor, once per process."""

import ctypes
import functools
import itertools
import threading
from collections.abc import Callable

import llvmlite.binding as llvm
from llvmlite import ir

from a2tg_jax.rasterize.kernels.native import dump

CompiledFunction = Callable[..., None]
"""Compiled function void(pointer…, int32…), which releases the GIL as it runs."""
_LOCK = threading.Lock()


@functools.cache
def _machine() -> llvm.TargetMachine:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    features = llvm.get_host_cpu_features().flatten()
    return target.create_target_machine(cpu=llvm.get_host_cpu_name(), features=features, opt=3, jit=True)


@functools.cache
def _engine() -> llvm.ExecutionEngine:
    return llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())


@functools.cache
def vector_bytes() -> int:
    """Return the width of the processor's vectors in bytes: 64 with AVX-512, 32 with AVX, else 16."""
    features = llvm.get_host_cpu_features()
    if features.get("avx512f"):
        return 64
    return 32 if features.get("avx") else 16


_numbers = itertools.count()


def unique(name: str) -> str:
    """Return a unique name for a function: all modules share one namespace."""
    return f"{name}_{next(_numbers)}"


def compile_module(module: ir.Module) -> dict[str, int]:
    """Optimise and compile a module; return the addresses of its functions, valid for the life of the process."""
    with _LOCK:
        module.triple = llvm.get_default_triple()
        module.data_layout = str(_machine().target_data)
        names = [function.name for function in module.functions if _is_exported(function)]
        parsed = llvm.parse_assembly(str(module))
        parsed.verify()
        dump.write(names[0], "ll", str(parsed))
        options = llvm.create_pipeline_tuning_options(speed_level=3)
        options.slp_vectorization = False
        builder = llvm.create_pass_builder(_machine(), options)
        builder.getModulePassManager().run(parsed, builder)
        if dump.is_wanted():
            dump.write(names[0], "optimised.ll", str(parsed))
            dump.write(names[0], "s", _machine().emit_assembly(parsed))
        _engine().add_module(parsed)
        _engine().finalize_object()
        return {name: _engine().get_function_address(name) for name in names}


def _is_exported(function: ir.Function) -> bool:
    return not function.is_declaration and function.linkage != "internal"


def as_function(address: int, num_pointers: int, num_integers: int) -> CompiledFunction:
    """Return a compiled function void(pointer…, int32…) as a Python callable, which releases the GIL as it runs."""
    types = [ctypes.c_void_p] * num_pointers + [ctypes.c_int32] * num_integers
    return ctypes.CFUNCTYPE(None, *types)(address)
