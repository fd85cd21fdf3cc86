"""Pruning of floaters: Gaussians that matter in too few training views, or that hang close before a camera."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from a2tg_jax.core.optim import AdamState
from a2tg_jax.data import View
from a2tg_jax.densify.pruning import kept_first, pruning_times, shown_in
from a2tg_jax.events import Change, Due, FieldError, HostEvent, event, static
from a2tg_jax.model import Model


@event
class PruneFloaters(HostEvent):
    """Event that prunes the Gaussians that show in fewer training views than asked for, or stand close before one.

    Each view can hang splats before its own camera that no other view contradicts. It uses the cameras of the scene,
    not refined ones.
    """

    min_views: int = static(default=2)
    """Least number of views in which a Gaussian must show, by Σ α·T of `least`; 0 or 1: those that show nowhere stay,
    too."""
    near: float = static(default=0.0)
    """Least depth before every camera that sees it, in units of the normalised world; 0: none."""
    least: float = static(default=1.0)
    """Least Σ α·T in a view, in pixels."""
    at: tuple[float, ...] = static(default=(0.4, 0.6, 0.8))
    """Fractions of the stage at which Gaussians are pruned; 1: at its end."""

    def iterations(self, num_iterations: int) -> tuple[int, ...]:
        if self.min_views < 0 or self.near < 0:
            name, value = ("min_views", self.min_views) if self.min_views < 0 else ("near", self.near)
            raise FieldError(self, f"{{{name}}} must be at least 0; got {value}")
        return pruning_times(self, self.at, num_iterations)

    def num_programs(self, num_iterations: int) -> int:
        return 2  # Rows keep their number; tile lists grow with the Gaussians.

    def apply(self, due: Due, model: Model, moments: AdamState, state: Any) -> Change:
        num = model.num
        is_kept = np.ones(num, bool)
        if self.min_views > 1:
            needed = min(self.min_views, len(due.views))
            is_kept &= due.agreed(shown_in(model, due.views, self.least).num_views)[:num] >= needed
        if self.near > 0:
            is_kept &= ~are_near(np.asarray(model.gaussians.means)[:num], due.views, self.near)
        if is_kept.sum() < 2:  # A model of nothing cannot be trained.
            is_kept[:] = True
        return kept_first(model, moments, state, is_kept)


def are_near(means: np.ndarray, views: Sequence[View], near: float) -> np.ndarray:
    """Return [N] whether a point [N, 3] lies within the picture of a view, less than `near` before its camera."""
    found = np.zeros(len(means), bool)
    for camera in (view.camera for view in views):
        viewmat, K = np.asarray(camera.viewmat, np.float64), np.asarray(camera.K, np.float64)
        x, y, z = viewmat[:3, :3] @ means.T + viewmat[:3, 3:]
        depth = np.where(z > 0, z, np.nan)
        column, row, _ = K @ np.stack([x / depth, y / depth, np.ones_like(z)])
        found |= (z < near) & (column >= 0) & (column <= camera.width) & (row >= 0) & (row <= camera.height)
    return found
