"""Several processes that train one scene together: they join by `jax.distributed`, watch each other, and leave."""

import contextlib
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple, NoReturn

import jax
import numpy as np
from jax.experimental import multihost_utils

from a2tg_jax.host.operating_system import own_output_only, wait_in_abort
from a2tg_jax.host.text import shortened
from a2tg_jax.parallel.liveness import Liveness, accept, connect, listen

JOIN_SECONDS = 300
"""Time in which all processes must have started."""
LEAVE_SECONDS = 60
"""Time in which all processes must have finished training."""
AUTO = "auto"
LOST = 75
"""Exit code after another process was lost: training can go on from its last checkpoint."""
LONGEST_HOST = 255
MOST_TOLD = 300
"""Largest number of characters of another process's error."""


class ProcessPlace(NamedTuple):
    """Place of this process among all; arguments of `jax.distributed.initialize`."""

    coordinator: str
    """HOST:PORT of the first process, or "auto": JAX detects Slurm, Open MPI, Kubernetes. IPv6 addresses are in
    brackets."""
    num_processes: int | None
    process_id: int | None
    seconds: float
    """Time after which a silent process is lost."""


class Team:
    """All processes, seen from one that has joined them."""

    def __init__(self, seconds: float):
        self.index, self.count, self._seconds = jax.process_index(), jax.process_count(), seconds
        self.advice: Callable[[], str] = str
        """Function that tells how to go on after a process is lost."""
        self.has_met = False
        """Whether all are training, so that an interruption of one stops all after the same iteration."""
        self._liveness: Liveness | None = None

    @property
    def is_first(self) -> bool:
        """Whether this process writes files and shows progress."""
        return self.index == 0

    def watch(self, coordinator: str) -> None:
        """Connect the processes, which watch each other from now on."""
        own = listen() if self.is_first else None
        host = own_address(coordinator).encode() if own else b""
        told = broadcast(b"".join([own[1].to_bytes(4, "big"), own[2], host]) if own else b"")
        others = accept(own[0], own[2], self.count) if own else connect(
            told[36:].decode(), int.from_bytes(told[:4], "big"), told[4:36], self.index
        )  # fmt: skip
        self._liveness = Liveness(others, self.count, self._seconds, self._end)

    def leave(self) -> None:
        """End the common work; this process goes on alone."""
        if self._liveness is not None:
            multihost_utils.sync_global_devices("leave")
            self._liveness.leave()
            self._liveness = None
            jax.distributed.shutdown()

    def told(self, error: BaseException) -> None:
        """Tell the others of an error; if it comes of a lost process, wait for what is known of that one."""
        liveness, self._liveness = self._liveness, None
        if liveness is None:
            return
        if is_of_collectives(error):
            time.sleep(2 * self._seconds)  # `_end` comes first.
        elif isinstance(error, KeyboardInterrupt) and self.has_met:
            liveness.interrupt()
        elif self.is_first:
            liveness.quit()
        else:
            is_interrupted = isinstance(error, KeyboardInterrupt)
            liveness.fail("it was interrupted" if is_interrupted else shortened(str(error), MOST_TOLD))
            time.sleep(self._seconds)

    def _end(self, reason: str) -> NoReturn:
        """End this process, which waits inside XLA, with one line; without a reason the first one ends, too."""
        if not reason:
            with contextlib.suppress(Exception):
                jax.distributed.shutdown()  # The first process waits for it at its end.
        else:
            with contextlib.suppress(ValueError, OSError):
                print("; ".join(filter(None, (f"a2tg: error: {reason}", self.advice()))), file=sys.stderr)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(LOST)


_team: Team | None = None


def team() -> Team | None:
    """Return the processes that this one has joined; None if it works alone."""
    return _team


@contextlib.contextmanager
def joined(place: ProcessPlace | None) -> Iterator[Team | None]:
    """Join the other processes within the block; None: there are none.

    Raises:
      ValueError: if a number is wrong, or JAX detects no cluster.
    """
    global _team
    if place is None:
        yield None
        return
    late = threading.Timer(JOIN_SECONDS, _give_up, (place.coordinator,))
    late.daemon = True
    late.start()
    try:
        _initialize(place)
        _team = Team(place.seconds)
        if _team.count > 1:
            _team.watch(place.coordinator)
    finally:
        late.cancel()
    try:
        yield _team
        _team.leave()
    except BaseException as error:
        _team.told(error)
        raise
    finally:
        _team = None


def _initialize(place: ProcessPlace) -> None:
    """Call `jax.distributed.initialize`."""
    if not os.environ.get("A2TG_DEBUG"):
        own_output_only()
    wait_in_abort()
    is_auto = place.coordinator == AUTO
    # JAX's handler of SIGTERM would take the place of `signals`.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        # Its own times are a net beneath this module's.
        jax.distributed.initialize(
            None if is_auto else place.coordinator,
            place.num_processes,
            place.process_id,
            cluster_detection_method=None if is_auto else "deactivate",
            initialization_timeout=2 * JOIN_SECONDS,
            heartbeat_timeout_seconds=round(2 * place.seconds) + 60,
            shutdown_timeout_seconds=LEAVE_SECONDS,
        )
    except (ValueError, TypeError, RuntimeError) as error:
        is_alone = is_auto and "coordinator_address" in str(error)
        reason = "no Slurm, Open MPI or Kubernetes was found: give HOST:PORT" if is_alone else error
        raise ValueError(f"--coordinator {place.coordinator}: {reason}") from error


def _give_up(coordinator: str) -> NoReturn:
    """End the process with one line, since the others do not come."""
    print(
        f"a2tg: error: not all processes have joined --coordinator {coordinator} within {JOIN_SECONDS} s: start as "
        "many as --num-processes says, each with a --process-id of its own",
        file=sys.stderr,
        flush=True,
    )
    os._exit(LOST)


def broadcast(data: bytes) -> bytes:
    """Return the first process's bytes in every process; all call it together."""
    length = np.frombuffer(len(data).to_bytes(8, "big"), np.uint8)
    size = int.from_bytes(bytes(np.asarray(multihost_utils.broadcast_one_to_all(length), np.uint8)), "big")
    own = np.frombuffer(data, np.uint8) if jax.process_index() == 0 else np.zeros(size, np.uint8)
    return bytes(np.asarray(multihost_utils.broadcast_one_to_all(own), np.uint8)) if size else b""


def gather(data: bytes) -> list[bytes]:
    """Return the bytes of all processes, in the order of their numbers; all call it together."""
    length = np.frombuffer(len(data).to_bytes(8, "big"), np.uint8)
    sizes = [int.from_bytes(bytes(own), "big") for own in multihost_utils.process_allgather(length)]
    padded = np.frombuffer(data.ljust(max(1, *sizes), b"\0"), np.uint8)
    return [bytes(own[:size]) for own, size in zip(multihost_utils.process_allgather(padded), sizes, strict=True)]


def is_of_collectives(error: BaseException) -> bool:
    """Return whether an error was raised because processes could not reach each other. A lack of memory is a process's
    own."""
    if "RESOURCE_EXHAUSTED" in str(error):
        return False
    return isinstance(error, jax.errors.JaxRuntimeError) or "Gloo" in str(error) or "NCCL" in str(error)


def own_address(coordinator: str) -> str:
    """Return the host name or address by which other processes reach the first one, which calls this."""
    if coordinator != AUTO:
        return coordinator.rpartition(":")[0].strip("[]")
    name = socket.gethostname()
    with contextlib.suppress(OSError):
        address = socket.gethostbyname(name)
        return name if address.startswith("127.") else address
    return name[:LONGEST_HOST]
