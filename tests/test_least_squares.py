"""Least squares on colours: linear where it says so, and at the optimum that dense linear algebra finds."""

import dataclasses

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from test_view_dependence import banded

import a2tg_jax as a2tg
from a2tg_jax import (
    Appearance,
    Exponents,
    Texture,
    TextureOptions,
    View,
    allocate_appearance,
    plan_render,
    polish,
    view_image,
)
from a2tg_jax.finish.polishing import colors_of, draw_change, with_colors


def some_views(model, camera, seed: int = 0, num: int = 3) -> list[View]:
    """Photographs that the model does not show, from cameras around."""
    rng = np.random.default_rng(seed)
    views = []
    for index in range(num):
        viewmat = camera.viewmat.at[:3, 3].add(jnp.asarray(rng.normal(size=3) * 0.1, camera.viewmat.dtype))
        image = rng.integers(0, 256, (camera.height, camera.width, 3), np.uint8)
        views.append(View(f"{index}.png", dataclasses.replace(camera, viewmat=viewmat), image))
    return views


def total_error(model, views) -> float:
    images = [np.asarray(view.image, np.float64) / 255 for view in views]
    return sum(
        float(np.square(np.asarray(model.render(v.camera).color) - i).sum()) for v, i in zip(views, images, strict=True)
    )


@pytest.mark.parametrize(
    "texture",
    [
        Texture(start=(2, 1)),
        pytest.param(None, marks=pytest.mark.long),
        pytest.param(Texture(start=(0, 0)), marks=pytest.mark.long),
    ],
)
def test_a_change_adds_what_it_draws(texture):
    model, _, camera = banded(1, template=Appearance(texture=texture))
    rng = np.random.default_rng(0)
    change = jax.tree.map(lambda x: jnp.asarray(1e-3 * rng.normal(size=x.shape), x.dtype), colors_of(model))
    settings = plan_render(model, camera)
    after = with_colors(model, jax.tree.map(jnp.add, colors_of(model), change))
    drawn = draw_change(model, change, camera, settings)
    before, later = (one.render(camera, background=(0.2, 0.1, 0.3)).color for one in (model, after))
    assert np.abs(drawn).max() > 1e-4
    np.testing.assert_allclose(later - before, drawn, atol=2e-6)


@pytest.mark.long
@pytest.mark.usefixtures("x64")
def test_many_steps_are_at_the_least_error():
    """That of a dense matrix, column by column, solved by numpy."""
    model, _, camera = banded(2, base=1, dtype="float64", template=Appearance(texture=Texture(start=(1, 2))))
    model = dataclasses.replace(model, gaussians=model.gaussians, num_live=jnp.int32(4)).live
    # Half a grey above zero, no colour is cut off before or after.
    model = dataclasses.replace(model, gaussians=dataclasses.replace(model.gaussians, sh=0.1 * model.gaussians.sh))
    model = dataclasses.replace(model, background=(0.25, 0.5, 0.75))
    views = some_views(model, camera, num=2)
    rng = np.random.default_rng(1)
    # One has an opacity and a mask.
    alpha = rng.integers(0, 256, views[0].image.shape[:2], np.uint8)
    mask = rng.uniform(size=views[0].image.shape[:2]) < 0.7
    views[0] = View("0.png", views[0].camera, np.dstack([views[0].image, alpha]), mask)
    counts = np.concatenate(
        [np.ravel(np.broadcast_to(own[..., None], views[0].image.shape)) for own in (mask, mask | True)]
    )
    settings = plan_render(model, [view.camera for view in views])
    flat, unflatten = jax.flatten_util.ravel_pytree(colors_of(model))
    draw = jax.jit(lambda change, camera: draw_change(model, unflatten(change), camera, settings).ravel())
    columns = [np.concatenate([draw(unit, view.camera) for view in views]) for unit in np.eye(len(flat))]
    J = counts[:, None] * np.stack(columns, axis=1)
    ridge = 0.5
    residual = np.concatenate(
        [np.ravel(view_image(v, model.background) - np.asarray(model.render(v.camera).color)) for v in views]
    )
    expected = np.linalg.solve(J.T @ J + ridge * np.eye(len(flat)), J.T @ residual)
    found, _ = jax.flatten_util.ravel_pytree(colors_of(polish(model, views, num_steps=60, ridge=ridge)))
    np.testing.assert_allclose(found - flat, expected, atol=1e-4)
    # The rays of the same pinhole: the centres of its pixels.
    rays = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), axis=-1)
    views = [
        dataclasses.replace(view, camera=dataclasses.replace(view.camera, rays=jnp.asarray(rays))) for view in views
    ]
    by_rays, _ = jax.flatten_util.ravel_pytree(colors_of(polish(model, views, num_steps=60, ridge=ridge)))
    np.testing.assert_allclose(by_rays, found, atol=1e-4)


@pytest.mark.long
def test_a_few_steps_lower_the_error_and_leave_the_rest():
    model, _, camera = banded(3, template=Appearance(texture=Texture(start=(2, 2))))
    views = some_views(model, camera)
    after = polish(model, views)
    errors = [total_error(one, views) for one in (model, polish(model, views, num_steps=1), after)]
    assert errors[0] > errors[1] > errors[2]
    for field in ("means", "quats", "log_scales", "logit_opacities"):
        np.testing.assert_array_equal(getattr(after.gaussians, field), getattr(model.gaussians, field))
    assert after.num_bytes == model.num_bytes
    alphas = [[bucket[..., 3] for bucket in m.textures.buckets] for m in (model, after)]
    jax.tree.map(np.testing.assert_array_equal, *alphas)


@pytest.mark.long
def test_plain_models_of_every_degree_are_polished():
    for base in range(4):
        _, plain, camera = banded(1, base)
        views = some_views(plain, camera)
        assert total_error(polish(plain, views, num_steps=2), views) < total_error(plain, views)


def test_what_is_not_linear_is_refused():
    model, _, camera = banded(1)
    with pytest.raises(ValueError, match="views must hold at least one view"):
        polish(model, [])
    template = Appearance(texture=Texture(options=TextureOptions(rgb="unit")), exponents=Exponents())
    other = a2tg.Model(model.gaussians, allocate_appearance(template, jax.random.key(0), model.gaussians))
    with pytest.raises(ValueError, match="not linear in the colours of Gaussians with texture and exponents"):
        polish(other, some_views(model, camera))
