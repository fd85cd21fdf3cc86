"""Pruning of the Gaussians that show least, so that others can use their bytes.

The measure of a Gaussian is the sum of its blending weights w = α·T over the counted pixels of the training views: the
share of its colour in the pictures. Densification leaves many Gaussians that are hidden or too faint to matter. Other
events use statistics of the steps; this one renders, because a weight is no gradient of the loss.
"""

import dataclasses
import functools
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import GivenColors
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.display import counted
from a2tg_jax.core.optim import AdamState
from a2tg_jax.core.pytree import pytree, static
from a2tg_jax.core.spread_arrays import on_host
from a2tg_jax.data import View, counted_pixels, views_by_kind
from a2tg_jax.events import LEAST_LEFT, Change, Due, FieldError, HostEvent, Times, keep_rows
from a2tg_jax.host.text import shortened
from a2tg_jax.model import Model
from a2tg_jax.rasterize.capacity import room_of_view
from a2tg_jax.rasterize.exchange import exchange_of, spread
from a2tg_jax.rasterize.placement import everywhere
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.renderer import plan_render


@pytree
class Prune(HostEvent):
    """Event that prunes the Gaussians with the smallest blending weights, summed over the training views.

    It uses the cameras of the scene, not refined ones.
    """

    share: float = 0.1
    """Share of the Gaussians removed each time, in [0, 1); ignored if `keep` is given. If fewer than 2 would be left,
    none is removed, with a warning."""
    keep: int | None = static(default=None)
    """Largest number of Gaussians left each time, at least 2."""
    at: tuple[float, ...] = static(default=(1.0,))
    """Fractions of the stage at which Gaussians are pruned; 1: at its end."""

    reads_whole = False

    def iterations(self, num_iterations: int) -> tuple[int, ...]:
        if self.keep is not None and self.keep < LEAST_LEFT:
            raise FieldError(self, f"{{keep}} must be at least {LEAST_LEFT} Gaussians; got {self.keep}")
        if self.keep is None and not 0 <= self.share < 1:
            raise FieldError(self, f"{{share}} must lie in [0, 1); got {self.share}")
        return pruning_times(self, self.at, num_iterations)

    def num_after(self, num: int, num_iterations: int) -> int:
        return num if self.keep is None else min(num, self.keep)

    def num_programs(self, num_iterations: int) -> int:
        return 2  # Rows keep their number; tile lists grow with the Gaussians.

    def apply(self, due: Due, model: Model, moments: AdamState, state: Any) -> Change:
        num, left = model.num, self._num_left(model.num)
        weights = due.agreed(blending_weights(model, due.views))
        is_kept = np.zeros(num, bool)
        is_kept[np.argsort(-weights[:num], kind="stable")[:left]] = True
        return keep_rows(model, moments, state, is_kept)

    def _num_left(self, num: int) -> int:
        if self.keep is not None:
            return min(num, self.keep)
        left = num - round(num * float(self.share))
        if left >= LEAST_LEFT:
            return left
        warnings.warn(
            f"nothing is pruned, for {left} of {counted(num, 'Gaussian')} would be left, and training needs "
            f"{LEAST_LEFT}: lower --prune.share",
            stacklevel=3,
        )
        return num


def pruning_times(of: HostEvent, at: tuple[float, ...], num_iterations: int) -> tuple[int, ...]:
    """Return the iterations at fractions of a stage, its end included.

    Raises:
      FieldError: if the fractions, the event's field `at`, are not ascending or not in (0, 1].
    """
    if any(not 0 < fraction <= 1 for fraction in at) or list(at) != sorted(set(at)):
        raise FieldError(of, f"{{at}} must be ascending fractions above 0, up to 1; got {shortened(at)}")
    return tuple(dict.fromkeys(max(1, round(fraction * num_iterations)) for fraction in at))


def during_growth(at: tuple[float, ...], num_iterations: int, growth: Times) -> tuple[float, ...]:
    """Return the fractions of a stage before its last growth, so that others grow in the place of what is pruned."""
    return tuple(fraction for fraction in at if round(fraction * num_iterations) < growth.last_time)


class Shown(NamedTuple):
    """Contribution of N Gaussians to some views."""

    weights: np.ndarray
    """[N] Σ α·T over the pixels of all views that count, in pixels."""
    num_views: np.ndarray
    """[N] number of the views in which Σ α·T is large enough."""


def blending_weights(model: Model, views: Sequence[View]) -> np.ndarray:
    """Return [N] Σ α·T of each Gaussian over the pixels of all views that count, in pixels (host).

    Args:
      model: N rows; spare rows have weight 0.
      views: at least one; only their cameras and masks are used.

    Raises:
      ValueError: if there is no view.
    """
    return shown_in(model, views).weights


def shown_in(model: Model, views: Sequence[View], least: float = 1.0) -> Shown:
    """Return how much each Gaussian shows, and in how many views it shows as much as `least` pixels (host).

    The devices over which the model's rows are spread draw each view together. If they are of several processes, all
    of these call it; their numbers may differ by rounding (`Due.agreed`).

    Args, Raises: as of `blending_weights`.
    """
    if not views:
        raise ValueError("views must hold at least one view; got none")
    total, num_views = np.zeros(model.gaussians.num), np.zeros(model.gaussians.num, np.int64)
    if not len(total):
        return Shown(total, num_views)
    settings, dtype = _planned(model, [view.camera for view in views]), model.gaussians.means.dtype
    for own in views_by_kind(views):
        rays = own[0].camera.rays
        rays = None if rays is None else jnp.asarray(rays, dtype)
        cameras = [dataclasses.replace(view.camera, rays=None) for view in own]
        stacked: Any = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves), dtype), *cameras)
        counted = jnp.asarray(counted_pixels(own), dtype)
        arrays: Any = stacked, rays, counted, jnp.asarray(least, dtype)
        if settings.exchange is not None:
            arrays = jax.tree.map(functools.partial(everywhere, settings.exchange), arrays)
        weights, num = _jitted()(model, *arrays, settings)
        total += on_host(weights).astype(np.float64)
        num_views += on_host(num)
    return Shown(total, num_views)


def _planned(model: Model, cameras: Sequence[Camera]) -> RenderSettings:
    """Return settings with room for all cameras, rounded up, because programs are compiled for a room: for few of
    them."""
    settings, rule = RenderSettings(exchange=exchange_of(model.gaussians.means)), model.rule
    if settings.exchange is None:
        capacity = plan_render(model, cameras, settings=settings).capacity
        return dataclasses.replace(settings, capacity=_rounded_up(capacity or 1))
    rooms = [room_of_view(model.gaussians, camera, rule, settings, model.num_live) for camera in cameras]
    capacity = _rounded_up(max(room.pairs for room in rooms))
    rows_per_pair = _rounded_up(max(room.rows for room in rooms)) / capacity
    exchange = dataclasses.replace(settings.exchange, rows_per_pair=rows_per_pair)
    return dataclasses.replace(settings, capacity=capacity, exchange=exchange)


def _rounded_up(number: int) -> int:
    """Return the next power of two above a number."""
    return 1 << number.bit_length()


@functools.cache
def _jitted() -> jax.stages.Wrapped:
    return jax.jit(_weights, static_argnums=(5,))


def _weights(
    model: Model, cameras: Camera, rays: Array | None, counted: Array, least: Array, settings: RenderSettings
) -> tuple[Array, Array]:
    """Return the sums over views of one size and lens, and the numbers of views with at least so much. A picture is
    linear in the colours, so this is a backward pass of ones."""
    nothing = jnp.zeros_like(model.gaussians.means)

    def of_view(found: tuple[Array, Array], view: tuple[Camera, Array]) -> tuple[tuple[Array, Array], None]:
        camera, weight = view
        camera = dataclasses.replace(camera, rays=rays)

        def draw(colors: Array) -> Array:
            rule = GivenColors(model.rule, colors)
            output, _ = render_traced(
                model.gaussians, camera, rule, jnp.zeros_like(colors[0]), settings,
                has_geometry=False, num_live=model.num_live,
            )  # fmt: skip
            return output.color

        color, back = jax.vjp(draw, nothing)
        (weights,) = back(jnp.broadcast_to(weight, color.shape))
        total, num = found
        return (total + weights[:, 0], num + (weights[:, 0] >= least).astype(num.dtype)), None

    none = jnp.zeros(len(nothing), jnp.int32)
    found, _ = jax.lax.scan(of_view, (nothing[:, 0], none), (cameras, counted))
    shown: tuple[Array, Array] = spread(settings.exchange, found)
    return shown
