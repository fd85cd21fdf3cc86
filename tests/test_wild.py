"""Scenes in the wild: robust masks, bilateral grids, depth priors and floaters, each against a plain twin."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from scenes_random import as_camera, as_gaussians, draw_scene
from test_data_colmap import HEIGHT, WIDTH, write_scene

import a2tg_jax as a2tg
from a2tg_jax import BilateralGrid, Due, Geometry, LossConfig, adam_init
from a2tg_jax.data.photo_reading import find_depths, read_depths
from a2tg_jax.densify.pruning import shown_in
from a2tg_jax.results.run_evaluation import learned_corrections
from a2tg_jax.training.batches import stack_views
from a2tg_jax.training.start import initial_model
from a2tg_jax.training.terms import inliers, scale_and_shift

RNG = np.random.default_rng(0)


def differences(function, x, step=1e-6):
    """Central differences of a scalar function in each coordinate."""
    x = jnp.asarray(x)
    steps = step * jnp.eye(x.size).reshape(x.size, *x.shape)
    central = jax.jit(jax.vmap(lambda each: (function(x + each) - function(x - each)) / (2 * step)))
    return central(steps).reshape(x.shape)


@pytest.fixture(scope="module")
def scene():
    return a2tg.synthetic_scene(num_views=5, width=40, height=30, num_points=150)


def small(**options):
    options = {"stage1_iterations": 4, "initial_gaussians": None, "densify": {"cap": 0}, **options}
    return a2tg.find_system("gaussians-2d-mcmc").preset("smoke", **options)


@pytest.fixture(scope="module")
def trained(scene):
    """A training with all of it: one view has a depth map, and 20 points hang before a camera."""
    camera = scene.train[0].camera
    near = np.asarray(camera.center + 0.1 * camera.viewmat[2, :3])[None] + 0.01 * RNG.normal(size=(20, 3))
    points = np.concatenate([near, scene.points])
    colors = np.concatenate([np.ones((20, 3)), scene.colors])
    first = dataclasses.replace(scene.train[0], depth=RNG.uniform(0.5, 1, (30, 40)).astype(np.float32))
    found = dataclasses.replace(
        scene, train=(first, *scene.train[1:]), points=points.astype(np.float32), colors=colors.astype(np.float32)
    )
    system = small(
        exposure=True, corrections={"exposure_kind": "grid", "grid": {"size": [4, 4, 2]}},
        floaters={"min_views": 2, "at": [1.0]},
        loss={"depth_weight": 1.0, "robust_share": 0.2, "ssim_weight": 0.0},
    )  # fmt: skip
    return a2tg.fit(found, system)


class TestRobust:
    residual = jnp.asarray(np.random.default_rng(1).uniform(0.02, 0.06, (64, 96)))

    def test_a_blob_is_left_out_and_nothing_else(self):
        found = inliers(self.residual.at[24:36, 40:60].set(0.5), 0.2, 4.0)
        assert not found[24:36, 40:60].any()
        assert found.mean() > 0.9 and found[:20].all() and found[:, 64:].all()
        assert inliers(self.residual.at[40, 60].set(0.5), 0.2, 4.0).all(), "a single pixel is no outlier"

    def test_pixels_outside_the_mask_change_nothing(self):
        residual = self.residual.at[24:36, 40:60].set(0.5)
        mask = jnp.zeros((64, 96), bool).at[:, 24:].set(True)
        found = [inliers(residual.at[:, :24].set(value), 0.2, 4.0, mask)[:, 24:] for value in (0.0, 0.9)]
        np.testing.assert_array_equal(*found)
        assert not found[0].all()

    @pytest.mark.parametrize("error, progress", [(0.02, 1.0), (0.5, 0.1)])
    def test_without_outliers_and_in_the_beginning_it_is_the_photometric_loss(self, error, progress):
        image = jnp.full((32, 32, 3), 0.5, jnp.float32)
        target = a2tg.Target(None, (image + 0.02).at[8:16, 8:16].add(error), jnp.zeros(3), progress=progress)
        output = a2tg.RenderOutput(image, None, None)
        values = [LossConfig(robust_share=share).terms()[0](None, target, output) for share in (0.0, 0.2)]
        np.testing.assert_array_equal(*values)

    def test_the_gradient_is_zero_in_what_is_left_out(self):
        image = jnp.full((32, 32, 3), 0.5)
        target = a2tg.Target(None, (image + 0.02).at[8:16, 8:16].set(1.0), jnp.zeros(3))

        def loss(color):
            (term,) = LossConfig(ssim_weight=0.0, robust_share=0.2).terms(is_first=False)
            return term(None, target, a2tg.RenderOutput(color, None, None))

        gradient = jax.grad(loss)(image)
        assert not gradient[8:16, 8:16].any() and (gradient[20:] != 0).all()


class TestBilateralGrid:
    @pytest.mark.usefixtures("x64")
    def test_slices_are_those_of_plain_loops(self):
        grid = RNG.normal(size=(3, 2, 4, 3, 4))
        color = RNG.uniform(size=(5, 7, 3))
        found = BilateralGrid().color(jnp.asarray(grid), jnp.asarray(color))
        for y, x in np.ndindex(5, 7):
            luminance = color[y, x] @ (0.299, 0.587, 0.114)
            places = (luminance * 2, (y + 0.5) / 5 * 1, (x + 0.5) / 7 * 3)
            affine = np.zeros((3, 4))
            for node in np.ndindex(3, 2, 4):
                weights = [max(0, 1 - abs(place - at)) for place, at in zip(places, node, strict=True)]
                affine += np.prod(weights) * grid[node]
            np.testing.assert_allclose(found[y, x], affine[:, :3] @ color[y, x] + affine[:, 3], rtol=1e-12)

    @pytest.mark.usefixtures("x64")
    def test_gradients_are_exact(self):
        numbers = np.concatenate([RNG.normal(size=96), RNG.uniform(0.1, 0.4, size=18)])
        weights = jnp.asarray(RNG.normal(size=(2, 3, 3)))
        correction = BilateralGrid(smoothness=1.0)

        def value(numbers):
            grid = numbers[:96].reshape(2, 2, 2, 3, 4)
            color = numbers[96:].reshape(2, 3, 3)
            return jnp.sum(weights * correction.color(grid, color)) + correction.penalty(grid)

        found = jax.jit(jax.grad(value))(jnp.asarray(numbers))
        np.testing.assert_allclose(found, differences(value, numbers), rtol=1e-6, atol=1e-8)

    def test_it_begins_as_the_identity_and_holds_every_affine_map(self):
        correction = BilateralGrid(size=(3, 2, 4))
        color = jnp.asarray(RNG.uniform(size=(6, 5, 3)), jnp.float32)
        neutral = jnp.asarray(correction.neutral, jnp.float32)
        np.testing.assert_allclose(correction.color(neutral, color), color, atol=1e-6)
        assert correction.penalty(neutral) == 0
        affine = RNG.normal(size=(3, 4)).astype(np.float32)
        whole = jnp.broadcast_to(affine, neutral.shape)
        np.testing.assert_allclose(
            correction.color(whole, color), np.asarray(color) @ affine[:, :3].T + affine[:, 3], atol=1e-5
        )

    def test_on_average_over_the_views_nothing_changes(self):
        correction = BilateralGrid(size=(3, 2, 4))
        rows = jnp.asarray(RNG.normal(size=(5, *correction.neutral.shape)), jnp.float32)
        projected = correction.project(rows)
        np.testing.assert_allclose(projected.mean(axis=0), correction.neutral, atol=1e-6)
        np.testing.assert_allclose(projected[1] - projected[0], rows[1] - rows[0], atol=1e-5)

    @pytest.mark.long
    def test_a_training_learns_grids(self, scene, trained):
        origin = trained.model.origin
        grids = origin.corrections["bilateral_grid"]
        assert grids.shape == (5, 2, 4, 4, 3, 4)
        assert np.abs(grids[: len(scene.train)] - np.eye(3, 4)).max() > 1e-4
        assert all(set(found) == {"exposure"} for found in learned_corrections(origin).values())


def depth_term(kind="inverse"):
    return LossConfig(depth_weight=1.0, depth_kind=kind).terms()[-1]


class TestDepthPrior:
    @pytest.mark.usefixtures("x64")
    def test_scale_and_shift_are_those_of_least_squares(self):
        prior = RNG.uniform(size=(6, 7))
        counts = RNG.random((6, 7)) < 0.7
        inverse = 2 * prior + 3 + 0.3 * RNG.normal(size=(6, 7))
        columns = np.stack([prior[counts], np.ones(counts.sum())], axis=1)
        expected = np.linalg.lstsq(columns, inverse[counts], rcond=None)[0]
        found = scale_and_shift(*map(jnp.asarray, (prior, inverse, counts)))
        np.testing.assert_allclose(found, expected, rtol=1e-10)
        alone = scale_and_shift(*map(jnp.asarray, (prior, inverse, counts)), has_shift=False)
        np.testing.assert_allclose(alone, (np.linalg.lstsq(columns[:, :1], inverse[counts], rcond=None)[0][0], 0))
        np.testing.assert_allclose(scale_and_shift(*map(jnp.asarray, (-prior, inverse, counts)))[0], 0)

    @pytest.mark.usefixtures("x64")
    def test_gradients_are_exact_with_scale_and_shift_held(self):
        images = jnp.asarray(np.stack([RNG.uniform(1, 2, (3, 4)), RNG.uniform(0.6, 1, (3, 4))]))
        prior = jnp.asarray(RNG.uniform(size=(3, 4)))
        counts = jnp.asarray(RNG.random((3, 4)) < 0.8)
        inverse = jnp.where(counts, images[1] / images[0], 0)
        num = float(counts.sum())
        scale, shift = scale_and_shift(jnp.where(counts, prior, 0), inverse, counts)

        def held(images):
            return jnp.sum(jnp.where(counts, jnp.abs(scale * prior + shift - images[1] / images[0]), 0)) / num

        def loss(images):
            depth, alpha = images
            output = a2tg.RenderOutput(None, alpha, None, Geometry(depth, None, None))
            target = a2tg.Target(None, None, None, depth_map=jnp.where(counts, prior, jnp.nan))
            return depth_term()(None, target, output)

        found = jax.jit(jax.grad(loss))(images)
        np.testing.assert_allclose(found, differences(held, images), rtol=1e-6, atol=1e-9)

    def test_right_depth_costs_nothing_and_unknown_depth_neither(self):
        depth = jnp.asarray(RNG.uniform(1, 2, (5, 6)), jnp.float32)
        one = jnp.ones_like(depth)
        output = a2tg.RenderOutput(None, one, None, Geometry(depth, None, None))
        for kind, prior in (("inverse", 3 / depth - 1), ("depth", 7 * depth)):
            target = a2tg.Target(None, None, None, depth_map=prior.at[0].set(jnp.nan))
            assert depth_term(kind)(None, target, output) < 1e-5
        nothing = a2tg.Target(None, None, None, depth_map=jnp.full_like(depth, jnp.nan))
        assert depth_term()(None, nothing, output) == 0
        wrong = a2tg.Target(None, None, None, depth_map=depth)
        assert depth_term()(None, wrong, output) > 0.05

    @pytest.mark.long
    def test_a_training_needs_some_and_may_lack_others(self, scene, trained):
        printed = r"loss.depth_weight, or a custom term, needs depth maps, but no training view has one"
        with pytest.raises(ValueError, match=printed):
            a2tg.fit(scene, small(loss={"depth_weight": 1.0}))
        assert np.isfinite(trained.history.loss).all()

    def test_maps_come_with_their_photographs(self, scene):
        values = RNG.uniform(size=(30, 40))
        values[3, 4] = np.inf
        first = dataclasses.replace(scene.train[0], depth=4 * values)
        stack = stack_views([first, scene.train[1]], has_depths=True)
        expected = np.where(np.isinf(values), np.nan, values / values[values < 2].max())
        np.testing.assert_allclose(stack.depths[0], expected, rtol=1e-6)
        assert np.isnan(stack.depths[1]).all() and stack_views([first]).depths is None


class TestDepthFiles:
    def test_both_formats_are_found_and_read(self, tmp_path):
        (tmp_path / "depths/a").mkdir(parents=True)
        values = RNG.uniform(size=(4, 6)).astype(np.float32)
        np.save(tmp_path / "depths/a/x.npy", values[None])
        Image.fromarray((65535 * values).astype(np.uint16)).save(tmp_path / "depths/y.jpg.png")
        images = tmp_path / "images"
        np.testing.assert_array_equal(read_depths(find_depths(images, "a/x.jpg")), values)
        np.testing.assert_allclose(read_depths(find_depths(images, "y.jpg")), values, atol=1e-4)
        assert find_depths(images, "z.jpg") is None

    def test_capitals_and_either_byte_order(self, tmp_path):
        levels = (1000 * np.arange(24)).reshape(4, 6)
        np.save(tmp_path / "x.npy", levels / 65535)
        (tmp_path / "x.npy").rename(tmp_path / "x.NPY")
        Image.frombytes("I;16B", (6, 4), levels.astype(">u2").tobytes()).save(tmp_path / "x.tif")
        for name in ("x.NPY", "x.tif"):
            np.testing.assert_allclose(read_depths(tmp_path / name), levels / 65535, rtol=1e-6)
        Image.fromarray(levels.astype(np.int32) << 16).save(tmp_path / "deep.tif")
        with pytest.raises(ValueError, match=r"deep\.tif: must be greyscale, of 8 or 16 bits; its mode is I"):
            read_depths(tmp_path / "deep.tif")

    def test_they_are_undistorted_and_resized_with_their_photographs(self, tmp_path):
        """A step in a map of twice the size is where the step in the photograph's undistorted mask is."""
        write_scene(tmp_path, models=("OPENCV_FISHEYE",), num_views=3)
        (tmp_path / "depths").mkdir()
        (tmp_path / "masks").mkdir()
        for name in ("img_00", "img_01", "img_02"):
            is_left = np.broadcast_to(np.arange(2 * WIDTH) < WIDTH // 2, (2 * HEIGHT, 2 * WIDTH))
            np.save(tmp_path / f"depths/{name}.npy", np.where(is_left, 2.0, 1.0))
            Image.fromarray(255 * is_left[::2, ::2].astype(np.uint8)).save(tmp_path / f"masks/{name}.png")
        for view in a2tg.load_scene(tmp_path, downscale=2, test_every=0).train:
            depth = view.depth.read()
            assert depth.shape == view.picture.size and depth.min() == 0.5 and depth.max() == 1
            assert np.mean((depth > 0.75) != view.mask.read()) < 0.04

    def test_another_aspect_is_refused(self, tmp_path):
        write_scene(tmp_path, num_views=3)
        (tmp_path / "depths").mkdir()
        np.save(tmp_path / "depths/img_00.npy", np.ones((HEIGHT, 2 * WIDTH)))
        view = a2tg.load_scene(tmp_path, test_every=0).train[0]
        with pytest.raises(ValueError, match="of another aspect than its photograph"):
            view.depth.read()


def are_near(points, views, near):
    """[N] whether an event prunes the points [N, 3] as close to a camera, with others that no camera sees."""
    unseen = np.full((2, 3), 1e3)
    gaussians = a2tg.init_from_points(np.concatenate([points, unseen]), np.zeros((len(points) + 2, 3)))
    numbered = dataclasses.replace(gaussians, logit_opacities=jnp.arange(gaussians.num, dtype=jnp.float32))
    model = a2tg.Model(numbered)
    moments = adam_init(a2tg.partition(model)[0])
    change = a2tg.PruneFloaters(min_views=0, near=near).apply(Due(views=views), model, moments, ())
    kept = np.asarray(change.model.live.gaussians.logit_opacities).astype(int)
    return ~np.isin(np.arange(len(points)), kept)


class TestFloaters:
    @pytest.mark.long
    def test_views_are_counted_as_each_alone_says(self):
        scene = draw_scene(0)._replace(textures=None)
        model = a2tg.Model(as_gaussians(scene, "float32"))
        camera = as_camera(scene, "float32")
        picture = np.zeros((camera.height, camera.width, 3), np.uint8)
        turned = dataclasses.replace(camera, viewmat=camera.viewmat.at[0, 3].add(0.7))
        views = [a2tg.View(str(index), each, picture) for index, each in enumerate((camera, turned))]
        found = shown_in(model, Due(views=views), least=2.0)
        alone = [shown_in(model, Due(views=[view])).weights for view in views]
        np.testing.assert_array_equal(found.num_views, sum(weights >= 2.0 for weights in alone))
        assert len(set(found.num_views.tolist())) > 1
        change = a2tg.PruneFloaters(min_views=2, least=2.0).apply(
            Due(views=views), model, adam_init(a2tg.partition(model)[0]), ()
        )
        assert change.model.num == (found.num_views >= 2).sum()
        np.testing.assert_array_equal(change.model.live.gaussians.means, model.gaussians.means[found.num_views >= 2])

    def test_what_is_close_before_a_camera(self, scene):
        camera = scene.train[0].camera
        forward = np.asarray(camera.viewmat)[2, :3]
        right = np.asarray(camera.viewmat)[0, :3]
        center = np.asarray(camera.center)
        points = np.stack(
            [center + 0.1 * forward, center + 0.5 * forward, center - 0.1 * forward, center + 0.1 * right]
        )
        np.testing.assert_array_equal(are_near(points, scene.train[:1], 0.2), [True, False, False, False])

    def test_what_is_close_before_a_fisheye(self, scene):
        """Its rays are far outside the picture in the plane of K; some of its pixels have none."""
        view = scene.train[0]
        width, height = view.camera.width, view.camera.height
        column, row = np.meshgrid(np.linspace(-2 * width, 3 * width, width), np.linspace(-height, 2 * height, height))
        rays = np.stack([column, row], axis=2)
        rays[0, 0] = np.nan
        wide = dataclasses.replace(view, camera=dataclasses.replace(view.camera, rays=jnp.asarray(rays)))
        pixels = np.asarray([[-1.5, 0.5], [2.5, 1.5], [3.5, 0.5], [0.5, -1.5]]) * (width, height)
        K = np.asarray(view.camera.K)
        viewmat = np.asarray(view.camera.viewmat)
        seen = 0.1 * np.concatenate([pixels, np.ones((4, 1))], axis=1) @ np.linalg.inv(K).T
        points = (seen - viewmat[:3, 3]) @ viewmat[:3, :3]
        near = 0.2
        np.testing.assert_array_equal(are_near(points, [wide], near), [True, True, False, False])
        np.testing.assert_array_equal(are_near(points, [view], near), False)
        unseen = dataclasses.replace(wide, camera=dataclasses.replace(wide.camera, rays=jnp.full_like(rays, np.nan)))
        assert not are_near(points, [unseen], near).any()

    @pytest.mark.long
    def test_a_training_without_them(self, scene, trained):
        model = trained.model
        assert len(scene.points) / 2 < model.num <= len(scene.points)
        assert not are_near(np.asarray(model.gaussians.means), scene.train, 0.2).any()

    def test_they_are_pruned_while_others_grow(self):
        system = a2tg.Gaussians2d()
        late = a2tg.PruneFloaters(min_views=0, near=0.2, at=(0.5, 0.8))
        floaters = dataclasses.replace(late, at=(0.3, 0.4, 0.5))
        (stage,) = dataclasses.replace(system, floaters=floaters).stages()
        assert stage.events[-1].at == (0.3, 0.4)
        with pytest.raises(ValueError, match=r"floaters\.at must hold a fraction before the last growth, which is at"):
            dataclasses.replace(system, floaters=late).check()
        (stage,) = small(floaters={"near": 0.2, "at": [0.5, 1.0]}).stages()
        assert stage.events[-1].at == (0.5, 1.0), "nothing grows"

    def test_pruning_that_would_leave_nothing(self, scene):
        system = small()
        model = initial_model(scene, system)
        moments = adam_init(a2tg.partition(model)[0])
        with pytest.warns(UserWarning, match=r"no floaters are pruned, because 0 of 150 .* min_views"):
            change = a2tg.PruneFloaters(min_views=2, least=1e9).apply(Due(views=scene.train), model, moments, ())
        assert change.model.num == model.num


class TestSupersampling:
    @pytest.mark.long
    def test_a_pixel_is_the_mean_of_a_finer_view(self):
        scene = draw_scene(0)._replace(textures=None)
        model = a2tg.Model(as_gaussians(scene, "float32"))
        camera = as_camera(scene, "float32")
        found = a2tg.Renderer(model, settings=a2tg.RenderSettings(supersample=2))(camera)
        fine = a2tg.Renderer(model)(a2tg.resize_camera(camera, 2 * camera.width, 2 * camera.height))
        for name in ("color", "depth", "normal"):
            image = np.asarray(getattr(fine, name))
            mean = (image[::2, ::2] + image[1::2, ::2] + image[::2, 1::2] + image[1::2, 1::2]) / 4
            np.testing.assert_allclose(getattr(found, name), mean, atol=1e-6)
