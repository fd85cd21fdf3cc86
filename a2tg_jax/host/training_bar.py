"""Progress of a training: a bar on a terminal or in a notebook, elsewhere plain lines."""

import datetime
import math
import sys
import time
from collections.abc import Mapping

from a2tg_jax import Display
from a2tg_jax.base.text import in_bytes
from a2tg_jax.host.progress_bars import has_terminal, is_line_due, new_bar

MOMENTUM = 0.95
BAR = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}{postfix}]"
"""tqdm's format without its rate and remaining time, which count compilation."""


class ProgressBar(Display):
    """A line with loss, PSNR, live Gaussians, memory and time left; a line for every tenth without a terminal.

    Examples:
      >>> system = a2tg.Gaussians2dMcmc.preset("smoke", stage1_iterations=20)
      >>> result = a2tg.fit(scene, system, progress=a2tg.ProgressBar)
    """

    def __init__(self, title: str, done: int, total: int):
        is_bar = has_terminal()
        self._bar = new_bar(
            desc=f"{title} (compiling)", initial=done, total=total, disable=not is_bar, unit="it",
            dynamic_ncols=True, mininterval=0.5, bar_format=BAR,
        )  # fmt: skip
        self._title = title
        self._done = done
        self._total = total
        self._is_plain = not is_bar
        self._last_line = done, time.perf_counter()
        self._loss: float | None = None
        self._psnr = 0.0
        if self._is_plain:
            self._print("compiling")

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def tell(self, text: str) -> None:
        """Print a line above the bar."""
        self._bar.write(f"{self._title}: {text}")

    def update(
        self, done: int, loss: float, psnr: float, row: Mapping[str, float] | None, left: datetime.timedelta | None
    ) -> None:
        """Show the iterations that are done; loss and PSNR are shown as running means."""
        if self._loss is None:
            self._loss = loss
            self._bar.set_description_str(self._title)
        self._loss += (1 - MOMENTUM) * (loss - self._loss)
        if math.isfinite(psnr):  # An infinite one, of an empty photograph, would stay in the mean.
            before = self._psnr or psnr
            self._psnr = before + (1 - MOMENTUM) * (psnr - before)
        self._bar.update(done - self._done)
        self._done = done
        if row and not self._bar.disable:
            self._bar.set_postfix_str(self._figures(row, left), refresh=False)
        if self._is_plain and is_line_due(self._done, self._total, *self._last_line):
            self._print(f"{self._done:,} of {self._total:,}, {self._figures(row, left)}")

    def _figures(self, row: Mapping[str, float] | None, left: datetime.timedelta | None) -> str:
        words = [] if not left or self._done == self._total else [f"{left} left"]
        words.append(f"loss {self._loss:.4f}, {self._psnr:.2f} dB")
        if row:
            words.append(f"{row['num_gaussians']:,} Gaussians, {in_bytes(1e6 * row['megabytes'])}")
        return ", ".join(words)

    def _print(self, text: str) -> None:
        print(f"{self._title}: {text}", file=sys.stderr, flush=True)
        self._last_line = self._done, time.perf_counter()
