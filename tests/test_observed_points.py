"""Points that photographs observed: read from COLMAP's models, and compared with rendered depth."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_data_colmap import CAMERAS, dot_place, project, write_scene

import a2tg_jax as a2tg
from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.data.observations import stacked_points
from a2tg_jax.data.synthetic import exact_depths
from a2tg_jax.rasterize.render_types import Geometry
from a2tg_jax.training.batches import BatchOrder, Extras, PhotoStore, stack_views, view_bytes
from a2tg_jax.training.terms import PointDepths, points_loss

RNG = np.random.default_rng(0)


def small(**options):
    options = {"stage1_iterations": 4, "initial_gaussians": None, "densify": {"cap": 0}, **options}
    return a2tg.find_system("gaussians-2d-mcmc").preset("smoke", **options)


@pytest.fixture(scope="module")
def scene():
    return a2tg.synthetic_scene(num_views=5, width=40, height=30, num_points=300)


def with_observations(folder, model, seen):
    """Write a scene in which image i saw the points of numbers seen[i]."""
    colmap = pycolmap()
    write_scene(folder, models=(model,), num_views=5)
    reconstruction = colmap.Reconstruction(str(folder / "sparse/0"))
    for (key, image), points in zip(sorted(reconstruction.images.items()), seen, strict=True):
        image.points2D = colmap.Point2DList([colmap.Point2D(np.zeros(2)) for _ in range(len(points) + 1)])
        for index, point in enumerate(points):
            reconstruction.add_observation(point, colmap.TrackElement(key, index))
    reconstruction.write_binary(str(folder / "sparse/0"))
    return reconstruction


@pytest.mark.parametrize("lens", ["undistort", "keep"])
@pytest.mark.parametrize("model", CAMERAS)
def test_points_are_where_the_photograph_shows_them(tmp_path, model, lens):
    """The first point, which is a white dot, and those that COLMAP projects into the picture, at their depths."""
    seen = [range(1, 30), range(2, 50), [1], [], [1, 40]]
    reconstruction = with_observations(tmp_path, model, seen)
    scene = a2tg.load_scene(tmp_path, test_every=0, lens=lens)
    assert scene.train[3].points is None
    for index in (0, 1, 2, 4):
        view, found = scene.train[index], scene.train[index].points
        image = reconstruction.find_image_with_name(view.name)
        own = np.array([image.cam_from_world() * reconstruction.points3D[key].xyz for key in seen[index]])
        own = own[own[:, 2] > 0]
        undistorted = own @ np.asarray(view.camera.K).T
        places = image.camera.img_from_cam(own) if lens == "keep" else undistorted[:, :2] / undistorted[:, 2:]
        is_within = ((places >= 0) & (places < [view.camera.width, view.camera.height])).all(axis=1)
        nearest = {}
        for (column, row), z in zip(places[is_within].astype(int), own[is_within, 2], strict=True):
            pixel = row * view.camera.width + column
            nearest[pixel] = min(z, nearest.get(pixel, np.inf))
        np.testing.assert_array_equal(found.pixels, sorted(nearest))
        expected = scene.transform.scale * np.array([nearest[pixel] for pixel in sorted(nearest)])
        np.testing.assert_allclose(found.depths, expected, rtol=1e-5)
        if index != 1:
            row, column = np.divmod(found.pixels, view.camera.width)
            distance = np.linalg.norm(np.stack([column, row], 1) + 0.5 - dot_place(view.image), axis=1)
            assert distance.min() < 1.5


@pytest.mark.long
def test_real_scenes(shared):
    """COLMAP's features are within a pixel or so of where its points are drawn."""
    folder = shared / "scenes/fox"
    scene = a2tg.load_scene(folder, downscale=4)
    reconstruction = pycolmap().Reconstruction(str(folder / "sparse/0"))
    for view in scene.train[::10]:
        image = reconstruction.find_image_with_name(view.name)
        places = np.array([feature.xy for feature in image.points2D if feature.has_point3D()])
        places *= [view.camera.width / image.camera.width, view.camera.height / image.camera.height]
        row, column = np.divmod(view.points.pixels, view.camera.width)
        apart = np.abs(places[None] - np.stack([column, row], 1)[:, None] - 0.5).max(axis=2).min(axis=1)
        assert len(view.points.pixels) > 500 and np.quantile(apart, 0.9) < 1


def test_the_nearest_of_a_pixel_counts_and_what_is_outside_does_not():
    places = np.array([[1.5, 0.5], [1.2, 0.9], [-0.1, 0.5], [3.0, 1.0], [np.nan, 1.0], [0.0, 1.99], [2.5, 1.5]])
    found = a2tg.observed_points(places, np.array([3.0, 2.0, 1.0, 1.0, 1.0, 5.0, -1.0]), (2, 3))
    np.testing.assert_array_equal(found.pixels, [1, 3])
    np.testing.assert_array_equal(found.depths, np.float32([2, 5]))
    assert found.pixels.dtype == np.int32 and found.depths.dtype == np.float32
    nothing = a2tg.observed_points(np.zeros((0, 2)), np.zeros(0), (2, 3))
    assert nothing.pixels.shape == nothing.depths.shape == (0,)
    with pytest.raises(ValueError, match=r"xy must be \[S, 2\] and depths \[S\]; got \[3, 2\] and \[2\]"):
        a2tg.observed_points([[1, 2]] * 3, [1, 2], (4, 4))


DEPTH, ALPHA = (jnp.asarray(RNG.uniform(*limits, (5, 6))) for limits in ((1, 2), (0.6, 1)))
POINTS = a2tg.ObservedPoints(np.array([1, 8, 29, 30, 31], np.int32), np.array([2.0, 1.0, 3.0, 0.0, 0.0]))


def test_the_loss_is_the_mean_difference_of_inverse_depths():
    alpha = ALPHA.at[1, 2].set(0.4)
    expected = np.mean([abs(1 / z - alpha[at] / DEPTH[at]) for at, z in (((0, 1), 2.0), ((4, 5), 3.0))])
    np.testing.assert_allclose(points_loss(DEPTH, alpha, POINTS), expected, rtol=1e-6)
    mask = np.ones((5, 6), bool)
    mask[4, 5] = False
    masked = points_loss(DEPTH, alpha, POINTS, jnp.asarray(mask))
    np.testing.assert_allclose(masked, abs(0.5 - alpha[0, 1] / DEPTH[0, 1]), rtol=1e-6)


def test_the_gradient_of_the_loss_is_exact():
    with jax.enable_x64():
        images = jnp.asarray(np.stack([DEPTH, ALPHA]), float)
        loss = lambda images: points_loss(*images, POINTS)  # noqa: E731
        steps = 1e-6 * jnp.eye(images.size).reshape(-1, *images.shape)
        central = jax.jit(jax.vmap(lambda each: (loss(images + each) - loss(images - each)) / 2e-6))(steps)
        np.testing.assert_allclose(jax.jit(jax.grad(loss))(images).reshape(-1), central, atol=1e-9)


def test_right_depth_costs_nothing_and_no_points_neither():
    depth = jnp.asarray(DEPTH, jnp.float32)
    at = np.arange(30, dtype=np.int32)
    target = a2tg.Target(None, None, None, observed=a2tg.ObservedPoints(at, depth.reshape(-1)))
    output = a2tg.RenderOutput(None, jnp.ones_like(depth), None, Geometry(depth, None, None))
    assert float(PointDepths(1.0)(None, target, output)) < 1e-7
    for length in (0, 4):
        pixels, depths = stacked_points([None], (5, 6), length)
        nothing = dataclasses.replace(target, observed=a2tg.ObservedPoints(pixels[0], depths[0]))
        assert float(PointDepths(1.0)(None, nothing, output)) == 0
    wrong = dataclasses.replace(output, geometry=Geometry(2 * depth, None, None))
    assert PointDepths(1.0)(None, target, wrong) > 0.1


@pytest.mark.long
def test_views_of_the_built_in_scene_see_points_on_its_surfaces():
    scene = a2tg.synthetic_scene(num_views=5, num_points=2_000)
    for view, depth in zip(scene.train, exact_depths(scene), strict=True):
        around = np.stack([np.roll(depth, (y, x), (0, 1)).reshape(-1) for x in (-1, 0, 1) for y in (-1, 0, 1)])
        apart = np.abs(around[:, view.points.pixels] / view.points.depths - 1).min(axis=0)
        assert len(view.points.pixels) > 500 and np.quantile(apart, 0.95) < 0.01
        own = scene.points @ np.asarray(view.camera.viewmat)[:3, :3].T + np.asarray(view.camera.viewmat)[:3, 3]
        places = project(view.camera, scene.points)
        is_within = ((places >= 0) & (places < view.picture.size[::-1])).all(axis=1) & (own[:, 2] > 0)
        assert len(view.points.pixels) < is_within.sum(), "some points are hidden"


def test_batches_hold_the_points_of_their_views(scene):
    """Whether photographs stay on the device or are read for each step; views without points have none."""
    views = (dataclasses.replace(scene.train[0], points=None), *scene.train[1:])
    order = BatchOrder(views, 2, 0)
    most = max(len(view.points.pixels) for view in views[1:])
    for room in (None, 0):
        store = PhotoStore(views, order, 2, extras=Extras(points=True), room=room)
        for iteration in (1, 2):
            batch, places = store.batch(iteration)
            for place, index in enumerate(order.indices(iteration)):
                row = place if places is None else places[place]
                pixels, depths = (np.asarray(x[row]) for x in batch.points)
                assert pixels.shape == (most,)
                own = views[index].points or a2tg.ObservedPoints(np.zeros(0, np.int32), np.zeros(0, np.float32))
                np.testing.assert_array_equal(pixels[depths > 0], own.pixels)
                np.testing.assert_array_equal(depths[depths > 0], own.depths)
                assert (np.diff(pixels) > 0).all()
        store.close()
    assert stack_views(list(views)).points is None
    more = view_bytes(views[1], Extras(points=True)) - view_bytes(views[1])
    assert more == 8 * len(views[1].points.pixels) and view_bytes(views[0], Extras(points=True)) == view_bytes(views[0])


@pytest.mark.long
def test_training_moves_depths_to_the_points(scene):
    """Wrong points to start from: rendered depth comes nearer to the true one with the loss than without."""
    moved = dataclasses.replace(scene, points=scene.points + 0.1 * RNG.normal(size=scene.points.shape).astype("f4"))
    truth = exact_depths(scene)[0]

    def error(**options):
        system = small(stage1_iterations=150, **options)
        model = a2tg.fit(moved, system, progress=False).model
        output = a2tg.Renderer(model)(scene.train[0].camera)
        covered = np.asarray(output.alpha) > 0.5
        return np.abs(1 / truth - np.asarray(output.alpha) / np.asarray(output.depth))[covered].mean()

    assert error(loss={"points_weight": 1.0}) < 0.9 * error()


@pytest.mark.parametrize("points, printed", [
    (a2tg.ObservedPoints(np.zeros((1, 2), np.int32), np.ones((1, 2), np.float32)), "must be pixels [S] int32 and"),
    (a2tg.ObservedPoints(np.zeros(2, np.int32), np.ones(2, np.float32)), "must have increasing pixels from 0 to 1199"),
    (a2tg.ObservedPoints(np.array([1200], np.int32), np.ones(1, np.float32)), "must have increasing pixels from 0 to"),
    (a2tg.ObservedPoints(np.array([3], np.int32), np.array([np.nan], np.float32)), "must have depths from 1e-12 to"),
    ((np.zeros(1, np.int32), np.ones(1, np.float32)), "must be ObservedPoints; got tuple"),
    (3, "must be ObservedPoints; got int"),
])  # fmt: skip
def test_other_points_are_refused(scene, points, printed):
    first = dataclasses.replace(scene.train[0], points=points)
    with pytest.raises(ValueError, match=re.escape(f"points of view {first.name} {printed}")) as caught:
        a2tg.fit(dataclasses.replace(scene, train=(first,)), small(), progress=False)
    assert str(caught.value).endswith(": make them with observed_points")


@pytest.mark.parametrize("far", [1e13, 1e39, 1e-14, np.inf])
@pytest.mark.filterwarnings("ignore:.* left out, not finite")
def test_points_too_far_or_too_near_are_left_out(tmp_path, far):
    reconstruction = with_observations(tmp_path, "PINHOLE", [range(1, 30)] * 5)
    image = reconstruction.find_image_with_name("img_00.png")
    reconstruction.points3D[7].xyz = image.cam_from_world().inverse() * np.array([0, 0, far])
    reconstruction.write_binary(str(tmp_path / "sparse/0"))
    depths = a2tg.load_scene(tmp_path, test_every=0).train[0].points.depths
    assert np.isfinite(depths).all() and len(depths) > 5 and depths.max() < 100
