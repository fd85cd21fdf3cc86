"""Transformations of JAX that each compositor supports (docs/transformations.md)."""

import dataclasses
import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from scenes_random import (
    as_camera,
    as_gaussians,
    as_textures,
    assert_all_close,
    draw_scene,
    draw_smooth_scene,
    render_scene,
)

import a2tg_jax as a2tg
from a2tg_jax import Camera, RenderSettings, combine, partition, render_image

SCENE = draw_scene(1, num=4, width=8, height=8)
SMOOTH = draw_smooth_scene(53, width=8, height=8)
CAMERA = as_camera(SCENE, "float32")
VIEWMATS = jnp.stack([CAMERA.viewmat, CAMERA.viewmat.at[0, 3].add(0.05)])


def some_gaussians():
    return as_gaussians(SCENE, "float32")


def loss(gaussians, viewmat=CAMERA.viewmat, compositor="auto"):
    camera = Camera(viewmat, CAMERA.K, CAMERA.width, CAMERA.height)
    settings = RenderSettings(capacity=1024, compositor=compositor)
    return jnp.sum(render_image(gaussians, camera, settings=settings).color ** 2)


@functools.cache
def expected():
    """Losses of both views, and the gradient of their sum."""
    one = jax.jit(jax.value_and_grad(loss))
    values, gradients = zip(*(one(some_gaussians(), viewmat) for viewmat in VIEWMATS), strict=True)
    return jnp.stack(values), jax.tree.map(lambda a, b: a + b, *gradients)


WAYS = {
    "vmap": lambda gaussians: jax.vmap(loss, in_axes=(None, 0))(gaussians, VIEWMATS),
    "scan": lambda gaussians: jax.lax.scan(lambda carry, view: (carry, loss(gaussians, view)), 0, VIEWMATS)[1],
    "map": lambda gaussians: jax.lax.map(functools.partial(loss, gaussians), VIEWMATS),
    "remat": lambda gaussians: jax.lax.map(functools.partial(jax.checkpoint(loss), gaussians), VIEWMATS),
}


@pytest.mark.parametrize("way", WAYS)
def test_first_derivatives_come_through(way):
    """Values and gradients are the same as for the views one by one, under jit."""
    values, gradient = expected()

    def of_sum(gaussians):
        losses = WAYS[way](gaussians)
        return jnp.sum(losses), losses

    (_, found), of_way = jax.jit(jax.value_and_grad(of_sum, has_aux=True))(some_gaussians())
    np.testing.assert_allclose(found, values, rtol=1e-5)
    for a, b in zip(jax.tree.leaves(of_way), jax.tree.leaves(gradient), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_donated_buffers():
    step = lambda g: jax.tree.map(lambda x, d: x - 1e-3 * d, g, jax.grad(loss)(g))  # noqa: E731
    wanted = jax.jit(step)(some_gaussians())
    found = jax.jit(step, donate_argnums=0)(some_gaussians())
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), found, wanted)


@pytest.mark.parametrize("compositor", ["xla", "autodiff"])
def test_programs_are_exported(compositor):
    leaves, structure = jax.tree.flatten(some_gaussians())

    def gradient(*leaves):
        return jax.grad(functools.partial(loss, compositor=compositor))(jax.tree.unflatten(structure, leaves)).means

    exported = jax.export.export(jax.jit(gradient))(*leaves)
    wanted = jax.jit(jax.grad(loss))(some_gaussians()).means
    np.testing.assert_allclose(exported.call(*leaves), wanted, rtol=1e-4, atol=1e-5)


def test_an_export_that_is_not_possible_names_the_compositor():
    with pytest.raises(ValueError, match="compositor=native"):
        jax.export.export(jax.jit(loss))(some_gaussians())


def test_an_eager_render_makes_no_implicit_transfer():
    gaussians, camera = jax.tree.map(jnp.asarray, (some_gaussians(), CAMERA))
    settings = RenderSettings(capacity=1024)
    render = lambda: render_image(gaussians, camera, background=(0.5, 0.5, 0.5), settings=settings)  # noqa: E731
    wanted = np.asarray(render().color)
    with jax.transfer_guard("disallow"):
        found = render()
    np.testing.assert_array_equal(found.color, wanted)


SEVERAL_DEVICES = """
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P
from a2tg_jax import Camera, RenderSettings, init_from_points, render_image
from a2tg_jax.training.losses import mean_ssim

gaussians = init_from_points([[0, 0, 2], [0.1, 0, 2], [0, 0.1, 2]], [[1, 1, 1]] * 3)
mesh = jax.make_mesh((2,), ("views",), axis_types=(jax.sharding.AxisType.Auto,))
viewmats = jnp.stack([jnp.eye(4), jnp.eye(4).at[0, 3].set(0.1)])

def show(gaussians, viewmat):
    camera = Camera(viewmat, jnp.asarray([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), 16, 16)
    return render_image(gaussians, camera, settings=RenderSettings(capacity=1024, compositor="native")).color

def shown(gaussians, viewmats, check_vma):
    one = lambda gaussians, viewmats: show(gaussians, viewmats[0])[None]
    specs = dict(mesh=mesh, in_specs=(P(), P("views")), out_specs=P("views"), check_vma=check_vma)
    return jax.shard_map(one, **specs)(gaussians, viewmats)

def loss(gaussians, viewmats, check_vma):
    return jnp.sum(shown(gaussians, viewmats, check_vma) ** 2)

found = jax.jit(shown, static_argnums=2)(gaussians, viewmats, True)
expected = jnp.stack([show(gaussians, viewmat) for viewmat in viewmats])
np.testing.assert_allclose(found, expected, atol=1e-6)
assert expected.max() > 0.05 and jnp.abs(found[0] - found[1]).max() > 0.01
of_view = jax.value_and_grad(lambda g, viewmat: jnp.sum(show(g, viewmat) ** 2))
wanted = [of_view(gaussians, viewmat) for viewmat in viewmats]
total = sum(gradient.means for _, gradient in wanted)
for check_vma in (True, False):
    gradient = jax.jit(jax.grad(loss), static_argnums=2)(gaussians, viewmats, check_vma)
    np.testing.assert_allclose(gradient.means, total, rtol=1e-3, atol=1e-4)

values, gradients = jax.pmap(of_view, in_axes=(None, 0))(gaussians, viewmats)
for k in range(2):
    np.testing.assert_allclose(values[k], wanted[k][0], rtol=1e-5)
    np.testing.assert_allclose(gradients.means[k], wanted[k][1].means, rtol=1e-4, atol=1e-5)

photo = jnp.linspace(0, 1, 32 * 32 * 3).reshape(32, 32, 3)
photos = jnp.stack([photo**2, photo**3])
means = lambda photo, photos: jax.vmap(mean_ssim, in_axes=(None, 0))(photo, photos)
both = jax.shard_map(means, mesh=mesh, in_specs=(P(), P("views")), out_specs=P("views"))
wanted, found = (jax.grad(lambda x, f=f: jnp.sum(f(x, photos)))(photo) for f in (means, both))
np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-7)

def as_if_equal(gaussians, viewmats):
    one = lambda gaussians, viewmats: show(gaussians, viewmats[0])
    return jax.shard_map(one, mesh=mesh, in_specs=(P(), P("views")), out_specs=P())(gaussians, viewmats)

try:
    as_if_equal(gaussians, viewmats)
except ValueError as error:
    assert "out_specs" in str(error)
else:
    raise AssertionError("pictures that differ between devices passed for one")
"""


@pytest.mark.long
def test_shard_map_and_pmap(monkeypatch):
    """Two devices each render a view, in a process that has rendered nothing before: the first rendering may be inside
    a shard_map."""
    monkeypatch.setenv("XLA_FLAGS", f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2")
    command = [sys.executable, "-c", SEVERAL_DEVICES]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
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
    with pytest.raises(ValueError, match=rf"compositor='{compositor}' is .*RenderSettings\(compositor='autodiff'\)"):
        MODES[mode](functools.partial(loss, compositor=compositor), some_gaussians())


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
    scene = draw_scene(4, num=12, width=19, height=13)
    found = render_scene(scene, "float64", RenderSettings(compositor="autodiff"))
    wanted = oracle.render(scene)
    for field in ("color", "alpha", "depth", "normal"):
        np.testing.assert_allclose(getattr(found, field), getattr(wanted, field), atol=1e-9)


@pytest.mark.long
@pytest.mark.usefixtures("x64")
def test_derivatives_of_autodiff_are_those_of_differences():
    """First derivatives in both modes and second ones, forward over reverse, along one direction of Gaussians and
    texels, of a loss of all that a textured scene shows."""
    gaussians = as_gaussians(SMOOTH, "float64")
    camera = as_camera(SMOOTH, "float64")
    parameters, places = partition((gaussians, as_textures(SMOOTH, "float64")))
    settings = RenderSettings(capacity=1024, compositor="autodiff")
    rng = np.random.default_rng(0)
    weights = jnp.asarray(rng.normal(size=(8, 8, 9)))
    direction = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), parameters)

    def loss(parameters):
        gaussians, textures = combine(parameters, places)
        output = render_image(gaussians, camera, textures, settings=settings)
        images = [output.color, output.alpha[..., None], output.depth[..., None], output.normal]
        images = jnp.concatenate([*images, output.distortion[..., None]], axis=-1)
        return jnp.sum(weights * images + images**2)

    value, slope = jax.jit(lambda d: jax.jvp(loss, (parameters,), (d,)))(direction)
    differentiate = jax.jit(jax.value_and_grad(loss))
    step = 3e-6
    here, gradient = differentiate(parameters)
    np.testing.assert_allclose([value, slope], [here, dot(gradient, direction)], rtol=1e-9)
    (more, ahead), (less, behind) = (differentiate(moved(parameters, direction, by)) for by in (step, -step))
    np.testing.assert_allclose(slope, (more - less) / (2 * step), rtol=1e-6)
    curvature = jax.jit(lambda x: jax.jvp(jax.grad(loss), (x,), (direction,))[1])(parameters)
    assert_differences(curvature, ahead, behind, step)


@pytest.mark.long
@pytest.mark.usefixtures("x64")
def test_gradient_of_a_gradient():
    camera = as_camera(SCENE, "float64")
    gaussians = as_gaussians(SCENE, "float64")
    parameters = dataclasses.replace(gaussians, sh=gaussians.sh[:, :1])
    direction = jax.tree.map(jnp.sin, parameters)

    def loss(gaussians):
        settings = RenderSettings(capacity=64, compositor="autodiff", sh_degree=0)
        return jnp.sum(render_image(gaussians, camera, settings=settings).color ** 2)

    found = jax.jit(jax.grad(lambda x: dot(jax.grad(loss)(x), direction)))(parameters)
    gradient_of = jax.jit(jax.grad(loss))
    step = 3e-6
    ahead, behind = (gradient_of(moved(parameters, direction, by)) for by in (step, -step))
    assert_differences(found, ahead, behind, step)


@pytest.mark.long
@pytest.mark.usefixtures("x64")
def test_autodiff_has_the_gradient_of_the_other_compositors():
    """On a scene with opaque, edge-on and invisible splats, in tiles with several blocks."""
    scene = draw_scene(6, num=20, width=12, height=9)
    camera = as_camera(scene, "float64")
    background = jnp.asarray(scene.background)

    def gradient(compositor):
        settings = RenderSettings(capacity=1024, compositor=compositor)

        def loss(gaussians):
            output = render_image(gaussians, camera, background=background, settings=settings)
            return jnp.sum(output.color**2) + jnp.sum(output.depth) + jnp.sum(output.normal * output.color)

        return jax.jit(jax.grad(loss))(as_gaussians(scene, "float64"))

    assert_all_close(gradient("autodiff"), gradient("native"), 1e-7, 1e-9)


def test_a_model_with_spare_rows_is_an_argument_of_a_jitted_render():
    model = a2tg.Model(some_gaussians())
    settings = a2tg.plan_render(model, [CAMERA])
    spare = dataclasses.replace(model, num_live=jnp.int32(5))
    color = jax.jit(lambda model: model.render(CAMERA, settings=settings).color)
    np.testing.assert_allclose(color(spare), color(model[:5]), rtol=0, atol=1e-6)


@pytest.mark.long
def test_an_eager_call_finds_its_capacity_in_forward_mode():
    def brightness(factor):
        scaled = jax.tree.map(lambda leaf: factor * leaf, some_gaussians())
        return jnp.sum(render_image(scaled, CAMERA, settings=RenderSettings(compositor="autodiff")).color)

    slope = jax.jacfwd(brightness)(jnp.float32(1.0))
    assert np.isfinite(slope) and slope != 0
