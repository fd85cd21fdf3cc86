"""Pruning of floaters: Gaussians that matter in too few training views, or that hang close before a camera."""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from a2tg_jax.core.cameras import Camera
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
    """Least number of views in which a Gaussian must show, by Σ α·T of `least`, at least 2; 0: none."""
    near: float = static(default=0.0)
    """Least depth before every camera that sees it, in units of the normalised world; 0: none."""
    least: float = static(default=1.0)
    """Least Σ α·T in a view, in pixels."""
    at: tuple[float, ...] = static(default=(0.4, 0.6, 0.8))
    """Fractions of the stage at which Gaussians are pruned; 1: at its end."""

    def iterations(self, num_iterations: int) -> tuple[int, ...]:
        if self.min_views < 0 or self.min_views == 1:
            raise FieldError(self, f"{{min_views}} must be at least 2 views, or 0 for off; got {self.min_views}")
        if self.near < 0:
            raise FieldError(self, f"{{near}} must be at least 0; got {self.near}")
        if not self.at:
            raise FieldError(self, "{at} must hold at least one fraction of the stage; got none")
        return pruning_times(self, self.at, num_iterations)

    def num_programs(self, num_iterations: int) -> int:
        return 2  # Rows keep their number; tile lists grow with the Gaussians.

    def apply(self, due: Due, model: Model, moments: AdamState, state: Any) -> Change:
        num = model.num
        is_kept = np.ones(num, bool)
        if self.min_views:
            needed = min(self.min_views, len(due.views))
            is_kept &= due.agreed(shown_in(model, due.views, self.least).num_views)[:num] >= needed
        if self.near > 0:
            is_kept &= ~are_near(np.asarray(model.gaussians.means)[:num], due.views, self.near)
        if is_kept.sum() < 2:
            warnings.warn(
                f"no floaters are pruned, for {is_kept.sum()} of {num:,} Gaussians would be left, and training needs "
                "2: lower --floaters.near or --floaters.min-views",
                stacklevel=2,
            )
            is_kept[:] = True
        return kept_first(model, moments, state, is_kept)


def are_near(means: np.ndarray, views: Sequence[View], near: float) -> np.ndarray:
    """Return [N] whether a point [N, 3] lies within the picture of a view, less than `near` before its camera.

    The picture of a lens that is no pinhole is the smallest rectangle in the image plane that holds all its rays.
    """
    found = np.zeros(len(means), bool)
    for camera in (view.camera for view in views):
        viewmat, K = np.asarray(camera.viewmat, np.float64), np.asarray(camera.K, np.float64)
        x, y, z = viewmat[:3, :3] @ means.T + viewmat[:3, 3:]
        depth = np.where(z > 0, z, np.nan)
        column, row, _ = K @ np.stack([x / depth, y / depth, np.ones_like(z)])
        (left, top), (right, bottom) = _bounds(camera)
        found |= (z < near) & (column >= left) & (column <= right) & (row >= top) & (row <= bottom)
    return found


def _bounds(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest (x, y) of a picture in the image plane of K, in its pixels."""
    if camera.rays is None:
        return np.zeros(2), np.asarray([camera.width, camera.height])
    rays = np.asarray(camera.rays, np.float64).reshape(-1, 2)
    rays = rays[np.isfinite(rays).all(axis=1)]
    return rays.min(axis=0, initial=np.inf), rays.max(axis=0, initial=-np.inf)
