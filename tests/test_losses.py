"""Losses: SSIM against scikit-image, normals of a depth map against a plane, gradients against differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from skimage.metrics import structural_similarity

from a2tg_jax import (
    Camera,
    LossConfig,
    Model,
    init_from_points,
    normal_consistency,
    photometric_loss,
    set_num_threads,
    value_and_grad,
)
from a2tg_jax.rasterize.kernels import platforms, window_scores
from a2tg_jax.rasterize.kernels.native import ssim as kernel
from a2tg_jax.rasterize.kernels.score import Score
from a2tg_jax.training.losses import mean_ssim


def random_pair(height, width, noise, dtype=np.float64, seed=0):
    """A smooth random image and a disturbed copy that leaves [0, 1]."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(width) / width, np.arange(height) / height)
    image = 0.5 + 0.4 * np.stack([np.sin(9 * x + 5 * y + phase) for phase in rng.uniform(0, 6, 3)], -1)
    return image.astype(dtype), (image + noise * rng.normal(size=image.shape)).astype(dtype)


def reference_ssim(image, target):
    return structural_similarity(
        image, target, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=-1
    )


@pytest.mark.parametrize("shape", [(11, 11), (11, 30), (37, 24)])
def test_ssim_equals_scikit_image(x64, shape):
    jitted = jax.jit(mean_ssim)
    for noise in (0.0, 0.02, 0.5):
        image, target = random_pair(*shape, noise)
        wanted = reference_ssim(image, target)
        np.testing.assert_allclose(jitted(image, target), wanted, atol=1e-12)
        wanted = 0.8 * np.abs(image - target).mean() + 0.2 * (1 - wanted)
        np.testing.assert_allclose(photometric_loss(image, target), wanted, atol=1e-12)
    gradient = jax.jit(jax.grad(photometric_loss))(jnp.zeros((*shape, 3)), jnp.zeros((*shape, 3)))
    assert np.isfinite(gradient).all(), "of flat images, too"


@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_gradient_equals_central_differences_at_every_pixel(x64, weight):
    image, target = map(jnp.asarray, random_pair(13, 19, 0.1))

    def loss(flat):
        return photometric_loss(flat.reshape(image.shape), target, ssim_weight=weight)

    eps = 1e-6
    steps = eps * jnp.eye(image.size)
    values = jax.jit(jax.vmap(loss))(image.ravel()[None] + jnp.concatenate([steps, -steps]))
    differences = (values[: image.size] - values[image.size :]) / (2 * eps)
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(image.ravel()), differences, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("is_native", [True, pytest.param(False, marks=pytest.mark.long)])
def test_first_and_second_derivatives_in_both_modes(monkeypatch, x64, is_native):
    """Forward mode is the gradient along a direction; second derivatives are differences of gradients."""
    monkeypatch.setattr(platforms, "has_native", lambda: is_native)
    image, target = map(jnp.asarray, random_pair(11, 18, 0.1))
    direction = jnp.sin(jnp.arange(image.size, dtype=image.dtype)).reshape(image.shape)
    eps = 1e-6
    gradient = jax.grad(lambda image: photometric_loss(image, target))

    def derivatives(image):
        along = jax.jacfwd(lambda step: photometric_loss(image + step * direction, target))(0.0)
        forward_over_reverse = jax.jvp(gradient, (image,), (direction,))[1]
        return along, forward_over_reverse, jax.grad(lambda image: jnp.vdot(gradient(image), direction))(image)

    along, *seconds = jax.jit(derivatives)(image)
    here, ahead, behind = (jax.jit(gradient)(image + step * direction) for step in (0, eps, -eps))
    np.testing.assert_allclose(along, jnp.vdot(here, direction), rtol=1e-9)
    for second in seconds:
        np.testing.assert_allclose(second, (ahead - behind) / (2 * eps), atol=1e-6 * jnp.abs(seconds[0]).max())


@pytest.mark.parametrize("is_native", [True, pytest.param(False, marks=pytest.mark.long)])
def test_ssim_of_a_batch_under_vmap_and_jit(monkeypatch, is_native):
    monkeypatch.setattr(platforms, "has_native", lambda: is_native)
    pairs = [random_pair(14, 31, 0.1, np.float32, seed) for seed in range(3)]
    images, targets = (jnp.stack([jnp.asarray(x) for x in side]) for side in zip(*pairs, strict=True))
    batched = jax.jit(jax.vmap(jax.value_and_grad(mean_ssim)))(images, targets)
    single = jax.jit(jax.value_and_grad(mean_ssim))
    for index in range(3):
        value, gradient = single(images[index], targets[index])
        np.testing.assert_allclose(batched[0][index], value, rtol=1e-5)
        np.testing.assert_allclose(batched[1][index], gradient, rtol=1e-3, atol=1e-6)


def test_bad_images_are_named():
    image = jnp.zeros((12, 12, 3))
    with pytest.raises(ValueError, match="at least 11 by 11"):
        mean_ssim(image[:10], image[:10])
    with pytest.raises(ValueError, match="must both be"):
        photometric_loss(image, image[:11])
    with pytest.raises(ValueError, match="must be floats"):
        photometric_loss(image, jnp.zeros((12, 12, 3), jnp.uint8))
    assert photometric_loss(image[:4], image[:4], ssim_weight=0.0) == 0


def plane_view(width=17, height=13):
    """A turned camera and the depth map it sees of a tilted plane, whose world normal faces it."""
    angle = 0.4
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, (0.3, -0.2, 0.5)
    K = np.array([[20.0, 0, 8], [0, 22, 7], [0, 0, 1]])
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T
    normal = np.array([0.3, -0.4, -1.0]) / np.linalg.norm([0.3, -0.4, -1.0])
    depth = normal[2] * 4 / (rays @ normal)
    camera = Camera(jnp.asarray(viewmat), jnp.asarray(K), width, height)
    return camera, jnp.asarray(depth), jnp.asarray(rotation.T @ normal)


def test_normal_consistency_is_zero_on_its_own_plane_at_any_alpha(x64):
    camera, depth, normal = plane_view()
    alpha = jnp.linspace(0.1, 1.0, depth.size).reshape(depth.shape)
    rendered = alpha[..., None] * normal[None, None]
    np.testing.assert_allclose(normal_consistency(rendered, depth * alpha, alpha, camera), 0, atol=1e-12)
    turned = normal_consistency(-rendered, depth * alpha, alpha, camera)
    np.testing.assert_allclose(turned, 2 * alpha[1:-1, 1:-1].sum() / alpha.size, rtol=1e-12)


def test_normal_consistency_leaves_out_pixels_without_a_surface(x64):
    camera, depth, _ = plane_view()
    hole = jnp.ones_like(depth).at[5, 6].set(0.0)

    def loss(alpha):
        return normal_consistency(jnp.zeros((*depth.shape, 3)), depth * alpha, alpha, camera)

    value, gradient = jax.jit(jax.value_and_grad(loss))(hole)
    np.testing.assert_allclose(value, (11 * 15 - 5) / depth.size, rtol=1e-12)
    assert np.isfinite(gradient).all()


def test_normal_consistency_gradient(x64):
    camera, depth, normal = plane_view(7, 6)
    rng = np.random.default_rng(0)
    alpha = jnp.asarray(rng.uniform(0.3, 1, depth.shape))
    rendered = alpha[..., None] * normal[None, None] + 0.2 * jnp.asarray(rng.normal(size=(6, 7, 3)))
    bumpy = depth * jnp.asarray(rng.uniform(0.9, 1.1, depth.shape))
    loss = jax.jit(lambda *x: normal_consistency(*x, camera))
    check_grads(loss, (rendered, bumpy * alpha, alpha), 1, modes=["rev"], eps=1e-6)


def test_a_gpu_does_not_round_the_points_of_a_depth_map():
    """By default, factors of float32 have 10 bits there, in which neighbouring rays differ by a few steps only."""
    camera, depth, normal = plane_view()

    def loss(depth, camera):
        return normal_consistency(jnp.broadcast_to(normal, (*depth.shape, 3)), depth, jnp.ones_like(depth), camera)

    text = jax.jit(jax.grad(loss, (0, 1))).lower(depth, camera).as_text()
    products = [line for line in text.splitlines() if "dot_general" in line and f"tensor<{depth.shape[0]}x" in line]
    assert len(products) >= 2
    assert all("precision = [HIGHEST, HIGHEST]" in product for product in products)


def test_regularisers_see_live_rows_only():
    rng = np.random.default_rng(0)
    gaussians = init_from_points(rng.normal(size=(8, 3)), rng.uniform(size=(8, 3)))
    model = Model(gaussians, num_live=jnp.int32(5))
    opacity, scale = LossConfig(opacity_weight=1.0, scale_weight=1.0).terms()[1:]
    np.testing.assert_allclose(opacity(model, None, None), gaussians.opacities[:5].mean(), rtol=1e-6)
    value, gradient = value_and_grad(lambda model: scale(model, None, None))(model)
    np.testing.assert_allclose(value, gaussians.scales[:5].mean(), rtol=1e-6)
    slopes = gradient.gaussians.log_scales
    assert (slopes[:5] > 0).all() and (slopes[5:] == 0).all()
    assert opacity(dataclasses.replace(model, num_live=jnp.int32(0)), None, None) == 0


@pytest.mark.parametrize("shape", [(11, 18), (40, 51), (90, 333)])
@pytest.mark.parametrize(("dtype", "rtol"), [(np.float64, 1e-10), (np.float32, 2e-3)])
def test_ssim_and_its_gradients_are_the_same_without_native_loops(monkeypatch, threads, x64, shape, dtype, rtol):
    """In float32 the variances, differences of means of about 0.3, keep four digits where they are about 0.01."""
    monkeypatch.setattr(kernel, "LEAST_PIXELS", 500)
    set_num_threads(2)
    image, target = map(jnp.asarray, random_pair(*shape, 0.1, dtype))
    value, gradients = jax.value_and_grad(mean_ssim, argnums=(0, 1))(image, target)
    jax.clear_caches()
    monkeypatch.setattr(platforms, "has_native", lambda: False)
    exact, wanted = jax.value_and_grad(mean_ssim, argnums=(0, 1))(image.astype(np.float64), target.astype(np.float64))
    np.testing.assert_allclose(value, exact, rtol=rtol / 100)
    for a, b in zip(gradients, wanted, strict=True):
        assert a.dtype == dtype
        np.testing.assert_allclose(a, b, rtol=0, atol=rtol * abs(np.asarray(b)).max())


def test_another_score_of_the_same_name_is_another():
    image, target = (jnp.asarray(x.transpose(2, 0, 1)) for x in random_pair(14, 40, 0.1, np.float32))
    found = [
        window_scores.mean_score(Score(lambda x, y, squares, product, k=k: k * x, (0.5, 0.5)), image, target)
        for k in (1.0, 3.0)
    ]
    np.testing.assert_allclose(found[1], 3 * found[0], rtol=1e-6)


def test_ssim_in_half_precision():
    image, target = random_pair(20, 40, 0.1, np.float16)
    assert jax.jit(mean_ssim)(image, target).dtype == jnp.float16
