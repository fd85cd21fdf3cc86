"""The progress bar of training."""

from tqdm import tqdm

from a2tg_jax.training.checkpoint import History
from a2tg_jax.training.step import StepInfo

MOMENTUM = 0.95


class ProgressBar:
    """A line with loss, PSNR, live Gaussians, memory and time left."""

    def __init__(self, title: str, done: int, total: int, *, is_shown: bool):
        self._bar = tqdm(
            desc=f"{title} (compiling)", initial=done, total=total, disable=not is_shown, unit="it",
            dynamic_ncols=True, mininterval=0.5,
        )  # fmt: skip
        self._title = title
        self._loss: float | None = None
        self._psnr = 0.0

    def __enter__(self) -> "ProgressBar":
        return self

    def __exit__(self, *_) -> None:
        self._bar.close()

    def update(self, info: StepInfo, history: History) -> None:
        """Counts one iteration; loss and PSNR are running means."""
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
                f"loss {self._loss:.4f}, {self._psnr:.2f} dB, {num:,} Gaussians, {megabytes:.2f} MB", refresh=False
            )
