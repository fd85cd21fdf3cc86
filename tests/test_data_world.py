"""The normalised world: similarities are consistent, and the normalisation does what it promises."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from a2tg_jax.core.similarity import Similarity, camera_centers
from a2tg_jax.data.assembly import normalizing_similarity


def look_at(center, target, up=(0.0, 0.0, 1.0)):
    """World-to-camera matrix (OpenCV) of a camera at `center` that looks at `target`."""
    forward = np.subtract(target, center) / np.linalg.norm(np.subtract(target, center))
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return viewmat


def random_similarity(rng):
    rotation = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    return Similarity(float(rng.uniform(0.1, 10)), rotation, rng.normal(size=3))


def ring(rng, target, count=12):
    """Cameras all around and above a target."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    heights = rng.uniform(0.5, 1.5, count)
    centers = target + np.stack([3 * np.cos(angles), 3 * np.sin(angles), heights], -1)
    return np.stack([look_at(center, target) for center in centers])


@pytest.mark.parametrize("seed", range(3))
def test_moved_camera_sees_the_moved_point_at_the_same_pixel(seed):
    rng = np.random.default_rng(seed)
    similarity, point = random_similarity(rng), rng.normal(size=3)
    viewmat = look_at(point + np.array([2, 0.3, 0.1]), point + np.array([0, 0.2, 0]))
    moved = similarity.apply_to_viewmat(viewmat)
    before = viewmat[:3, :3] @ point + viewmat[:3, 3]
    after = moved[:3, :3] @ similarity.apply(point) + moved[:3, 3]
    np.testing.assert_allclose(after, similarity.scale * before, atol=1e-12)
    np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_normalised_world(seed):
    """Wherever the scene was: target at the origin, up is +z, median distance 1."""
    rng = np.random.default_rng(seed)
    target = rng.normal(size=3)
    elsewhere = random_similarity(rng)
    viewmats = np.stack([elsewhere.apply_to_viewmat(viewmat) for viewmat in ring(rng, target)])
    similarity = normalizing_similarity(viewmats)
    moved = np.stack([similarity.apply_to_viewmat(viewmat) for viewmat in viewmats])
    np.testing.assert_allclose(similarity.apply(elsewhere.apply(target)), np.zeros(3), atol=1e-9)
    up = -moved[:, 1, :3].mean(axis=0)
    np.testing.assert_allclose(up / np.linalg.norm(up), [0, 0, 1], atol=1e-12)
    assert np.median(np.linalg.norm(camera_centers(moved), axis=1)) == pytest.approx(1)


def test_parallel_axes_fall_back_to_the_mean_camera():
    centers = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 2], [5, 0, 1]])
    viewmats = np.stack([look_at(center, center + np.array([0, 1, 0])) for center in centers])
    similarity = normalizing_similarity(viewmats)
    np.testing.assert_allclose(similarity.apply(centers.mean(axis=0)), np.zeros(3), atol=1e-12)


def test_cameras_hanging_upside_down_are_turned_over():
    viewmats = np.stack([look_at(center, (0, 0, 0), up=(0, 0, -1)) for center in np.eye(3) + 0.1])
    np.testing.assert_allclose(normalizing_similarity(viewmats).rotation @ [0, 0, -1], [0, 0, 1], atol=0.5)


@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_cameras_at_one_place_are_an_error(offset):
    center = np.array([offset, 1.0, 2.0])
    viewmats = np.stack([look_at(center, center + direction) for direction in np.eye(3)[:2]])
    with pytest.raises(ValueError, match="one place"):
        normalizing_similarity(viewmats)
