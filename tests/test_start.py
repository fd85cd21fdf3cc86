"""Start of training from dense points, whose splats are smaller than a pixel."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import a2tg_jax as a2tg
from a2tg_jax import Gaussians
from a2tg_jax.training.start import fainter_where_dense, initial_model, wider_where_dense

FOCAL, DEPTH = 100.0, 2.0


def camera_at(depth: float, focal: float = FOCAL) -> a2tg.Camera:
    """A camera that looks at the origin along z."""
    viewmat = jnp.eye(4).at[2, 3].set(depth)
    return a2tg.Camera(viewmat, jnp.asarray([[focal, 0, 16], [0, focal, 12], [0, 0, 1]]), 32, 24)


def splats(sides_in_pixels, opacity: float) -> Gaussians:
    """Splats at the origin that have these standard deviations, in pixels of `camera_at(DEPTH)`."""
    scales = np.asarray(sides_in_pixels) * DEPTH / FOCAL
    gaussians = a2tg.init_from_points(
        np.random.default_rng(0).normal(size=(len(scales), 3)), np.zeros((len(scales), 3))
    )
    log_scales = jnp.asarray(np.log(np.stack([scales, 3 * scales], axis=1)), jnp.float32)
    logits = jnp.full(len(scales), np.log(opacity / (1 - opacity)), jnp.float32)
    return dataclasses.replace(
        gaussians, means=jnp.zeros_like(gaussians.means), log_scales=log_scales, logit_opacities=logits
    )


def test_layers_of_small_splats_have_the_opacity_of_one():
    """k splats under one pixel of the filter: 1 − (1 − o')^k = o, by hand for k = 1, 2 and 4."""
    sides = np.sqrt([0.5, 0.5 / 2, 0.5 / 4])
    fainter = fainter_where_dense(splats(sides, 0.5), [camera_at(DEPTH)])
    opacities = np.asarray(fainter.opacities, np.float64)
    np.testing.assert_allclose(1 - (1 - opacities) ** [1, 2, 4], 0.5, rtol=1e-4)


def test_splats_of_a_pixel_stay_bit_for_bit():
    given = splats([0.71, 1.0, 30.0], 0.5)
    np.testing.assert_array_equal(fainter_where_dense(given, [camera_at(DEPTH)]).logit_opacities, given.logit_opacities)


def test_the_camera_that_sees_a_splat_largest_decides():
    given = splats([0.5, 0.5], 0.5)
    near = camera_at(DEPTH / 2)
    far = camera_at(4 * DEPTH)
    behind = camera_at(-DEPTH, 10 * FOCAL)
    np.testing.assert_array_equal(fainter_where_dense(given, [far, near]).logit_opacities, given.logit_opacities)
    one = fainter_where_dense(given, [far]).opacities
    np.testing.assert_array_equal(fainter_where_dense(given, [far, behind]).opacities, one)
    assert (np.asarray(one) < 0.5).all()


def test_no_splat_becomes_fainter_than_3dgs_begins():
    for opacity, least in ((0.5, 0.1), (0.1, 0.1), (0.04, 0.04)):
        opacities = fainter_where_dense(splats([1e-2, 1e-3], opacity), [camera_at(DEPTH)]).opacities
        np.testing.assert_allclose(opacities, least, rtol=1e-5)


@pytest.mark.parametrize(("num_points", "least", "most"), [(300, 0.0, 0.1), (9_000, 0.5, 1.0)])
def test_dense_points_start_fainter_and_sparse_ones_as_asked(num_points, least, most):
    scene = a2tg.synthetic_scene(num_views=6, num_points=num_points, width=32, height=24)
    opacities = np.asarray(initial_model(scene, a2tg.Gaussians2dMcmc.preset("quick")).gaussians.opacities)
    assert least <= (opacities < 0.499).mean() <= most
    assert opacities.max() == pytest.approx(0.5)


def test_splats_without_a_filter_begin_a_pixel_wide():
    """Both axes grow alike; what is wide enough, or seen by no camera, stays."""
    given = splats([0.1, 0.5, 2.0], 0.5)
    growth = np.exp(wider_where_dense(given, [camera_at(DEPTH)]).log_scales - given.log_scales)
    np.testing.assert_allclose(growth, np.array([[10.0], [2.0], [1.0]]) * np.ones(2), rtol=1e-5)
    unseen = wider_where_dense(given, [camera_at(-DEPTH)])
    np.testing.assert_array_equal(unseen.log_scales, given.log_scales)


def test_billboards_begin_wide_and_opaque():
    scene = a2tg.synthetic_scene(num_views=4, width=24, height=16, num_points=900)
    system = a2tg.BBSplat.preset("smoke")
    model = initial_model(scene, system)
    plain = initial_model(scene, a2tg.Gaussians2d.preset("smoke"))
    assert (model.gaussians.log_scales > plain.gaussians.log_scales[: model.num]).any()
    np.testing.assert_allclose(model.gaussians.opacities, system.initial_opacity, rtol=1e-5)


def test_points_that_no_view_sees_are_refused():
    scene = a2tg.synthetic_scene(num_views=4, width=24, height=16, num_points=50)
    lost = dataclasses.replace(scene, points=scene.points + np.float32([0, 0, 1000]))
    with pytest.raises(ValueError, match=r"scene\.points: no training view sees any of the 50 points: .*transform"):
        a2tg.fit(lost, a2tg.Gaussians2dMcmc(stage1_iterations=1))


def test_rows_of_given_textures_may_be_in_any_order():
    """Textures that are equal but for the rows of their bucket train to the same model, while Gaussians are added."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Grows(a2tg.System):
        def stages(self):
            appearance = a2tg.Appearance(texture=a2tg.Texture(start=(2, 2)))
            return (a2tg.Stage("grow", appearance, (a2tg.Mcmc(cap=30),), self.loss.terms(), self.rates, 12, 1e-2),)

    scene = a2tg.synthetic_scene(num_views=3, width=16, height=16, num_points=20)
    gaussians = a2tg.init_from_points(scene.points, scene.colors, sh_degree=0)
    rng = np.random.default_rng(0)
    ordered = a2tg.textures_from_arrays(list(rng.random((20, 2, 2, 4), np.float32)))
    rows = rng.permutation(20).astype(np.int32)
    bucket = np.array(ordered.buckets[0])
    bucket[rows] = ordered.buckets[0][:20]
    shuffled = dataclasses.replace(ordered, buckets=(jnp.asarray(bucket),), row=jnp.asarray(rows))
    images = []
    for textures in (ordered, shuffled):
        model = a2tg.Model(gaussians, a2tg.Appearance(texture=a2tg.Texture(textures, start=(2, 2))))
        trained = a2tg.fit(scene, Grows(sh_degree=0, loss=a2tg.LossConfig(ssim_weight=0.0)), start=model).model
        assert trained.num > 20
        images.append(trained.render(scene.train[0].camera).color)
    np.testing.assert_array_equal(*images)
