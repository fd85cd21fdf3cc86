"""The progress bar of training."""

import datetime
import time
from collections.abc import Callable

from tqdm import tqdm

from a2tg_jax.training.checkpoint import History
from a2tg_jax.training.step import StepInfo

MOMENTUM = 0.95
TIMED_SECONDS, TIMED_STEPS = 2.0, 3
"""Smallest number of timed steps before a forecast of the duration."""


class Pace:
    """Forecast of a stage's duration, printed once. The first step compiles and is not timed."""

    def __init__(self, total: int, now: Callable[[], float] = time.perf_counter):
        """Args:
        total: the last iteration.
        now: a clock in seconds.
        """
        self._total, self._now = total, now
        self._start: tuple[int, float] | None = None
        self._is_told = False

    def told(self, done: int) -> str | None:
        """Return the forecast after some iterations, or None. The first call begins the timing."""
        now = self._now()
        if self._start is None:
            self._start = done, now
        steps, seconds = done - self._start[0], now - self._start[1]
        if self._is_told or steps < TIMED_STEPS or seconds < TIMED_SECONDS:
            return None
        self._is_told = True
        left = datetime.timedelta(seconds=round((self._total - done) * seconds / steps))
        return f"{1e3 * seconds / steps:,.0f} ms an iteration, about {left} for the other {self._total - done:,}"


class ProgressBar:
    """A line with loss, PSNR, live Gaussians, memory and time left."""

    def __init__(self, title: str, done: int, total: int, *, is_shown: bool):
        self._bar = tqdm(
            desc=f"{title} (compiling)", initial=done, total=total, disable=not is_shown, unit="it",
            dynamic_ncols=True, mininterval=0.5,
        )  # fmt: skip
        self._title, self._pace = title, Pace(total)
        self._loss: float | None = None
        self._psnr = 0.0

    def __enter__(self) -> "ProgressBar":
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def tell_pace(self, done: int) -> None:
        """Print the forecast once, after a group of steps that were launched together."""
        told = self._pace.told(done)
        if told is not None and not self._bar.disable:
            self._bar.write(f"{self._title}: {told}")

    def update(self, info: StepInfo, history: History) -> None:
        """Count one iteration; loss and PSNR are running means."""
        loss, psnr = float(info.loss), float(info.psnr)
        if self._loss is None:
            self._loss, self._psnr = loss, psnr
            self._bar.set_description_str(self._title)
        self._loss += (1 - MOMENTUM) * (loss - self._loss)
        self._psnr += (1 - MOMENTUM) * (psnr - self._psnr)
        self._bar.update()
        if len(history.iteration):
            num, megabytes = int(history.num_gaussians[-1]), float(history.megabytes[-1])
            self._bar.set_postfix_str(
                f"loss {self._loss:.4f}, {self._psnr:.2f} dB, {num:,} Gaussians, {told_size(megabytes)}", refresh=False
            )


def told_size(megabytes: float) -> str:
    """Return the size of a model in MB, or in kB where MB would round to nothing."""
    return f"{megabytes:.2f} MB" if megabytes >= 0.01 else f"{1e3 * megabytes:.1f} kB"
