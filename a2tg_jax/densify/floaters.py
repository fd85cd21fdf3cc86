"""Pruning of floaters: Gaussians that matter in too few training views, or that hang close before a camera."""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.checks import check_number
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.data import View
from a2tg_jax.densify.pruning import shown_in
from a2tg_jax.events import LEAST_LEFT, Change, Due, HostEvent, iterations_at, keep_rows
from a2tg_jax.model import Model
from a2tg_jax.parallel.rows import on_host


@pytree
class PruneFloaters(HostEvent):
    """Event that prunes the Gaussians that show in fewer training views than asked for, or stand close before one.

    Each view can hang splats before its own camera that no other view contradicts. It uses the cameras of the scene,
    not refined ones.
    """

    min_views: int = static(default=2)
    """Least number of training views in which a Gaussian must show, at least 2; others are pruned. 0: off."""
    near: float = static(default=0.0)
    """Least depth of a Gaussian before each camera that sees it, in units of the normalised world, in which cameras are
    about 1 from what they see, such as 0.2. 0: off."""
    least: float = static(default=1.0)
    """Least Σ α·T, in pixels, with which a Gaussian counts as shown in a view."""
    at: tuple[float, ...] = static(default=(0.4, 0.6, 0.8))
    """Fractions of the stage at which Gaussians are pruned; 1: at its end. In a system, those after the last growth are
    left out."""

    def check_options(self) -> None:
        if self.min_views:
            check_number("min_views", self.min_views, least=2)
        check_number("near", self.near, least=0)
        check_number("least", self.least, least=0)
        if not self.at:
            raise ValueError("at must hold at least one fraction of the stage; got none")
        self.iterations(1)

    def iterations(self, num_iterations: int) -> tuple[int, ...]:
        return iterations_at(self.at, num_iterations, with_end=True)

    def num_programs(self, num_iterations: int) -> int:
        return 2  # Rows keep their number; tile lists grow with the Gaussians.

    def apply(self, due: Due, model: Model, moments: AdamState, state: Any) -> Change:
        num, means = model.num, on_host(model.gaussians.means)[: model.num]
        is_kept = np.ones(num, bool)
        if self.min_views:
            num_views = shown_in(model, due.views, self.least).num_views[:num]
            is_kept = num_views >= min(self.min_views, len(due.views))
        if self.near:
            is_kept &= ~are_near(means, due.views, self.near)
        if is_kept.sum() < LEAST_LEFT:
            warnings.warn(
                f"no floaters are pruned, for {is_kept.sum()} of {num:,} Gaussians would be left, and training needs "
                f"{LEAST_LEFT}: lower near or min_views",
                stacklevel=2,
            )
            is_kept[:] = True
        return keep_rows(model, moments, state, is_kept)


def are_near(means: np.ndarray, views: Sequence[View], near: float) -> np.ndarray:
    """Return [N] whether a point lies within the picture of a view, at a smaller depth than `near`.

    The picture of a lens that is no pinhole is the smallest rectangle in the image plane that holds all its rays.

    Args:
      means: [N, 3] points.
      views: V views.
      near: limit of the depth.
    """
    found = np.zeros(len(means), bool)
    for view in views:
        found |= depths_in_picture(means, view.camera) < near
    return found


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
