"""The built-in scenes: their geometry agrees with their images, and they are made reproducibly."""

from functools import partial

import numpy as np
import pytest

import a2tg_jax as a2tg
from a2tg_jax import cells_scene, synthetic_scene, view_image
from a2tg_jax.data.load import SceneSource
from a2tg_jax.data.ray_tracing import Ball, Block, Disc, Tube
from a2tg_jax.data.synthetic import BUILT_IN, _lit_surfaces, exact_points

SHAPES = [
    Disc((0.1, 0.2, 0.3), 1.5),
    Tube((0.1, 0.2, 0.3), 0.5, 0.8),
    Tube((0.1, 0.2, 0.3), 0.5, 0.8, is_inward=True),
    Ball((0.1, 0.2, 0.3), 0.5),
    Block((0.1, 0.2, 0.3), 0.4, 0.7),
]


built_in = pytest.mark.parametrize("make", [synthetic_scene, cells_scene])


@pytest.fixture(scope="module", params=[partial(synthetic_scene, width=160, height=120), cells_scene])
def scene(request):
    return request.param(num_views=9)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_shapes_locate_what_they_place(shape):
    """(u, v) → point → (u, v), and a ray against the normal hits the point."""
    u, v = np.random.default_rng(0).uniform(0.3, 0.7, (2, 200))
    points, normals = shape.place(u, v)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=0), 1, atol=1e-6)
    found_u, found_v = shape.locate(points.astype(np.float32))
    np.testing.assert_allclose(found_u, u, atol=1e-4)
    np.testing.assert_allclose(found_v, v, atol=1e-4)
    t = shape.hit((points + 0.05 * normals).astype(np.float32), (-0.1 * normals).astype(np.float32))
    np.testing.assert_allclose(t, 0.5, atol=1e-3)


def test_points_have_the_colours_of_the_pixels_that_see_them(scene):
    """Each point came from some view's pixel, so in the view that fits best it fits nearly exactly."""
    best = np.full(len(scene.points), np.inf)
    for view in (*scene.train, *scene.test):
        viewmat = np.asarray(view.camera.viewmat)
        K = np.asarray(view.camera.K)
        homogeneous = (scene.points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
        column, row = np.floor(homogeneous[:, :2] / homogeneous[:, 2:] + 1e-3).astype(int).T
        is_seen = (column >= 0) & (row >= 0) & (column < view.camera.width) & (row < view.camera.height)
        error = np.abs(view_image(view)[row[is_seen], column[is_seen]] - scene.colors[is_seen]).max(axis=1)
        best[is_seen] = np.minimum(best[is_seen], error)
    assert np.mean(best < 0.01) > 0.97


@built_in
def test_seed_and_downscale(make):
    options = dict(num_views=2, width=64, height=48, num_points=50, test_every=0)
    made = []
    for seed in (0, 0, 1):
        _lit_surfaces.cache_clear()
        made.append(make(seed, **options))
    first, again, other = made
    np.testing.assert_array_equal(first.train[1].image, again.train[1].image)
    np.testing.assert_array_equal(first.points, again.points)
    assert (first.train[1].image != other.train[1].image).any()
    half = make(0, **options, downscale=2).train[0]
    assert (half.camera.width, half.camera.height) == (32, 24)
    np.testing.assert_allclose(half.camera.K[:2], np.asarray(first.train[0].camera.K)[:2] / 2)


@built_in
@pytest.mark.parametrize("options", [{"num_views": 1}, {"num_points": 1}, {"downscale": 0}, {"width": 0}])
def test_bad_options(make, options):
    ((name, value),) = options.items()
    wanted = {"width": rf"got .*{value}x\d+"}.get(name, f"got .*{name}={value}")
    with pytest.raises(ValueError, match=f"the (synthetic|cells) scene needs .*{wanted}"):
        make(**options)


def test_cells_are_seen_by_all_views_and_two_to_four_pixels_wide():
    scene = cells_scene()
    assert (len(scene.train), len(scene.test), len(scene.points)) == (28, 4, 2500)
    cell = 1 / 24 * scene.transform.scale
    for view in (*scene.train, *scene.test):
        image = view_image(view)
        camera = view.camera
        assert image.shape == (160, 160, 3)
        is_background = (image == 0).all(axis=-1)
        assert 0.3 < is_background.mean() < 0.6 and is_background[:, [0, -1]].all()
        viewmat = np.asarray(camera.viewmat)
        depths = scene.points @ viewmat[2, :3] + viewmat[2, 3]
        width = cell * float(camera.K[0, 0]) / depths
        assert 2 < width.min() < width.max() < 4.6 and np.mean(width < 4) > 0.9


def test_points_of_cells_are_on_the_floor_or_the_box():
    scene = cells_scene(num_views=9)
    points = np.concatenate([scene.transform.inverse().apply(scene.points), exact_points(scene)])
    x, y, z = points.T
    on_floor = (np.abs(z) < 1e-4) & (np.hypot(x, y) < 1)
    turned = np.stack([np.cos(0.3) * x + np.sin(0.3) * y, np.cos(0.3) * y - np.sin(0.3) * x, z - 0.365])
    on_box = np.abs(np.abs(turned).max(axis=0) - 0.36) < 1e-4
    assert (on_floor != on_box).all()
    assert 0.3 < on_box.mean() < 0.7


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_scenes_by_name(name):
    """The path of a scene is also the name of its function."""
    source = SceneSource(name, downscale=4, test_every=4)
    scene = source.load()
    assert (source.name, scene.name, source.is_built_in) == (name, name, True)
    assert not SceneSource(f"./{name}").is_built_in
    sizes = {"synthetic": (208, 156), "cells": (160, 160)}
    width, height = sizes[name]
    wanted = getattr(a2tg, f"{name}_scene")(width=width, height=height, downscale=4, test_every=4)
    assert len(scene.test) == len(wanted.test)
    np.testing.assert_array_equal(scene.points, wanted.points)
    np.testing.assert_array_equal(scene.test[0].image, wanted.test[0].image)
