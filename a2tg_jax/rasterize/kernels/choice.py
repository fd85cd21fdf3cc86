"""Choice of the compositor."""

import functools
import importlib.util
import os
import warnings
from typing import Literal

import jax

# It registers configuration that belongs to every trace's key. `tracing` imports it on first use; if that were during
# the first trace, JAX would trace and compile all of it a second time.
import jax.extend.core

from a2tg_jax.rasterize.splats import Compositor, Wanted

DETERMINISM_FLAGS = ("--xla_gpu_deterministic_ops", "--xla_gpu_exclude_nondeterministic_ops")
MAX_TILE_SIZE = 64
"""Largest side of a tile in pixels; native loops keep a tile on the stack."""
IS_COMPILED_AHEAD = False
"""Set to compile for a GPU on a machine without one."""

REMEDIES: dict[Literal["cuda", "native"], str] = {
    "cuda": "JAX on an NVIDIA GPU and NVRTC: pip install 'a2tg-jax[cuda13]'",
    "native": "JAX on the CPU and llvmlite: pip install llvmlite",
}
"""Requirements of the compositors that do not run everywhere."""


def choose(wanted: Wanted) -> Compositor:
    """Return the compositor that is wanted, or with "auto" the fastest one for JAX's default backend.

    Raises:
      ValueError: if there is no such compositor, or it cannot run here.
    """
    if wanted not in ("auto", "cuda", "native", "xla", "autodiff"):
        raise ValueError(f"compositor must be 'auto', 'cuda', 'native', 'xla' or 'autodiff'; got {wanted!r}")
    if (wanted == "cuda" or wanted == "native") and not is_available(wanted):
        raise ValueError(f"compositor={wanted!r} needs {REMEDIES[wanted]}, or say 'auto'")
    if wanted != "auto":
        return wanted
    if has_native():
        return "native"
    return "cuda" if has_cuda() and not wants_determinism() else "xla"


def is_available(compositor: Literal["cuda", "native"]) -> bool:
    """Return whether a compositor of `REMEDIES` runs here."""
    return has_cuda() if compositor == "cuda" else has_native()


def wants_determinism() -> bool:
    """Return whether XLA_FLAGS in the environment ask for reproducible results on GPUs.

    The CUDA kernels add atomically, so that their results are not.
    """
    asked = dict.fromkeys(DETERMINISM_FLAGS, False)
    for word in os.environ.get("XLA_FLAGS", "").split():
        flag, _, value = word.partition("=")
        if flag in asked:
            asked[flag] = value.lower() in ("", "true", "1")
    return any(asked.values())


def instead_of(wanted: Wanted, rule: type, reason: str) -> Compositor:
    """Return the compositor for a rule that kernels cannot run: XLA, with one warning per rule.

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


@functools.cache
def has_native() -> bool:
    """Return whether native loops are available: XLA runs on the CPU, and llvmlite is installed."""
    if jax.default_backend() != "cpu" or not _is_installed("llvmlite") or IS_COMPILED_AHEAD:
        return False
    from a2tg_jax.rasterize.kernels.native import ffi

    reason = ffi.refusal()
    if reason is not None:
        warnings.warn(f"compositing by XLA, which is slower: {reason}; install a jax that was tried", stacklevel=2)
    return reason is None


def _is_installed(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:
        return False


@functools.cache
def has_cuda() -> bool:
    """Return whether CUDA kernels are available: XLA runs on an NVIDIA GPU, and NVRTC is installed."""
    from a2tg_jax.rasterize.kernels.cuda import nvrtc

    is_nvidia = jax.default_backend() == "gpu" and "cuda" in jax.devices()[0].client.platform_version.lower()
    if not is_nvidia and not IS_COMPILED_AHEAD:
        return False
    if nvrtc.find() is None:
        warnings.warn(f"compositing by XLA, which is slower: CUDA kernels need {REMEDIES['cuda']}", stacklevel=2)
        return False
    return True
