"""Pruning of floaters: Gaussians that matter in too few training views, or that hang close before a camera."""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.core.spread_arrays import on_host
from a2tg_jax.data import View
from a2tg_jax.densify.pruning import pruning_times, shown_in
from a2tg_jax.events import LEAST_LEFT, Change, Due, FieldError, HostEvent, keep_rows
from a2tg_jax.model import Model

NEAREST = 0.02
"""Quantile of the depths in a picture that counts as the nearest."""
SURE_VIEWS = 3
"""Number of training views in which a Gaussian must show to count as a part of the scene."""


@pytree
class PruneFloaters(HostEvent):
    """Event that prunes the Gaussians that show in fewer training views than asked for, or stand close before one.

    Each view can hang splats before its own camera that no other view contradicts. It uses the cameras of the scene,
    not refined ones.
    """

    min_views: int = static(default=2)
    """Least number of views in which a Gaussian must show, by Σ α·T of `least`, at least 2; 0: none."""
    near: float = static(default=0.0)
    """Least depth before every camera that sees it, in units of the normalised world; 0: none."""
    near_share: float = static(default=0.0, is_addition=True)
    """The same as a share of the depth of what stands nearest in its picture (`nearest_depths`), below 1; 0: none."""
    least: float = static(default=1.0)
    """Least Σ α·T in a view, in pixels."""
    at: tuple[float, ...] = static(default=(0.4, 0.6, 0.8))
    """Fractions of the stage at which Gaussians are pruned; 1: at its end."""

    reads_whole = False

    def iterations(self, num_iterations: int) -> tuple[int, ...]:
        if self.min_views < 0 or self.min_views == 1:
            raise FieldError(self, f"{{min_views}} must be at least 2 views, or 0 for off; got {self.min_views}")
        if self.near < 0:
            raise FieldError(self, f"{{near}} must be at least 0; got {self.near}")
        if not 0 <= self.near_share < 1:
            raise FieldError(self, f"{{near_share}} must lie in [0, 1); got {self.near_share}")
        if not self.at:
            raise FieldError(self, "{at} must hold at least one fraction of the stage; got none")
        return pruning_times(self, self.at, num_iterations)

    def num_programs(self, num_iterations: int) -> int:
        return 2  # Rows keep their number; tile lists grow with the Gaussians.

    def apply(self, due: Due, model: Model, moments: AdamState, state: Any) -> Change:
        num, means = model.num, on_host(model.gaussians.means)[: model.num]
        is_kept, limits, most = np.ones(num, bool), np.full(len(due.views), self.near), len(due.views)
        if self.min_views or self.near_share:
            num_views = due.agreed(shown_in(model, due.views, self.least).num_views)[:num]
            is_kept = num_views >= min(self.min_views, most)
        if self.near_share:
            nearest = nearest_depths(means[num_views >= min(SURE_VIEWS, most)], due.views)
            limits = np.maximum(limits, self.near_share * nearest)
        if self.near or self.near_share:
            is_kept &= ~are_near(means, due.views, limits)
        if is_kept.sum() < LEAST_LEFT:
            warnings.warn(
                f"no floaters are pruned, for {is_kept.sum()} of {num:,} Gaussians would be left, and training needs "
                f"{LEAST_LEFT}: lower --floaters.near, --floaters.near-share or --floaters.min-views",
                stacklevel=2,
            )
            is_kept[:] = True
        return keep_rows(model, moments, state, is_kept)


def are_near(means: np.ndarray, views: Sequence[View], near: np.ndarray) -> np.ndarray:
    """Return [N] whether a point lies within the picture of a view, at a smaller depth than its limit.

    The picture of a lens that is no pinhole is the smallest rectangle in the image plane that holds all its rays.

    Args:
      means: [N, 3] points.
      views: V views.
      near: [V] limits of the depth.
    """
    found = np.zeros(len(means), bool)
    for view, limit in zip(views, near, strict=True):
        found |= depths_in_picture(means, view.camera) < limit
    return found


def nearest_depths(means: np.ndarray, views: Sequence[View]) -> np.ndarray:
    """Return [V] the depth in each picture that 2 % of the points there are nearer than; 0 without points.

    Args:
      means: [N, 3] points of the scene, a few of which may be floaters.
      views: V views.
    """
    found = [depths[np.isfinite(depths)] for depths in (depths_in_picture(means, view.camera) for view in views)]
    return np.asarray([np.quantile(depths, NEAREST) if len(depths) else 0.0 for depths in found])


def depths_in_picture(means: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the depths [N] before a camera of the points [N, 3] in its picture; infinity of the others."""
    viewmat, K = np.asarray(camera.viewmat, np.float64), np.asarray(camera.K, np.float64)
    x, y, z = viewmat[:3, :3] @ means.T + viewmat[:3, 3:]
    depth = np.where(z > 0, z, np.nan)
    column, row, _ = K @ np.stack([x / depth, y / depth, np.ones_like(z)])
    (left, top), (right, bottom) = _bounds(camera)
    is_inside = (column >= left) & (column <= right) & (row >= top) & (row <= bottom)
    return np.where(is_inside, z, np.inf)


def _bounds(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest (x, y) of a picture in the image plane of K, in its pixels."""
    if camera.rays is None:
        return np.zeros(2), np.asarray([camera.width, camera.height])
    rays = np.asarray(camera.rays, np.float64).reshape(-1, 2)
    rays = rays[np.isfinite(rays).all(axis=1)]
    return rays.min(axis=0, initial=np.inf), rays.max(axis=0, initial=-np.inf)
