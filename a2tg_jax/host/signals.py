"""Ctrl-C, SIGTERM and SIGHUP: orderly ends of a program.

Python ignores exceptions in callbacks of the garbage collector, of which JAX has one. A signal that comes while one
runs is therefore sent once more.
"""

import contextlib
import dataclasses
import gc
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

from a2tg_jax.host.operating_system import ending_signals

CTRL_C = signal.SIGINT
ENDING = ending_signals()
SOON = 0.02
"""Seconds after which a signal is sent once more."""


class Stopped(KeyboardInterrupt):
    """The process was asked to end."""

    def __init__(self, number: int, advice: str = ""):
        """Args:
        number: of the signal.
        advice: how to go on with the stopped work.
        """
        super().__init__(signal.Signals(number).name)
        self.number, self.advice = int(number), advice

    @staticmethod
    def of(interrupt: KeyboardInterrupt) -> "Stopped":
        """Return the end that an interrupt asked for: Ctrl-C, unless it says another."""
        return interrupt if isinstance(interrupt, Stopped) else Stopped(CTRL_C)

    @property
    def exit_code(self) -> int:
        """Exit code, 128 plus the number of the signal: 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP."""
        return 128 + self.number


@contextlib.contextmanager
def raised() -> Iterator[None]:
    """Have SIGTERM and SIGHUP raise `Stopped` within the block, as Ctrl-C raises KeyboardInterrupt."""

    def stop(number: int, frame: object) -> None:
        raise Stopped(number)

    with _handled_by(stop, ENDING), _handled_by(_interrupt, (CTRL_C,)):
        yield


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


@contextlib.contextmanager
def noted() -> Iterator[Callable[[], bool]]:
    """Note the first signal within the block, and raise `Stopped` at the second.

    Yield a function that returns whether there was one. At the end of the block a noted signal raises `Stopped`.
    """
    numbers: list[int] = []

    def note(number: int, frame: object) -> None:
        numbers.append(number)
        if len(numbers) > 1:
            raise Stopped(number)

    with _handled_by(note, (CTRL_C, *ENDING)):
        try:
            yield lambda: bool(numbers)
        except KeyboardInterrupt:
            raise Stopped(numbers[-1] if numbers else CTRL_C) from None
    if numbers:
        raise Stopped(numbers[-1])


@contextlib.contextmanager
def ctrl_c_noted() -> Iterator[Callable[[], bool]]:
    """Note the first Ctrl-C within the block; the second raises KeyboardInterrupt, and so does the end of the block.

    Yield a function that returns whether there was one. Programs that handle Ctrl-C themselves keep their handler.
    """
    numbers: list[int] = []

    def note(number: int, frame: object) -> None:
        numbers.append(number)
        if len(numbers) > 1:
            raise KeyboardInterrupt

    before = signal.getsignal(CTRL_C)
    handler = before.handler if isinstance(before, _Heard) else before
    is_own = handler not in (signal.default_int_handler, _interrupt)
    with contextlib.nullcontext() if is_own else _handled_by(note, (CTRL_C,)):
        yield lambda: bool(numbers)
    if numbers:
        raise KeyboardInterrupt


@dataclasses.dataclass(frozen=True)
class _Heard:
    """Handler of a signal whose exceptions are not lost."""

    handler: Callable[..., Any]

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if not _ignores_exceptions(frame):
            self.handler(number, frame)
            return
        again = threading.Timer(SOON, _send, (number,))
        again.daemon = True
        again.start()


def _send(number: int) -> None:
    """Send a signal to the main thread, whose waiting it ends; Windows has no such call."""
    if hasattr(signal, "pthread_kill") and (main := threading.main_thread().ident) is not None:
        signal.pthread_kill(main, number)
    else:
        signal.raise_signal(number)


def _ignores_exceptions(frame: FrameType | None) -> bool:
    """Return whether a frame runs within a callback of the garbage collector."""
    callbacks = {getattr(callback, "__code__", None) for callback in gc.callbacks}
    while frame is not None:
        if frame.f_code in callbacks:
            return True
        frame = frame.f_back
    return False


@contextlib.contextmanager
def _handled_by(handler: Callable[..., Any], numbers: tuple[int, ...]) -> Iterator[None]:
    """Install a handler within the block. Ignored signals, such as SIGHUP under nohup, stay ignored; other threads
    install none."""
    before: dict[int, object] = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.getsignal(number) for number in numbers}
        before = {number: old for number, old in before.items() if old not in (signal.SIG_IGN, None)}
    for number in before:
        signal.signal(number, _Heard(handler))
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)  # type: ignore[arg-type]
