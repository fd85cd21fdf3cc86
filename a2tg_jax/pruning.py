"""Pruning: the Gaussians that show least go, so that their bytes are spent where they show.

What a Gaussian shows is the sum of its blending weights w = α·T over all pixels of the training views: how much of the
pictures is its colour. Many that densification leaves are hidden, or too faint to matter.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.appearance import Banded, GivenColors
from a2tg_jax.cameras import Camera
from a2tg_jax.classes import jit
from a2tg_jax.events import Change, Due, HostEvent, event, gather_moments, gather_rows, static
from a2tg_jax.model import Model
from a2tg_jax.optim import AdamState
from a2tg_jax.render import RenderSettings, plan_render, render_traced


@event
class Prune(HostEvent):
    """Removes those Gaussians whose blending weights, summed over the training views, are least."""

    share: float = 0.1
    """Of the Gaussians, removed each time."""
    keep: int | None = static(default=None)
    """How many are left instead."""
    at: tuple[float, ...] = static(default=(1.0,))
    """Fractions of the stage at which it happens; 1: at its end."""

    def iterations(self, num_iterations: int) -> tuple[int, ...]:
        if any(not 0 < fraction <= 1 for fraction in self.at) or list(self.at) != sorted(set(self.at)):
            raise ValueError(f"at must be ascending fractions above 0, up to 1; got {self.at}")
        return tuple(dict.fromkeys(max(1, round(fraction * num_iterations)) for fraction in self.at))

    def num_left(self, num: int, num_iterations: int) -> int:
        return num if self.keep is None else min(num, self.keep)

    def num_programs(self, num_iterations: int) -> int:
        return 1

    def apply(self, due: Due, model: Model, moments: AdamState, state: Any) -> Change:
        if isinstance(model.appearance, Banded):
            raise ValueError("Gaussians that have degrees of their own cannot change rows: prune before they have")
        num = model.num
        left = num - round(num * float(self.share)) if self.keep is None else min(num, self.keep)
        order = np.argsort(-blending_weights(model, due.cameras)[:num], kind="stable")
        rows = np.arange(model.gaussians.num)
        rows[:num] = np.concatenate([np.sort(order[:left]), np.sort(order[left:])])
        moments = gather_moments(model, moments, jnp.asarray(rows))
        model = dataclasses.replace(gather_rows(model, jnp.asarray(rows)), num_live=jnp.asarray(left, jnp.int32))
        return Change(model, moments, state, rows=rows)


def blending_weights(model: Model, cameras: Sequence[Camera]) -> np.ndarray:
    """[N] sum of Σ α·T over the pixels of all views, of each Gaussian; in pixels (host).

    Raises:
      ValueError: if there is no view.
    """
    if not cameras:
        raise ValueError("cameras must hold at least one view; got none")
    dtype = model.gaussians.means.dtype
    settings = plan_render(model.gaussians, cameras, rule=model.rule)
    by_size: dict[tuple[int, int], list[Camera]] = {}
    for camera in cameras:
        by_size.setdefault((camera.width, camera.height), []).append(camera)
    total = np.zeros(model.gaussians.num)
    for own in by_size.values():
        stacked: Any = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf, dtype) for leaf in leaves]), *own)
        total += np.asarray(_jitted()(model, stacked, settings), np.float64)
    return total


@functools.cache
def _jitted() -> jit:
    return jit(_weights, static_argnums=(2,))


def _weights(model: Model, cameras: Camera, settings: RenderSettings) -> Array:
    """The sums over views of one size: a picture is linear in the colours, and this is the backward pass of ones."""
    nothing = jnp.zeros_like(model.gaussians.means)

    def of_view(total: Array, camera: Camera) -> tuple[Array, None]:
        def draw(colors: Array) -> Array:
            rule = GivenColors(model.rule, colors)
            output, _ = render_traced(
                model.gaussians, camera, rule, jnp.zeros_like(colors[0]), settings,
                has_geometry=False, num_live=model.num_live,
            )  # fmt: skip
            return output.color

        color, back = jax.vjp(draw, nothing)
        (weights,) = back(jnp.ones_like(color))
        return total + weights[:, 0], None

    return jax.lax.scan(of_view, nothing[:, 0], cameras)[0]
