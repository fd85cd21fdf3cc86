"""A splat with a number that is not finite is seen in the picture; one that shows nowhere does no harm."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_camera, as_gaussians, as_textures, draw_scene

from a2tg_jax import Appearance, RenderSettings, render_image
from a2tg_jax.rasterize.views import render_traced

COMPOSITORS = ("native", "xla", "cuda")
SCENE = draw_scene(4, num=16, width=19, height=13)
VISIBLE = 1
"""A splat of the scene that shows."""


def with_number(gaussians, field: str, row: int, number: float):
    array = getattr(gaussians, field)
    flat = array.reshape(len(array), -1).at[row, 0].set(number)
    return dataclasses.replace(gaussians, **{field: flat.reshape(array.shape)})


@pytest.mark.parametrize("compositor", ["native", "xla"])
@pytest.mark.parametrize("field", ["means", "quats", "log_scales", "logit_opacities", "sh"])
def test_a_splat_that_is_not_a_number_does_not_vanish(field, compositor):
    gaussians, camera = as_gaussians(SCENE, "float32"), as_camera(SCENE, "float32")
    settings = RenderSettings(compositor=compositor, capacity=1024)

    def loss(gaussians):
        output = render_image(gaussians, camera, settings=settings)
        return jnp.sum(output.color**2), output

    broken = with_number(gaussians, field, VISIBLE, np.nan)
    (_, output), gradient = jax.value_and_grad(loss, has_aux=True)(broken)
    assert jnp.isnan(output.color).all() and jnp.isnan(output.alpha).all() and jnp.isnan(output.depth).all()
    assert jnp.isnan(gradient.logit_opacities).any()
    assert not output.overflow


@pytest.mark.parametrize("compositor", ["native", "xla"])
@pytest.mark.parametrize("row", [0])
def test_what_shows_nowhere_may_hold_anything(row, compositor):
    """Behind the camera, too faint, or beyond the live rows."""
    gaussians, camera = as_gaussians(SCENE, "float32"), as_camera(SCENE, "float32")
    settings = RenderSettings(compositor=compositor, capacity=1024)
    hidden = with_number(gaussians, "logit_opacities", row, -20.0)
    expected = render_image(hidden, camera, settings=settings).color
    found = render_image(with_number(hidden, "sh", row, np.nan), camera, settings=settings).color
    np.testing.assert_array_equal(found, expected)

    live, plain = 8, Appearance()
    show = lambda gaussians: render_traced(gaussians, camera, plain, jnp.zeros(3), settings, num_live=live)[0].color  # noqa: E731
    np.testing.assert_array_equal(show(with_number(gaussians, "means", live + row, np.nan)), show(gaussians))


@pytest.mark.parametrize("compositor", COMPOSITORS)
@pytest.mark.parametrize("column", [0, 3])
def test_a_texel_that_is_not_a_number_is_seen(column, compositor):
    gaussians, camera = as_gaussians(SCENE, "float32"), as_camera(SCENE, "float32")
    textures = as_textures(SCENE, "float32")
    settings = RenderSettings(compositor=compositor, capacity=1024)
    broken = dataclasses.replace(textures, buckets=tuple(b.at[..., column].set(jnp.nan) for b in textures.buckets))
    shown = render_image(gaussians, camera, textures, settings=settings).alpha > 0.05
    color = render_image(gaussians, camera, broken, settings=settings).color
    assert shown.any() and jnp.isnan(color[..., 0])[shown].all()
