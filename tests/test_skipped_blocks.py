"""Native loops skip blocks of pixels that a splat does not touch: splats that end exactly at a block's first pixel."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from a2tg_jax import (
    Appearance,
    Camera,
    Exponents,
    Gaussians,
    RenderSettings,
    Texture,
    render_appearance,
    textures_from_arrays,
)
from a2tg_jax.appearance.parts import curves_of, falloff_of

CELL = 32
"""Side in pixels of the part of the image that one splat has for itself."""
CELLS = 8
FOCAL = 100.0
LEAST = 1 / 255


def splats_that_end_at(pixels, excess, kind):
    """Splats upper left of pixel centres [N, 2], where alpha is 1/255·(1 + excess), and their appearance."""
    rng = np.random.default_rng(0)
    num = len(pixels)
    away = rng.uniform(0.3, 1.0, (num, 2)) * rng.uniform(1, 12, (num, 1))
    # Of equal size along both axes: no other pixel of the block is as near. Larger than the low-pass filter.
    size = np.linalg.norm(away, axis=1) / rng.uniform(1.0, 2.5, num)
    size = np.maximum(size, 1.0)
    rho = np.sum(away**2, axis=1) / size**2
    depth = rng.uniform(1, 5, num)
    mean = (pixels - away - CELL * CELLS / 2) * depth[:, None] / FOCAL
    shapes = jnp.asarray(rng.uniform(-1, 0.3, num), jnp.float32)
    falloff = np.exp(-0.5 * rho)
    appearance = Appearance()
    if kind == "shaped":
        appearance = Appearance(exponents=Exponents(shapes))
        falloff = np.asarray(falloff_of(curves_of(shapes), jnp.asarray(rho, jnp.float32)))
    if kind == "textured":
        texel = np.asarray([0.1, -0.1, 0.2, 0.5], np.float32)
        sizes = [(1, 1), (2, 1), (4, 4), (5, 7)]
        textures = [np.broadcast_to(texel, (*sizes[k % 4], 4)) for k in range(num)]
        appearance = Appearance(texture=Texture(textures_from_arrays(textures)))
        falloff = 0.5 * falloff
    opacity = LEAST * (1 + excess) / falloff
    assert opacity.max() < 0.9
    gaussians = Gaussians(
        means=jnp.asarray(np.concatenate([mean, depth[:, None]], axis=1), jnp.float32),
        quats=jnp.tile(jnp.asarray([1.0, 0.0, 0.0, 0.0]), (num, 1)),
        log_scales=jnp.asarray(np.log(size * depth / FOCAL)[:, None].repeat(2, axis=1), jnp.float32),
        logit_opacities=jnp.asarray(np.log(opacity / (1 - opacity)), jnp.float32),
        sh=jnp.zeros((num, 1, 3)),
    )
    return gaussians, appearance


@pytest.mark.parametrize(("kind", "tile_size"), [("plain", 16), ("shaped", 8), ("textured", 16), ("plain", 10)])
def test_a_splat_shows_at_the_last_pixel_that_it_reaches(kind, tile_size):
    """And it has a gradient there; a little less opaque, it shows nothing."""
    corners = np.stack(np.meshgrid(np.arange(CELLS), np.arange(CELLS)), axis=-1).reshape(-1, 2) * CELL
    # Corners of blocks of 4×4, 2×4 and 2×2 pixels, within and at the border of tiles.
    places = corners + np.random.default_rng(1).choice([16, 20, 24], corners.shape)
    side = CELL * CELLS
    camera = Camera(jnp.eye(4), jnp.asarray([[FOCAL, 0, side / 2], [0, FOCAL, side / 2], [0, 0, 1]]), side, side)
    settings = RenderSettings(tile_size=tile_size, capacity=8192, compositor="native")

    @jax.jit
    def alphas(logit_opacities, gaussians, appearance):
        shown = dataclasses.replace(gaussians, logit_opacities=logit_opacities)
        alpha = render_appearance(shown, camera, appearance, settings=settings).alpha
        return alpha[places[:, 1], places[:, 0]]

    gaussians, appearance = splats_that_end_at(places + 0.5, 1e-3, kind)
    found, pull_back = jax.vjp(lambda x: alphas(x, gaussians, appearance), gaussians.logit_opacities)
    np.testing.assert_allclose(found, LEAST * 1.001, rtol=2e-4)
    np.testing.assert_allclose(pull_back(jnp.ones_like(found))[0], found * (1 - gaussians.opacities), rtol=1e-3)
    gaussians, appearance = splats_that_end_at(places + 0.5, -1e-3, kind)
    np.testing.assert_array_equal(alphas(gaussians.logit_opacities, gaussians, appearance), 0)
