"""Several views at once have the values and gradients of one view after the other. `on_devices` draws with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from a2tg_jax.parallel.exchange import map_views, of_all_views, of_own_view, value_and_grad_of_views


def drawn_together(x):
    """What a view shows, computed for all views at once: each of them twice its own."""
    return of_own_view(2 * of_all_views(x))


def loss_of(draw):
    def loss(gaussians, params, rows, probe, view):
        shown = draw(gaussians * params + rows[None]) + probe
        return jnp.sum(view[:, None] * shown**2), shown[0]

    return loss


@pytest.mark.parametrize("num_at_once", [2, 4])
def test_views_at_once_are_those_of_one_after_the_other(num_at_once):
    rng = np.random.default_rng(0)
    gaussians, params, probe = jnp.asarray(rng.normal(size=(5, 3))), jnp.asarray(0.7), jnp.zeros((5, 3))
    rows, views = jnp.asarray(rng.normal(size=(4, 3))), jnp.asarray(rng.normal(size=(4, 5)))

    def one(arrays):
        derivative = jax.value_and_grad(loss_of(lambda x: 2 * x), argnums=(0, 1, 2, 3), has_aux=True)
        told, (by_gaussians, by_params, *others) = derivative(gaussians, params, arrays[0], probe, arrays[1])
        return (told, by_gaussians, others), by_params

    def together(arrays):
        derivative = value_and_grad_of_views(loss_of(drawn_together), num_at_once, 0)
        told, (by_gaussians, by_params, *others) = derivative(gaussians, params, arrays[0], probe, arrays[1])
        return (told, by_gaussians, others), by_params

    expected, by_params = jax.lax.map(one, (rows, views))
    found, means = jax.jit(lambda arrays: map_views(together, arrays, num_at_once))((rows, views))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(b, a, rtol=1e-5), expected, found)
    np.testing.assert_allclose(jnp.mean(means), jnp.mean(by_params), rtol=1e-5)
