"""Several processes that train one scene together: they join by `jax.distributed`, watch each other, and leave.

They watch each other over TCP: each sends heartbeats, and detects when another one has ended or fallen silent. The
first process has a connection to every other one, and reports each loss. Everything runs in threads, because a
training waits for a lost process inside XLA and cannot be interrupted there.
"""

import contextlib
import os
import queue
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from multiprocessing import AuthenticationError
from multiprocessing.connection import Connection, answer_challenge, deliver_challenge
from typing import NamedTuple, NoReturn

import jax
import numpy as np
from jax.experimental import multihost_utils

from a2tg_jax.host.operating_system import own_output_only, wait_in_abort
from a2tg_jax.host.text import shortened

BEATS = 5
"""Number of heartbeats within the time after which a silent process is lost."""
GRACE = 2.0
"""Seconds in which a process that fails with the others can report its own error."""
INTERRUPTED_GRACE = 300.0
"""Seconds in which a process that is interrupted with the others can write its last checkpoint."""
LOOK_SECONDS = 0.1
"""Interval in seconds at which new connections are polled."""
ALIVE, BYE, FAILED, INTERRUPTED, OTHER_LOST, QUIT = b".", b"b", b"f", b"i", b"l", b"q"
"""Kinds of messages; a text follows FAILED and OTHER_LOST."""


class Liveness:
    """Connections of one process to the others, whose loss ends it."""

    def __init__(self, others: Mapping[int, Connection], count: int, seconds: float, on_end: Callable[[str], None]):
        """Watch the others, by number, of `count` processes; a silent one is lost after some seconds.

        A thread calls `on_end`, which ends this process, with the reason once another one is lost, or with "" if the
        first process ends the others quietly.
        """
        self._others, self._count, self._seconds, self._on_end = dict(others), count, seconds, on_end
        self._ending, self._sending = threading.Lock(), threading.Lock()
        self._is_left = threading.Event()
        for number, connection in self._others.items():
            threading.Thread(target=self._listen, args=(number, connection), daemon=True).start()
        threading.Thread(target=self._beat, daemon=True).start()

    def end(self, kind: bytes, reason: str = "") -> None:
        """Report the end of this process to the others: by BYE, they can continue alone; by INTERRUPTED, they were
        interrupted as well; by FAILED, it ends by its own error, the reason; by QUIT, they are to end quietly."""
        if kind != FAILED:
            self._is_left.set()
        self._say(kind + reason.encode())

    def _say(self, message: bytes) -> None:
        with self._sending:
            # A copy, since lost connections are removed.
            for number, connection in list(self._others.items()):
                try:
                    connection.send_bytes(message)
                except OSError:
                    self._others.pop(number, None)  # `_listen` reports it.

    def _beat(self) -> None:
        while not self._is_left.wait(self._seconds / BEATS):
            self._say(ALIVE)

    def _listen(self, number: int, connection: Connection) -> None:
        reason = f"was not heard from for {self._seconds:g} s"
        try:
            while connection.poll(self._seconds):
                message = connection.recv_bytes()
                kind, text = message[:1], message[1:].decode()
                if kind == BYE:
                    return
                if kind == FAILED:
                    time.sleep(GRACE)
                    reason = f"failed: {text}"
                    break
                if kind == INTERRUPTED:
                    self._is_left.wait(INTERRUPTED_GRACE)
                    reason = "was interrupted"
                    break
                if kind in (OTHER_LOST, QUIT):
                    return self._end(text)
        except (EOFError, OSError, TypeError):  # TypeError: Python's, of a connection that is closed during a read
            reason = "has ended"
        self._end(f"process {number} of {self._count} {reason}")

    def _end(self, reason: str) -> None:
        # Several may be lost at once, each with a thread here: the first reason counts.
        with self._ending:
            if self._is_left.is_set():
                return
            self._is_left.set()
            if reason:
                self._say(OTHER_LOST + reason.encode())
            self._on_end(reason)


def accept(listener: socket.socket, key: bytes, count: int) -> dict[int, Connection]:
    """Return the connections of processes 1 to `count` - 1, each of which first sends its number. Connections
    without the key, or that send nothing, are rejected, and no process waits for them."""
    arrived: queue.SimpleQueue[tuple[int, Connection]] = queue.SimpleQueue()
    found: dict[int, Connection] = {}

    def admit(guest: socket.socket) -> None:
        with contextlib.suppress(AuthenticationError, EOFError, OSError):
            # Detached: a socket that is deleted would close the descriptor.
            connection = Connection(guest.detach())
            # Both sides prove that they have the key, in an order that mirrors `connect`.
            deliver_challenge(connection, key)
            answer_challenge(connection, key)
            arrived.put((int.from_bytes(connection.recv_bytes(), "big"), connection))

    with listener:
        listener.settimeout(LOOK_SECONDS)
        while len(found) < count - 1:
            with contextlib.suppress(OSError):  # TimeoutError is one.
                threading.Thread(target=admit, args=listener.accept()[:1], daemon=True).start()
            with contextlib.suppress(queue.Empty):
                while True:
                    found.update([arrived.get_nowait()])
    return found


def connect(host: str, port: int, key: bytes, number: int) -> dict[int, Connection]:
    """Return the connection of process `number` to the first."""
    connection = Connection(socket.create_connection((host, port)).detach())
    answer_challenge(connection, key)
    deliver_challenge(connection, key)
    connection.send_bytes(number.to_bytes(4, "big"))
    return {0: connection}


def listen() -> tuple[socket.socket, int, bytes]:
    """Return a listener on a free port, by IPv4 and, if available, IPv6, the port, and the key that clients need."""
    has_both = socket.has_dualstack_ipv6()
    family = socket.AF_INET6 if has_both else socket.AF_INET
    listener = socket.create_server(("", 0), family=family, backlog=64, dualstack_ipv6=has_both)
    return listener, int(listener.getsockname()[1]), os.urandom(32)


JOIN_SECONDS = 300
"""Time in which all processes must have started."""
LEAVE_SECONDS = 60
"""Time in which all processes must have finished training."""
AUTO = "auto"
LOST = 75  # EX_TEMPFAIL of sysexits.h
"""Exit code after another process was lost: training can resume from its last checkpoint."""
LONGEST_HOST = 255
LONGEST_REASON = 300
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
        """Function that returns how to resume after a process is lost."""
        self.has_met = False
        """Whether all are training, so that an interruption of one stops all after the same iteration."""
        self._liveness: Liveness | None = None

    @property
    def is_first(self) -> bool:
        """Whether this process writes files and shows progress."""
        return self.index == 0

    def watch(self, coordinator: str) -> None:
        """Connect the processes and start watching them."""
        own = listen() if self.is_first else None
        host = coordinator.rpartition(":")[0].strip("[]")
        if coordinator == AUTO:
            host = socket.gethostname()
            with contextlib.suppress(OSError):
                address = socket.gethostbyname(host)
                # Some systems resolve their own name to a loopback address, which is of no use to others.
                host = host if address.startswith("127.") else address
            host = host[:LONGEST_HOST]
        # 4 bytes of port, 32 of key, then the host.
        sent = broadcast(b"".join([own[1].to_bytes(4, "big"), own[2], host.encode()]) if own else b"")
        others = accept(own[0], own[2], self.count) if own else connect(
            sent[36:].decode(), int.from_bytes(sent[:4], "big"), sent[4:36], self.index
        )  # fmt: skip
        self._liveness = Liveness(others, self.count, self._seconds, self._end)

    def leave(self) -> None:
        """End the common work; this process continues alone."""
        if self._liveness is not None:
            multihost_utils.sync_global_devices("leave")
            self._liveness.end(BYE)
            self._liveness = None
            jax.distributed.shutdown()

    def report(self, error: BaseException) -> None:
        """Report an error to the others; if a lost process caused it, wait for the report about that one."""
        liveness, self._liveness = self._liveness, None
        if liveness is None:
            return
        if is_of_collectives(error):
            time.sleep(2 * self._seconds)  # `_end` comes first.
        elif isinstance(error, KeyboardInterrupt) and self.has_met:
            liveness.end(INTERRUPTED)
        elif self.is_first:
            liveness.end(QUIT)
        else:
            is_interrupted = isinstance(error, KeyboardInterrupt)
            liveness.end(FAILED, "it was interrupted" if is_interrupted else shortened(str(error), LONGEST_REASON))
            time.sleep(self._seconds)

    def _end(self, reason: str) -> NoReturn:
        """End this process, which waits inside XLA, with one line; without a reason the first one ends as well."""
        if not reason:
            with contextlib.suppress(Exception):
                jax.distributed.shutdown()  # The first process waits for it at its end.
        else:
            with contextlib.suppress(ValueError, OSError):
                print("; ".join(filter(None, (f"a2tg: error: {reason}", self.advice()))), file=sys.stderr)
        sys.stdout.flush()
        sys.stderr.flush()
        # Not `sys.exit`, which would end this thread only: the main one waits in XLA.
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

    def give_up() -> NoReturn:
        missing = f"not all processes have joined --coordinator {place.coordinator} within {JOIN_SECONDS} s"
        print(f"a2tg: error: {missing}: start --num-processes of them, each with its --process-id", file=sys.stderr)
        sys.stderr.flush()
        os._exit(LOST)

    late = threading.Timer(JOIN_SECONDS, give_up)
    late.daemon = True
    late.start()
    try:
        if not os.environ.get("A2TG_DEBUG"):
            own_output_only()
        wait_in_abort()
        is_auto = place.coordinator == AUTO
        # JAX's handler of SIGTERM would replace `signals`.
        jax.config.update("jax_enable_preemption_service", False)
        try:
            # JAX's own timeouts are longer: a safety net.
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
        _team = Team(place.seconds)
        if _team.count > 1:
            _team.watch(place.coordinator)
    finally:
        late.cancel()
    try:
        yield _team
        _team.leave()
    except BaseException as error:
        _team.report(error)
        raise
    finally:
        _team = None


def broadcast(data: bytes) -> bytes:
    """Return the first process's bytes in every process; all call it together."""
    return gather(data if jax.process_index() == 0 else b"")[0]


def gather(data: bytes) -> list[bytes]:
    """Return the bytes of all processes, in the order of their numbers; all call it together."""
    # All processes must send arrays of one shape: lengths first, then padded bytes.
    length = np.frombuffer(len(data).to_bytes(8, "big"), np.uint8)
    sizes = [int.from_bytes(bytes(own), "big") for own in multihost_utils.process_allgather(length)]
    padded = np.frombuffer(data.ljust(max(1, *sizes), b"\0"), np.uint8)
    return [bytes(own[:size]) for own, size in zip(multihost_utils.process_allgather(padded), sizes, strict=True)]


def is_of_collectives(error: BaseException) -> bool:
    """Return whether an error was raised because processes could not reach each other."""
    # Out of memory is this process's own failure, though JAX raises the same class.
    if "RESOURCE_EXHAUSTED" in str(error):
        return False
    return isinstance(error, jax.errors.JaxRuntimeError) or "Gloo" in str(error) or "NCCL" in str(error)
