"""Points where photographs agree."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

import a2tg_jax as a2tg
from a2tg_jax import Mask, Picture
from a2tg_jax.data.photo_points import Look, agreeing_points


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
        viewmat = np.asarray(camera.viewmat, float)
        K = np.asarray(camera.K, float)
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


@pytest.mark.parametrize("times", [1, 10])
def test_large_photographs_are_averaged(times):
    """Means are of what is opaque. Of a large photograph, 16 pixels of each square count; the last ones are smaller."""
    image = np.zeros((300, 403, 4), np.uint8)
    image[:, :202] = 200, 100, 0, 255
    image[:, 202:, :3] = 90  # Transparent.
    look = Look(Picture.of(np.kron(image, np.ones((times, times, 1), np.uint8))), None, np.eye(4), np.eye(3))
    assert look.colors.shape == (75, 101, 3)
    np.testing.assert_allclose(look.colors[:, :51], np.tile([200 / 255, 100 / 255, 0], (75, 51, 1)), atol=1e-6)
    np.testing.assert_allclose(look.opacity[0], [1.0] * 50 + [0.5] + [0.0] * 50, atol=1e-6)


def test_the_air_before_a_plain_background_has_no_points(candidates):
    """It agrees in all photographs that do not show the ball behind it. Opaque walls with detail are compared."""

    def opaque(behind):
        return lambda image: np.where(image[..., 3:] > 0, image[..., :3], behind).astype(np.uint8)

    plain = 255
    wall = np.random.default_rng(0).integers(0, 256, (60, 60, 3))
    assert len(agreeing_points(looks_at_ball(change=opaque(plain)), candidates, 5_000)[0]) == 0
    assert len(agreeing_points(looks_at_ball(change=opaque(wall)), candidates, 5_000)[0]) > 300


def test_one_bad_cut_out_loses_no_points(candidates):
    looks = looks_at_ball()
    blank = Look(Picture.of(np.zeros((60, 60, 4), np.uint8)), None, looks[0].viewmat, looks[0].K)
    points, _ = agreeing_points([*looks, blank], candidates, 5_000)
    assert len(points) > 500 and np.linalg.norm(points[:, :2], axis=1).max() < 1.5


def test_the_start_does_not_depend_on_validation_views_and_leaves_no_view_without_points():
    """Of six headings in turn at each place, every one is compared. Each eighth training view is another's to judge."""
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (24, 24, 3), np.uint8) for _ in range(96)]
    places = [np.array([np.cos(place), np.sin(place), 0]) for place in range(16)]
    headings = [np.array([np.cos(turn), np.sin(turn), 0]) for turn in np.arange(6) * np.pi / 3]
    cameras = [a2tg.look_at(place, place + turn, width=24, height=24) for place in places for turn in headings]
    viewmats = np.stack([camera.viewmat for camera in cameras])
    K = cameras[0].K

    def load(images):
        with pytest.warns(UserWarning, match="starts from [0-9,]+ points where photographs agree"):
            return a2tg.scene_from_arrays(images, viewmats, K, test_every=0)

    scene = load(images)
    for view in scene.train:
        own = scene.points @ np.asarray(view.camera.viewmat)[:3, :3].T + np.asarray(view.camera.viewmat)[:3, 3]
        place = own @ np.asarray(view.camera.K)[:2].T / own[:, 2:]
        assert ((own[:, 2] > 0) & (place >= 0).all(axis=1) & (place <= 24).all(axis=1)).sum() > 10
    changed = load([255 - image if index % 8 == 0 else image for index, image in enumerate(images)])
    np.testing.assert_array_equal(changed.points, scene.points)
    np.testing.assert_array_equal(changed.colors, scene.colors)
    others = load([images[0], 255 - images[1], *images[2:]])
    assert others.points.shape != scene.points.shape or (others.points != scene.points).any()
