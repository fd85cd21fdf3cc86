"""Textures that shrink."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from run_folders import circle
from small_models import assert_same_rule, movable_kernels
from small_values import SH_C0

import a2tg_jax as a2tg
from a2tg_jax import (
    Appearance,
    Bands,
    Exponents,
    Model,
    Texture,
    TextureOptions,
    View,
    allocate_appearance,
    init_from_points,
    shrink_textures,
    texture_arrays,
    textures_from_arrays,
)
from a2tg_jax.finish.shrinking import halve_textures, taken, texel_weights
from a2tg_jax.results.images import to_uint8

NUM = 12
BACKGROUND = (0.2, 0.3, 0.1)


def some_model(seed: int = 0, roughness: float = 0.25) -> Model:
    """A third of the textures rough, a third constant along u, the rest of one texel."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (NUM, 3)).astype(np.float32)
    gaussians = init_from_points(points, rng.uniform(0.3, 0.7, (NUM, 3)))
    gaussians = dataclasses.replace(gaussians, log_scales=jnp.full((NUM, 2), np.log(0.15), jnp.float32))
    arrays = []
    for index in range(NUM):
        texels = rng.uniform(-roughness, roughness, (4, 4, 4)).astype(np.float32)
        texels[..., 3] = rng.uniform(0.5, 1, (4, 4))
        arrays.append([texels, np.repeat(texels[:, :1], 4, axis=1), texels[:1, :1]][index % 3])
    return Model(gaussians, Appearance(texture=Texture(textures_from_arrays(arrays))))


def views_of(model: Model) -> list[View]:
    cameras = circle(4)
    return [
        View(str(at), camera, to_uint8(model.render(camera, background=BACKGROUND).color))
        for at, camera in enumerate(cameras)
    ]


def images_of(model: Model) -> np.ndarray:
    return np.stack([np.asarray(model.render(camera, background=BACKGROUND).color) for camera in circle(4)])


def test_what_is_constant_shrinks_at_next_to_no_loss():
    model = some_model()
    views = views_of(model)
    small = shrink_textures(model, views, max_loss=0.05, background=BACKGROUND)
    sizes = model.textures.sizes
    found = small.textures.sizes
    assert (found[2::3] == 0).all() and (found[1::3, 1] == 1).all()  # single texels, and what is constant along u
    assert small.num == model.num and small.num_bytes <= model.num_bytes - 16 * (4 * 12 + 4)
    assert (found <= sizes).all()


@pytest.mark.parametrize("max_loss", [0.01, pytest.param(0.5, marks=pytest.mark.long)])
def test_no_more_is_lost_than_may_be(max_loss):
    model = some_model(1)
    target = some_model(1, roughness=0.2)
    views = views_of(target)
    small = shrink_textures(model, views, max_loss=max_loss, background=BACKGROUND)
    before, after = (a2tg.evaluate(views, one, background=BACKGROUND).psnr for one in (model, small))
    assert before - after <= max_loss + 1e-3
    assert small.num_bytes < model.num_bytes


def test_single_texels_go_into_their_gaussians():
    model = some_model()
    step = halve_textures(model, texel_weights(model, circle(4), BACKGROUND))
    is_single = (model.textures.sizes == 1).all(axis=1)
    after = taken(model, step, is_single)
    np.testing.assert_allclose(images_of(after), images_of(model), atol=1e-5)
    texels = texture_arrays(model.textures)
    sh0 = np.asarray(model.gaussians.sh)[2, 0] + texels[2][0, 0, :3] / SH_C0
    np.testing.assert_allclose(np.asarray(after.gaussians.sh)[2, 0], sh0, rtol=1e-5)
    opacity = float(model.gaussians.opacities[2]) * texels[2][0, 0, 3]
    np.testing.assert_allclose(float(after.gaussians.opacities[2]), opacity, rtol=1e-4)


def test_the_cost_predicts_the_change_of_the_picture():
    model = some_model(2)
    cameras = circle(4) * 8  # Many draws of signs.
    step = halve_textures(model, texel_weights(model, cameras, BACKGROUND))
    before = images_of(model)
    costs = []
    changes = []
    for index in range(0, NUM, 3):
        is_chosen = np.arange(NUM) == index
        costs.append(step.cost[index] / 8)
        changes.append(np.sum((images_of(taken(model, step, is_chosen)) - before) ** 2))
    assert np.corrcoef(np.log(costs), np.log(changes))[0, 1] > 0.5
    assert all(1 / 6 < cost / change < 6 for cost, change in zip(costs, changes, strict=True))


def test_weights_are_the_squared_slopes_of_the_picture():
    """Against finite differences, on one texture."""
    model = some_model(3)
    cameras = circle(4) * 50
    weights = texture_arrays(texel_weights(model, cameras, BACKGROUND))[0] / 50
    texels = texture_arrays(model.textures)
    for place in [(1, 2, 0), (2, 1, 1), (1, 1, 3)]:
        images = []
        for sign in (-1, 1):
            moved = [own.copy() for own in texels]
            moved[0][place] += sign * 1e-2
            images.append(images_of(model.with_textures(textures_from_arrays(moved))))
        exact = np.sum(((images[1] - images[0]) / 2e-2) ** 2)
        np.testing.assert_allclose(weights[place], exact, rtol=0.5)


@pytest.mark.long
def test_bands_and_shapes_stay_as_they_are():
    model = some_model()
    shapes = Exponents(jnp.linspace(-2.0, 2.0, NUM))
    bands = Bands().allocate(model.gaussians)
    appearance = dataclasses.replace(model.appearance, exponents=shapes, bands=bands)
    model = Model(model.gaussians, appearance)
    small = shrink_textures(model, views_of(model), max_loss=0.05, background=BACKGROUND)
    assert_same_rule(small, model)
    assert small.num_bytes < model.num_bytes
    np.testing.assert_array_equal(small.appearance.shapes, model.appearance.shapes)


def test_what_cannot_shrink_is_refused():
    model = some_model()
    views = views_of(model)
    for template, name in (
        (Appearance(), "plain Gaussians"),
        (Appearance(texture=Texture(options=TextureOptions.official())), "Gaussians with texture"),
        (movable_kernels(), "MovableKernels"),
        (Appearance(bands=Bands(), exponents=Exponents()), "Gaussians with exponents and bands"),
    ):
        other = Model(model.gaussians, allocate_appearance(template, jax.random.key(0), model.gaussians))
        with pytest.raises(ValueError, match=f"^{name} cannot shrink: only textures with signed RGB and projected al"):
            shrink_textures(other, views)
    with pytest.raises(ValueError, match="at least one view"):
        shrink_textures(model, [])
    with pytest.raises(ValueError, match="max_loss"):
        shrink_textures(model, views, max_loss=-1.0)
