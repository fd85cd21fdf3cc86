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
    scene = a2tg.scene_from_arrays(**given)
    for own, view in zip((*scene.train, *scene.test), (*whole.train, *whole.test), strict=True):
        assert own.name == view.name
        np.testing.assert_array_equal(own.image, view.image)
        np.testing.assert_allclose(own.camera.viewmat, view.camera.viewmat, atol=1e-5)
        np.testing.assert_array_equal(own.camera.K, view.camera.K)
    np.testing.assert_allclose(scene.points, whole.points, atol=1e-5)
    np.testing.assert_allclose(scene.colors, whole.colors, atol=1e-6)
    assert scene.scale == pytest.approx(whole.scale, rel=1e-5)
    assert scene.transform.scale == pytest.approx(whole.transform.scale, rel=1e-5)


def test_what_is_given_beside_images_is_in_the_views(given):
    masks = [None] * 5 + [np.arange(1200).reshape(30, 40) > 7]
    depths = [None, np.full((30, 40), 2.0, np.float32), *[None] * 4]
    scene = a2tg.scene_from_arrays(**given, masks=masks, depths=depths)
    views = {view.name: view for view in (*scene.train, *scene.test)}
    first, second, *_, last = (views[name] for name in given["names"])
    assert last.mask.num == 1192 and first.mask is None and second.depth is not None and last.depth is None
    system = a2tg.Gaussians2dMcmc.preset("smoke", stage1_iterations=2, initial_gaussians=None, densify={"cap": 250})
    changed = a2tg.LossConfig(depth_weight=0.1)
    assert a2tg.fit(scene, dataclasses.replace(system, loss=changed)).model.num >= 200


def test_points_may_be_left_out(given):
    few = {name: given[name] for name in ("images", "viewmats", "Ks")}
    with pytest.warns(UserWarning, match="the scene mine: has no sparse points"):
        scene = a2tg.scene_from_arrays(**few, name="mine")
    assert [view.name for view in scene.test] == ["0000"] and 1000 < len(scene.points) <= 10_000
    grey = a2tg.scene_from_arrays(**few, points=given["points"])
    np.testing.assert_allclose(grey.colors, 128 / 255, atol=1e-6)


PICTURE = "must be an array uint8 [H, W, 3], or [H, W, 4] with alpha; got "
NO_DEPTHS = [None] * 4
WRONG = [
    (f"images[0]: a picture {PICTURE}float32 [30, 40, 3]: use", "images", [np.zeros((30, 40, 3), np.float32)] * 6),
    (f"{PICTURE}uint8 [3, 30, 40]", "images", [np.zeros((3, 30, 40), np.uint8)] * 6),
    (f"{PICTURE}float64 [30, 40]: use np.rint(255 * image)", "images", [np.zeros((30, 40))] * 6),
    ("images must hold at least two images, with a pose each; got 0", "images", []),
    ("images must be an Iterable; got NoneType: use a list", "images", None),
    ("use np.clip(np.rint(image), 0, 255).astype(np.uint8) of [0, 255]", "images", [np.full((30, 40, 3), 255.0)] * 6),
    ("got int64 [30, 40, 3]: use np.clip(np.rint(image), 0, 255)", "images", [np.full((30, 40, 3), 200)] * 6),
    ("use (image // 257).astype", "images", [np.full((30, 40, 3), 65535, np.uint16)] * 6),
    ("viewmats must be [6, 4, 4]; got [6, 3, 4]", "viewmats", np.zeros((6, 3, 4))),
    ("viewmats[0]: its pose is not a rigid motion", "viewmats", np.stack([np.diag([2.0, 2, 2, 1])] * 6)),
    ("end with the row 0, 0, 0, 1: transpose", "viewmats", np.stack([np.eye(4) + np.eye(4, k=-1)] * 6)),
    ("viewmats[0]: its pose is not finite", "viewmats", np.full((6, 4, 4), np.nan)),
    ("viewmats[0]: its pose exceeds ±1e+12, at 1e+200", "viewmats", np.stack([np.eye(4) + 1e200 * np.eye(4, k=3)] * 6)),
    ("viewmats must be an array of real numbers; got NoneType", "viewmats", None),
    ("Ks must be [6, 3, 3]; got [2, 3, 3]", "Ks", np.zeros((2, 3, 3))),
    ("Ks must be an array of real numbers; got list", "Ks", [[1, 2], [3]]),
    ("Ks[0]: its focal lengths must be in 0.04..4e+06 pixels", "Ks", np.full((3, 3), np.inf)),
    ("Ks[0]: its focal lengths must be in 0.04..4e+06 pixels", "Ks", np.zeros((6, 3, 3))),
    ("points must be an array of real numbers; got complex128[5, 3]", "points", np.full((5, 3), 1j)),
    ("points must be [P, 3]; got [5, 2]", "points", np.zeros((5, 2))),
    ("colors needs points", "points", None),
    ("colors must be uint8; got float64: use np.rint(255", "colors", np.zeros((200, 3))),
    ("got float64: use np.clip(np.rint(colors), 0, 255)", "colors", np.full((200, 3), 99.0)),
    ("colors must be [200, 3]; got [2, 3]", "colors", np.zeros((2, 3), np.uint8)),
    ("names must hold one item for each of 6 images; got 1", "names", ["a"]),
    ("lists a twice", "names", ["a"] * 6),
    ("names[0] must be a str; got NoneType", "names", [None] * 6),
    ("masks[0]: a mask must be an array bool", "masks", [np.ones((30, 40))] * 6),
    ("the mask of view_001.png excludes every pixel", "masks", [None, np.zeros((30, 40), bool), *NO_DEPTHS]),
    ("masks[0] must be as large as its image, [30, 40]; got [3, 4]", "masks", [np.ones((3, 4), bool)] * 6),
    ("depths[1] must be as large as its image, [30, 40]; got [3, 4]", "depths", [None, np.ones((3, 4)), *NO_DEPTHS]),
]  # fmt: skip


def test_what_is_wrong_is_named_and_arrays_of_jax_are_fine(given):
    for message, name, wrong in WRONG:
        with pytest.raises(ValueError, match=re.escape(message)):
            a2tg.scene_from_arrays(**{**given, name: wrong})
    of_jax = {name: jnp.asarray(given[name]) for name in ("viewmats", "Ks")}
    assert len(a2tg.scene_from_arrays(**{**given, **of_jax}).train) == 4


def of_opengl(viewmats):
    return np.diag([1.0, -1, -1, 1]) @ viewmats


CONVENTIONS = {
    "np.linalg.inv(viewmats)": np.linalg.inv,
    "np.linalg.inv(viewmats @ np.diag([1, -1, -1, 1]))": lambda given: np.linalg.inv(of_opengl(given)),
    "np.diag([1, -1, -1, 1]) @ viewmats": of_opengl,
}
"""How to make poses of another convention OpenCV's, and how they are made here."""


@pytest.mark.parametrize("has_points", [True, False])
@pytest.mark.parametrize("advice", CONVENTIONS)
@pytest.mark.filterwarnings("ignore:.*sparse points")
def test_poses_of_another_convention_are_named(given, advice, has_points):
    """The advice is right."""
    changed = {} if has_points else {"points": None, "colors": None}
    wrong = CONVENTIONS[advice](given["viewmats"])
    with pytest.warns(UserWarning, match=re.escape(f"with {advice}, if these")):
        a2tg.scene_from_arrays(**{**given, **changed, "viewmats": wrong})
    np.testing.assert_allclose(eval(advice, {"np": np, "viewmats": wrong}), given["viewmats"], atol=1e-6)
    a2tg.scene_from_arrays(**{**given, **changed})


def room(camera, radius=3.0):
    """What a camera in a sphere sees: smooth waves on its wall, whose rays are intersected here."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    viewmat = np.asarray(camera.viewmat, float)
    K = np.asarray(camera.K, float)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T @ viewmat[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    center = -viewmat[:3, :3].T @ viewmat[:3, 3]
    along = rays @ center
    wall = center + (np.sqrt(along**2 - center @ center + radius**2) - along)[..., None] * rays
    waves = np.random.default_rng(0).normal(size=(3, 40))
    return np.clip(128 + 25 * np.sin(4 / radius * wall @ waves + waves[0]) @ waves.T, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("is_real", [False, True], ids=["photographs of elsewhere", "a room"])
def test_cameras_that_look_outwards_are_fine(given, is_real):
    """On a circle, without points. Their axes meet behind them, as flipped axes around a subject do."""
    cameras = [a2tg.look_at([x, y, 0], [2 * x, 2 * y, 0], width=40, height=30)
               for x, y in zip(np.cos(range(6)), np.sin(range(6)), strict=True)]  # fmt: skip
    images = [room(camera) for camera in cameras] if is_real else given["images"]
    with pytest.warns(UserWarning) as warned:
        a2tg.scene_from_arrays(images, [camera.viewmat for camera in cameras], cameras[0].K)
    assert len(warned) == 1 and "has no sparse points" in str(warned[0].message)


def test_grey_images_are_those_of_three_equal_channels(given):
    planes = [image[..., 1] for image in given["images"]]
    wanted = a2tg.scene_from_arrays(**{**given, "images": [np.stack([plane] * 3, -1) for plane in planes]})
    for images in (planes, [plane[..., None] for plane in planes], (plane for plane in planes)):
        found = a2tg.scene_from_arrays(**{**given, "images": images})
        for own, view in zip(found.train, wanted.train, strict=True):
            np.testing.assert_array_equal(own.image, view.image)
            np.testing.assert_array_equal(a2tg.view_image(own), a2tg.view_image(view))


def test_points_that_are_nowhere_are_left_out_with_one_warning(given):
    """NumPy says nothing of its own."""
    nowhere = [[np.nan] * 3, [0, np.inf, 0], [1e300, 0, 0]]
    changed = {"points": np.concatenate([given["points"], nowhere]), "colors": None}
    with pytest.warns(UserWarning) as warned:
        scene = a2tg.scene_from_arrays(**{**given, **changed})
    assert [str(each.message) for each in warned] == [
        "the scene arrays: 3 points left out, not finite or beyond ±1e+12"
    ] and len(scene.points) == 200  # fmt: skip


MAP = np.array([4e5, 5e6, 100.0])
"""An offset of map coordinates, at which float32 has steps of half a metre."""


def on_map(given, dtype=np.float64):
    """Camera-to-world matrices on a map, whose rotations have been rounded."""
    poses = np.linalg.inv(given["viewmats"])
    poses[:, :3, :3] = poses[:, :3, :3].astype(np.float32)
    poses[:, :3, 3] += MAP
    return poses.astype(dtype).astype(np.float64)


def test_cameras_on_a_map_stay_where_rounded_rotations_have_them(given):
    """They are orthonormal to 1e-8 only, which t = -R·c would multiply by 5e6."""
    here, there = (
        a2tg.scene_from_arrays(**{**given, "viewmats": np.linalg.inv(poses), "points": points})
        for poses, points in (
            (np.linalg.inv(given["viewmats"]), given["points"]),
            (on_map(given), given["points"] + MAP),
        )
    )
    for own, view in zip(there.train, here.train, strict=True):
        np.testing.assert_allclose(own.camera.center, view.camera.center, atol=1e-6)


ROUNDED = {
    "viewmats": lambda given: {"viewmats": np.linalg.inv(on_map(given)).astype(np.float32)},
    "camera positions": lambda given: {"viewmats": np.linalg.inv(on_map(given, np.float32))},
    "points": lambda given: {"points": (given["points"] + MAP).astype(np.float32)},
}


@pytest.mark.parametrize("what", ROUNDED)
def test_map_coordinates_in_float32_are_noticed(given, what):
    on_a_map = {"viewmats": np.linalg.inv(on_map(given)), "points": given["points"] + MAP}
    with pytest.warns(
        UserWarning, match=rf"arrays: {what} were rounded to float32, in steps of 0\.5, which is 0\.\d+ of"
    ):
        a2tg.scene_from_arrays(**{**given, **on_a_map, **ROUNDED[what](given)})
    a2tg.scene_from_arrays(**{**given, **on_a_map})
    near = {name: np.asarray(given[name], np.float32) for name in ("viewmats", "points")}
    a2tg.scene_from_arrays(**{**given, **near})


def test_gaussians_on_a_map_are_noticed(given):
    colors = given["colors"] / 255.0
    with pytest.warns(UserWarning, match=r"points are in map coordinates, where means of float32 have steps of 0\.5"):
        a2tg.init_from_points(given["points"] + MAP, colors)
    a2tg.init_from_points(given["points"] + 100, colors)


def test_it_is_said_why_photographs_are_not_compared(given):
    few = {name: given[name] for name in ("viewmats", "Ks")}
    plain = [np.where(np.arange(30)[:, None, None] < 8, image, 90).astype(np.uint8) for image in given["images"]]
    with pytest.warns(UserWarning, match=r"random points, since [67]\d% of the photographs is plain, such as a wall"):
        a2tg.scene_from_arrays(plain, **few)
    clear = [np.zeros((30, 40, 4), np.uint8)] * 6
    with pytest.warns(UserWarning, match="random points, since the photographs agree nowhere"):
        a2tg.scene_from_arrays(clear, **few)


def test_a_view_that_does_not_fit_its_camera_is_named(whole):
    view = whole.train[0]
    other = dataclasses.replace(view, name="b.png", camera=a2tg.resize_camera(view.camera, 20, 15))
    model = a2tg.Model(a2tg.init_from_points(whole.points, whole.colors, num=20))
    with pytest.raises(ValueError, match=r"picture of view b\.png must be uint8 \[15, 20, 3\], as large as its camera"):
        a2tg.evaluate([view, other], model)


@pytest.mark.parametrize(
    ("factor", "size"), [((4, 4), "160 × 120"), ((0.5, 0.5), "20 × 15"), ((0.75, 4 / 3), "30 × 40")]
)
def test_intrinsics_of_another_size_are_named(given, factor, size):
    """A size that is the principal point's, twice; the last one is of turned photographs."""
    K = np.diag([*factor, 1]) @ given["Ks"]
    with pytest.warns(
        UserWarning, match=rf"6 of 6 .* Ks\[0\] would fit {size} pixels, but the image has 40 × 30\. Multiply"
    ):
        a2tg.scene_from_arrays(**{**given, "Ks": K})
    a2tg.scene_from_arrays(**{**given, "Ks": given["Ks"] + np.array([[0, 0, 9], [0, 0, 0], [0, 0, 0]])})  # a crop


def test_colours_without_their_factor_are_named(given):
    """uint8 of [0, 1] is black but for 1; an image that is dark throughout is one of several."""
    shares = [(image > 100).astype(np.uint8) for image in given["images"]]
    with pytest.warns(UserWarning, match="images hold no value above 1 of 255: multiply colours in"):
        a2tg.scene_from_arrays(**{**given, "images": shares})
    with pytest.warns(UserWarning, match="colors hold no value above 1 of 255"):
        a2tg.scene_from_arrays(**{**given, "colors": given["colors"] // 255 + 1})
    a2tg.scene_from_arrays(**{**given, "images": [*shares[:5], given["images"][5]]})


@pytest.mark.filterwarnings("ignore:no Gaussian is visible")
def test_a_transparent_photograph_is_compared_on_the_background_of_the_model():
    """The photograph shows nothing, and the Gaussians are hidden: on white, both are white."""
    cameras = [a2tg.look_at([x, -2, 0], [0, 0, 0], width=16, height=12) for x in (-0.5, 0.5)]
    images = [np.zeros((12, 16, 4), np.uint8)] * 2
    scene = a2tg.scene_from_arrays(images, [each.viewmat for each in cameras], cameras[0].K, 0.1 * np.eye(4, 3))
    hidden = a2tg.init_from_points(scene.points, scene.colors, opacity=1e-4)
    model = a2tg.Model(hidden, background=(1.0, 1.0, 1.0))
    view = scene.train[0]
    assert a2tg.psnr(model.render(view.camera).color, a2tg.view_image(view, model.background)) > 50
    with pytest.warns(UserWarning, match=r"transparent and was put on black: use view_image\(view, model.background\)"):
        assert not np.asarray(a2tg.view_image(view)).any()
