"""Transformations of JAX that each compositor supports (docs/transformations.md)."""

import dataclasses
import functools
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from scenes_random import as_camera, as_gaussians, as_textures, draw_scene, draw_smooth_scene, render_scene

from a2tg_jax import Camera, RenderSettings, combine, partition, render_image

SCENE = draw_scene(1, num=4, width=8, height=8)
SMOOTH = draw_smooth_scene(53, width=8, height=8)
SETTINGS = RenderSettings(capacity=1024)
CAMERA = as_camera(SCENE, "float32")


def shown(gaussians, viewmat=CAMERA.viewmat):
    camera = Camera(viewmat, CAMERA.K, CAMERA.width, CAMERA.height)
    return render_image(gaussians, camera, settings=SETTINGS).color


def loss(gaussians, viewmat=CAMERA.viewmat):
    return jnp.sum(shown(gaussians, viewmat) ** 2)


def some_gaussians():
    return as_gaussians(SCENE, "float32")


VIEWMATS = jnp.stack([CAMERA.viewmat, CAMERA.viewmat.at[0, 3].add(0.05)])


@functools.cache
def expected():
    """Losses of both views, and the gradient of their sum."""
    one = jax.jit(jax.value_and_grad(loss))
    values, gradients = zip(*(one(some_gaussians(), viewmat) for viewmat in VIEWMATS), strict=True)
    return jnp.stack(values), jax.tree.map(lambda a, b: a + b, *gradients)


def total(losses):
    """Of a function that gives the losses of both views: their gradient."""
    return jax.jit(jax.grad(lambda gaussians: jnp.sum(losses(gaussians))))(some_gaussians())


def in_scan(gaussians):
    return jax.lax.scan(lambda carry, viewmat: (carry, loss(gaussians, viewmat)), 0, VIEWMATS)[1]


WAYS = {
    "vmap": lambda gaussians: jax.vmap(loss, in_axes=(None, 0))(gaussians, VIEWMATS),
    "scan": in_scan,
    "map": lambda gaussians: jax.lax.map(functools.partial(loss, gaussians), VIEWMATS),
    "remat": lambda gaussians: jax.lax.map(functools.partial(jax.checkpoint(loss), gaussians), VIEWMATS),
}


@pytest.mark.parametrize("way", WAYS)
def test_first_derivatives_come_through(way):
    """Values and gradients are those of the views one by one, under jit."""
    values, gradient = expected()
    np.testing.assert_allclose(jax.jit(WAYS[way])(some_gaussians()), values, rtol=1e-5)
    for a, b in zip(jax.tree.leaves(total(WAYS[way])), jax.tree.leaves(gradient), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_donated_buffers():
    step = jax.jit(lambda g: jax.tree.map(lambda x, d: x - 1e-3 * d, g, jax.grad(loss)(g)), donate_argnums=0)
    wanted = jax.tree.map(lambda x, d: x - 1e-3 * d, some_gaussians(), jax.jit(jax.grad(loss))(some_gaussians()))
    found = step(some_gaussians())
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), found, wanted)


PMAP = """
import jax, jax.numpy as jnp, numpy as np
from a2tg_jax import Camera, RenderSettings, init_from_points, render_image

gaussians = init_from_points([[0, 0, 2], [0.1, 0, 2], [0, 0.1, 2]], [[1, 1, 1]] * 3, sh_degree=0)
viewmats = jnp.stack([jnp.eye(4), jnp.eye(4).at[0, 3].set(0.1)])

def loss(gaussians, viewmat):
    camera = Camera(viewmat, jnp.asarray([[20.0, 0, 4], [0, 20, 4], [0, 0, 1]]), 8, 8)
    return jnp.sum(render_image(gaussians, camera, settings=RenderSettings(capacity=1024)).color ** 2)

found = jax.pmap(jax.value_and_grad(loss), in_axes=(None, 0))(gaussians, viewmats)
wanted = [jax.value_and_grad(loss)(gaussians, viewmat) for viewmat in viewmats]
for k in range(2):
    np.testing.assert_allclose(found[0][k], wanted[k][0], rtol=1e-5)
    np.testing.assert_allclose(found[1].means[k], wanted[k][1].means, rtol=1e-4, atol=1e-5)
"""


def test_pmap(monkeypatch):
    """In a process with two devices; `tests/test_shard_map.py` has the test of `shard_map`."""
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=2 --xla_backend_optimization_level=0")
    done = subprocess.run([sys.executable, "-c", PMAP], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr


MODES = {
    "jvp": lambda f, x: jax.jvp(f, (x,), (x,)),
    "jvp under jit": lambda f, x: jax.jit(lambda x: jax.jvp(f, (x,), (x,)))(x),
    "linearize": lambda f, x: jax.linearize(f, x)[1](x),
    "forward over reverse": lambda f, x: jax.jvp(jax.grad(f), (x,), (x,)),
    "reverse over reverse": lambda f, x: jax.grad(lambda x: jnp.sum(jax.grad(f)(x).means))(x),
}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("compositor", ["native", "xla"])
def test_other_derivatives_name_the_compositor_to_use(mode, compositor):
    def of_compositor(gaussians):
        settings = RenderSettings(capacity=1024, compositor=compositor)
        return jnp.sum(render_image(gaussians, CAMERA, settings=settings).color)

    with pytest.raises(ValueError, match=rf"compositor='{compositor}' is .*RenderSettings\(compositor='autodiff'\)"):
        MODES[mode](of_compositor, some_gaussians())


def smooth_loss():
    """A loss of all that a textured scene shows, by gaussians and texels, and where to differentiate it."""
    gaussians, camera = as_gaussians(SMOOTH, "float64"), as_camera(SMOOTH, "float64")
    parameters, places = partition((gaussians, as_textures(SMOOTH, "float64")))
    settings = RenderSettings(capacity=1024, compositor="autodiff")
    rng = np.random.default_rng(0)
    weights = jnp.asarray(rng.normal(size=(8, 8, 9)))

    def loss(parameters):
        gaussians, textures = combine(parameters, places)
        output = render_image(gaussians, camera, textures, settings=settings)
        images = [output.color, output.alpha[..., None], output.depth[..., None], output.normal]
        images = jnp.concatenate([*images, output.distortion[..., None]], axis=-1)
        return jnp.sum(weights * images + images**2)

    direction = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), parameters)
    return loss, parameters, direction


def moved(parameters, direction, step):
    return jax.tree.map(lambda x, d: x + step * d, parameters, direction)


def assert_differences(found, ahead, behind, step):
    """Derivatives are the central differences of two gradients, `step` before and after."""
    wanted = jax.tree.map(lambda a, b: (a - b) / (2 * step), ahead, behind)
    largest = max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(wanted))
    compare = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5 * largest)
    jax.tree.map(compare, found, wanted)


def dot(a, b):
    return sum(jnp.sum(x * y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@pytest.mark.usefixtures("x64")
def test_autodiff_shows_what_the_oracle_shows():
    for scene in (draw_scene(4, num=12, width=19, height=13), SMOOTH):
        found, wanted = render_scene(scene, "float64", RenderSettings(compositor="autodiff")), oracle.render(scene)
        for field in ("color", "alpha", "depth", "normal"):
            np.testing.assert_allclose(getattr(found, field), getattr(wanted, field), atol=1e-9)


@pytest.mark.usefixtures("x64")
def test_derivatives_of_autodiff_are_those_of_differences():
    """First derivatives in both modes and second ones, forward over reverse, along one direction."""
    loss, parameters, direction = smooth_loss()
    value, slope = jax.jit(lambda d: jax.jvp(loss, (parameters,), (d,)))(direction)
    differentiate, step = jax.jit(jax.value_and_grad(loss)), 3e-6
    here, gradient = differentiate(parameters)
    np.testing.assert_allclose([value, slope], [here, dot(gradient, direction)], rtol=1e-9)
    (more, ahead), (less, behind) = (differentiate(moved(parameters, direction, by)) for by in (step, -step))
    np.testing.assert_allclose(slope, (more - less) / (2 * step), rtol=1e-6)

    curvature = jax.jit(lambda x: jax.jvp(jax.grad(loss), (x,), (direction,))[1])(parameters)
    assert_differences(curvature, ahead, behind, step)


@pytest.mark.usefixtures("x64")
def test_gradient_of_a_gradient():
    camera, gaussians = as_camera(SCENE, "float64"), as_gaussians(SCENE, "float64")
    parameters = dataclasses.replace(gaussians, sh=gaussians.sh[:, :1])
    direction = jax.tree.map(jnp.sin, parameters)

    def loss(gaussians):
        settings = RenderSettings(capacity=64, compositor="autodiff", sh_degree=0)
        return jnp.sum(render_image(gaussians, camera, settings=settings).color ** 2)

    found = jax.jit(jax.grad(lambda x: dot(jax.grad(loss)(x), direction)))(parameters)
    gradient_of, step = jax.jit(jax.grad(loss)), 3e-6
    ahead, behind = (gradient_of(moved(parameters, direction, by)) for by in (step, -step))
    assert_differences(found, ahead, behind, step)


@pytest.mark.usefixtures("x64")
def test_autodiff_has_the_gradient_of_the_other_compositors():
    """On a scene with opaque, edge-on and invisible splats, in tiles with several blocks."""
    scene = draw_scene(6, num=20, width=12, height=9)
    camera, background = as_camera(scene, "float64"), jnp.asarray(scene.background)

    def gradient(compositor):
        settings = RenderSettings(capacity=1024, compositor=compositor)

        def loss(gaussians):
            output = render_image(gaussians, camera, background=background, settings=settings)
            return jnp.sum(output.color**2) + jnp.sum(output.depth) + jnp.sum(output.normal * output.color)

        return jax.jit(jax.grad(loss))(as_gaussians(scene, "float64"))

    found, wanted = gradient("autodiff"), gradient("native")
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9 * float(jnp.abs(b).max()))


def test_an_eager_call_finds_its_capacity_in_forward_mode():
    def brightness(factor):
        scaled = jax.tree.map(lambda leaf: factor * leaf, some_gaussians())
        return jnp.sum(render_image(scaled, CAMERA, settings=RenderSettings(compositor="autodiff")).color)

    slope = jax.jacfwd(brightness)(jnp.float32(1.0))
    assert np.isfinite(slope) and slope != 0
