"""Checks of arguments: what they let pass. What they refuse is in test_mistakes."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_values import some_gaussians, some_world

import a2tg_jax as a2tg
from a2tg_jax.base.checks import check_floats, check_number, check_shape, described
from a2tg_jax.base.even_spacing import evenly_chosen
from a2tg_jax.base.text import shortened

CAMERA = a2tg.Camera(jnp.eye(4).at[2, 3].set(3), jnp.array([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]), 16, 12)
SETTINGS = a2tg.RenderSettings(capacity=1024)


def render(**options):
    return a2tg.render_image(some_gaussians(), CAMERA, **options)


def test_intrinsics_may_be_skewed_and_drift():
    K = CAMERA.K.at[0, 1].set(3.0).at[1, 0].set(1e-3).at[2, 2].set(1.001)
    a2tg.plan_render(some_gaussians(), dataclasses.replace(CAMERA, K=K))


def test_numbers_within_limits_pass_whatever_their_kind():
    for value in (1, 1.0, np.float32(1), jnp.float32(1), np.ones((), int)):
        check_number("x", value, least=0, most=1)
    assert jax.jit(lambda x: check_number("x", x, above=5) or x)(1.0) == 1
    for value in (True, "1", None, np.ones(1), np.nan, 2, 1j):
        with pytest.raises(ValueError, match=r"^x must be (a number )?at least 0 and at most 1; got "):
            check_number("x", value, least=0, most=1)


def test_schedules_are_computed_for_many_iterations_at_once():
    rates = a2tg.exponential_decay(jnp.ones(3), 0.01, jnp.array([0, 5, 10]), 10)
    np.testing.assert_allclose(rates, [1, 0.1, 0.01], rtol=1e-6)


def test_metrics_take_nested_lists():
    image = np.full((12, 12, 3), 0.25, np.float32)
    assert float(a2tg.psnr(image.tolist(), image + np.float32(0.1))) == pytest.approx(20, abs=1e-4)


def test_gaussians_are_not_iterated_without_an_end():
    with pytest.raises(TypeError, match="'Gaussians' object is not iterable"):
        list(some_gaussians())


def test_an_image_goes_behind_the_splats_as_the_error_says():
    """The recipe for a background image gives what one colour gives where the image is of that colour."""
    color = jnp.array([0.2, 0.5, 0.7])
    output = render()
    composed = output.color + (1 - output.alpha[..., None]) * jnp.broadcast_to(color[None, None], (12, 16, 3))
    np.testing.assert_allclose(composed, render(background=color).color, atol=1e-6)


def test_checks_pass_tracers_and_leave_nothing_in_the_program():
    def checked(x):
        check_floats("x", x, ("N", 3))
        check_shape("x", x, ("N", "C"))
        return jax.lax.sin(x)

    assert str(jax.make_jaxpr(checked)(jnp.ones((5, 3)))) == str(jax.make_jaxpr(jax.lax.sin)(jnp.ones((5, 3))))
    assert jax.vmap(checked)(jnp.ones((2, 5, 3))).shape == (2, 5, 3)


def test_shapes_and_values_in_words():
    check_shape("x", np.ones((4, 2, 4)), ("N", 2, "N"))
    with pytest.raises(ValueError, match=re.escape("x must be [N, 2, N]; got [4, 2, 3]")):
        check_shape("x", np.ones((4, 2, 3)), ("N", 2, "N"))
    assert described((np.zeros((2, 3)), 4, "a")) == "(float64[2, 3], 4, 'a')"
    assert described((jnp.zeros(1),)) == "(float32[1],)"
    assert shortened("a\nb\tc") == "a b c" and shortened([1, None]) == "[1, None]"
    assert shortened("\x1b[31mred\x07") == "\ufffd[31mred\ufffd"
    assert len(shortened("x" * 10**6)) == 80 and shortened("x" * 81).endswith("…") and shortened("x" * 80) == "x" * 80


def test_pytrees_may_hold_anything():
    """No validation when one is made: transformations put objects, batches and None into them."""
    batched = jax.tree.map(lambda x: jnp.stack([x, x]), some_gaussians())
    colors = jax.vmap(lambda g: a2tg.render_image(g, CAMERA, settings=SETTINGS).color)(batched)
    np.testing.assert_array_equal(colors[0], colors[1])
    assert "object" in repr(jax.tree.map(lambda x: object(), some_gaussians()))


@pytest.mark.long
def test_a_moved_model_renders_the_same_with_moved_settings():
    near = a2tg.Camera(jnp.eye(4).at[2, 3].set(0.7), CAMERA.K, 16, 12)
    model = dataclasses.replace(a2tg.Model(some_gaussians(40)), origin=a2tg.Origin.of_cameras([near]))
    world = dataclasses.replace(some_world(), scale=0.2)
    settings = SETTINGS
    moved = model.transform(world)
    (camera,) = moved.origin.cameras
    shown = model.render(near, settings=settings).color
    np.testing.assert_allclose(moved.render(camera, settings=settings.transform(world)).color, shown, atol=2e-5)
    assert np.abs(moved.render(camera, settings=settings).color - shown).max() > 0.01


@pytest.mark.parametrize("most", [1, 2, 7, 48])
@pytest.mark.parametrize("num", [0, 1, 7, 48, 49, 1000])
def test_items_are_chosen_evenly(num, most):
    found = evenly_chosen(list(range(num)), most)
    assert len(found) == min(num, most) and found[:1] == [0][:num]
    np.testing.assert_array_equal(evenly_chosen(np.arange(num), most), found)
    if len(found) > 1:
        gaps = np.diff(found)
        assert found[-1] == num - 1 and gaps.min() > 0 and gaps.max() - gaps.min() <= 1
