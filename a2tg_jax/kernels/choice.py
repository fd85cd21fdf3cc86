"""Which compositor runs where."""

import functools
import importlib.util
import warnings
from types import ModuleType
from typing import Literal

import jax

Compositor = Literal["native", "pallas", "xla"]


def choose(wanted: Literal["auto", "native", "pallas", "xla"], tile_size: int) -> Compositor:
    """The compositor that is wanted, or with "auto" the fastest that JAX's default device can run.

    Raises:
      ValueError: if native loops are wanted where they cannot run.
    """
    if wanted == "native" and not has_native():
        raise ValueError("compositor='native' needs JAX on the CPU and llvmlite: pip install llvmlite, or say 'auto'")
    if wanted != "auto":
        return wanted
    if has_native():
        return "native"
    is_power_of_two = tile_size & (tile_size - 1) == 0
    return "pallas" if is_power_of_two and has_pallas() else "xla"


@functools.cache
def has_native() -> bool:
    """Whether native loops can be made here: XLA runs on the CPU, and llvmlite is installed."""
    return jax.default_backend() == "cpu" and _is_installed("llvmlite")


def _is_installed(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:
        return False


@functools.cache
def has_pallas() -> bool:
    """Whether Pallas kernels can be compiled here: XLA runs on a GPU, and JAX still has the Triton backend."""
    if jax.default_backend() != "gpu":
        return False
    if triton() is None:
        warnings.warn(
            "this JAX has no Triton backend of Pallas: compositing falls back to XLA, which is slower", stacklevel=2
        )
        return False
    return True


@functools.cache
def triton() -> ModuleType | None:
    """Pallas on Triton, or None where JAX has dropped it."""
    try:
        from jax.experimental.pallas import triton as module
    except ImportError:
        return None
    return module if hasattr(module, "CompilerParams") else None
