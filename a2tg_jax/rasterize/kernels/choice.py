"""Which compositor runs where."""

import functools
import importlib.util
import os
import warnings
from types import ModuleType

import jax

# It registers configuration that belongs to every trace's key: imported during the first trace (by `lanes`, on use), it
# would have JAX trace and compile all of it a second time.
import jax.extend.core

from a2tg_jax.appearance import Arguments, StaticRule, takes_arrays
from a2tg_jax.rasterize.splats import Compositor, Wanted

DETERMINISM_FLAGS = ("--xla_gpu_deterministic_ops", "--xla_gpu_exclude_nondeterministic_ops")
MAX_TILE_SIZE = 64
"""Native loops keep a tile on the stack."""


def choose(wanted: Wanted, tile_size: int) -> Compositor:
    """The compositor that is wanted, or with "auto" the fastest that JAX's default backend can run.

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
    """Whether the environment's XLA_FLAGS ask for a GPU that computes the same twice: Pallas' kernels do not, for they
    add atomically."""
    asked = dict.fromkeys(DETERMINISM_FLAGS, False)
    for word in os.environ.get("XLA_FLAGS", "").split():
        flag, _, value = word.partition("=")
        if flag in asked:
            asked[flag] = value.lower() in ("", "true", "1")
    return any(asked.values())


def instead_of(wanted: Wanted, rule: type, reason: str) -> Compositor:
    """The compositor for a rule that native loops or Pallas kernels cannot run: XLA, with one warning per rule.

    Raises:
      ValueError: if a compositor was asked for by name.
    """
    if wanted != "auto":
        raise ValueError(f"compositor={wanted!r} cannot run {rule.__name__}: {reason}. Say 'xla', or 'auto'")
    _warn_of_fallback(rule, reason)
    return "xla"


@functools.cache
def _warn_of_fallback(rule: type, reason: str) -> None:
    warnings.warn(f"{rule.__name__} is composited by XLA, which is slower: {reason}", stacklevel=2)


def pallas_refusal(static: StaticRule, arguments: Arguments) -> str | None:
    """Why there can be no Pallas kernels for a rule; None if there are."""
    if takes_arrays(static, arguments):
        return None
    return "Pallas kernels call a rule with arrays of pixels, and this one takes scalars only"


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
