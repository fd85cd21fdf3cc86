"""Ellipsoids of 3DGS against the published formulas in NumPy, finite differences, and a short training."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lab.ellipsoids import Ellipsoids, Gaussians3dMcmc
from oracle import rotation_matrix

import a2tg_jax as a2tg


@pytest.fixture
def scene(x64):
    rng = np.random.default_rng(3)
    num = 12
    means = rng.uniform([-1, -1, 3], [1, 1, 5], (num, 3))
    log_scales = np.log(rng.uniform(0.05, 0.4, (num, 3)))
    arrays = means, rng.normal(size=(num, 4)), log_scales[:, :2], rng.uniform(-1, 3, num), rng.normal(size=(num, 4, 3))
    gaussians = a2tg.Gaussians(*(jnp.asarray(array, jnp.float64) for array in arrays))
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)) * 0.1 + np.eye(3))[0] * [1, 1, 1]
    viewmat[:3, :3] *= np.sign(np.diag(viewmat[:3, :3]))[None]
    viewmat[:3, 3] = [0.1, -0.2, 0.3]
    K = np.array([[40.0, 0, 17.0], [0, 42.0, 11.0], [0, 0, 1]])
    camera = a2tg.Camera(jnp.asarray(viewmat), jnp.asarray(K), 32, 24)
    return gaussians, Ellipsoids(log_thickness=jnp.asarray(log_scales[:, 2])), camera


def published(gaussians, appearance, camera):
    """The image by the formulas of the paper of 3DGS, a splat and a pixel at a time."""
    W, t, K = (np.asarray(a) for a in (camera.viewmat[:3, :3], camera.viewmat[:3, 3], camera.K))
    colors = np.asarray(a2tg.Appearance().own_colors(gaussians, camera, 1))
    splats = []
    for i in range(gaussians.num):
        R = rotation_matrix(np.asarray(gaussians.quats[i]))
        S = np.diag(np.exp([*np.asarray(gaussians.log_scales[i]), float(appearance.log_thickness[i])]))
        a, b, c = W @ np.asarray(gaussians.means[i]) + t
        limits = 1.3 * 0.5 * camera.width / K[0, 0], 1.3 * 0.5 * camera.height / K[1, 1]
        tx, ty = (np.clip(value / c, -most, most) for value, most in zip((a, b), limits, strict=True))
        J = np.array([[K[0, 0] / c, 0, -K[0, 0] * tx / c], [0, K[1, 1] / c, -K[1, 1] * ty / c]])
        cov = J @ W @ R @ S @ S @ R.T @ W.T @ J.T + 0.3 * np.eye(2)
        center = np.array([K[0, 0] * a / c + K[0, 2], K[1, 1] * b / c + K[1, 2]])
        splats.append((c, np.linalg.inv(cov), center, 1 / (1 + np.exp(-gaussians.logit_opacities[i])), colors[i]))
    image = np.zeros((camera.height, camera.width, 3))
    for row, column in np.ndindex(camera.height, camera.width):
        transmittance = 1.0
        for _, conic, center, opacity, color in sorted(splats, key=lambda splat: splat[0]):
            d = np.array([column + 0.5, row + 0.5]) - center
            alpha = min(0.99, opacity * np.exp(-0.5 * d @ conic @ d))
            if alpha >= 1 / 255:
                image[row, column] += transmittance * alpha * color
                transmittance *= 1 - alpha
    return image


def test_the_image_is_that_of_the_published_formulas(scene):
    gaussians, appearance, camera = scene
    found = a2tg.Model(gaussians, appearance).render(camera).color
    np.testing.assert_allclose(found, published(gaussians, appearance, camera), atol=1e-9)


def test_gradients_agree_with_differences(scene):
    gaussians, appearance, camera = scene
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(24, 32, 3)))

    @jax.jit
    def loss(log_thickness, quats):
        model = a2tg.Model(dataclasses.replace(gaussians, quats=quats), Ellipsoids(log_thickness=log_thickness))
        return jnp.sum(weights * model.render(camera, settings=a2tg.RenderSettings(capacity=2_000)).color)

    at = appearance.log_thickness, gaussians.quats
    gradients = jax.grad(loss, argnums=(0, 1))(*at)
    step = 1e-6
    for place, (value, gradient) in enumerate(zip(at, gradients, strict=True)):
        direction = jnp.asarray(np.random.default_rng(place).normal(size=value.shape))
        ends = [loss(*at[:place], value + sign * step * direction, *at[place + 1 :]) for sign in (1, -1)]
        difference = float(ends[0] - ends[1]) / (2 * step)
        assert float(jnp.sum(gradient * direction)) == pytest.approx(difference, rel=1e-5)


def test_a_short_training_fills_its_budget_and_learns():
    scene = a2tg.synthetic_scene(num_views=4, width=40, height=30, num_points=100)
    smoke = {"stage1_iterations": 200, "stage2_iterations": 20, "initial_opacity": 0.5, "memory_budget": 0.0084}
    result = a2tg.fit(scene, Gaussians3dMcmc(sh_degree=0, **smoke))
    assert result.model.num_bytes == result.model.num * 56 == 8400
    assert result.model.appearance.log_thickness.shape == (150,)
    history = result.stages[0].history.psnr
    assert history[-4:].mean() > history[:4].mean() + 1


def test_long_splats_close_to_the_camera_have_finite_gradients():
    """Their covariance is nearly singular: 0.3 pixels² beside 10⁸. In float32 a difference of squares would cancel."""
    camera = a2tg.Camera(jnp.eye(4), jnp.asarray([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]), 320, 240)
    quats = jnp.asarray(np.random.default_rng(0).normal(size=(50, 4)), jnp.float32)
    means = jnp.tile(jnp.asarray([[0.02, -0.01, 0.05]]), (50, 1))
    log_scales = jnp.tile(jnp.asarray([[-9.0, -9.0]]), (50, 1))
    gaussians = a2tg.Gaussians(means, quats, log_scales, jnp.zeros(50), jnp.zeros((50, 1, 3)))

    def homographies(gaussians, thickness):
        return Ellipsoids(log_thickness=thickness).homographies(gaussians, camera)[0]

    M, back = jax.vjp(homographies, gaussians, jnp.full(50, 0.4))
    gradients = back(jnp.ones_like(M))
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradients))
    # The shorter axis on the screen is at least that of the low-pass filter.
    across = np.linalg.det(np.asarray(M[:, :2, :2], np.float64)) / 0.05**2
    along = np.linalg.norm(np.asarray(M[:, :2, :2], np.float64), 2, axis=(1, 2)) / 0.05
    assert (across / along).min() > 0.9 * np.sqrt(0.3)
