"""Points where photographs agree."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

import a2tg_jax as a2tg
from a2tg_jax.data import photo_points
from a2tg_jax.data.photo_points import Photo, agreeing_points
from a2tg_jax.data.photo_store import Mask, Picture


def photos_of(views):
    """The photographs and cameras of views."""
    return [
        Photo(view.picture, view.mask, np.asarray(view.camera.viewmat, float), np.asarray(view.camera.K, float))
        for view in views
    ]


def ball_views(count=8, size=60):
    """Photographs of a red unit ball with alpha, by rays, and their cameras."""
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
        views.append(Photo(Picture.of(image), None, viewmat, K))
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
    points, colors = agreeing_points(photos_of(scene.train), given, 3_000)
    assert len(points) == 3_000
    distances, nearest = surface.query(points)
    assert np.median(distances) < 0.3 * np.median(surface.query(given)[0])
    errors = np.abs(colors - scene.colors[nearest]).mean(axis=1)
    assert np.median(errors) < 0.1


def test_transparent_pixels_hold_no_points(candidates):
    photos = ball_views()
    points, colors = agreeing_points(photos, candidates, 5_000)
    radii = np.linalg.norm(points[:, :2], axis=1)  # Cameras on a ring leave what is above and below the ball.
    assert len(points) > 500 and radii.max() < 1.15
    np.testing.assert_allclose(colors, np.tile([1.0, 0, 0], (len(colors), 1)), atol=1e-6)


def test_masked_pixels_are_not_compared(candidates):
    """Left halves are masked: what only they show is neither chosen nor dropped as transparent."""
    photos = ball_views()
    left = np.ones(photos[0].picture.size, bool)
    left[:, :30] = False
    halves = [photo._replace(mask=Mask.of(left)) for photo in photos]
    one, colors = agreeing_points(halves[:1], candidates, 5_000)
    own = one @ photos[0].viewmat[:3, :3].T + photos[0].viewmat[:3, 3]
    assert len(one) and (own[:, 0] > 0).all() and (colors[:, 0] > 0.99).all()
    spoiled = [
        photo._replace(picture=Picture.of(np.where(left[..., None], photo.picture.read(), 77).astype(np.uint8)))
        for photo in halves
    ]
    for found, expected in zip(
        agreeing_points(spoiled, candidates, 5_000), agreeing_points(halves, candidates, 5_000), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("chunk", [1_000, 50_000])
def test_chunks_change_nothing_and_a_photograph_may_stand_alone(monkeypatch, candidates, chunk):
    photos = ball_views()
    expected = agreeing_points(photos, candidates, 400)
    monkeypatch.setattr(photo_points, "CHUNK", chunk)
    for found, wanted in zip(agreeing_points(photos, candidates, 400), expected, strict=True):
        np.testing.assert_array_equal(found, wanted)
    assert len(expected[0]) == 400 and len(agreeing_points(photos[:1], candidates, 400)[0]) == 400
    assert len(agreeing_points([], candidates, 400)[0]) == 0
