"""Mistakes of a caller of the library: each is an error or a warning that says what was wanted."""

import dataclasses
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_models import some_model
from small_values import some_gaussians, some_world

import a2tg_jax as a2tg

CAMERA = a2tg.Camera(jnp.eye(4).at[2, 3].set(3), jnp.array([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]), 16, 12)


def crowd() -> a2tg.Model:
    """Return Gaussians that lie in more tiles than a capacity of 1 has room for."""
    return a2tg.Model(some_gaussians(40))


def with_pose(matrix) -> a2tg.Camera:
    return dataclasses.replace(CAMERA, viewmat=jnp.asarray(matrix, jnp.float32))


def test_an_eager_render_with_too_small_a_capacity_warns_and_a_jitted_one_cannot():
    model, settings = crowd(), a2tg.RenderSettings(capacity=1)
    with pytest.warns(a2tg.CapacityWarning, match=re.escape("plan_render(model, cameras)")) as caught:
        assert model.render(CAMERA, settings=settings).overflow
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert jax.jit(lambda camera: model.render(camera, settings=settings))(CAMERA).overflow
        assert not model.render(CAMERA, settings=a2tg.plan_render(model, [CAMERA])).overflow


@pytest.mark.parametrize("capacity", [0, -3, 1e4, True, "4"])
def test_a_capacity_is_a_positive_int(capacity):
    with pytest.raises(ValueError, match="capacity must be an int, at least 1, or None"):
        a2tg.RenderSettings(capacity=capacity)


def test_plan_render_takes_a_model_as_evaluate_and_save_ply_do():
    model = some_model()
    planned = a2tg.plan_render(model.gaussians, [CAMERA], rule=model.rule)
    assert a2tg.plan_render(model, [CAMERA]) == planned
    with pytest.raises(ValueError, match=re.escape("say plan_render(model, cameras)")):
        a2tg.plan_render(model, [CAMERA], rule=model.rule)


def test_a_moved_model_renders_the_same_with_settings_that_are_scaled_along():
    near = a2tg.Camera(jnp.eye(4).at[2, 3].set(0.7), CAMERA.K, 16, 12)
    origin = a2tg.Origin.of_cameras([near])
    model, world = dataclasses.replace(a2tg.Model(some_gaussians(40)), origin=origin), some_world()
    world = dataclasses.replace(world, scale=0.2)
    moved = model.transform(world)
    assert moved.origin is not None
    settings = a2tg.RenderSettings()
    shown = model.render(near, settings=settings).color
    again = moved.render(moved.origin.cameras[0], settings=settings.transform(world)).color
    np.testing.assert_allclose(again, shown, atol=2e-5)
    assert np.abs(moved.render(moved.origin.cameras[0], settings=settings).color - shown).max() > 0.01


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.diag([1.0, -1, 1, 1]), "mirrors"),
        (np.diag([2.0, 2, 2, 1]), "R·Rᵀ − I up to 3"),
        (np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 3, 1]]), "its last row must be 0, 0, 0, 1"),
    ],
)
def test_a_pose_that_is_no_rigid_motion_is_refused_outside_jit(matrix, message):
    with pytest.raises(ValueError, match=f"camera.viewmat must be a rigid motion, world to camera, OpenCV.*{message}"):
        crowd().render(with_pose(matrix))
    settings = a2tg.RenderSettings(capacity=1024)
    jax.jit(lambda camera: crowd().render(camera, settings=settings))(with_pose(matrix))


def test_a_pose_that_drifted_a_little_is_rendered():
    crowd().render(with_pose(np.diag([1.01, 0.995, 1, 1])))


def test_a_camera_says_its_convention_and_prints_numbers():
    assert "OpenCV" in a2tg.Camera.__doc__ and "+0.5" in a2tg.Camera.__doc__
    camera = dataclasses.replace(CAMERA, width=np.int64(80))
    assert "width=80" in repr(camera) and type(camera.width) is int


@pytest.mark.parametrize(
    ("colors", "message"),
    [
        (np.full((9, 3), 200, np.uint8), "colors must be floats in [0, 1]; got uint8: divide bytes by 255"),
        (np.full((9, 3), 200.0), "colors must lie in [0, 1]; got 200: divide bytes by 255"),
        (np.full((9, 3), -0.5), "colors must lie in [0, 1]; got -0.5"),
    ],
)
def test_colours_of_points_lie_in_the_unit_range(colors, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        a2tg.init_from_points(np.random.default_rng(0).normal(size=(9, 3)), colors)


def test_the_public_names_hold_no_helpers():
    names = dir(a2tg)
    assert not {"Any", "TYPE_CHECKING", "importlib"} & set(names)
    assert "__version__" in names and re.match(r"\d+\.\d+", a2tg.__version__)
    assert a2tg.load_lpips.__module__ == "a2tg_jax.measure.metrics"


def test_a_renderer_prints_as_one_line():
    renderer = a2tg.Renderer(crowd())
    assert repr(renderer) == "Renderer(40 Gaussians, no size yet)"
    renderer(CAMERA)
    assert repr(renderer) == "Renderer(40 Gaussians, 16×12)"
