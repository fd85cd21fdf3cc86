"""Cameras with a ray for each pixel: the picture of a pinhole camera where they are one, and of each ray elsewhere."""

import dataclasses
import functools
import json
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from scenes_random import CAPACITY, as_camera, as_gaussians, as_textures, draw_scene, fisheye

import a2tg_jax as a2tg
from a2tg_jax import Appearance, Camera, Model, Prune, normal_consistency
from a2tg_jax.rasterize.room import most_pairs
from a2tg_jax.scene import kinds_of, ray_bytes
from a2tg_jax.training import batches
from a2tg_jax.training.batches import BatchOrder, PhotoStore
from a2tg_jax.training.cost import fed_bytes

WIDTH, HEIGHT = 43, 30
BOTH = pytest.mark.parametrize("compositor", [pytest.param("xla", marks=pytest.mark.long), "native"])


def pinhole_rays(camera: Camera, K) -> Camera:
    """The rays of a pinhole camera K, in the image plane of the camera's own."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    places = np.asarray(camera.K, np.float64) @ np.linalg.solve(K, np.stack([x, y, np.ones_like(x)]).reshape(3, -1))
    rays = (places[:2] / places[2]).T.reshape(camera.height, camera.width, 2)
    return dataclasses.replace(camera, rays=jnp.asarray(rays, camera.K.dtype))


def draw(scene, camera, **settings):
    settings = a2tg.RenderSettings(**settings)
    return a2tg.render_image(as_gaussians(scene, "float64"), camera, as_textures(scene, "float64"), settings=settings)


@pytest.mark.parametrize(("compositor", "tile_size"), [pytest.param("xla", 8, marks=pytest.mark.long), ("native", 5)])
def test_rays_of_a_pinhole_camera_show_what_it_shows(x64, compositor, tile_size):
    """Low-pass filter included: it is as wide in the pixels of the image, wherever their rays are."""
    scene = draw_scene(3)
    camera = as_camera(scene, "float64")
    # A pinhole camera of any affine K, which turns and shears, as no K of a camera does.
    K = np.array([[0.6, 0.05, 9.0], [0.02, 1.3, -4.0], [0.0, 0.0, 1.0]]) @ np.asarray(camera.K)
    of_pinhole = draw(scene, dataclasses.replace(camera, K=jnp.asarray(K)), tile_size=tile_size, compositor=compositor)
    of_rays = draw(scene, pinhole_rays(camera, K), tile_size=tile_size, compositor=compositor)
    assert float(of_pinhole.alpha.max()) > 0.5
    for wanted, found in zip(*map(jax.tree.leaves, (of_pinhole, of_rays)), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-6)


@pytest.mark.long
def test_every_pixel_of_a_fisheye_sees_along_its_own_ray(x64):
    """It shows what a pinhole camera of that pixel alone does. Splats are larger than pixels: no filter decides."""
    scene = draw_scene(4, num=12)
    camera = fisheye(as_camera(scene, "float64"))
    gaussians = as_gaussians(scene, "float64")
    gaussians = dataclasses.replace(gaussians, log_scales=jnp.log(jnp.maximum(gaussians.scales, 0.4)))
    settings = a2tg.RenderSettings(compositor="native")
    whole = a2tg.render_image(gaussians, camera, settings=settings)
    moved = np.abs(np.asarray(camera.rays) - np.asarray(pinhole_rays(camera, camera.K).rays)).max()
    assert moved > 3
    for row, column in [(0, 0), (3, 40), (14, 21), (29, 42), (29, 0), (15, 2)]:
        shift = np.asarray(camera.rays[row, column]) - 0.5
        K = np.asarray(camera.K) - np.pad(np.outer(shift, [0, 0, 1]), ((0, 1), (0, 0)))
        one = a2tg.render_image(gaussians, Camera(camera.viewmat, jnp.asarray(K), 1, 1), settings=settings)
        for name in ("color", "alpha", "depth", "normal"):
            np.testing.assert_allclose(getattr(whole, name)[row, column], getattr(one, name)[0, 0], atol=1e-10)


@BOTH
def test_gradients_through_rays_are_those_of_finite_differences(x64, compositor):
    scene = draw_scene(6, num=15)
    camera = fisheye(as_camera(scene, "float64"))
    gaussians = as_gaussians(scene, "float64")
    settings = a2tg.plan_render(gaussians, [camera], settings=a2tg.RenderSettings(compositor=compositor))
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 3)))

    @jax.jit
    def loss(means, log_scales, viewmat):
        changed = dataclasses.replace(gaussians, means=means, log_scales=log_scales)
        seen = dataclasses.replace(camera, viewmat=viewmat)
        return jnp.sum(weights * a2tg.render_image(changed, seen, settings=settings).color)

    at = gaussians.means, gaussians.log_scales, camera.viewmat
    gradients = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(*at)
    rng = np.random.default_rng(1)
    for index, gradient in enumerate(gradients):
        direction = rng.normal(size=gradient.shape)
        if index == 2:
            direction[:, :3] = direction[3] = 0  # The camera moves and does not turn.
        step = 1e-6 * direction
        ends = [loss(*at[:index], at[index] + sign * step, *at[index + 1 :]) for sign in (1, -1)]
        slope = (float(ends[0]) - float(ends[1])) / 2e-6
        np.testing.assert_allclose(np.sum(np.asarray(gradient) * direction), slope, rtol=2e-5, atol=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("statistic", ["position", "screen"])
def test_statistics_do_not_depend_on_the_image_plane(x64, statistic):
    """The rays of a pinhole camera, in the image plane of a focal length four times shorter."""
    scene = draw_scene(8, num=20)
    camera = as_camera(scene, "float64")
    gaussians = as_gaussians(scene, "float64")
    wide = dataclasses.replace(camera, K=camera.K * jnp.asarray([[0.25], [0.25], [1.0]]))
    in_plane = pinhole_rays(wide, np.asarray(camera.K))
    settings = a2tg.RenderSettings(capacity=CAPACITY)

    @jax.jit
    def norms(model, seen):
        square = lambda model, output: jnp.sum(output.color**2)  # noqa: E731
        return a2tg.view_gradients(square, model, seen, settings=settings, statistic=statistic).norms

    of_camera, of_rays = (norms(Model(gaussians), seen) for seen in (camera, in_plane))
    assert float(of_camera.max()) > 0
    np.testing.assert_allclose(of_rays, of_camera, rtol=1e-5, atol=1e-6 * float(of_camera.max()))


@pytest.mark.long
def test_normals_of_depth_follow_the_rays():
    """Exact depth and normals of a tilted plane, seen through a fisheye: consistent, but for differences' curvature."""
    camera = fisheye(Camera(jnp.eye(4), jnp.asarray([[30.0, 0, 20], [0, 30, 15], [0, 0, 1]]), 40, 30))
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    slopes = np.concatenate([(np.asarray(camera.rays) - [20, 15]) / 30, np.ones((30, 40, 1))], axis=2)
    depth = jnp.asarray(-4.0 / (slopes @ normal), jnp.float32)
    normals = jnp.broadcast_to(jnp.asarray(normal, jnp.float32), (30, 40, 3))
    error = functools.partial(normal_consistency, normals, depth, jnp.ones((30, 40)))
    assert float(error(camera)) < 1e-5 < 1e-3 < float(error(dataclasses.replace(camera, rays=None)))
    half = jnp.asarray(np.where(np.arange(40)[None, :, None] < 20, np.nan, np.asarray(camera.rays)))
    gradient = jax.grad(lambda depth: normal_consistency(normals, depth, jnp.ones((30, 40)),
                                                         dataclasses.replace(camera, rays=half)))(depth)  # fmt: skip
    assert np.isfinite(gradient).all()


def test_wide_lenses_make_a_few_times_the_pairs():
    """Tiles far off the axis, whose pixels are long in the image plane, widen no splat in the middle."""
    K = jnp.asarray([[90.0, 0, 100], [0, 90, 75], [0, 0, 1]], jnp.float32)
    camera = Camera(jnp.eye(4), K, 200, 150)
    wide = fisheye(camera)
    assert float(wide.rays.max()) > 450  # The corner looks 79° off the axis.
    rng = np.random.default_rng(0)
    gaussians = dataclasses.replace(
        as_gaussians(draw_scene(2, num=200), "float32"),
        means=jnp.asarray(np.column_stack([rng.uniform(-0.3, 0.3, (200, 2)), np.full(200, 2.0)]), jnp.float32),
        log_scales=jnp.full((200, 2), np.log(0.01), jnp.float32),
    )
    settings = a2tg.RenderSettings()
    of_pinhole, of_rays = (most_pairs(gaussians, [seen], Appearance(), settings) for seen in (camera, wide))
    assert of_pinhole > 200 and of_rays < 4 * of_pinhole


@pytest.mark.long
def test_pixels_without_a_ray_see_the_background(x64):
    scene = draw_scene(5)
    camera = fisheye(as_camera(scene, "float64"))
    hidden = np.zeros((HEIGHT, WIDTH), bool)
    hidden[:8, :8], hidden[20, 30] = True, True
    blind = dataclasses.replace(camera, rays=jnp.where(hidden[..., None], jnp.nan, camera.rays))
    gaussians = as_gaussians(scene, "float64")
    textures = as_textures(scene, "float64")
    settings = a2tg.RenderSettings(capacity=CAPACITY, tile_size=8)  # The first hidden pixels are a whole tile.

    @jax.jit
    def seen(means, camera):
        return a2tg.render_image(dataclasses.replace(gaussians, means=means), camera, textures, settings=settings)

    found = seen(gaussians.means, blind)
    wanted = seen(gaussians.means, camera)
    assert np.asarray(wanted.alpha)[hidden].max() > 0.1 and not np.asarray(found.alpha)[hidden].any()
    # A tile's frame, and with it the low-pass filter, follows from the rays that it has.
    np.testing.assert_allclose(np.asarray(found.color)[~hidden], np.asarray(wanted.color)[~hidden], atol=1e-5)
    gradient = jax.jit(jax.grad(lambda means: jnp.sum(seen(means, blind).color)))(gaussians.means)
    assert np.isfinite(gradient).all()


def write_fisheye(folder, num_views=4, focal=20.0, size=(32, 24), **more):
    """Bright photographs of a fisheye, all from places on a circle, as a transforms.json."""
    rng, (width, height) = np.random.default_rng(0), size
    frames = []
    for index in range(num_views):
        Image.fromarray(rng.integers(180, 256, (height, width, 3), np.uint8)).save(folder / f"{index}.png")
        place = 3 * np.array([np.cos(index), np.sin(index), 0.3])
        camera_to_world = np.linalg.inv(a2tg.look_at(place, np.zeros(3), width=width, height=height).viewmat)
        pose = camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"{index}.png", "transform_matrix": pose.tolist()})
    lens = {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": 0.0, "k3": 0.0, "k4": 0.0, "fl_x": focal, **more}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # There are no points.
        return a2tg.load_scene(write_fisheye(tmp_path_factory.mktemp("fisheye")), lens="keep", test_every=4)


def test_a_kept_photograph_has_the_rays_of_its_lens(kept, tmp_path):
    camera = kept.train[0].camera
    places = (np.asarray(camera.rays) - np.asarray(camera.K)[:2, 2]) / np.diag(np.asarray(camera.K))[:2]
    angle = np.arctan(np.linalg.norm(places, axis=2))
    x, y = np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5)
    # OpenCV's fisheye: r = f·θ·(1 + k₁·θ²)
    distance = np.hypot(x - 16, y - 12)
    seen = np.isfinite(angle)
    np.testing.assert_allclose((20 * angle * (1 + 0.05 * angle**2))[seen], distance[seen], atol=1e-3)
    np.testing.assert_allclose(places[12, 30], angle[12, 30] * np.array([14.5, 0.5]) / distance[12, 30] * (
        np.tan(angle[12, 30]) / angle[12, 30]), rtol=1e-4)  # fmt: skip
    assert seen.all() and kept.train[0].mask is None
    assert all(view.camera.rays is camera.rays for view in (*kept.train, *kept.test))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        undistorted = a2tg.load_scene(write_fisheye(tmp_path))
    assert undistorted.train[0].camera.rays is None
    # Only photographs of pinholes are compared.
    assert len(np.unique(undistorted.colors, axis=0)) > 100
    assert len(kept.points) == 10_000 and (kept.colors == kept.colors[0]).all()


def test_pixels_too_far_from_the_direction_of_view_do_not_count(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = a2tg.load_scene(write_fisheye(tmp_path, focal=11.0), lens="keep")
    view = scene.train[0]
    has_ray = np.isfinite(view.camera.rays).all(axis=2)
    assert 0.5 < has_ray.mean() < 1
    np.testing.assert_array_equal(view.mask.read(), has_ray)
    with pytest.raises(ValueError, match="gives 2% of the pixels a ray within 80°"):
        a2tg.load_scene(write_fisheye(tmp_path, focal=1.5), lens="keep")
    with pytest.raises(ValueError, match="lens must be one of undistort, keep; got 'crop'"):
        a2tg.load_scene(tmp_path, lens="crop")


@pytest.mark.parametrize("lacking", [0, 1])
def test_rays_stay_on_the_device_if_those_of_all_lenses_fit(kept, lacking):
    room = ray_bytes(kept.train) - lacking
    photographs = PhotoStore(kept.train, BatchOrder(kept.train, 1, 0), 2, room=room)
    first, second = (photographs.batch(iteration)[0].rays for iteration in (1, 2))
    photographs.close()
    assert (first is second) == (not lacking) and isinstance(first, jax.Array)
    np.testing.assert_array_equal(second, kept.train[0].camera.rays)


def test_rays_that_come_with_batches_count_twice(kept, monkeypatch):
    """The forecast counts the rays of two batches in flight, and those that stay on the device once."""
    of_rays = ray_bytes(kept.train)
    counted = []
    for room in (of_rays, of_rays - 1):
        monkeypatch.setattr(batches, "device_room", lambda room=room: room)
        counted.append(fed_bytes(kept.train, 1, has_depths=False))
    assert counted[1] - counted[0] == of_rays > 0


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:training does not learn")
def test_training_through_lenses_learns_and_prunes(kept):
    """Photographs of a lens and of none in one training."""
    first, second, *others = kept.train
    other = dataclasses.replace(first.camera, rays=np.asarray(first.camera.rays) + np.float32(0.5))
    plain = dataclasses.replace(others[0], camera=dataclasses.replace(others[0].camera, rays=None))
    assert [kind[2] for kind in kinds_of((dataclasses.replace(first, camera=other), second, plain))] == [1, 2, 0]
    mixed = dataclasses.replace(kept, train=(first, second, plain))
    system = dataclasses.replace(
        a2tg.Gaussians2dMcmc.preset("smoke"), stage1_iterations=60, initial_gaussians=200, sh_degree=0,
        prune=Prune(share=0.3, at=(0.5,)),
    )  # fmt: skip
    result = a2tg.fit(mixed, system)
    assert np.mean(result.history.psnr[-2:]) > result.history.psnr[0] + 1
    assert result.model.num < 200 and np.isfinite(a2tg.evaluate(mixed.test, result.model).psnr)
