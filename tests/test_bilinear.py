"""Bilinear interpolation against scipy, its slopes against differences, and its edges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from a2tg_jax import TextureRegion
from a2tg_jax.core.bilinear import corners_of, follow, interpolate

SIZES = [(1, 1), (1, 8), (8, 2), (5, 3), (16, 16)]
FIRST = 7


def sample(texels: np.ndarray, x, y):
    """The sample of one channel of an image [h, w] within a table of others."""
    height, width = texels.shape
    table = jnp.concatenate([jnp.full(FIRST, 1e6), jnp.asarray(texels).reshape(-1), jnp.full(50, 1e6)])
    found = corners_of(
        TextureRegion(jnp.int32(FIRST), jnp.int32(height), jnp.int32(width)), jnp.asarray(x), jnp.asarray(y)
    )
    return interpolate(found, tuple((table[corner.texel],) for corner in found))


def draw(size: tuple[int, int], count: int = 200):
    rng = np.random.default_rng(sum(size))
    height, width = size
    return rng.normal(size=size), rng.uniform(0, width - 1, count), rng.uniform(0, height - 1, count)


@pytest.mark.parametrize("size", SIZES)
def test_values_are_those_of_scipy_and_slopes_are_differences(x64, size):
    texels, x, y = draw(size)
    found = sample(texels, x, y)
    eps = 1e-7
    np.testing.assert_allclose(found.values[0], map_coordinates(texels, [y, x], order=1), atol=1e-12)
    ends = np.float64([0, size[1] - 1]), np.float64([0, size[0] - 1])
    at_ends = map_coordinates(texels, ends[::-1], order=1)
    np.testing.assert_allclose(sample(texels, *ends).values[0], at_ends, atol=1e-12)
    for slope, dx, dy in ((found.slope_x, eps, 0), (found.slope_y, 0, eps)):
        ahead, back = (map_coordinates(texels, [y + s * dy, x + s * dx], order=1, mode="nearest") for s in (1, -1))
        np.testing.assert_allclose(slope[0], (ahead - back) / (2 * eps), atol=1e-6)


def test_slopes_at_texels_are_those_ahead_and_zero_at_the_end(x64):
    texels = np.array([[1.0, 4.0, 2.0]])
    (slope,) = sample(texels, np.array([0.0, 1.0, 2.0]), np.zeros(3)).slope_x
    np.testing.assert_array_equal(slope, [3.0, -2.0, 0.0])


def test_nothing_outside_of_the_image_is_read():
    texels = np.ones((2, 3), np.float32)
    x = np.float32([-5, 9, np.nan, np.inf])
    found = corners_of(
        TextureRegion(jnp.int32(FIRST), jnp.int32(2), jnp.int32(3)), jnp.asarray(x), jnp.asarray(x[::-1])
    )
    for corner in found:
        assert corner.texel.min() >= FIRST and corner.texel.max() < FIRST + texels.size


def test_following_a_sample_gives_its_slopes(x64):
    texels, x, y = draw((5, 3), 1)
    found = sample(texels, x, y)
    value, (along_x, along_y) = jax.value_and_grad(lambda x, y: follow(found, x, y)[0][0], argnums=(0, 1))(x, y)
    assert value == found.values[0][0]
    assert along_x[0] == found.slope_x[0][0] and along_y[0] == found.slope_y[0][0]
