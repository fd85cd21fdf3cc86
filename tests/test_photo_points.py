"""Points where photographs agree."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

import a2tg_jax as a2tg
from a2tg_jax.data.photo_points import Look, agreeing_points
from a2tg_jax.data.photo_store import Mask, Picture


def looks_of(views):
    return [
        Look(view.picture, view.mask, np.asarray(view.camera.viewmat, float), np.asarray(view.camera.K, float))
        for view in views
    ]


def ball_views(count=8, size=60):
    """Photographs of a red unit ball with alpha, by rays, and their cameras [(image, viewmat, K)]."""
    views = []
    for angle in 2 * np.pi * np.arange(count) / count:
        camera = a2tg.look_at([4 * np.cos(angle), 4 * np.sin(angle), 1.0], [0, 0, 0], width=size, height=size)
        viewmat, K = np.asarray(camera.viewmat, float), np.asarray(camera.K, float)
        pixels = np.stack([*np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5), np.ones((size, size))], axis=-1)
        rays = pixels @ np.linalg.inv(K).T @ viewmat[:3, :3]
        center = -viewmat[:3, :3].T @ viewmat[:3, 3]
        nearest = center + rays * (-(rays @ center) / (rays**2).sum(axis=-1))[..., None]
        shows = np.linalg.norm(nearest, axis=-1) < 1
        image = np.where(shows[..., None], [255, 0, 0, 255], 0).astype(np.uint8)
        views.append((image, viewmat, K))
    return views


@pytest.fixture(scope="module")
def candidates():
    return np.random.default_rng(1).uniform(-2, 2, (30_000, 3))


def test_points_are_on_surfaces_and_have_their_colours():
    """The built-in scene has points on its surfaces; random candidates fill a box around them."""
    scene = a2tg.synthetic_scene(num_views=12, width=96, height=72, num_points=20_000)
    surface = cKDTree(scene.points)
    low, high = np.quantile(scene.points, [0.02, 0.98], axis=0)
    given = np.random.default_rng(0).uniform(low, high, (60_000, 3))
    points, colors = agreeing_points(looks_of(scene.train), given, 3_000)
    assert len(points) == 3_000
    distances, nearest = surface.query(points)
    assert np.median(distances) < 0.3 * np.median(surface.query(given)[0])
    errors = np.abs(colors - scene.colors[nearest]).mean(axis=1)
    assert np.median(errors) < 0.1


def looks_at_ball(mask=None, change=lambda image: image):
    return [Look(Picture.of(change(image)), mask, viewmat, K) for image, viewmat, K in ball_views()]


def test_transparent_pixels_hold_no_points(candidates):
    points, colors = agreeing_points(looks_at_ball(), candidates, 5_000)
    radii = np.linalg.norm(points[:, :2], axis=1)  # Cameras on a ring leave what is above and below the ball.
    assert len(points) > 500 and radii.max() < 1.15
    np.testing.assert_allclose(colors, np.tile([1.0, 0, 0], (len(colors), 1)), atol=1e-6)


def test_masked_pixels_are_not_compared(candidates):
    """Left halves are masked: what only they show is neither chosen nor dropped as transparent."""
    right = np.ones((60, 60), bool)
    right[:, :30] = False
    halves = looks_at_ball(Mask.of(right))
    points, colors = agreeing_points(halves[:1], candidates, 5_000)
    own = points @ halves[0].viewmat[:3, :3].T + halves[0].viewmat[:3, 3]
    assert len(points) and (own[:, 0] > 0).all() and (colors[:, 0] > 0.99).all()
    spoiled = looks_at_ball(Mask.of(right), lambda image: np.where(right[..., None], image, 77).astype(np.uint8))
    expected = agreeing_points(halves, candidates, 5_000)
    for found, wanted in zip(agreeing_points(spoiled, candidates, 5_000), expected, strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_a_photograph_may_stand_alone_or_lack(candidates):
    looks = looks_at_ball()
    for count, most in ((1, 400), (8, 400), (0, 0)):
        points, colors = agreeing_points(looks[:count], candidates, 400)
        assert points.shape == colors.shape == (most, 3)
        for found, wanted in zip(agreeing_points(looks[:count], candidates, 400), (points, colors), strict=True):
            np.testing.assert_array_equal(found, wanted)


def test_large_photographs_are_averaged():
    """Of 4,000 pixels a side, 16 a square are; the mean counts what is opaque."""
    image = np.zeros((300, 400, 4), np.uint8)
    image[:, :200] = 200, 100, 0, 255
    image[:, 201::2, :3] = 90  # Transparent.
    large = np.kron(image, np.ones((10, 10, 1), np.uint8))
    for pixels in (image, large):
        look = Look(Picture.of(pixels), None, np.eye(4), np.eye(3))
        assert max(look.colors.shape) == 100
        np.testing.assert_allclose(look.colors[:, :50], np.tile([200 / 255, 100 / 255, 0], (75, 50, 1)), atol=1e-6)
        assert (look.opacity[:, :50] == 1).all() and (look.opacity[:, 50:] == 0).all()
