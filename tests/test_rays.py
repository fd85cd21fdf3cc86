"""Cameras with a ray for each pixel: the picture of a pinhole camera where they are one, and of each ray elsewhere."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_camera, as_gaussians, as_textures, draw_scene

import a2tg_jax as a2tg
from a2tg_jax.core.cameras import Camera, resize_camera

WIDTH, HEIGHT = 43, 30


def fisheye(camera: Camera) -> Camera:
    """The camera behind an equidistant lens: a pixel at r focal lengths from the middle looks at an angle of r."""
    K, dtype = np.asarray(camera.K, np.float64), camera.K.dtype
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    places = np.linalg.solve(K, np.stack([x, y, np.ones_like(x)]).reshape(3, -1))[:2]
    angles = np.linalg.norm(places, axis=0)
    seen = np.concatenate([places * np.tan(angles) / angles, np.ones((1, places.shape[1]))])
    rays = (K @ seen)[:2].T.reshape(camera.height, camera.width, 2)
    return dataclasses.replace(camera, rays=jnp.asarray(rays, dtype))


def pinhole_rays(camera: Camera, K) -> Camera:
    """The rays of a pinhole camera K, in the image plane of the camera's own."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    places = np.asarray(camera.K, np.float64) @ np.linalg.solve(K, np.stack([x, y, np.ones_like(x)]).reshape(3, -1))
    rays = (places[:2] / places[2]).T.reshape(camera.height, camera.width, 2)
    return dataclasses.replace(camera, rays=jnp.asarray(rays, camera.K.dtype))


def draw(scene, camera, **settings):
    settings = a2tg.RenderSettings(compositor="xla", **settings)
    return a2tg.render_image(as_gaussians(scene, "float64"), camera, *as_textures(scene, "float64"), settings=settings)


@pytest.mark.parametrize("tile_size", [8, 5])
@pytest.mark.parametrize("change", [np.eye(3), [[0.6, 0.05, 9.0], [0.02, 1.3, -4.0], [0.0, 0.0, 1.0]]])
def test_rays_of_a_pinhole_camera_show_what_it_shows(x64, change, tile_size):
    """Low-pass filter included: it is as wide in the pixels of the image, wherever their rays are."""
    scene = draw_scene(3)
    camera = as_camera(scene, "float64")
    K = np.asarray(change) @ np.asarray(camera.K)
    # A pinhole camera of any affine K: the 2×2 part of `change` may turn and shear, which no K of a camera does.
    of_pinhole = draw(scene, dataclasses.replace(camera, K=jnp.asarray(K)), tile_size=tile_size)
    of_rays = draw(scene, pinhole_rays(camera, K), tile_size=tile_size)
    assert float(of_pinhole.alpha.max()) > 0.5
    for wanted, found in zip(of_pinhole, of_rays, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_every_pixel_of_a_fisheye_sees_along_its_own_ray(x64):
    """As a pinhole camera of a single pixel does; splats are larger than pixels, so that no filter decides."""
    scene = draw_scene(4, num=12)
    camera = fisheye(as_camera(scene, "float64"))
    gaussians = as_gaussians(scene, "float64")
    gaussians = dataclasses.replace(gaussians, log_scales=jnp.log(jnp.maximum(gaussians.scales, 0.4)))
    settings = a2tg.RenderSettings(compositor="xla")
    whole = a2tg.render_image(gaussians, camera, settings=settings)
    moved = np.abs(np.asarray(camera.rays) - np.asarray(pinhole_rays(camera, camera.K).rays)).max()
    assert moved > 3
    for row, column in [(0, 0), (3, 40), (14, 21), (29, 42), (29, 0), (15, 2)]:
        shift = np.asarray(camera.rays[row, column]) - 0.5
        K = np.asarray(camera.K) - np.pad(np.outer(shift, [0, 0, 1]), ((0, 1), (0, 0)))
        one = a2tg.render_image(gaussians, Camera(camera.viewmat, jnp.asarray(K), 1, 1), settings=settings)
        for name in ("color", "alpha", "depth", "normal"):
            np.testing.assert_allclose(getattr(whole, name)[row, column], getattr(one, name)[0, 0], atol=1e-10)


def test_gradients_through_rays_are_those_of_finite_differences(x64):
    scene = draw_scene(6, num=15)
    camera, gaussians = fisheye(as_camera(scene, "float64")), as_gaussians(scene, "float64")
    settings = a2tg.plan_render(gaussians, [camera], settings=a2tg.RenderSettings(compositor="xla"))
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


def test_pixels_without_a_ray_see_the_background(x64):
    scene = draw_scene(5)
    camera = fisheye(as_camera(scene, "float64"))
    hidden = np.zeros((HEIGHT, WIDTH), bool)
    hidden[:8, :8], hidden[20, 30] = True, True
    blind = dataclasses.replace(camera, rays=jnp.where(hidden[..., None], jnp.nan, camera.rays))
    found, wanted = draw(scene, blind), draw(scene, camera)
    assert np.asarray(wanted.alpha)[hidden].max() > 0.1 and not np.asarray(found.alpha)[hidden].any()
    # A tile's frame, and with it the low-pass filter, follows from the rays that it has.
    np.testing.assert_allclose(np.asarray(found.color)[~hidden], np.asarray(wanted.color)[~hidden], atol=1e-5)
    gradient = jax.grad(lambda means: jnp.sum(a2tg.render_image(
        dataclasses.replace(as_gaussians(scene, "float64"), means=means), blind,
        settings=a2tg.RenderSettings(compositor="xla")).color))(as_gaussians(scene, "float64").means)  # fmt: skip
    assert np.isfinite(gradient).all()


def test_rays_are_resized_with_their_image():
    camera = fisheye(as_camera(draw_scene(1), "float32"))
    smaller = resize_camera(camera, 21, 15)
    again = fisheye(resize_camera(dataclasses.replace(camera, rays=None), 21, 15))
    np.testing.assert_allclose(smaller.rays, again.rays, atol=0.05)
    np.testing.assert_array_equal(resize_camera(camera, WIDTH, HEIGHT).rays, camera.rays)


def test_wrong_rays_are_refused():
    scene = draw_scene(1)
    camera = dataclasses.replace(as_camera(scene, "float32"), rays=jnp.zeros((4, 5, 2)))
    with pytest.raises(ValueError, match=r"camera.rays must be .*\[30, 43, 2\].*\[4, 5, 2\]"):
        a2tg.render_image(as_gaussians(scene, "float32"), camera)
    camera = fisheye(as_camera(scene, "float32"))
    with pytest.raises(ValueError, match="cannot render cameras with rays: say 'xla', or 'auto'"):
        a2tg.render_image(as_gaussians(scene, "float32"), camera, settings=a2tg.RenderSettings(compositor="native"))
