"""Settings of JAX before its first computation. The library itself never changes them."""

import os
from pathlib import Path

from jaxlib.version import __version__ as jaxlib_version

from a2tg_jax.base import threads
from a2tg_jax.base.machine import cache_folder, processor_features, processor_key

CHECKED_JAX_VERSIONS = ((0, 10), (0, 11), (0, 12))
"""Versions that have the first two flags below; an unknown flag would end the process."""
QUIET_CACHE_VERSION = (0, 12)
"""First version that reads programs from a cache without alarming log lines."""
WHOLE_LOOPS_FLAG = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000"
WIDE_VECTORS_FLAG = "--xla_cpu_prefer_vector_width=512"
OLD_FUSIONS_FLAG = "--xla_cpu_use_fusion_emitters=false"
"""XLA's code generator without MLIR, which jax 0.10 still has (experiments/NOTEBOOK.md, "Speed on CPUs")."""


def configure_cpu(*, use_cache: bool = True, num_threads: int | None = None) -> None:
    """Make JAX faster at this library's work on CPUs; call it once, before JAX computes anything.

    Keeps XLA's compiled programs on disk, and adds flags to XLA_FLAGS unless you have set them. While-loops are
    compiled whole, which speeds up compositing by XLA; vectors are 512 bits wide on processors with AVX-512; and jax
    0.10 takes its older code generator, which compiles in half the time. GPUs are not affected. The command line calls
    this function.

    Args:
      use_cache: whether to keep compiled programs in the user's cache folder, so that the next process starts in
        seconds, unless JAX has a cache already. If XLA would print pages for every cached program, its log is reduced
        to fatal errors.
      num_threads: number of threads of native loops (`set_num_threads`); None: unchanged.

    Raises:
      ValueError: if the number of threads, here or in the environment, is not a positive integer.
    """
    import jax  # Only here, as in `base.machine`.

    if num_threads is not None:
        threads.set_num_threads(num_threads)
    threads.num_threads()  # Raises if the number in the environment is wrong.
    features = processor_features()
    add_xla_flags(cpu_flags(features, jax.__version_info__[:2]))
    if use_cache and jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(compilation_cache_folder()))
        # A training has a hundred programs that take milliseconds each: together a fifth of its compiling.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        if "avx512f" in features and jax.__version_info__ < QUIET_CACHE_VERSION:
            silence_xla()


def cpu_flags(features: frozenset[str], jax_version: tuple[int, ...]) -> tuple[str, ...]:
    """Return the XLA flags that help on a processor with these features; none for an unknown version of JAX."""
    if jax_version not in CHECKED_JAX_VERSIONS:
        return ()
    flags = {
        WHOLE_LOOPS_FLAG: True,
        WIDE_VECTORS_FLAG: "avx512f" in features,
        OLD_FUSIONS_FLAG: jax_version == (0, 10),
    }
    return tuple(flag for flag, is_wanted in flags.items() if is_wanted)


def silence_xla() -> None:
    """Let XLA's C++ code log fatal errors only. Exceptions and JAX's own log are not affected.

    With AVX-512, XLA warns at length of crashes whenever it reads a program from a cache, because two of its own tuning
    hints are missing from the processor's features. It does not crash (openxla/xla#44565). With jax_logging_level or
    TF_CPP_MIN_LOG_LEVEL=0 you get the whole log.
    """
    import jax

    chosen = jax.config.values["jax_logging_level"]
    if chosen in (None, "NOTSET") and os.environ.get("TF_CPP_MIN_LOG_LEVEL") != "0":
        # The first call sets the levels of XLA and of JAX, the second restores only JAX's.
        jax.config.update("jax_logging_level", "CRITICAL")
        jax.config.update("jax_logging_level", chosen)


def add_xla_flags(flags: tuple[str, ...]) -> None:
    """Append flags to the environment's XLA_FLAGS, except flags that are set already."""
    kept = os.environ.get("XLA_FLAGS", "").split()
    names = {flag.partition("=")[0] for flag in kept}
    kept += [flag for flag in flags if flag.partition("=")[0] not in names]
    os.environ["XLA_FLAGS"] = " ".join(kept)


def compilation_cache_folder() -> Path:
    """Return the folder of compiled programs, in `cache_folder()`, one per processor and jaxlib: code for one may not
    run on another. You may delete it at any time."""
    return cache_folder() / f"jaxlib-{jaxlib_version}-{processor_key()}"
