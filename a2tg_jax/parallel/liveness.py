"""Processes that watch each other over TCP: each says that it lives, and notices who has ended or fallen silent.

The first process has a connection to every other one, and tells them whom it has lost. Everything runs in threads,
because a training waits for a lost process inside XLA and cannot be interrupted there.
"""

import contextlib
import os
import queue
import socket
import threading
import time
from collections.abc import Callable, Mapping
from multiprocessing import AuthenticationError
from multiprocessing.connection import Connection, answer_challenge, deliver_challenge

BEATS = 5
"""Number of signs of life within the time after which a silent process is lost."""
GRACE = 2.0
"""Seconds in which a process that fails with the others can tell its own error."""
INTERRUPTED_GRACE = 300.0
"""Seconds in which a process that is interrupted with the others can write its last checkpoint."""
LOOK_SECONDS = 0.1
"""Seconds between two looks at who has arrived."""
ALIVE, BYE, FAILED, INTERRUPTED, LOST, QUIT = b".", b"b", b"f", b"i", b"l", b"q"
"""Kinds of messages; a text follows FAILED and LOST."""
Told = Callable[[str], None]


class Liveness:
    """Connections of one process to those that must live as long as it does."""

    def __init__(self, others: Mapping[int, Connection], count: int, seconds: float, on_end: Told):
        """Args:
        others: connections by the number of the process.
        count: number of all processes.
        seconds: time after which a silent process is lost.
        on_end: called in a thread with the reason once another process is lost, or with "" if the first one asks to
          end quietly. It ends the process.
        """
        self._others, self._count, self._seconds, self._on_end = dict(others), count, seconds, on_end
        self._ending, self._sending = threading.Lock(), threading.Lock()
        self._is_left = threading.Event()
        for number, connection in self._others.items():
            threading.Thread(target=self._listen, args=(number, connection), daemon=True).start()
        threading.Thread(target=self._beat, daemon=True).start()

    def leave(self) -> None:
        """Tell the others that this process needs them no more, and they not it."""
        self._is_left.set()
        self._say(BYE)

    def fail(self, reason: str) -> None:
        """Tell the others that this process ends by an error of its own."""
        self._say(FAILED + reason.encode())

    def interrupt(self) -> None:
        """Tell the others that this process was asked to end, as they should be."""
        self._is_left.set()
        self._say(INTERRUPTED)

    def quit(self) -> None:
        """Ask the others to end quietly."""
        self._is_left.set()
        self._say(QUIT)

    def _say(self, message: bytes) -> None:
        with self._sending:
            for number, connection in list(self._others.items()):
                try:
                    connection.send_bytes(message)
                except OSError:
                    self._others.pop(number, None)  # `_listen` tells it.

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
                if kind in (LOST, QUIT):
                    return self._end(text)
        except (EOFError, OSError, TypeError):  # TypeError: Python's, of a connection that is closed during a read
            reason = "has ended"
        self._end(f"process {number} of {self._count} {reason}")

    def _end(self, reason: str) -> None:
        with self._ending:
            if self._is_left.is_set():
                return
            self._is_left.set()
            if reason:
                self._say(LOST + reason.encode())
            self._on_end(reason)


def accept(listener: socket.socket, key: bytes, count: int) -> dict[int, Connection]:
    """Return the connections of processes 1 to `count` - 1, each of which first sends its number.

    Strangers, who do not know the key or say nothing, are turned away and keep nobody waiting.
    """
    arrived: queue.SimpleQueue[tuple[int, Connection]] = queue.SimpleQueue()
    found: dict[int, Connection] = {}
    with listener:
        listener.settimeout(LOOK_SECONDS)
        while len(found) < count - 1:
            with contextlib.suppress(OSError):  # TimeoutError is one.
                guest = listener.accept()[0]
                threading.Thread(target=_admit, args=(guest, key, arrived), daemon=True).start()
            with contextlib.suppress(queue.Empty):
                while True:
                    found.update([arrived.get_nowait()])
    return found


def _admit(guest: socket.socket, key: bytes, arrived: "queue.SimpleQueue[tuple[int, Connection]]") -> None:
    """Add the connection of a guest who knows the key."""
    with contextlib.suppress(AuthenticationError, EOFError, OSError):
        connection = Connection(guest.detach())
        deliver_challenge(connection, key)
        answer_challenge(connection, key)
        arrived.put((int.from_bytes(connection.recv_bytes(), "big"), connection))


def connect(host: str, port: int, key: bytes, number: int) -> dict[int, Connection]:
    """Return the connection of process `number` to the first."""
    connection = Connection(socket.create_connection((host, port)).detach())
    answer_challenge(connection, key)
    deliver_challenge(connection, key)
    connection.send_bytes(number.to_bytes(4, "big"))
    return {0: connection}


def listen() -> tuple[socket.socket, int, bytes]:
    """Return a listener on a free port, that port, and a key for those who may connect: by IPv4, and IPv6 if it is
    there."""
    has_both = socket.has_dualstack_ipv6()
    family = socket.AF_INET6 if has_both else socket.AF_INET
    listener = socket.create_server(("", 0), family=family, backlog=64, dualstack_ipv6=has_both)
    return listener, int(listener.getsockname()[1]), os.urandom(32)
