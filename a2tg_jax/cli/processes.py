"""Several processes that train one scene together: how the command joins them, and how it ends when one is lost."""

import atexit
import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
from jax.experimental import multihost_utils

from a2tg_jax.base.text import shortened
from a2tg_jax.parallel import leave

AUTO = "auto"
JOIN_SECONDS = 300
"""Time in which all processes must have started."""
LEAVE_SECONDS = 10
"""Time in which the others must have ended their training after one has."""
LOST = 75  # EX_TEMPFAIL of sysexits.h
"""Exit code after another process was lost: training can resume from its last checkpoint."""


class ProcessPlace(NamedTuple):
    """Place of this process among all; arguments of `jax.distributed.initialize`."""

    coordinator: str
    """HOST:PORT of the first process, or "auto": JAX detects Slurm, Open MPI, Kubernetes. IPv6 addresses are in
    brackets."""
    num_processes: int | None
    process_id: int | None
    seconds: float
    """Time after which a silent process is lost."""


@contextlib.contextmanager
def joined(place: ProcessPlace | None, advice: Callable[[], str]) -> Iterator[None]:
    """Join the other processes within the block; None: there are none.

    If another process is lost, this one ends as well: with the advice in its message, or, where it waits for the other
    one, by JAX. JAX also ends it if not all join within `JOIN_SECONDS`.

    Raises:
      ValueError: if a number is wrong, or JAX detects no cluster.
    """
    if place is None:
        yield
        return
    is_auto = place.coordinator == AUTO
    # JAX's handler of SIGTERM would replace `signals`.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            None if is_auto else place.coordinator,
            place.num_processes,
            place.process_id,
            cluster_detection_method=None if is_auto else "deactivate",
            initialization_timeout=JOIN_SECONDS,
            heartbeat_timeout_seconds=max(1, round(place.seconds)),
            shutdown_timeout_seconds=LEAVE_SECONDS,
        )
    except (ValueError, TypeError, RuntimeError) as error:
        is_alone = is_auto and "coordinator_address" in str(error)
        reason = "no Slurm, Open MPI or Kubernetes was found: give HOST:PORT" if is_alone else error
        raise ValueError(f"--coordinator {place.coordinator}: {reason}") from error
    try:
        # The connections that collectives use are made at the first one, which waits for some seconds only.
        multihost_utils.sync_global_devices("joined")
        yield
        leave()
    except Exception as error:
        if not jax.distributed.is_initialized():
            raise  # The others have left.
        if not is_lost(error):
            # Before JAX's own function at the exit of Python, which would wait for the others and then abort.
            atexit.register(_exit, 2 if isinstance(error, ValueError | OSError) else 1)
            raise
        print(f"a2tg: error: another process was lost: {shortened(str(error), 200)}; {advice()}", file=sys.stderr)
        _exit(LOST)


def _exit(code: int) -> None:
    """End the process without a word to the others, which JAX ends in turn."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def is_lost(error: BaseException) -> bool:
    """Return whether an error was raised because processes could not reach each other."""
    # Out of memory is this process's own failure, though JAX raises the same class.
    if "RESOURCE_EXHAUSTED" in str(error):
        return False
    return isinstance(error, jax.errors.JaxRuntimeError) or "Gloo" in str(error) or "NCCL" in str(error)
