"""The normalised world: similarities are consistent, and the normalisation does what it promises."""

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from small_values import centers_of

import a2tg_jax as a2tg
from a2tg_jax import Similarity, load_scene, turntable
from a2tg_jax.data.assembly import normalizing_similarity
from a2tg_jax.data.capture_geometry import outlying_cameras
from a2tg_jax.mesh.extract import common_sphere


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
    similarity = random_similarity(rng)
    point = rng.normal(size=3)
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
    assert np.median(np.linalg.norm(centers_of(moved), axis=1)) == pytest.approx(1)


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


# Cameras far from all others


def moved(viewmat, offset):
    """The camera, at another place and looking in the same direction."""
    viewmat = viewmat.copy()
    viewmat[:3, 3] -= viewmat[:3, :3] @ offset
    return viewmat


def path(centers, ahead):
    """Cameras at some centres that look in one direction each."""
    return np.stack([look_at(center, center + direction) for center, direction in zip(centers, ahead, strict=True)])


def honest_captures():
    """Captures as people take them, in which no camera is outlying."""
    rng = np.random.default_rng(0)
    around = ring(rng, np.zeros(3), 20)
    yield "ring", around
    steps = np.arange(60.0)
    line = np.stack([2 * steps, rng.normal(0, 0.1, 60), np.full(60, 1.6)], axis=-1)
    yield "street, to the side", path(line, rng.normal([0, 1, 0], 0.1, (60, 3)))
    yield "street, ahead", path(line, rng.normal([1, 0, 0], 0.1, (60, 3)))
    yield (
        "street, both sides",
        path(line, np.where(steps[:, None] % 2 == 0, 1, -1) * rng.normal([0, 1, 0], 0.1, (60, 3))),
    )
    yield "street, dense at one end", path(np.concatenate([line[:40] / 20, line[:20] + 4]), rng.normal(0, 1, (60, 3)))
    rows = np.stack([*np.meshgrid(10.0 * np.arange(12), 30.0 * np.arange(3)), np.full((3, 12), 80.0)], -1).reshape(
        -1, 3
    )
    yield "drone, in rows", path(rows, rng.normal([0.1, 0.1, -1], 0.03, (36, 3)))
    way = np.stack([3 + steps, 0.2 * steps, np.ones(60)], axis=-1)
    yield "around, then away", np.concatenate([around, path(way[:10], np.tile([1.0, 0.2, 0], (10, 1)))])
    yield (
        "around, then up",
        np.concatenate([around, [look_at([0.1, 0, 2 * height], np.zeros(3)) for height in range(1, 9)]]),
    )
    overview = [look_at([20.0, y, 8], [0, 0.4, 0]) for y in (0.0, 3, 6)]
    yield "around, and overviews from afar", np.concatenate([around, overview])
    yield "through a long lens", np.concatenate([around, [look_at([60.0, 2, 8], [0, 0.5, 0])]])
    yield "two rooms", np.concatenate([around, np.stack([moved(viewmat, [30, 0, 0]) for viewmat in around])])
    still = np.repeat(around[:1], 8, axis=0)
    yield "a panorama and photographs", np.concatenate([still, around[3:6]])
    yield "few", around[[0, 5, 10, 15]]
    facing = np.stack([look_at([x, 0, z], [0.0, 30, 0]) for x in (-1, 0, 1) for z in (0.0, 0.5, 1)])
    yield "facing", facing


@pytest.mark.parametrize(("name", "viewmats"), [pytest.param(*pair, id=pair[0]) for pair in honest_captures()])
@pytest.mark.parametrize("distance", [None, 5.0])
def test_no_camera_of_an_honest_capture_is_outlying(name, viewmats, distance):
    found = outlying_cameras(viewmats, None if distance is None else lambda indices: distance)
    assert not found.any()
    elsewhere = random_similarity(np.random.default_rng(1))
    there = np.stack([elsewhere.apply_to_viewmat(viewmat) for viewmat in viewmats])
    assert not outlying_cameras(there).any()


OFFSETS = {
    "beside": [[300.0, 0, 0]],
    "near": [[40.0, 0, 0]],
    "up": [[0.0, 0, 300]],
    "behind": [[200.0, 200, 200]],
    "several": [[300.0, 0, 0], [0, -400, 0], [0, 30, 3000]],
    "together": [[300.0, 0, 0], [301, 0, 0], [302, 0, 1]],
}


@pytest.mark.parametrize("name", OFFSETS)
@pytest.mark.parametrize("count", [10, 20, 40])
def test_wrong_poses_do_not_move_the_world(name, count):
    """Origin, axes, unit and scale are those of the cameras without them."""
    rng = np.random.default_rng(0)
    viewmats = ring(rng, np.array([5.0, 1, 2]), count)
    places = rng.choice(count, len(OFFSETS[name]), replace=False)
    for place, offset in zip(places, OFFSETS[name], strict=True):
        viewmats[place] = moved(viewmats[place], offset)
    found = outlying_cameras(viewmats)
    assert sorted(np.flatnonzero(found)) == sorted(places)
    elsewhere = random_similarity(rng)
    there = np.stack([elsewhere.apply_to_viewmat(viewmat) for viewmat in viewmats])
    np.testing.assert_array_equal(outlying_cameras(there), found)


def test_wrong_poses_along_a_street_are_found_by_what_the_others_see():
    centers = np.stack([np.arange(30.0), np.zeros(30), np.zeros(30)], axis=-1)
    viewmats = path(centers, np.tile([0.0, 1, 0], (30, 1)))
    viewmats[7] = moved(viewmats[7], [0, 0, 200.0])
    assert np.flatnonzero(outlying_cameras(viewmats, lambda indices: 10.0)).tolist() == [7]
    assert not outlying_cameras(viewmats, lambda indices: 100.0).any()
    assert not outlying_cameras(viewmats).any()
    viewmats[7] = moved(viewmats[7], [0, 0, 2000.0])
    assert np.flatnonzero(outlying_cameras(viewmats)).tolist() == [7]


def write_ring(folder, viewmats):
    """A scene of 40 points around the origin in the form of COLMAP."""
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    (folder / "images").mkdir()
    (model / "cameras.txt").write_text("1 PINHOLE 32 24 35 35 16 12\n")
    lines = []
    for number, viewmat in enumerate(viewmats):
        pose = [*Rotation.from_matrix(viewmat[:3, :3]).as_quat(scalar_first=True), *viewmat[:3, 3]]
        lines.append(f"{number + 1} {' '.join(map(repr, map(float, pose)))} 1 {number:02}.png\n\n")
        Image.new("RGB", (32, 24)).save(folder / f"images/{number:02}.png")
    (model / "images.txt").write_text("".join(lines))
    points = np.random.default_rng(0).uniform(-1, 1, (40, 3))
    lines = [f"{number} {' '.join(map(repr, map(float, point)))} 9 9 9 1\n" for number, point in enumerate(points)]
    (model / "points3D.txt").write_text("".join(lines))
    return folder


@pytest.mark.filterwarnings("ignore:.*training views see none of its points")
def test_a_scene_with_wrong_poses_is_trained_in_the_world_of_the_others(tmp_path):
    viewmats = ring(np.random.default_rng(0), np.zeros(3), 12)
    outliers = {3: [300.0, 0, 0], 8: [0, 0, 900]}
    others = load_scene(write_ring(tmp_path / "others", np.delete(viewmats, list(outliers), axis=0)))
    for number, offset in outliers.items():
        viewmats[number] = moved(viewmats[number], offset)
    with pytest.warns(
        UserWarning, match=r"2 cameras of 12 far from all others: 03\.png, 08\.png\. The others alone decide.* remove"
    ):
        scene = load_scene(write_ring(tmp_path / "all", viewmats))
    assert len(scene.train) + len(scene.test) == 12
    for field in ("scale", "rotation", "translation"):
        np.testing.assert_array_equal(getattr(scene.transform, field), getattr(others.transform, field))
    assert scene.scale == others.scale
    np.testing.assert_array_equal(scene.points, others.points)


def test_an_orbit_and_a_mesh_leave_out_cameras_far_from_all_others():
    viewmats = ring(np.random.default_rng(0), np.zeros(3), 12)
    K = np.diag([35.0, 35, 1])
    cameras = [a2tg.Camera(jnp.asarray(viewmat), jnp.asarray(K), 32, 24) for viewmat in viewmats]
    far = a2tg.Camera(jnp.asarray(moved(viewmats[5], [300.0, 0, 0])), jnp.asarray(K), 32, 24)
    for orbit, other in zip(turntable([*cameras, far], 3), turntable(cameras, 3), strict=True):
        np.testing.assert_array_equal(orbit.viewmat, other.viewmat)
    center, radius = common_sphere(viewmats)
    with_far = common_sphere([*viewmats, far.viewmat])
    np.testing.assert_array_equal(with_far[0], center)
    assert with_far[1] == radius
