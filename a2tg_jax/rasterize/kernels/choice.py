"""Choice of the compositor."""

import functools
import importlib.util
import os
import warnings

from a2tg_jax.rasterize.kernels.cuda import nvrtc
from a2tg_jax.rasterize.splats import Compositor, Wanted

DETERMINISM_FLAGS = ("--xla_gpu_deterministic_ops", "--xla_gpu_exclude_nondeterministic_ops")
MAX_TILE_SIZE = 64
"""Largest side of a tile in pixels; native loops keep a tile on the stack."""

PLATFORMS: dict[Compositor, str] = {"native": "cpu", "cuda": "cuda"}
"""Platforms of the compositors that do not run everywhere, as JAX names them when it compiles."""
REMEDIES: dict[Compositor, str] = {
    "native": "JAX on the CPU and llvmlite: pip install llvmlite",
    "cuda": "JAX on an NVIDIA GPU and NVRTC: pip install 'a2tg-jax[cuda13]'",
}
"""Requirements of the same compositors."""


def check_compositor(wanted: Wanted) -> None:
    """Raise ValueError if there is no such compositor, or a package that it needs is not installed."""
    if wanted not in ("auto", "cuda", "native", "xla", "autodiff"):
        raise ValueError(f"compositor must be 'auto', 'cuda', 'native', 'xla' or 'autodiff'; got {wanted!r}")
    if wanted != "auto":
        choose(wanted, PLATFORMS.get(wanted, ""))


def choose(wanted: Wanted, platform: str) -> Compositor:
    """Return the compositor that is wanted, or with "auto" the fastest one for a platform.

    Args:
      wanted: a compositor, or "auto".
      platform: platform that JAX compiles for, "cpu", "cuda" or another.

    Raises:
      ValueError: if the compositor does not run on that platform, or a package that it needs is not installed.
    """
    if wanted == "auto":
        if is_available("native", platform):
            return "native"
        return "cuda" if platform == PLATFORMS["cuda"] and not wants_determinism() and has_cuda() else "xla"
    if wanted in PLATFORMS and not is_available(wanted, platform):
        raise ValueError(f"compositor={wanted!r} needs {REMEDIES[wanted]}, or say 'auto'")
    return wanted


def is_available(compositor: Compositor, platform: str) -> bool:
    """Return whether a compositor of `PLATFORMS` runs on a platform, and the packages that it needs are installed."""
    if platform != PLATFORMS[compositor]:
        return False
    return has_native() if compositor == "native" else nvrtc.find() is not None


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


def instead_of(wanted: Wanted, appearance: type, reason: str) -> None:
    """Warn, once per class, that XLA composites an appearance that kernels cannot run.

    Raises:
      ValueError: if a compositor is required by name.
    """
    if wanted != "auto":
        raise ValueError(f"compositor={wanted!r} cannot run {appearance.__name__}: {reason}. Say 'xla', or 'auto'")
    _warn_of_fallback(appearance, reason)


@functools.cache
def _warn_of_fallback(appearance: type, reason: str) -> None:
    warnings.warn(f"{appearance.__name__} is composited by XLA, which is slower: {reason}", stacklevel=2)


@functools.cache
def has_native() -> bool:
    """Return whether native loops can be called: llvmlite is installed, and jaxlib's interface is known."""
    try:
        if importlib.util.find_spec("llvmlite") is None:
            return False
    except ValueError:
        return False
    from a2tg_jax.rasterize.kernels.native import ffi

    reason = ffi.refusal()
    if reason is not None:
        warnings.warn(f"compositing by XLA, which is slower: {reason}; install a jax that was tried", stacklevel=2)
    return reason is None


@functools.cache
def has_cuda() -> bool:
    """Return whether CUDA kernels can be used: NVRTC is installed, and they agree with XLA on this machine's GPU."""
    from a2tg_jax.rasterize.kernels.cuda import check

    reason = check.failure() if nvrtc.find() else f"CUDA kernels need {REMEDIES['cuda']}"
    if reason is not None:
        warnings.warn(f"compositing by XLA, which is slower: {reason}", stacklevel=2)
    return reason is None
