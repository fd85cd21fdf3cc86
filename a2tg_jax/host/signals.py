"""Ctrl-C, SIGTERM, SIGHUP and SIGUSR1: orderly shutdown of a program.

Python ignores exceptions in callbacks of the garbage collector and of weak references, and in `__del__`; JAX has many
of them. A signal whose exception was ignored is therefore sent again.
"""

import contextlib
import ctypes
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

from a2tg_jax.base.operating_system import c_library

HANDLER_SIZE = 1024
"""Bytes for C's struct sigaction, whose size depends on the system; glibc's has 152."""

CTRL_C = signal.SIGINT
ENDING = (CTRL_C, *(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGUSR1") if hasattr(signal, name)))
"""Signals that end a process; Windows has neither SIGHUP nor SIGUSR1, which Slurm sends before a job's time limit."""
SOON = 0.02
"""Seconds after which a signal is sent again."""


class Stopped(KeyboardInterrupt):
    """A signal ended the work."""

    def __init__(self, number: int, advice: str = ""):
        """Args:
        number: number of the signal.
        advice: how to continue the stopped work.
        """
        super().__init__(signal.Signals(number).name)
        self.number = int(number)
        self.advice = advice

    @staticmethod
    def of(interrupt: KeyboardInterrupt) -> "Stopped":
        """Return a `Stopped` for any interrupt: by the signal that it names, or else by Ctrl-C."""
        return interrupt if isinstance(interrupt, Stopped) else Stopped(getattr(interrupt, "number", CTRL_C))

    @property
    def exit_code(self) -> int:
        """Exit code, 128 plus the number of the signal: 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP."""
        return 128 + self.number


@contextlib.contextmanager
def raised() -> Iterator[None]:
    """Within the block, SIGTERM, SIGHUP and SIGUSR1 raise `Stopped`, as Ctrl-C raises KeyboardInterrupt."""

    def stop(number: int, frame: object) -> None:
        raise KeyboardInterrupt if number == CTRL_C else Stopped(number)

    with _handled_by(stop, ENDING):
        yield


@contextlib.contextmanager
def stop_on_signals(numbers: tuple[int, ...] = ENDING) -> Iterator[Callable[[], bool]]:
    """Note the first Ctrl-C, SIGTERM, SIGHUP or SIGUSR1 within the block, for training that stops after a step.

    A second signal raises KeyboardInterrupt at once; after a single one, it is raised at the end of the block. Programs
    that handle a signal themselves keep their handler.

    Args:
      numbers: the signals.

    Returns:
      A context of a function that returns whether there was a signal, the `is_stopped` of `fit`.

    Examples:
      >>> system = a2tg.Gaussians2dMcmc.preset("smoke", stage1_iterations=20)
      >>> with a2tg.stop_on_signals() as is_stopped:
      ...     result = a2tg.fit(scene, system, is_stopped=is_stopped)
    """
    received: list[int] = []

    def note(number: int, frame: object) -> None:
        received.append(number)
        if len(received) > 1:
            raise Stopped(number)

    with _handled_by(note, tuple(number for number in numbers if _is_ours(signal.getsignal(number)))):
        try:
            yield lambda: bool(received)
        except KeyboardInterrupt as interrupt:
            if received:  # The interrupt keeps its class and gets the number of the signal.
                interrupt.number = received[-1]  # type: ignore[attr-defined]
            raise
    if received:
        raise Stopped(received[-1])


def _is_ours(handler: object) -> bool:
    """Return whether a handler is Python's default, or of an outer block of this module."""
    default = (signal.default_int_handler, signal.SIG_DFL)
    return handler in default or getattr(handler, "__module__", None) == __name__


def _send(number: int) -> None:
    """Send a signal to the main thread, which stops waiting; Windows has no such call."""
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, number)
    else:
        signal.raise_signal(number)


@contextlib.contextmanager
def _handled_by(handler: Callable[..., object], numbers: tuple[int, ...]) -> Iterator[None]:
    """Install a handler within the block. Ignored signals, such as SIGHUP under nohup, stay ignored, and only the main
    thread installs handlers."""
    before: dict[int, object] = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.getsignal(number) for number in numbers}
        # None: a handler that C code installed, which Python could not restore.
        before = {number: old for number, old in before.items() if old not in (signal.SIG_IGN, None)}
    for number in before:
        signal.signal(number, handler)
    ignored = sys.unraisablehook

    def send_again(unraisable: Any) -> None:
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            return ignored(unraisable)
        again = threading.Timer(SOON, _send, (Stopped.of(unraisable.exc_value or KeyboardInterrupt()).number,))
        again.daemon = True  # The process may end first.
        again.start()

    sys.unraisablehook = send_again if before else ignored
    try:
        yield
    finally:
        sys.unraisablehook = ignored
        for number, old in before.items():
            signal.signal(number, old)  # type: ignore[arg-type]


@contextlib.contextmanager
def signal_handlers_kept() -> Iterator[None]:
    """Restore the C handlers of all signals after the block, in which a library may replace them; not on Windows.

    `signal.getsignal` does not report such handlers.
    """
    sigaction: Any = getattr(c_library(), "sigaction", None)
    before = {}
    for signum in signal.valid_signals() if sigaction else ():
        handler = ctypes.create_string_buffer(HANDLER_SIZE)
        if sigaction(int(signum), None, handler) == 0:  # Without a new action it only reads.
            before[int(signum)] = handler
    try:
        yield
    finally:
        for number, handler in before.items():
            sigaction(number, handler, None)
