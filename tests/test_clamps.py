"""Clamps that parameters start on, or are driven onto, let them leave again: colours, texels, alphas at their cap."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import quick_then_long
from small_models import billboards
from small_values import SH_C0, some_gaussians

import a2tg_jax as a2tg
from a2tg_jax import (
    Appearance,
    Exponents,
    Texture,
    TextureOptions,
    adam_init,
    adam_update,
    allocate_appearance,
    combine,
    partition,
    project_appearance,
)
from a2tg_jax.core.numerics import at_least, within
from a2tg_jax.training.start import initial_model

UNIT = TextureOptions(rgb="unit", alpha="global-maximum")
CAMERA = a2tg.Camera(jnp.eye(4).at[2, 3].set(2.0), jnp.asarray([[30.0, 0, 8], [0, 30, 8], [0, 0, 1]]), 16, 16)


def one_splat(color=0.5):
    """A splat whose texture fills the image of `CAMERA`."""
    sh = jnp.zeros((1, 1, 3)).at[0, 0].set((color - 0.5) / SH_C0)
    means = jnp.zeros((1, 3))
    quats = jnp.asarray([[1.0, 0, 0, 0]])
    return a2tg.Gaussians(means, quats, jnp.full((1, 2), np.log(0.25)), jnp.full(1, 3.0), sh)


@pytest.mark.parametrize(("x", "slope"), [(-1e-6, 0.0), (-1e-7, 1.0), (0.0, 1.0), (1.0, 1.0), (1.0001, 0.0)])
def test_edges_have_the_derivative_of_the_inside(x, slope):
    assert jax.grad(lambda x: within(x, 0.0, 1.0))(x) == slope
    assert jax.grad(lambda x: at_least(x, 0.0))(x) == float(x >= -1e-7)
    assert jax.jvp(lambda x: within(x, 0.0, 1.0), (x,), (1.0,))[1] == slope


def test_clamped_numbers_are_those_of_numpy():
    x = jnp.asarray([-np.inf, -1, 0, 0.3, 1, 2, np.inf, np.nan])
    np.testing.assert_array_equal(within(x, 0.0, 1.0), np.clip(x, 0, 1))
    np.testing.assert_array_equal(at_least(x, 0.0), np.maximum(x, 0))


@pytest.mark.parametrize("compositor", quick_then_long(["native"], ["xla", "cuda"]))
def test_a_splat_that_starts_black_takes_the_colour_of_the_photographs(compositor):
    target = jnp.broadcast_to(jnp.asarray([0.8, 0.4, 0.2])[None, None], (16, 16, 3))
    settings = a2tg.RenderSettings(compositor=compositor, capacity=64)

    def loss(gaussians):
        return jnp.mean((a2tg.render_image(gaussians, CAMERA, settings=settings).color - target) ** 2)

    def step(state, _):
        gaussians, moments = state
        gradient = dataclasses.replace(jax.tree.map(jnp.zeros_like, gaussians), sh=jax.grad(loss)(gaussians).sh)
        return tuple(adam_update(gaussians, gradient, moments, jax.tree.map(lambda _: 0.02, gaussians))), None

    start = a2tg.init_from_points([[0.0, 0, 0], [0, 0, 9]], np.zeros((2, 3)), sh_degree=0)[:1]
    assert (jax.jit(jax.grad(loss))(one_splat(0.0)).sh < 0).all()  # on the very edge, too
    start = dataclasses.replace(one_splat(), sh=start.sh)
    (end, _), _ = jax.jit(lambda state: jax.lax.scan(step, state, None, 1500))((start, adam_init(start)))
    weights = np.asarray(a2tg.render_image(end, CAMERA, settings=settings).alpha)
    nearest = target[0, 0] * (weights.sum() / (weights**2).sum())  # least squares
    np.testing.assert_allclose(end.sh[0, 0] * SH_C0 + 0.5, nearest, rtol=0.02)


def test_initial_colours_lie_inside():
    sh = a2tg.init_from_points(np.eye(3)[:2], np.asarray([[0.0, 0.5, 1.0], [0.02, 0.9, 0.3]])).sh
    np.testing.assert_allclose(sh[:, 0] * SH_C0 + 0.5, [[0.05, 0.5, 1.0], [0.05, 0.9, 0.3]], atol=1e-6)


SCENE = a2tg.synthetic_scene(width=32, height=24, num_views=4, num_points=50)


def with_colors(colors):
    return dataclasses.replace(SCENE, colors=np.asarray(colors, np.float32))


def started(colors):
    return initial_model(with_colors(colors), a2tg.Gaussians2dMcmc(initial_gaussians=50)).gaussians


def test_points_of_one_colour_have_none_and_others_keep_theirs():
    for color in ((0, 0, 0), (1, 1, 1), (0.2, 0, 0)):
        with pytest.warns(UserWarning, match=r"all 50 points of synthetic have one colour \(.*\): taken as points"):
            assert not np.asarray(started(np.full((50, 3), color)).sh).any(), "grey"
    nearly_black = np.zeros((50, 3))
    nearly_black[3] = 0.1
    for kept in (np.full((50, 3), 0.502), nearly_black):
        given = a2tg.init_from_points(SCENE.points, with_colors(kept).colors, 50)
        np.testing.assert_array_equal(started(kept).sh[:, 0], given.sh[:, 0])


@pytest.mark.long
def test_a_channel_that_is_zero_in_all_points_is_learned():
    system = a2tg.Gaussians2dMcmc.preset("smoke", stage1_iterations=600)
    model = a2tg.fit(with_colors(SCENE.colors * np.asarray([0, 1, 1])), system).model
    view = SCENE.train[0]
    found, wanted = (np.clip(image[..., 0], 0, 1).mean() for image in (
        model.render(view.camera).color, a2tg.view_image(view)))  # fmt: skip
    assert abs(found - wanted) < 0.15 * wanted


def with_texels(texels, options):
    return Appearance(texture=Texture(a2tg.textures_from_arrays([texels]), options=options))


def gradient_of_texels(appearance, gaussians):
    """The gradient that would brighten or thicken the splat at each texel."""
    floats, places = partition(appearance)

    @jax.jit
    def total(floats):
        appearance = combine(floats, places)
        settings = a2tg.RenderSettings(capacity=64)
        return jnp.sum(a2tg.render_appearance(gaussians, CAMERA, appearance, settings=settings).color)

    return jax.grad(total)(floats).textures.buckets[0][0]


@pytest.mark.parametrize("options", [TextureOptions(), TextureOptions(rgb="unit"), UNIT], ids=["signed", "unit", "max"])
def test_texels_on_their_bounds_can_leave_them_and_projection_keeps_the_image(options):
    texels = np.full((2, 2, 4), 0.5, np.float32)
    texels[0, 0], texels[1, 1, :3] = 0, 1
    assert (gradient_of_texels(with_texels(texels, options), one_splat()) != 0).all()
    if options.rgb == "signed":
        return
    texels = np.random.default_rng(0).uniform(-0.5, 1.5, (2, 2, 4)).astype(np.float32)
    if options.alpha == "projected":
        texels[..., 3] = 0.7
    appearance = with_texels(texels, options)
    images = [
        a2tg.render_appearance(one_splat(), CAMERA, one).color for one in (appearance, project_appearance(appearance))
    ]
    np.testing.assert_allclose(images[0], images[1], atol=1e-6)
    assert (gradient_of_texels(project_appearance(appearance), one_splat())[..., :3] != 0).all()


def test_alphas_at_their_cap_can_fade():
    """Texels of pictures, whose alpha takes the place of opacity and Gaussian, are projected onto the cap."""
    gaussians = one_splat()
    floats, places = partition(allocate_appearance(billboards(), jax.random.key(0), gaussians))
    floats, _ = partition(project_appearance(combine(jax.tree.map(lambda x: jnp.full_like(x, 5.0), floats), places)))
    assert floats.pictures.buckets[0][..., 3].max() == jnp.float32(0.99)

    def mean_of_picture(floats):
        return jnp.mean(a2tg.render_appearance(gaussians, CAMERA, combine(floats, places)).alpha)

    assert (jax.grad(mean_of_picture)(floats).pictures.buckets[0][..., 3] > 0).all()


def test_exponents_at_their_limit_have_a_gradient():
    gaussians = some_gaussians(5)
    settings = a2tg.RenderSettings(capacity=1024)
    limit = jnp.full(5, np.arctanh(np.log(0.6)), jnp.float32)
    camera = a2tg.Camera(jnp.eye(4).at[2, 3].set(4.0), CAMERA.K, 16, 16)

    def total(shapes):
        appearance = Appearance(exponents=Exponents(shapes))
        return jnp.sum(a2tg.render_appearance(gaussians, camera, appearance, settings=settings).color)

    assert np.count_nonzero(jax.jit(jax.grad(total))(limit)) >= 3
