"""Several views that devices draw at once: a function of one view under `jax.vmap`, whose devices they share.

All is written for one view. Where the views meet, in `exchange.composite_on_devices`, each of them sees all of them
(`of_all_views`), and takes its own from the result (`of_own_view`). Derivatives are taken around the `jax.vmap`, since
views that share their devices are drawn, and differentiated, together.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

AXIS = "views_at_once"
"""Axis of `jax.vmap` along which the views are that are drawn at once."""


def value_and_grad_of_views(loss: Callable[..., tuple[Array, Any]], num_views: int, axes: Any) -> Callable[..., Any]:
    """Return what `jax.value_and_grad(loss, (0, 1, 2, 3), has_aux=True)` is for one view, for G views at once.

    Results have a leading axis [G, ...], but for the gradient in `appearance`, a mean over the views.

    Args:
      loss: of (gaussians, appearance, rows, probe, view), which returns a scalar and any auxiliary value. `rows` and
        `view` are those of the views [G, ...]; the others are shared.
      num_views: G.
      axes: of the view, for `jax.vmap`.
    """

    def of_views(gaussians: Any, appearance: Any, rows: Any, probe: Any, views: Any) -> tuple[Array, Any]:
        of_each = jax.vmap(loss, in_axes=(0, None, 0, 0, axes), axis_name=AXIS)
        values, aux = of_each(gaussians, appearance, rows, probe, views)
        return jnp.sum(values), (values, aux)

    def differentiated(gaussians: Any, appearance: Any, rows: Any, probe: Any, views: Any) -> Any:
        # Each view has its own copy of what events want the gradient of each view in.
        copy = lambda x: jnp.broadcast_to(x, (num_views, *x.shape))  # noqa: E731
        gaussians, probe = jax.tree.map(copy, (gaussians, probe))
        with_gradients = jax.value_and_grad(of_views, argnums=(0, 1, 2, 3), has_aux=True)
        (_, told), (of_gaussians, sums, *others) = with_gradients(gaussians, appearance, rows, probe, views)
        return told, (of_gaussians, jax.tree.map(lambda x: x / num_views, sums), *others)

    return differentiated


def map_views(function: Callable[[Any], tuple[Any, Any]], views: Any, num_at_once: int) -> tuple[Any, Any]:
    """Return what `jax.lax.map` does, of a function of G views [G, ...] at a time.

    Each of the G groups of devices draws V/G views in a row, whose photographs alone it needs
    (`pictures.sharding_of_batch`).

    Args:
      function: returns results of the views [G, ...], and results that they share.
      views: [V, ...].
      num_at_once: G, which divides V.

    Returns:
      The results of the views [V, ...], and the shared ones [V/G, ...].
    """
    rounds = jax.tree.map(lambda x: x.reshape(num_at_once, -1, *x.shape[1:]).swapaxes(0, 1), views)
    of_views, shared = jax.lax.map(function, rounds)
    of_views = jax.tree.map(lambda x: x.swapaxes(0, 1).reshape(-1, *x.shape[2:]), of_views)
    return of_views, shared


def of_all_views(tree: Any) -> Any:
    """Return the arrays [G, ...] of all views that are drawn at once."""
    return jax.tree.map(lambda x: jax.lax.all_gather(x, AXIS), tree)


def of_own_view(views: Any) -> Any:
    """Return this view's part of arrays [G, ...] of all views."""
    return _own(views, jax.lax.axis_index(AXIS))


@jax.custom_batching.custom_vmap
def _own(views: Any, index: Array) -> Any:
    return jax.tree.map(lambda x: x[index], views)


@_own.def_vmap
def _all(size: int, is_batched: Any, views: Any, index: Array) -> tuple[Any, Any]:
    # Indexing would be a gather, for which XLA may bring all views to every device.
    return views, jax.tree.map(lambda _: True, views)
