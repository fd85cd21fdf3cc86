"""Pruning of the Gaussians that show least, so that others can use their bytes.

The measure of a Gaussian is the sum of its blending weights w = α·T over the counted pixels of the training views: the
share of its colour in the pictures. Densification leaves many Gaussians that are hidden or too faint to matter. Other
events use statistics of the steps; this one renders, because a weight is no gradient of the loss.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import GivenColors
from a2tg_jax.core.cameras import Camera
from a2tg_jax.core.jit import Jitted
from a2tg_jax.core.optim import AdamState
from a2tg_jax.data import View, counted_pixels, views_by_kind
from a2tg_jax.events import Change, Due, FieldError, HostEvent, event, gather_moments, gather_rows, static
from a2tg_jax.host.text import shortened
from a2tg_jax.model import Model
from a2tg_jax.render import RenderSettings, render_traced
from a2tg_jax.renderer import plan_render


@event
class Prune(HostEvent):
    """Event that prunes the Gaussians with the smallest blending weights, summed over the training views.

    It uses the cameras of the scene, not refined ones.
    """

    share: float = 0.1
    """Share of the Gaussians removed each time, in [0, 1); ignored if `keep` is given."""
    keep: int | None = static(default=None)
    """Largest number of Gaussians left each time."""
    at: tuple[float, ...] = static(default=(1.0,))
    """Fractions of the stage at which Gaussians are pruned; 1: at its end."""

    def iterations(self, num_iterations: int) -> tuple[int, ...]:
        if any(not 0 < fraction <= 1 for fraction in self.at) or list(self.at) != sorted(set(self.at)):
            raise FieldError(self, f"{{at}} must be ascending fractions above 0, up to 1; got {shortened(self.at)}")
        return tuple(dict.fromkeys(max(1, round(fraction * num_iterations)) for fraction in self.at))

    def num_after(self, num: int, num_iterations: int) -> int:
        return num if self.keep is None else min(num, self.keep)

    def num_programs(self, num_iterations: int) -> int:
        return 2  # Rows keep their number; tile lists grow with the Gaussians.

    def apply(self, due: Due, model: Model, moments: AdamState, state: Any) -> Change:
        if model.appearance.has_degrees:
            raise ValueError("Gaussians that have degrees of their own cannot change rows: prune before they have")
        num, left = model.num, self._num_left(model.num)
        order = np.argsort(-blending_weights(model, due.views)[:num], kind="stable")
        rows = np.arange(model.gaussians.num)
        rows[:num] = np.concatenate([np.sort(order[:left]), np.sort(order[left:])])
        moments = gather_moments(model, moments, jnp.asarray(rows))
        model = dataclasses.replace(gather_rows(model, jnp.asarray(rows)), num_live=jnp.asarray(left, jnp.int32))
        return Change(model, moments, state, rows=rows)

    def _num_left(self, num: int) -> int:
        if self.keep is not None:
            if self.keep < 1:
                raise FieldError(self, f"{{keep}} must be at least 1 Gaussian; got {self.keep}")
            return min(num, self.keep)
        if not 0 <= self.share < 1:
            raise FieldError(self, f"{{share}} must lie in [0, 1); got {self.share}")
        return num - round(num * float(self.share))


def blending_weights(model: Model, views: Sequence[View]) -> np.ndarray:
    """Return [N] Σ α·T of each Gaussian over the pixels of all views that count, in pixels (host).

    Args:
      model: N rows; spare rows have weight 0.
      views: at least one; only their cameras and masks are used.

    Raises:
      ValueError: if there is no view.
    """
    if not views:
        raise ValueError("views must hold at least one view; got none")
    total = np.zeros(model.gaussians.num)
    if not len(total):
        return total
    settings = plan_render(model, [view.camera for view in views])
    # Programs are compiled for a capacity: for few of them.
    settings = dataclasses.replace(settings, capacity=1 << (settings.capacity or 1).bit_length())
    dtype = model.gaussians.means.dtype
    for own in views_by_kind(views):
        rays = own[0].camera.rays
        rays = None if rays is None else jnp.asarray(rays, dtype)
        cameras = [dataclasses.replace(view.camera, rays=None) for view in own]
        stacked: Any = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves), dtype), *cameras)
        counted = jnp.asarray(counted_pixels(own), dtype)
        total += np.asarray(_jitted()(model, stacked, rays, counted, settings), np.float64)
    return total


@functools.cache
def _jitted() -> Jitted[..., Array]:
    return Jitted(_weights, static_argnums=(4,))


def _weights(model: Model, cameras: Camera, rays: Array | None, counted: Array, settings: RenderSettings) -> Array:
    """Return the sums over views of one size and lens. A picture is linear in the colours: this is a backward pass of
    ones."""
    nothing = jnp.zeros_like(model.gaussians.means)

    def of_view(total: Array, view: tuple[Camera, Array]) -> tuple[Array, None]:
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
        return total + weights[:, 0], None

    return jax.lax.scan(of_view, nothing[:, 0], (cameras, counted))[0]
