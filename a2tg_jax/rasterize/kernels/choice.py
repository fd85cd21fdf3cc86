"""Choice of the compositor."""

import functools
import importlib.util
import os
import warnings
from types import ModuleType

import jax

# It registers configuration that is part of every trace's key. `lanes` imports it on use: during the first trace, it
# would make JAX trace and compile everything a second time.
import jax.extend.core

from a2tg_jax.appearance import Arguments, StaticRule, takes_arrays
from a2tg_jax.rasterize.splats import Compositor, Wanted

DETERMINISM_FLAGS = ("--xla_gpu_deterministic_ops", "--xla_gpu_exclude_nondeterministic_ops")
MAX_TILE_SIZE = 64
"""Largest side of a tile in pixels; native loops keep a tile on the stack."""


def choose(wanted: Wanted, tile_size: int) -> Compositor:
    """Return the compositor that is wanted, or with "auto" the fastest one for JAX's default backend.

    Raises:
      ValueError: if there is no such compositor, it cannot run here, or the tiles are too large.
    """
    if wanted not in ("auto", "native", "pallas", "xla", "autodiff"):
        raise ValueError(f"compositor must be 'auto', 'native', 'pallas', 'xla' or 'autodiff'; got {wanted!r}")
    if not 1 <= tile_size <= MAX_TILE_SIZE:
        raise ValueError(f"tile_size must lie in 1..{MAX_TILE_SIZE}; got {tile_size}")
    is_power_of_two = tile_size & (tile_size - 1) == 0
    if wanted == "pallas" and not is_power_of_two:
        raise ValueError(f"compositor='pallas' needs a tile_size that is a power of two; got {tile_size}")
    if wanted == "native" and not has_native():
        raise ValueError("compositor='native' needs JAX on the CPU and llvmlite: pip install llvmlite, or say 'auto'")
    if wanted != "auto":
        return wanted
    if has_native():
        return "native"
    is_for_pallas = is_power_of_two and has_pallas() and not wants_determinism()
    return "pallas" if is_for_pallas else "xla"


def wants_determinism() -> bool:
    """Return whether XLA_FLAGS in the environment ask for reproducible results on GPUs.

    The Pallas kernels add atomically, so that their results are not.
    """
    asked = dict.fromkeys(DETERMINISM_FLAGS, False)
    for word in os.environ.get("XLA_FLAGS", "").split():
        flag, _, value = word.partition("=")
        if flag in asked:
            asked[flag] = value.lower() in ("", "true", "1")
    return any(asked.values())


def instead_of(wanted: Wanted, rule: type, reason: str) -> Compositor:
    """Return the compositor for a rule that native loops or Pallas kernels cannot run: XLA, with a warning per rule.

    Raises:
      ValueError: if a compositor is required by name.
    """
    if wanted != "auto":
        raise ValueError(f"compositor={wanted!r} cannot run {rule.__name__}: {reason}. Say 'xla', or 'auto'")
    _warn_of_fallback(rule, reason)
    return "xla"


@functools.cache
def _warn_of_fallback(rule: type, reason: str) -> None:
    warnings.warn(f"{rule.__name__} is composited by XLA, which is slower: {reason}", stacklevel=2)


def pallas_refusal(static: StaticRule, arguments: Arguments) -> str | None:
    """Return why there can be no Pallas kernels for a rule; None if there can."""
    if takes_arrays(static, arguments):
        return None
    return "Pallas kernels call a rule with arrays of pixels, and this one takes scalars only"


@functools.cache
def has_native() -> bool:
    """Return whether native loops are available: XLA runs on the CPU, and llvmlite is installed."""
    return jax.default_backend() == "cpu" and _is_installed("llvmlite")


def _is_installed(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:
        return False


@functools.cache
def has_pallas() -> bool:
    """Return whether Pallas kernels are available: XLA runs on a GPU, and JAX has the Triton backend."""
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
    """Return JAX's module of Pallas on Triton; None if this JAX has none."""
    try:
        from jax.experimental.pallas import triton as module
    except ImportError:
        return None
    return module if hasattr(module, "CompilerParams") else None
