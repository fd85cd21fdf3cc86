"""The sky that training starts from: where it lies, what it looks like, and where it is refused."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

import a2tg_jax as a2tg
from a2tg_jax.core.cameras import intrinsics, looking
from a2tg_jax.core.gaussians import SH_C0, rotation_matrices
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.densify.pruning import shown_in
from a2tg_jax.io.config_json import changed_config
from a2tg_jax.results.record import RunRecord, SceneSource
from a2tg_jax.training import SYSTEMS
from a2tg_jax.training.cost import forecast_stages
from a2tg_jax.training.sky import MOST_TRIED, cell_rays, even_directions, is_bare, sky_of, sphere
from a2tg_jax.training.start import check_start, initial_model

WIDTH, HEIGHT, NUM = 48, 36, 60
HORIZON = HEIGHT // 2
BLUE, BROWN = (60, 120, 240), (120, 80, 40)
K = intrinsics(WIDTH, HEIGHT, np.deg2rad(58))


def camera_at(x: float) -> a2tg.Camera:
    """A level camera that looks along y; z is up."""
    viewmat = looking(np.array([x, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0]))
    return a2tg.Camera(jnp.asarray(viewmat, jnp.float32), jnp.asarray(K, jnp.float32), WIDTH, HEIGHT)


def ground(camera: a2tg.Camera, rng: np.random.Generator, top: float = HORIZON + 1) -> np.ndarray:
    """Points under random pixels lower than a row, one below the camera, or above it."""
    pixels = np.stack([rng.uniform(0, WIDTH, 2_000), rng.uniform(top, HEIGHT, 2_000), np.ones(2_000)], axis=1)
    rays = pixels @ np.linalg.inv(K).T @ np.asarray(camera.viewmat)[:3, :3]
    points: np.ndarray = np.asarray(camera.center) + rays / np.abs(rays[:, 2:])
    return points.astype(np.float32)


@pytest.fixture(scope="module")
def scene():
    """Three views of a brown ground with points, under a blue sky."""
    rng, cameras = np.random.default_rng(0), [camera_at(x) for x in (-0.5, 0.0, 0.5)]
    image = np.full((HEIGHT, WIDTH, 3), BROWN, np.uint8)
    image[:HORIZON] = BLUE
    views = tuple(a2tg.View(f"{index}.png", camera, image) for index, camera in enumerate(cameras))
    points = np.concatenate([ground(camera, rng) for camera in cameras])
    colors = np.full_like(points, 0.5)
    return a2tg.Scene("plain", views, views, points, colors, Similarity(1.0, np.eye(3), np.zeros(3)), 1.0)


def projected(camera: a2tg.Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of points before a camera."""
    viewmat = np.asarray(camera.viewmat, np.float64)
    x, y, depth = K @ (viewmat[:3, :3] @ points.T + viewmat[:3, 3:])
    assert (depth > 0).all()
    return x / depth, y / depth


def directions_of(gaussians, scene) -> np.ndarray:
    offsets = np.asarray(gaussians.means, np.float64) - sphere(scene)[0]
    return offsets / np.linalg.norm(offsets, axis=1, keepdims=True)


def changed(scene, **changes):
    return dataclasses.replace(scene, train=tuple(dataclasses.replace(view, **changes) for view in scene.train))


def with_cameras(scene, cameras):
    views = (dataclasses.replace(view, camera=camera) for view, camera in zip(scene.train, cameras, strict=True))
    return dataclasses.replace(scene, train=tuple(views))


def mcmc(**options):
    return changed_config(a2tg.find_system("gaussians-2d-mcmc").preset("smoke"), options, "test")


@pytest.fixture(scope="module")
def sky(scene):
    return sky_of(scene, NUM, opacity=0.3, sh_degree=1)


class TestSky:
    def test_it_lies_far_off_where_views_see_no_points(self, scene, sky):
        center, radius = sphere(scene)
        distances = np.linalg.norm(scene.points - center, axis=1)
        assert (distances < radius / 9.99).mean() == pytest.approx(0.99, abs=1e-3)
        np.testing.assert_allclose(np.linalg.norm(np.asarray(sky.means) - center, axis=1), radius, rtol=1e-5)
        found = [projected(view.camera, np.asarray(sky.means, np.float64)) for view in scene.train]
        is_seen = [(x > -1) & (x < WIDTH + 1) & (y > -1) & (y < HORIZON + 1) for x, y in found]
        assert np.any(is_seen, axis=0).all()

    def test_it_faces_the_cameras_evenly_in_their_colours(self, scene, sky):
        directions = directions_of(sky, scene)
        normals = np.asarray(rotation_matrices(sky.quats))[:, :, 2]
        np.testing.assert_allclose(np.abs((normals * directions).sum(axis=1)), 1, atol=1e-5)
        angles = cKDTree(directions).query(directions, k=2)[0][:, 1]
        np.testing.assert_allclose(angles, np.asarray(sky.scales)[:, 0] / sphere(scene)[1], rtol=0.25)
        np.testing.assert_allclose(0.5 + SH_C0 * sky.sh[:, 0], np.tile(np.array(BLUE) / 255, (NUM, 1)), atol=1e-5)
        assert sky.sh.shape == (NUM, 4, 3) and not sky.sh[:, 1:].any()
        np.testing.assert_allclose(sky.opacities, 0.3, rtol=1e-5)

    @pytest.mark.parametrize("kind", ["mask", "alpha"])
    def test_what_photographs_leave_out_is_no_sky(self, scene, kind):
        counts = np.tile(np.arange(WIDTH) >= WIDTH // 2, (HEIGHT, 1))
        pixels = np.dstack([scene.train[0].image, np.where(counts, 255, 0).astype(np.uint8)])
        left_out = changed(scene, **({"mask": counts} if kind == "mask" else {"picture": pixels}))
        sky = sky_of(left_out, NUM, opacity=0.3, sh_degree=0)
        found = np.stack([projected(view.camera, np.asarray(sky.means, np.float64))[0] for view in scene.train])
        assert found.max(axis=0).min() > WIDTH // 2 - 1

    def test_the_ground_is_no_sky(self, scene):
        """Without a point nearby, the ground is still no sky."""
        bare = dataclasses.replace(scene, points=scene.points + np.float32([500, 0, 0]))
        sky = sky_of(bare, NUM, opacity=0.3, sh_degree=0)
        sines = directions_of(sky, bare)[:, 2]
        assert sines.min() > -0.25 and (sines < -0.1).any()

    def test_it_shows(self, scene, sky):
        weights = shown_in(a2tg.Model(sky), scene.train).weights
        assert weights.min() > 1 and 0.6 * 3 * WIDTH * HORIZON < weights.sum() < 1.1 * 3 * WIDTH * HORIZON


def with_lens(camera: a2tg.Camera, has_ray: np.ndarray) -> a2tg.Camera:
    """The camera with the rays of its pixels, NaN where it has none [H, W]."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.where(has_ray[..., None], np.stack([x, y], axis=-1), np.nan)
    return dataclasses.replace(camera, rays=jnp.asarray(rays))


LEFT = np.tile(np.arange(WIDTH) < WIDTH // 2, (HEIGHT, 1))
UPPER = np.tile(np.arange(HEIGHT)[:, None] < HORIZON - 4, (1, WIDTH))


def test_rays_of_a_lens_are_those_of_its_pixels():
    camera = camera_at(0.0)
    pinhole, spacing = cell_rays(camera)
    lens, same = cell_rays(with_lens(camera, ~LEFT))
    assert same == pytest.approx(spacing, rel=1e-6) and len(pinhole) == WIDTH * HEIGHT
    has_ray = np.abs(lens).max(axis=1) <= 1
    np.testing.assert_array_equal(has_ray, ~LEFT.ravel())
    np.testing.assert_allclose(lens[has_ray], pinhole[has_ray], atol=1e-6)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -1)])
def test_corners_without_a_ray_are_not_empty(scene, up):
    camera, points = scene.train[0].camera, scene.points + np.float32([0, 0, 500])
    pinhole, lens = (
        is_bare(seen, cell_rays(seen), points, np.array(up, np.float64)) for seen in (camera, with_lens(camera, ~LEFT))
    )
    assert pinhole[LEFT.ravel()].any()
    np.testing.assert_array_equal(lens, pinhole & ~LEFT.ravel())


class TestEvenDirections:
    @pytest.mark.parametrize("height, num", [(0.1, 50), (0.1, 400), (1e-3, 50), (3e-4, 20)])
    def test_they_fill_a_cap(self, height, num):
        tried = []
        is_sky = lambda directions: tried.append(len(directions)) or directions[:, 0] > 1 - height  # noqa: E731
        directions, angle = even_directions(num, is_sky)
        assert directions.shape == (num, 3) and (directions[:, 0] > 1 - height).all()
        assert angle == pytest.approx(np.sqrt(2 * np.pi * height / num), rel=0.05), "the cap, shared by all"
        assert len(tried) <= 5 and tried[0] == 20_000 and tried[-1] < 10 * num

    def test_the_angle_is_right_if_more_are_found_than_requested(self):
        """The first directions that are found suggest too small a share."""
        sparse = iter([2])
        directions, angle = even_directions(
            100, lambda directions: (directions[:, 0] > 0.9) & (np.arange(len(directions)) % next(sparse, 1) == 0)
        )
        assert directions.shape == (100, 3)
        assert angle == pytest.approx(np.sqrt(2 * np.pi * 0.1 / 100), rel=0.05)

    @pytest.mark.parametrize(
        "num, height, message",
        [
            (50, 0.0, "too few training views see the same part of a sky.*: leave out sky_gaussians$"),
            (50, 1e-6, "too few training views"),
            (2_000_000, 0.1, r"is 2,000,000, but the sky .* with room for about 9\d,\d{3}: lower sky_gaussians$"),
        ],
    )
    def test_what_has_no_room_is_refused_at_once(self, num, height, message):
        tried = []
        with pytest.raises(ValueError, match=message):
            even_directions(num, lambda directions: tried.append(len(directions)) or directions[:, 0] > 1 - height)
        assert sum(tried) <= 220_000 < MOST_TRIED


class TestStart:
    def test_the_sky_counts_among_the_initial_gaussians(self, scene):
        model = initial_model(scene, mcmc(initial_gaussians=100, sky_gaussians=20))
        others = initial_model(scene, mcmc(initial_gaussians=80))
        assert model.num == 100
        for own, other in zip(model.gaussians[:80].__dict__.values(), others.gaussians.__dict__.values(), strict=True):
            np.testing.assert_array_equal(own, other)
        center, radius = sphere(scene)
        distances = np.linalg.norm(np.asarray(model.gaussians.means)[80:] - center, axis=1)
        np.testing.assert_allclose(distances, radius, rtol=1e-5)

    @pytest.mark.parametrize("name", sorted(set(SYSTEMS) - {"gaussians-2d", "supergaussians"}))
    def test_systems_forecast_what_they_start_from(self, scene, name):
        few = dataclasses.replace(scene, points=scene.points[::20], colors=scene.colors[::20])
        system = type(a2tg.find_system(name)).preset("smoke", initial_gaussians=None, sky_gaussians=20)
        system.check()
        model = initial_model(few, system)
        assert model.num == len(few.points) + 20
        assert next(forecast_stages(few, system)).num_rows >= model.num

    @pytest.mark.parametrize("name, budget", [("gaussians-2d", None), ("supergaussians", "1MB")])
    def test_systems_that_would_prune_it_refuse_it(self, name, budget):
        """Adaptive density control would prune each of its splats after the first reset of opacities."""
        system = type(a2tg.find_system(name)).preset("smoke", sky_gaussians=20, memory_budget=budget)
        with pytest.raises(ValueError, match=r"as large as what \w+ prunes: leave out sky_gaussians"):
            system.check()

    @pytest.mark.parametrize(
        "options, message",
        [
            ({"sky_gaussians": -1}, "sky_gaussians must be at least 0; got -1"),
            (
                {"sky_gaussians": 99, "densify": {"cap": 100}},
                r"room for 2 others among the 100 that training starts from at most; got 99: .* raise densify\.cap$",
            ),
            ({"sky_gaussians": 60, "initial_gaussians": 60}, "the 60 .* got 60: lower sky_gaussians, or raise init"),
            (
                {"sky_gaussians": 50, "memory_budget": "10kB", "initial_gaussians": None},
                "among the 43 .* or raise memory_budget$",
            ),
        ],
    )
    def test_a_sky_that_leaves_no_room_is_refused(self, options, message):
        with pytest.raises(ValueError, match=message):
            mcmc(**options).check()

    def test_a_scene_without_a_sky_is_refused(self, scene):
        above = np.concatenate([ground(view.camera, np.random.default_rng(0), 0) for view in scene.train])
        full = dataclasses.replace(scene, points=np.concatenate([scene.points, above]))
        with pytest.raises(ValueError, match=r"^sky_gaussians is 20, but the training views show no sky: \d"):
            check_start(full, mcmc(sky_gaussians=20))
        lens = [with_lens(view.camera, ~LEFT) for view in full.train]
        with pytest.raises(ValueError, match=r"the training views show no sky: 0\.0% .*: leave out sky_gaussians$"):
            check_start(with_cameras(full, lens), mcmc(sky_gaussians=20))

    def test_masks_that_leave_the_sky_out_are_told_before_training(self, scene):
        ground_only = np.tile(np.arange(HEIGHT)[:, None] >= HORIZON, (1, WIDTH))
        masked = changed(scene, mask=ground_only)
        for start in (check_start, initial_model):
            with pytest.raises(ValueError, match=r"masks or .* the sky out: 4\d\.\d% .* and 0\.0% counts: leave out"):
                start(masked, mcmc(sky_gaussians=20))
        pixels = np.dstack([scene.train[0].image, np.where(ground_only, 255, 0).astype(np.uint8)])
        for start in (check_start, initial_model):
            with pytest.raises(ValueError, match="alpha channels leave the sky out"):
                start(changed(scene, picture=pixels), mcmc(sky_gaussians=20))
        check_start(changed(scene, mask=~ground_only), mcmc(sky_gaussians=20))

    def test_a_first_stage_from_a_file_has_no_sky(self):
        record = RunRecord(SceneSource("synthetic"), "a2tg", a2tg.A2tg(sky_gaussians=20), init="a.ply")
        with pytest.raises(ValueError, match="sky_gaussians start in one: leave one out"):
            record.check()
