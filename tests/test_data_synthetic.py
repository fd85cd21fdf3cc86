"""The built-in scene: its geometry agrees with its images, and it is made quickly and reproducibly."""

import numpy as np
import pytest

from a2tg_jax.data.ray_tracing import Ball, Block, Disc, Tube
from a2tg_jax.data.scene import view_image
from a2tg_jax.data.synthetic import _lit_surfaces, synthetic_scene

SHAPES = [
    Disc((0.1, 0.2, 0.3), 1.5),
    Tube((0.1, 0.2, 0.3), 0.5, 0.8),
    Tube((0.1, 0.2, 0.3), 0.5, 0.8, is_inward=True),
    Ball((0.1, 0.2, 0.3), 0.5),
    Block((0.1, 0.2, 0.3), 0.4, 0.7),
]


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene(num_views=9, width=160, height=120)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_shapes_locate_what_they_place(shape):
    """(u, v) → point → (u, v), and a ray against the normal hits the point."""
    u, v = np.random.default_rng(0).uniform(0.3, 0.7, (2, 200))
    points, normals = shape.place(u, v)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=0), 1, atol=1e-6)
    found_u, found_v = shape.locate(points.astype(np.float32))
    np.testing.assert_allclose(found_u, u, atol=1e-4)
    np.testing.assert_allclose(found_v, v, atol=1e-4)
    t = shape.hit((points + 0.05 * normals).astype(np.float32), (-0.1 * normals).astype(np.float32))
    np.testing.assert_allclose(t, 0.5, atol=1e-3)


def test_points_have_the_colours_of_the_pixels_that_see_them(scene):
    """Each point came from some view's pixel, so in the view that fits best it fits nearly exactly."""
    best = np.full(len(scene.points), np.inf)
    for view in (*scene.train, *scene.test):
        viewmat, K = np.asarray(view.camera.viewmat), np.asarray(view.camera.K)
        homogeneous = (scene.points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
        column, row = np.floor(homogeneous[:, :2] / homogeneous[:, 2:] + 1e-3).astype(int).T
        is_seen = (column >= 0) & (row >= 0) & (column < view.camera.width) & (row < view.camera.height)
        error = np.abs(view_image(view)[row[is_seen], column[is_seen]] - scene.colors[is_seen]).max(axis=1)
        best[is_seen] = np.minimum(best[is_seen], error)
    assert np.mean(best < 0.01) > 0.97


def test_seed_and_downscale():
    options = dict(num_views=2, width=64, height=48, num_points=50, test_every=0)
    made = []
    for seed in (0, 0, 1):
        _lit_surfaces.cache_clear()
        made.append(synthetic_scene(seed, **options))
    first, again, other = made
    np.testing.assert_array_equal(first.train[1].image, again.train[1].image)
    np.testing.assert_array_equal(first.points, again.points)
    assert (first.train[1].image != other.train[1].image).any()
    half = synthetic_scene(0, **options, downscale=2).train[0]
    assert (half.camera.width, half.camera.height) == (32, 24)
    np.testing.assert_allclose(half.camera.K[:2], np.asarray(first.train[0].camera.K)[:2] / 2)


@pytest.mark.parametrize("options", [{"num_views": 1}, {"num_points": 1}, {"downscale": 0}, {"width": 0}])
def test_bad_options(options):
    with pytest.raises(ValueError, match="synthetic scene needs"):
        synthetic_scene(**options)
