"""Flights through views that someone chose: they pass through them, smoothly, and no file is believed unseen."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_values import centers_of

from a2tg_jax import Camera, look_at, path_through, turntable
from a2tg_jax.core.origin import vertical_of
from a2tg_jax.data.capture_geometry import front_camera
from a2tg_jax.io.path_file import load_views


@pytest.mark.parametrize(("width", "height"), [(80, 60), (60, 80)])
def test_a_camera_looks_at_its_target_with_a_level_horizon(width, height):
    """The target is in the middle, what is above it above, and the image's border at half the angle of view."""
    position = np.asarray([1.0, -3.0, 0.5])
    target = np.asarray([0.2, 0.4, -0.3])
    camera = look_at(position, target, width=width, height=height, fov=50)

    def seen(point):
        x, y, z = np.asarray(camera.K, float) @ (np.asarray(camera.viewmat, float) @ [*point, 1])[:3]
        return x / z, y / z, z

    x, y, depth = seen(target)
    assert (x, y) == pytest.approx((width / 2, height / 2), abs=1e-4)
    assert depth == pytest.approx(np.linalg.norm(target - position), rel=1e-6)
    x, y, _ = seen(target + np.asarray([0, 0, 0.1]))
    assert x == pytest.approx(width / 2, abs=1e-4) and y < height / 2
    focal = float(camera.K[0, 0])
    assert np.degrees(np.arctan(max(width, height) / 2 / focal)) == pytest.approx(25, abs=1e-4)
    for wrong in ({"target": position}, {"target": position + np.asarray([0, 0, 1])}, {"fov": 180}, {"target": [0, 0]}):
        arguments = {"position": position, "target": target, "width": 80, "height": 60} | wrong
        with pytest.raises(ValueError, match=r"target|fov"):
            look_at(**arguments)


def some_views(num: int = 4, size=(64, 48)) -> list[Camera]:
    rng = np.random.default_rng(num)
    views = []
    for index in range(num):
        viewmat = np.eye(4, dtype=np.float32)
        viewmat[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * 0.4).as_matrix()
        viewmat[:3, 3] = rng.normal(size=3) + np.array([0, 0, index])
        K = np.array([[60 + 5 * index, 0, 32], [0, 60, 24], [0, 0, 1]], np.float32)
        views.append(Camera(viewmat, K, *size))
    return views


def saved(path, views: list[Camera], changes: dict | None = None):
    """As the viewer saves it."""
    data = {
        "format": "a2tg-jax path",
        "version": 1,
        "views": [
            {
                "viewmat": np.asarray(view.viewmat, np.float64).ravel().tolist(),
                "K": np.asarray(view.K, np.float64).ravel().tolist(),
                "size": [view.width, view.height],
            }
            for view in views
        ],
    }
    path.write_text(json.dumps(data | (changes or {})))
    return path


def test_a_flight_begins_and_ends_at_views_and_passes_the_others():
    views = some_views()
    path = path_through(views, 400)
    viewmats = np.array([camera.viewmat for camera in path])
    for view in views:
        assert np.abs(viewmats - np.asarray(view.viewmat)).max(axis=(1, 2)).min() < 0.05
    for end in (0, -1):
        np.testing.assert_allclose(path[end].viewmat, views[end].viewmat, atol=1e-5)
        np.testing.assert_allclose(path[end].K, views[end].K, rtol=1e-5)


def test_one_view_is_a_still_flight_and_equal_views_do_no_harm():
    (view,) = some_views(1)
    assert path_through([view], 3) == [view] * 3
    still = path_through([view, view, view], 4)
    np.testing.assert_allclose(still[2].viewmat, view.viewmat, atol=1e-5)
    with pytest.raises(ValueError, match="a path needs a view; got none"):
        path_through([], 3)
    with pytest.raises(ValueError, match="num_frames must be an int, at least 1; got 0"):
        path_through([view], 0)


# Turntables


def ring(num: int = 12, rolled: float = 0.0, arc: float = 80.0) -> list[Camera]:
    """Level cameras on an arc of some degrees that look at (1, 2, 3) from above, each rolled a little."""
    subject = np.array([1.0, 2.0, 3.0])
    cameras = []
    for index, angle in enumerate(np.radians(np.linspace(-arc / 2, arc / 2, num))):
        tilt = np.radians(26 + 11 * np.sin(2 * index))
        outward = np.array([np.cos(tilt) * np.cos(angle), np.cos(tilt) * np.sin(angle), np.sin(tilt)])
        viewmat = np.array(look_at(subject + 4 * outward, subject, width=64, height=48).viewmat)
        roll = Rotation.from_rotvec([0, 0, rolled * (-1) ** index]).as_matrix()
        viewmat[:3] = roll @ viewmat[:3]
        cameras.append(Camera(viewmat.astype(np.float32), np.diag([60, 60, 1]).astype(np.float32), 64, 48))
    return cameras


def test_a_turntable_is_a_level_closed_loop_around_the_subject():
    with pytest.raises(ValueError, match="up must be 3 numbers of unit length"):
        turntable(ring(), 2, (0, 0, 2))
    orbit = turntable(ring(rolled=0.05), 36)
    viewmats = np.array([camera.viewmat for camera in orbit], np.float64)
    centers = centers_of(viewmats)
    up = vertical_of(np.array([c.viewmat for c in ring(rolled=0.05)]))
    assert up[2] > 0.995
    to_subject = [1, 2, 3] - centers
    np.testing.assert_allclose(np.linalg.norm(to_subject, axis=1), 4.0, rtol=1e-4)
    np.testing.assert_allclose(viewmats[:, 2, :3], to_subject / 4, atol=1e-4)
    np.testing.assert_allclose(viewmats[:, 0, :3] @ up, 0.0, atol=1e-6)
    assert (viewmats[:, 1, :3] @ up < 0).all() and (centers[:, 2] > 3).all()
    steps = np.linalg.norm(centers - np.roll(centers, 1, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-3)
    # It begins at the front.
    front = ring()[front_camera(np.array([c.viewmat for c in ring()], np.float64), UP)]
    np.testing.assert_allclose(np.cross(centers[0] - [1, 2, 3], np.asarray(front.center) - [1, 2, 3])[2], 0, atol=0.05)


def moved_away(viewmats, factor):
    """The cameras of `ring` at another distance from its subject, at (1, 2, 3)."""
    moved = viewmats.copy()
    centers = [1, 2, 3] + factor * (centers_of(viewmats) - [1, 2, 3])
    moved[:, :3, 3] = -np.einsum("vij,vj->vi", viewmats[:, :3, :3], centers)
    return moved


UP = np.array([0.0, 0.0, 1.0])


def test_the_front_of_a_surrounded_subject_is_where_the_first_photograph_was_taken():
    viewmats = np.array([camera.viewmat for camera in ring(24, arc=345)], np.float64)
    assert front_camera(viewmats, UP) == 0
    assert front_camera(np.roll(viewmats, -7, axis=0), UP) == 0
    # The first one is too near to show the subject whole.
    viewmats[:1] = moved_away(viewmats[:1], 0.4)
    assert front_camera(viewmats, UP) in (1, 23)


def test_the_front_of_cameras_on_one_side_is_where_most_of_them_are():
    arc = np.array([camera.viewmat for camera in ring(9, arc=120)], np.float64)
    assert abs(front_camera(arc, UP) - 4) <= 1
    many = np.concatenate([arc, np.repeat(arc[7:8], 6, axis=0)])
    assert front_camera(many, UP) >= 6
    # Close-ups of the middle, however many, are not taken.
    near = moved_away(np.repeat(arc[4:5], 5, axis=0), 0.4)
    assert front_camera(np.concatenate([arc, near]), UP) < 9
    # Nor is a camera that looks past the subject.
    center = centers_of(arc)[4]
    arc[4, :3, :3] = Rotation.from_euler("y", 20, degrees=True).as_matrix() @ arc[4, :3, :3]
    arc[4, :3, 3] = -arc[4, :3, :3] @ center
    assert front_camera(arc, UP) in (3, 5)


def test_files_come_back(tmp_path):
    views = some_views()
    for found, wanted in zip(load_views(saved(tmp_path / "path.json", views)), views, strict=True):
        np.testing.assert_array_equal(found.viewmat, wanted.viewmat)
        np.testing.assert_array_equal(found.K, wanted.K)
        assert (found.width, found.height) == (wanted.width, wanted.height)


GOOD = {"viewmat": np.eye(4).ravel().tolist(), "K": [9, 0, 4, 0, 9, 3, 0, 0, 1], "size": [8, 6]}


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"format": "another"}, "is not a path"),
        ({"version": 2}, "is not a path of version 1"),
        ({"views": []}, "must hold 1 to"),
        ({"views": 3}, "must hold 1 to"),
        ({"views": [3]}, r"views\[0\] must be an object"),
        ({"views": [GOOD, {}]}, r"views\[1\]\.viewmat must be 16 finite numbers"),
        ({"views": [GOOD | {"viewmat": [1.0] * 16}]}, "must be a rigid motion"),
        ({"views": [GOOD | {"viewmat": [True, *GOOD["viewmat"][1:]]}]}, "must be 16 finite numbers"),
        ({"views": [GOOD | {"K": [10**12] * 9}]}, "its focal lengths must be in"),
        ({"views": [GOOD | {"K": [-9, 0, 4, 0, 9, 3, 0, 0, 1]}]}, "its focal lengths must be in"),
        ({"views": [GOOD | {"size": [8, 0]}]}, "must be 1 to 16384 pixels"),
        ({"views": [GOOD | {"size": [8.5, 6]}]}, "must be 1 to 16384 pixels"),
        ({"views": [GOOD | {"size": [1e6, 6]}]}, "must be 1 to 16384 pixels"),
    ],
)
def test_other_files_are_refused(tmp_path, changes, match):
    path = saved(tmp_path / "bad.json", some_views(1), changes)
    with pytest.raises(ValueError, match=rf"bad\.json: .*{match}"):
        load_views(path)
