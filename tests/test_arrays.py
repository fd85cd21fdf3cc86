"""Scenes of arrays: the same as the built-in scene whose images and cameras they are given."""

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
import pytest

import a2tg_jax as a2tg


@pytest.fixture(scope="module")
def whole():
    return a2tg.synthetic_scene(num_views=6, width=40, height=30, num_points=200, test_every=3)


@pytest.fixture(scope="module")
def given(whole):
    """Arguments in the original world, in the order of names."""
    views = sorted((*whole.train, *whole.test), key=lambda view: view.name)
    back = whole.transform.inverse()
    return {
        "images": [view.image for view in views],
        "viewmats": np.stack([back.apply_to_viewmat(np.asarray(view.camera.viewmat, np.float64)) for view in views]),
        "Ks": np.asarray(views[0].camera.K),
        "points": back.apply(whole.points),
        "colors": np.rint(255 * whole.colors).astype(np.uint8),
        "names": [view.name for view in views],
        "test_every": 3,
    }


def test_the_scene_is_that_of_the_arrays(whole, given):
    scene = a2tg.scene_from_arrays(**given, observed=[np.arange(len(whole.points))] * 6)
    for own, view in zip((*scene.train, *scene.test), (*whole.train, *whole.test), strict=True):
        assert own.name == view.name
        np.testing.assert_array_equal(own.image, view.image)
        np.testing.assert_allclose(own.camera.viewmat, view.camera.viewmat, atol=1e-5)
        np.testing.assert_array_equal(own.camera.K, view.camera.K)
        assert set(view.points.pixels) <= set(own.points.pixels), "hidden points were said to be observed, too"
    np.testing.assert_allclose(scene.points, whole.points, atol=1e-5)
    np.testing.assert_allclose(scene.colors, whole.colors, atol=1e-6)
    assert scene.scale == pytest.approx(whole.scale, rel=1e-5)
    assert scene.transform.scale == pytest.approx(whole.transform.scale, rel=1e-5)


def test_what_is_given_beside_images_is_in_the_views(whole, given):
    """The depths of observed points are in units of the normalised world, however large the given one is."""
    masks = [None] * 5 + [np.arange(1200).reshape(30, 40) > 7]
    depths = [None, np.full((30, 40), 2.0, np.float32), *[None] * 4]
    larger = {"points": 2 * given["points"], "viewmats": given["viewmats"].copy()}
    larger["viewmats"][:, :3, 3] *= 2
    observed = [[], [3, 5], *[range(100)] * 4]
    scene = a2tg.scene_from_arrays(**{**given, **larger}, masks=masks, depths=depths, observed=observed)
    views = {view.name: view for view in (*scene.train, *scene.test)}
    first, second, *_, last = (views[name] for name in given["names"])
    assert last.mask.num == 1192 and first.mask is None and second.depth is not None and last.depth is None
    assert len(first.points.pixels) == 0 and len(second.points.pixels) <= 2
    own = scene.points[[3, 5]] @ np.asarray(second.camera.viewmat)[:3, :3].T + np.asarray(second.camera.viewmat)[:3, 3]
    assert all(np.abs(own[:, 2] - z).min() < 1e-5 for z in second.points.depths)
    system = a2tg.Gaussians2dMcmc.preset("smoke", stage1_iterations=2, initial_gaussians=None, densify={"cap": 250})
    changed = a2tg.LossConfig(points_weight=0.1, depth_weight=0.1)
    assert a2tg.fit(scene, dataclasses.replace(system, loss=changed), progress=False).model.num >= 200


def test_points_may_be_left_out(given):
    few = {name: given[name] for name in ("images", "viewmats", "Ks")}
    with pytest.warns(UserWarning, match="the scene mine: has no sparse points"):
        scene = a2tg.scene_from_arrays(**few, name="mine")
    assert [view.name for view in scene.test] == ["0000"] and len(scene.points) == 10_000
    grey = a2tg.scene_from_arrays(**few, points=given["points"])
    np.testing.assert_allclose(grey.colors, 128 / 255, atol=1e-6)


WRONG = {
    "images[0]: a picture must be an array uint8 [H, W, 3], or [H, W, 4] with alpha; got float32 [30, 40, 3]: say": {
        "images": [np.zeros((30, 40, 3), np.float32)] * 6
    },
    "a picture must be an array uint8 [H, W, 3], or [H, W, 4] with alpha; got uint8 [3, 30, 40]": {
        "images": [np.zeros((3, 30, 40), np.uint8)] * 6
    },
    "viewmats must be [6, 4, 4]; got [6, 3, 4]": {"viewmats": np.zeros((6, 3, 4))},
    "viewmats[0]: its pose is not a rigid motion": {"viewmats": np.stack([np.diag([2.0, 2, 2, 1])] * 6)},
    "Ks must be [6, 3, 3]; got [2, 3, 3]": {"Ks": np.zeros((2, 3, 3))},
    "points must be [P, 3]; got [5, 2]": {"points": np.zeros((5, 2))},
    "colors must be uint8; got float64: say np.rint(255": {"colors": np.zeros((200, 3))},
    "colors must be [200, 3]; got [2, 3]": {"colors": np.zeros((2, 3), np.uint8)},
    "names must hold one item for each of 6 images; got 1": {"names": ["a"]},
    "observed[1] must hold integers [S] from 0 to 199, indices of points; got int64 [1]": {
        "observed": [[0], [200], *[[]] * 4]
    },
    "observed needs points": {"points": None, "colors": None, "observed": [[0]] * 6},
    "lists a twice": {"names": ["a"] * 6},
    "masks[0]: a mask must be an array bool": {"masks": [np.ones((30, 40))] * 6},
    "masks[0] must be as large as its image, [30, 40]; got [3, 4]": {"masks": [np.ones((3, 4), bool)] * 6},
    "depths[1] must be as large as its image, [30, 40]; got [3, 4]": {"depths": [None, np.ones((3, 4)), *[None] * 4]},
    "names[0] must be a str; got NoneType": {"names": [None] * 6},
    "must end with the row 0, 0, 0, 1: transpose": {"viewmats": np.stack([np.eye(4) + np.eye(4, k=-1)] * 6)},
    "colors needs points": {"points": None},
    "; got bool [200]: say np.flatnonzero of a mask": {"observed": [np.ones(200, bool)] * 6},
}  # fmt: skip


@pytest.mark.parametrize("message", WRONG)
def test_what_is_wrong_is_named(given, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        a2tg.scene_from_arrays(**{**given, **WRONG[message]})


def test_arrays_of_jax_are_fine(given):
    scene = a2tg.scene_from_arrays(
        **{**given, "viewmats": jnp.asarray(given["viewmats"]), "Ks": jnp.asarray(given["Ks"])}
    )
    assert len(scene.train) == 4
