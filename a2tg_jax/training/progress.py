"""The progress of training: a bar on a terminal, plain lines elsewhere, and forecasts of a stage's duration."""

import datetime
import sys
import time
from collections.abc import Callable

from tqdm import tqdm

from a2tg_jax.host.progress_bars import has_terminal, is_line_due
from a2tg_jax.host.text import counted, in_bytes
from a2tg_jax.training.checkpoint import History
from a2tg_jax.training.step import StepInfo

MOMENTUM = 0.95
TIMED_SECONDS, TIMED_STEPS = 2.0, 3
"""Smallest number of timed steps before a forecast of the duration."""
BAR = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}{postfix}]"
"""tqdm's format without its rate and remaining time, which count compilation."""


class Pace:
    """Time of an iteration, and forecasts of a stage's duration: early, and at a half."""

    def __init__(self, first: int, total: int, now: Callable[[], float] = time.perf_counter, *, may_grow: bool = True):
        """Args:
        first: iterations done before.
        total: the last iteration.
        now: a clock in seconds.
        may_grow: whether Gaussians may be added.
        """
        self._total, self._now, self._may_grow = total, now, may_grow
        self._due = [first, (first + total) // 2]
        self._before: tuple[int, float, int] | None = None
        self._steps, self._seconds = 0, 0.0
        self._ahead, self._seconds_a_program = 0, 0.0

    def time(self, done: int, num_compiled: int, ahead: int = 0, seconds_a_program: float = 0.0) -> None:
        """Time the iterations since the last call, unless programs were compiled meanwhile.

        Args:
          done: iterations so far.
          num_compiled: programs compiled so far.
          ahead: programs that will be compiled, about.
          seconds_a_program: time of a compilation.
        """
        now = self._now()
        self._ahead, self._seconds_a_program = ahead, seconds_a_program
        if self._before is not None and self._before[2] == num_compiled:
            self._steps += done - self._before[0]
            self._seconds += now - self._before[1]
        self._before = done, now, num_compiled

    def told(self, done: int) -> str | None:
        """Return a forecast if one is due and enough was timed since the last, or None."""
        left = self.left(done)
        is_due = self._due and done >= self._due[0] and self._steps >= TIMED_STEPS and self._seconds >= TIMED_SECONDS
        if left is None or not is_due or done >= self._total:
            return None
        growing = "; more if Gaussians are added" if self._may_grow and len(self._due) > 1 else ""
        told = f"{1e3 * self._seconds / self._steps:,.0f} ms an iteration, about {left} for the other "
        self._due = [due for due in self._due[1:] if due > done]
        self._steps, self._seconds = 0, 0.0
        compiling = f"with {counted(self._ahead, 'program')} to compile" if self._ahead else "without compiling"
        return f"{told}{self._total - done:,}, {compiling}{growing}"

    def left(self, done: int) -> datetime.timedelta | None:
        """Return the remaining time, that of known compilations included; None before a step was timed."""
        if self._steps == 0:
            return None
        of_steps = (self._total - done) * self._seconds / self._steps
        return datetime.timedelta(seconds=round(of_steps + self._ahead * self._seconds_a_program))


class ProgressBar:
    """A line with loss, PSNR, live Gaussians, memory and time left; a line for every tenth without a terminal."""

    def __init__(self, title: str, done: int, total: int, *, is_shown: bool, may_grow: bool = True):
        is_bar = is_shown and has_terminal()
        self._bar = tqdm(
            desc=f"{title} (compiling)", initial=done, total=total, disable=not is_bar, unit="it",
            dynamic_ncols=True, mininterval=0.5, bar_format=BAR,
        )  # fmt: skip
        self._title, self._done, self._total = title, done, total
        self._pace = Pace(done, total, may_grow=may_grow)
        self._is_shown, self._is_plain = is_shown, is_shown and not is_bar
        self._last_line = done, time.perf_counter()
        self._loss: float | None = None
        self._psnr = 0.0
        if self._is_plain:
            self._print("compiling")

    def __enter__(self) -> "ProgressBar":
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def tell_pace(self, done: int, num_compiled: int, ahead: int = 0, seconds_a_program: float = 0.0) -> None:
        """Print a forecast if one is due, after a group of steps that were launched together.

        Args: as of `Pace.time`.
        """
        self._pace.time(done, num_compiled, ahead, seconds_a_program)
        told = self._pace.told(done)
        if told is not None and self._is_shown:
            self._bar.write(f"{self._title}: {told}")

    def update(self, info: StepInfo, history: History) -> None:
        """Count one iteration; loss and PSNR are running means."""
        loss, psnr = float(info.loss), float(info.psnr)
        if self._loss is None:
            self._loss, self._psnr = loss, psnr
            self._bar.set_description_str(self._title)
        self._loss += (1 - MOMENTUM) * (loss - self._loss)
        self._psnr += (1 - MOMENTUM) * (psnr - self._psnr)
        self._done += 1
        self._bar.update()
        if len(history.iteration) and not self._bar.disable:
            self._bar.set_postfix_str(self._told(history), refresh=False)
        if self._is_plain and is_line_due(self._done, self._total, *self._last_line):
            self._print(f"{self._done:,} of {self._total:,}, {self._told(history)}")

    def _told(self, history: History) -> str:
        left = self._pace.left(self._done)
        words = [] if left is None or self._done == self._total else [f"{left} left"]
        words.append(f"loss {self._loss:.4f}, {self._psnr:.2f} dB")
        if len(history.iteration):
            words.append(
                f"{int(history.num_gaussians[-1]):,} Gaussians, {in_bytes(1e6 * float(history.megabytes[-1]))}"
            )
        return ", ".join(words)

    def _print(self, text: str) -> None:
        print(f"{self._title}: {text}", file=sys.stderr, flush=True)
        self._last_line = self._done, time.perf_counter()
