"""Notice a training that does not learn: its renders are no better than one flat colour per view."""

import collections
import warnings
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.data.scene import View, view_image
from a2tg_jax.training.batches import BatchOrder
from a2tg_jax.training.stage import Background

CHECKED_AFTER = 0.2
"""Share of the first stage after which training must have learned something."""
LEAST_ITERATIONS = 200
"""Training is not judged earlier than this."""
NUM_COMPARED = 16
"""Iterations before the check whose PSNR is averaged."""
NEARLY_FLAT = 40.0
"""Photographs that one colour shows to so many dB tell nothing of whether a model has learned."""
ADVICE = (
    "Look whether the points and cameras fit (cameras.png of a2tg sfm; in a2tg view RUN, photographs beside the render "
    "from their cameras), then try fewer initial_gaussians, a lower initial_opacity or "
    "lower learning rates, and refine_poses if poses may be wrong"
)
FLAT_BACKGROUNDS: dict[Background, float] = {"black": 0.0, "white": 1.0, "random": 0.5}


class LearningCheck:
    """Warn once if training is not above a flat colour per view after a fifth of its first stage."""

    def __init__(
        self,
        views: tuple[View, ...],
        order: BatchOrder,
        iterations: int,
        background: Background,
        *,
        is_first: bool,
        small_budget: str = "",
    ):
        """Set up the check of one stage.

        Args:
          views: the training views.
          order: training views of each iteration.
          iterations: length of the stage.
          background: behind transparent photographs.
          is_first: whether this is the first stage; later ones are not checked.
          small_budget: what a small memory budget has room for, for the warning.
        """
        self._small_budget = small_budget
        self._views, self._order, self._level = views, order, FLAT_BACKGROUNDS[background]
        at = max(round(CHECKED_AFTER * iterations), LEAST_ITERATIONS)
        self._at = at if is_first and at <= iterations else None
        self._seen: collections.deque[tuple[int, float]] = collections.deque(maxlen=NUM_COMPARED)

    def observe(self, iteration: int, psnr: float) -> None:
        """Record the training PSNR of an iteration in dB; warn once if it stays low."""
        if self._at is None or iteration > self._at:
            return
        self._seen.append((iteration, psnr))
        if iteration == self._at:
            self._judge()

    def _judge(self) -> None:
        reached = float(np.mean([psnr for _, psnr in self._seen]))
        flat = float(np.mean([self._flat(self._order.indices(iteration)) for iteration, _ in self._seen]))
        if not has_learned(reached, flat):
            advice = f"{self._small_budget}: raise it" if self._small_budget else ADVICE
            warnings.warn(
                f"training does not learn: {reached:.1f} dB on the training views after {self._at:,} iterations, where "
                f"one flat colour per view reaches {flat:.1f} dB. {advice}",
                stacklevel=2,
            )

    def _flat(self, indices: Sequence[int]) -> float:
        """Return the mean PSNR of a flat colour on some views, in dB."""
        views = [self._views[index] for index in indices]
        return float(np.mean([_flat_psnr(view, self._level) for view in views]))


def _flat_psnr(view: View, level: float) -> float:
    image, mask = jnp.asarray(view_image(view, (level,) * 3)), None
    if view.mask is not None:
        mask = jnp.asarray(view.mask.read())
    return float(flat_psnr(image, mask))


def has_learned(psnr: float, flat: float) -> bool:
    """Return whether a PSNR is above that of flat colours (`flat_psnr`); always, if the photographs are nearly flat."""
    return psnr > flat or flat > NEARLY_FLAT


def flat_psnr(target: Array, mask: Array | None = None) -> Array:
    """Return the PSNR in dB of the best image of one flat colour, which a model reaches without learning more.

    Args:
      target: [H, W, 3], clipped to [0, 1] first.
      mask: [H, W] bool, the pixels that count; None: all of them.
    """
    target = jnp.clip(target, 0, 1)
    weight = jnp.ones(target.shape[:2], target.dtype) if mask is None else jnp.asarray(mask, target.dtype)
    weight = (weight / jnp.sum(weight))[:, :, None]
    mean = jnp.sum(weight * target, axis=(0, 1), keepdims=True)
    return -10 * jnp.log10(jnp.mean(jnp.sum(weight * (target - mean) ** 2, axis=(0, 1))))
