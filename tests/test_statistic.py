"""The statistics that densification is driven by, against the oracle's closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from oracle import DEFAULT_RULES, OFFICIAL, Scene
from scenes_random import CAPACITY, as_camera, as_gaussians, as_settings, as_textures, draw_scene

from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.render import RenderSettings, appearance_of


def statistic(scene: Scene, cotangent: np.ndarray, settings: RenderSettings, which: str) -> np.ndarray:
    """[N, 4] gradient at the probe: the statistic, and the number of pixels composited."""
    gaussians, camera = as_gaussians(scene, "float64"), as_camera(scene, "float64")
    settings = dataclasses.replace(settings, capacity=CAPACITY)
    appearance = appearance_of(gaussians, as_textures(scene, "float64"), settings)

    def loss(probe):
        background = jnp.asarray(scene.background)
        output, _ = render_traced(
            gaussians, camera, appearance, background, settings, has_geometry=False, probe=probe, statistic=which
        )
        return jnp.sum(output.color * jnp.asarray(cotangent))

    return np.asarray(jax.jit(jax.grad(loss))(jnp.zeros((len(scene.means), 4))))


def assert_statistic(seed, rules, settings, which):
    scene = draw_scene(seed)
    cotangent = np.random.default_rng(seed).normal(size=(scene.height, scene.width, 3))
    found = statistic(scene, cotangent, settings, which)
    expected = oracle.gradient_statistic(scene, cotangent, rules, which)
    assert np.count_nonzero(expected) > 20
    np.testing.assert_allclose(found[:, :3], expected, rtol=1e-8, atol=1e-10 * expected.max())
    num_pixels = np.count_nonzero(oracle.render(scene, rules).weights, axis=(1, 2))
    np.testing.assert_array_equal(found[:, 3], num_pixels)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    ("rules", "settings"),
    [
        (DEFAULT_RULES, as_settings()),
        (DEFAULT_RULES, as_settings(compositor="xla")),
        (DEFAULT_RULES, as_settings(compositor="xla", tile_size=16, tile_batch=0)),
        (OFFICIAL, RenderSettings.official()),
    ],
    ids=["native", "xla", "xla, all tiles at once", "official"],
)
@pytest.mark.parametrize("seed", [4, 9])
def test_positional_gradient(seed, rules, settings):
    assert_statistic(seed, rules, settings, "position")


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("compositor", ["native", "xla"])
@pytest.mark.parametrize("which", ["screen", "center"])
def test_other_statistics(which, compositor):
    assert_statistic(4, DEFAULT_RULES, as_settings(compositor=compositor), which)
