"""Pruning of the Gaussians that show least, so that others can use their bytes.

The measure of a Gaussian is the sum of its blending weights w = α·T over the counted pixels of the training views: the
share of its colour in the pictures. Densification leaves many Gaussians that are hidden or too faint to matter. Other
events use statistics of the steps; this one renders, because a weight is no gradient of the loss. `PruneFloaters`
prunes Gaussians that matter in too few training views, or are close to a camera.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.base.checks import check_fields
from a2tg_jax.base.text import counted
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.core.sight import Sight
from a2tg_jax.events import LEAST_LEFT, Change, Due, FractionsEvent, keep_rows
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.scene import View, counted_pixels, views_by_kind


@pytree
class Prune(FractionsEvent):
    """Event that prunes the Gaussians with the smallest blending weights, summed over the training views.

    After Mini-Splatting (Fang and Wang, 2024).

    It uses the cameras of the scene, not refined ones.

    Examples:
      >>> a2tg.Prune(share=0.1, at=(0.25, 0.5)).times(1000)
      (250, 500)
    """

    share: float = 0.1
    """Share of the Gaussians to prune each time, in [0, 1); ignored if `keep` is given. If fewer than 2 would be left,
    none is pruned, with a warning."""
    keep: int | None = static(default=None)
    """Largest number of Gaussians left each time, at least 2."""
    at: tuple[float, ...] = static(default=(1.0,))
    """Fractions of the stage at which Gaussians are pruned; 1: at its end."""

    with_end = True

    def check_options(self) -> None:
        super().check_options()
        check_fields(self, "share", least=0, below=1)
        check_fields(self, "keep", least=LEAST_LEFT)

    def num_after(self, num: int, num_iterations: int) -> int:
        return num if self.keep is None else min(num, self.keep)

    def apply(self, due: Due, model: Model, moments: AdamState, state: object) -> Change:
        num = model.num
        left = num - round(num * float(self.share)) if self.keep is None else min(num, self.keep)
        if left < LEAST_LEFT:
            warn(
                f"nothing is pruned, because {left} of {counted(num, 'Gaussian')} would be left, and training needs "
                f"{LEAST_LEFT}: lower the share"
            )
            left = num
        weights = shown_in(model, due).weights
        is_kept = np.zeros(num, bool)
        is_kept[np.argsort(-weights[:num], kind="stable")[:left]] = True
        return keep_rows(model, moments, state, is_kept)


class Contributions(NamedTuple):
    """Contribution of N Gaussians to some views."""

    weights: np.ndarray
    """[N] Σ α·T over the pixels of all views that count, in pixels."""
    num_views: np.ndarray
    """[N] number of the views in which Σ α·T is large enough."""


def shown_in(model: Model, due: Due, least: float = 1.0) -> Contributions:
    """Return how much each of N Gaussians contributes, and in how many views by at least `least` pixels (host).

    Spare rows show nothing. Of the views, at least one, only cameras and masks are used.
    """
    total = np.zeros(model.num_rows)
    num_views = np.zeros(model.num_rows, np.int64)
    if not len(total):
        return Contributions(total, num_views)
    dtype = model.gaussians.means.dtype
    settings = due.render_settings(model, due.views)
    for alike in views_by_kind(due.views):
        rays = alike[0].camera.rays
        rays = None if rays is None else jnp.asarray(rays, dtype)
        cameras = [dataclasses.replace(view.camera, rays=None) for view in alike]
        stacked: Any = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves), dtype), *cameras)
        pixels = jnp.asarray(counted_pixels(alike), dtype)
        arrays = stacked, rays, pixels, jnp.asarray(least, dtype)
        weights, num = jax.jit(_weights, static_argnums=(5,))(model, *arrays, settings)
        total += np.asarray(weights).astype(np.float64)
        num_views += np.asarray(num)
    return Contributions(total, num_views)


def _weights(
    model: Model, cameras: Camera, rays: Array | None, pixels: Array, least: Array, settings: RenderSettings
) -> tuple[Array, Array]:
    """Return the sums of weights over the counted pixels of views of one size and lens, and the numbers of views with
    at least `least`. An image is linear in features, so the backward pass of ones gives the weights."""
    nothing = jnp.zeros_like(model.gaussians.means)

    def add_view(sums: tuple[Array, Array], view: tuple[Camera, Array]) -> tuple[tuple[Array, Array], None]:
        camera, weight = view
        camera = dataclasses.replace(camera, rays=rays)

        def draw(colors: Array) -> Array:
            # Not `given_colors`, which an appearance may multiply.
            appearance = dataclasses.replace(model.appearance, features=colors)
            output, _ = render_traced(
                model.gaussians, camera, appearance, jnp.zeros_like(colors[0]), settings,
                has_geometry=False, num_live=model.num_live,
            )  # fmt: skip
            return output.color

        color, back = jax.vjp(draw, nothing)
        (weights,) = back(jnp.broadcast_to(weight, color.shape))
        total, num = sums
        # All three channels have the same weights.
        return (total + weights[:, 0], num + (weights[:, 0] >= least).astype(num.dtype)), None

    none = jnp.zeros(len(nothing), jnp.int32)
    sums, _ = jax.lax.scan(add_view, (nothing[:, 0], none), (cameras, pixels))
    return sums


# Floaters


@pytree
class PruneFloaters(FractionsEvent):
    """Event that prunes the Gaussians that show in too few training views, or are close to a camera.

    Each view can learn splats close to its own camera that no other view contradicts. It uses the cameras of the scene,
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

    with_end = True

    def check_options(self) -> None:
        super().check_options()
        if self.min_views:
            check_fields(self, "min_views", least=2)
        check_fields(self, "near", "least", least=0)
        if not self.at:
            raise ValueError("at must hold at least one fraction of the stage; got none")

    def apply(self, due: Due, model: Model, moments: AdamState, state: object) -> Change:
        num = model.num
        is_kept = np.ones(num, bool)
        if self.min_views:
            num_views = shown_in(model, due, self.least).num_views[:num]
            # With fewer training views than that, no Gaussian would be kept.
            is_kept = num_views >= min(self.min_views, len(due.views))
        if self.near:
            is_kept &= ~are_near(np.asarray(model.gaussians.means)[:num], due.views, self.near)
        if is_kept.sum() < LEAST_LEFT:
            warn(
                f"no floaters are pruned, because {is_kept.sum()} of {num:,} Gaussians would be left, and training "
                f"needs {LEAST_LEFT}: lower near or min_views"
            )
            is_kept[:] = True
        return keep_rows(model, moments, state, is_kept)


def are_near(means: np.ndarray, views: Sequence[View], near: float) -> np.ndarray:
    """Return [N] whether a point [3] is within the picture of a view, at a smaller depth than `near`.

    The picture of a lens that is no pinhole is the smallest rectangle in the image plane that holds all its rays.
    """
    is_near = np.zeros(len(means), bool)
    for view in views:
        is_seen, depths = Sight.of_camera(view.camera).seen(means, 0.0)
        is_near |= is_seen & (depths < near)
    return is_near
