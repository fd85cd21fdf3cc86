"""The absolute positional gradient, which chooses what is upscaled, against the oracle's closed form."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from oracle import DEFAULT_RULES, Rules, Scene
from scenes_random import CAPACITY, as_camera, as_gaussians, as_settings, as_textures, draw_scene

from a2tg_jax.render import RenderSettings, appearance_of, render_traced

OFFICIAL = Rules(uv="align-corners", outside="identity", rgb="unit")


def statistic(scene: Scene, cotangent: np.ndarray, settings: RenderSettings) -> np.ndarray:
    """[N, 4] gradient at the tap: Σ_pixels |∂L/∂mean| per component, and the number of pixels composited."""
    gaussians, camera = as_gaussians(scene, "float64"), as_camera(scene, "float64")
    settings = dataclasses.replace(settings, capacity=CAPACITY)
    rule = appearance_of(gaussians, *as_textures(scene, "float64"), settings)

    def loss(tap):
        background = jnp.asarray(scene.background)
        output, _ = render_traced(gaussians, camera, rule, background, settings, has_geometry=False, tap=tap)
        return jnp.sum(output.color * jnp.asarray(cotangent))

    return np.asarray(jax.jit(jax.grad(loss))(jnp.zeros((len(scene.means), 4))))


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
def test_statistic(seed, rules, settings):
    scene = draw_scene(seed)
    cotangent = np.random.default_rng(seed).normal(size=(scene.height, scene.width, 3))
    found = statistic(scene, cotangent, settings)
    expected = oracle.mean_gradient_statistic(scene, cotangent, rules)
    np.testing.assert_allclose(found[:, :3], expected, rtol=1e-8, atol=1e-10 * expected.max())
    num_pixels = np.count_nonzero(oracle.render(scene, rules).weights, axis=(1, 2))
    np.testing.assert_array_equal(found[:, 3], num_pixels)
