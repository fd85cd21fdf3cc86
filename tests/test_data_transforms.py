"""transforms.json of nerfstudio and instant-ngp, and Blender's: intrinsics, splits, points, distortion, errors."""

import contextlib
import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from a2tg_jax import load_scene
from a2tg_jax.data import assembly
from a2tg_jax.data.colmap_library import pycolmap

TARGET = np.array([0.2, -0.1, 0.3])
"""The images show it as a white dot, and it is the first of the points."""
WIDTH, HEIGHT = 120, 90
FOCAL = dict(fl_x=100.0, fl_y=104.0, cx=58.0, cy=47.0)
CENTERED = dict(fl_x=100.0, fl_y=100.0, cx=WIDTH / 2, cy=HEIGHT / 2)
SIZE = dict(w=WIDTH, h=HEIGHT)
NAMES = [f"images/{index:02d}.png" for index in range(8)]
DC = 0.28209479177387814
"""3DGS stores (colour - 0.5) / DC as f_dc."""
no_points = pytest.mark.filterwarnings("ignore:.*sparse points")


def camera_to_world(index, count):
    """Pose [4, 4] as these files have it: x right, y up, z backward."""
    angle = 2 * np.pi * index / count
    center = TARGET + 3 * np.array([np.cos(angle), np.sin(angle), 0.4])
    return pose_of(center, TARGET + np.array([0.1, 0.2, 0.1]) - center)


def pose_of(center, forward):
    """Pose of an upright camera that looks somewhere."""
    backward = -forward / np.linalg.norm(forward)
    right = np.cross([0, 0, 1.0], backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(backward, right), backward, center], axis=1)
    return pose


def to_camera(pose, point):
    """The point in OpenCV's camera frame (x right, y down, z forward)."""
    return pose[:3, :3].T @ (point - pose[:3, 3]) * [1, -1, -1]


def pinhole_place(pose, fl_x, fl_y, cx, cy):
    """(x, y) at which a pinhole camera sees the target."""
    x, y, z = to_camera(pose, TARGET)
    return fl_x * x / z + cx, fl_y * y / z + cy


def save_dot(file, place, size=(WIDTH, HEIGHT), alpha=False):
    """A white dot on black around a place (x, y); pixel centres are at +0.5."""
    y, x = np.indices(size[::-1]) + 0.5
    dot = np.rint(255 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 8)).astype(np.uint8)
    channels = [np.full_like(dot, 255)] * 3 + [dot] if alpha else [dot] * 3
    save(file, np.stack(channels, axis=-1))


def save(file, pixels):
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(file)


def write_frames(folder, count=8, place=lambda pose: pinhole_place(pose, **FOCAL), alpha=False, split="images"):
    """Images of the dot, and their frames without intrinsics."""
    frames = []
    for index in range(count):
        pose = camera_to_world(index, count)
        save_dot(folder / split / f"{index:02d}.png", place(pose), alpha=alpha)
        frames.append({"file_path": f"{split}/{index:02d}.png", "transform_matrix": pose.tolist()})
    return frames


def write_ply(file, encoding="ascii", kinds=("float", "uint8")):
    """Four points, the target first, as nerfstudio (ASCII) or a point-cloud program (binary) writes them."""
    points = np.concatenate([TARGET[None], np.eye(3)])
    if encoding == "ascii":
        return write_points(file, points, [[255, 0, 51]] * 4, kinds[1])
    order = "<" if "little" in encoding else ">"
    rows = np.zeros(4, [*((axis, order + {"float": "f4", "double": "f8"}[kinds[0]]) for axis in "xyz"), ("c", "3u1")])
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    rows["c"] = 255, 0, 51
    header = [f"ply\nformat {encoding} 1.0\ncomment points\nelement vertex 4"]
    header += [f"property {kinds[0]} {name}" for name in "xyz"]
    header += [f"property {kinds[1]} {name}" for name in ("red", "green", "blue")]
    return file.write_bytes("\n".join([*header, "end_header\n"]).encode() + rows.tobytes())


def write_points(file, points, colors=None, kind="uchar", names=("red", "green", "blue")):
    """Points with colours, as text."""
    colors = np.zeros((len(points), 3), int) if colors is None else colors
    rows = [" ".join(map(str, [*map(float, point), *color])) for point, color in zip(points, colors, strict=True)]
    header = [f"ply\nformat ascii 1.0\nelement vertex {len(points)}"]
    header += [f"property float {name}" for name in "xyz"] + [f"property {kind} {name}" for name in names]
    file.write_text("\n".join([*header, "end_header", *rows, ""]))


def write_json(folder, frames, name="transforms.json", **values):
    (folder / name).write_text(json.dumps({**values, "frames": frames}))


def write_scene(folder, **values):
    """A sound nerfstudio scene with sparse points."""
    write_ply(folder / "sparse_pc.ply")
    write_json(folder, write_frames(folder), **{"ply_file_path": "sparse_pc.ply", **FOCAL, **SIZE, **values})


def write_blender(folder, splits=("train", "test")):
    for count, split in zip((6, 3), splits, strict=False):
        frames = write_frames(folder, count, lambda pose: pinhole_place(pose, **CENTERED), alpha=True, split=split)
        for frame in frames:
            frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")
        write_json(folder, frames, f"transforms_{split}.json", camera_angle_x=2 * np.arctan(WIDTH / 200))


def dot_place(weights):
    y, x = np.indices(weights.shape) + 0.5
    return np.array([(weights * x).sum(), (weights * y).sum()]) / weights.sum()


def check_dots(scene, tolerance=0.03):
    """Every view shows the target where its camera, in the normalised world, says."""
    target = scene.transform.apply(TARGET)
    for view in (*scene.train, *scene.test):
        viewmat = np.asarray(view.camera.viewmat, np.float64)
        K = np.asarray(view.camera.K, np.float64)
        x, y, z = K @ (viewmat[:3, :3] @ target + viewmat[:3, 3])
        weights = (view.image[..., 0] if view.alpha is None else view.alpha).astype(float)
        assert weights.shape == (view.camera.height, view.camera.width)
        np.testing.assert_allclose(dot_place(weights), [x / z, y / z], atol=tolerance)


def shares_seen(scene):
    """The share of the scene's points in each training view's picture."""
    points = np.asarray(scene.points, np.float64)
    shares = []
    for view in scene.train:
        viewmat = np.asarray(view.camera.viewmat, np.float64)
        K = np.asarray(view.camera.K, np.float64)
        x, y, z = K @ (viewmat[:3, :3] @ points.T + viewmat[:3, 3:])
        is_within = (z > 0) & (x >= 0) & (x <= z * view.camera.width) & (y >= 0) & (y <= z * view.camera.height)
        shares.append(is_within.mean())
    return np.array(shares)


def test_global_intrinsics_and_points(tmp_path):
    write_scene(tmp_path, applied_transform=[[1, 0, 0, 5], [0, 0, 1, 0], [0, -1, 0, 0]])
    scene = load_scene(tmp_path)
    check_dots(scene)
    assert load_scene(tmp_path / "transforms.json").name == scene.name == tmp_path.name
    assert [view.name for view in scene.test] == ["images/00.png"]
    np.testing.assert_allclose(scene.points[0], scene.transform.apply(TARGET), atol=1e-6)
    np.testing.assert_allclose(scene.colors[0], [1, 0, 0.2], atol=1e-6)


@no_points
def test_intrinsics_per_frame_and_missing_suffix(tmp_path):
    frames = write_frames(tmp_path)
    for frame in frames:
        frame |= FOCAL | SIZE | {"file_path": frame["file_path"].removesuffix(".png")}
    write_json(tmp_path, frames, fl_x=1.0)
    check_dots(load_scene(tmp_path))


def shades(scene):
    """The grey of each view's photograph, by name."""
    return {view.name: int(view.image.mean().round()) for view in (*scene.train, *scene.test)}


def write_shades(folder, sizes):
    """A scene without points whose photographs, of given names and sizes, are each of one grey."""
    frames = [dict(transform_matrix=camera_to_world(index, len(sizes)).tolist()) for index in range(len(sizes))]
    for index, (frame, (name, size)) in enumerate(zip(frames, sizes.items(), strict=True)):
        save(folder / name, np.full((size[1], size[0], 3), 10 * index, np.uint8))
        frame["file_path"] = name
    write_json(folder, frames, **FOCAL, **SIZE)
    return {name: 10 * index for index, name in enumerate(sizes)}


@no_points
@pytest.mark.parametrize("second", [(WIDTH, HEIGHT), (WIDTH // 2, HEIGHT // 2)])
def test_a_second_clip_is_no_folder_of_smaller_copies(tmp_path, second):
    """images/clip_2 is a clip of the scene, even if its photographs have half the size."""
    names = [f"images/clip{'_2' * (index % 2)}/{index // 2}.png" for index in range(6)]
    wanted = write_shades(tmp_path, {name: second if "_2/" in name else (WIDTH, HEIGHT) for name in names})
    assert shades(load_scene(tmp_path, downscale=2)) == wanted


@no_points
@pytest.mark.parametrize(
    ("size", "message"),
    [
        ((WIDTH, HEIGHT), r"6 of 6, such as 0\.png, which is 120x90 for 120x90: not used"),
        ((WIDTH // 2, HEIGHT // 2 - 2), r"6 of 6, such as 0\.png, which is 60x43 for 120x90: not used"),
        (None, r"1 of 6, such as 5\.png, which is missing: not used"),
    ],
)
def test_a_folder_that_holds_no_smaller_copies(tmp_path, size, message):
    names = [f"images/{index}.png" for index in range(6)]
    wanted = write_shades(tmp_path, dict.fromkeys(names, (WIDTH, HEIGHT)))
    for name in names if size else names[:-1]:
        pixels = np.full((*(size or (WIDTH // 2, HEIGHT // 2))[::-1], 3), 255, np.uint8)
        save(tmp_path / name.replace("images", "images_2"), pixels)
    with pytest.warns(UserWarning, match=rf"images_2: does not hold the files of .*images at 1/2 .* {message}"):
        scene = load_scene(tmp_path, downscale=2)
    assert shades(scene) == wanted and scene.train[0].picture.size == (45, 60)


@no_points
def test_the_scene_beside_is_no_folder_of_smaller_copies(tmp_path):
    """Photographs may be in the scene's folder itself, whose siblings are other scenes."""
    names = [f"{index}.png" for index in range(4)]
    wanted = write_shades(tmp_path / "scene", dict.fromkeys(names, (WIDTH, HEIGHT)))
    for name in names:
        save(tmp_path / "scene_2" / name, np.full((HEIGHT // 2, WIDTH // 2, 3), 255, np.uint8))
    assert shades(load_scene(tmp_path / "scene", downscale=2)) == wanted


@pytest.mark.parametrize("is_full_there", [True, False])
@pytest.mark.parametrize("values", [FOCAL, FOCAL | {"w": WIDTH}, dict(camera_angle_x=2 * np.arctan(WIDTH / 200))])
def test_intrinsics_without_a_size_belong_to_the_full_images(tmp_path, values, is_full_there):
    place = FOCAL if "cx" in values else CENTERED
    frames = write_frames(tmp_path, place=lambda pose: pinhole_place(pose, **place))
    write_ply(tmp_path / "sparse_pc.ply")
    write_json(tmp_path, frames, ply_file_path="sparse_pc.ply", **values)
    check_dots(load_scene(tmp_path))
    (tmp_path / "images_2").mkdir()
    for file in (tmp_path / "images").iterdir():
        Image.open(file).reduce(2).save(tmp_path / "images_2" / file.name)
        if not is_full_there:
            file.unlink()
    scene = load_scene(tmp_path, downscale=2)
    assert scene.train[0].image.shape == (45, 60, 3)
    check_dots(scene)


def test_reduced_images_that_are_rounded(tmp_path):
    """Reduced images of 8 pixels are of 23, not 24."""
    frames = write_frames(tmp_path)
    for frame in frames:
        save(tmp_path / frame["file_path"], np.zeros((23, 23, 3), np.uint8))
        save(tmp_path / frame["file_path"].replace("images", "images_3"), np.zeros((8, 8, 3), np.uint8))
    write_ply(tmp_path / "sparse_pc.ply")
    write_json(tmp_path, frames, ply_file_path="sparse_pc.ply", fl_x=46.0)
    np.testing.assert_allclose(load_scene(tmp_path, downscale=3).train[0].camera.K[0, 0], 46 * 8 / 23, rtol=1e-6)


PRISM = dict(camera_model="THIN_PRISM_FISHEYE", k1=0.03, k4=0.002, p1=0.003, p2=-0.002, sx1=0.004)


@pytest.mark.parametrize(
    ("distortion", "model", "params"),
    [
        (dict(k1=-0.1, k2=0.02, p1=0.003, p2=-0.002), "OPENCV", [-0.1, 0.02, 0.003, -0.002]),
        (dict(k1=-0.1, k2=0.02, k3=0.01), "FULL_OPENCV", [-0.1, 0.02, 0, 0, 0.01, 0, 0, 0]),
        (dict(camera_model="OPENCV_FISHEYE", k1=0.03, k3=0.001), "OPENCV_FISHEYE", [0.03, 0, 0.001, 0]),
        (dict(is_fisheye=True, k1=0.03), "OPENCV_FISHEYE", [0.03, 0, 0, 0]),
        (PRISM, "THIN_PRISM_FISHEYE", [0.03, 0, 0.003, -0.002, 0, 0.002, 0.004, 0]),
    ],
)
def test_distortion_is_taken_out(tmp_path, distortion, model, params):
    camera = pycolmap().Camera(model=model, width=WIDTH, height=HEIGHT, params=[*FOCAL.values(), *params])
    write_ply(tmp_path / "points.ply")
    frames = write_frames(tmp_path, place=lambda pose: camera.img_from_cam(to_camera(pose, TARGET)))
    write_json(tmp_path, frames, ply_file_path="points.ply", **FOCAL, **SIZE, **distortion)
    check_dots(load_scene(tmp_path), 0.05)


@pytest.mark.parametrize(
    ("train", "val", "test", "message"),
    [
        (NAMES[:5], NAMES[5:7], [f"./{NAMES[7]}"], r"2 of 8 frames .*/05\.png; val_filenames count only without"),
        (NAMES[:5], NAMES[5:7], None, r"transforms\.json: 1 of 8 frames .* such as images/07\.png"),
        (None, None, NAMES[:2], None),
    ],
)
def test_split_lists(tmp_path, train, val, test, message):
    """Without a list for training, all other frames are trained on. Frames of no list are reported."""
    lists = {"train_filenames": train, "val_filenames": val, "test_filenames": test}
    write_scene(tmp_path, **{key: names for key, names in lists.items() if names})
    with pytest.warns(UserWarning, match=message) if message else contextlib.nullcontext():
        scene = load_scene(tmp_path)
    assert [view.name for view in scene.train] == (train or NAMES[2:])
    assert [view.name for view in scene.test] == [name.removeprefix("./") for name in test or val]


@pytest.mark.parametrize("key", ["train_filenames", "val_filenames", "test_filenames"])
def test_listed_names_without_a_frame(tmp_path, key):
    write_scene(tmp_path, **{"train_filenames": NAMES[:4], "test_filenames": NAMES[4:], key: [*NAMES[4:], "03"]})
    with pytest.raises(ValueError, match=f"{key} names 03, which is no frame; .* such as images/00.png"):
        load_scene(tmp_path)


def test_blender(tmp_path):
    write_blender(tmp_path)
    scene = load_scene(tmp_path)
    assert (len(scene.train), len(scene.test)) == (6, 3)
    assert scene.test[0].name == "test/00"
    assert scene.train[0].alpha is not None and (scene.train[0].image == 255).all()
    check_dots(scene)
    assert shares_seen(scene).min() > 0.5
    half = load_scene(tmp_path, downscale=2)
    check_dots(half)
    assert all(view.image[view.alpha > 0].min() == 255 for view in half.train), "white beside transparent pixels"
    (tmp_path / "transforms_test.json").unlink()
    assert [view.name for view in load_scene(tmp_path, test_every=3).test] == ["train/00", "train/03"]


def write_poses(folder, centers, forwards, name="transforms.json", angle=0.6911112070083618):
    """Black photographs of cameras at some places that look somewhere, upright."""
    frames = []
    for index, (center, forward) in enumerate(zip(centers, forwards, strict=True)):
        pose = pose_of(center, forward).tolist()
        frames.append({"file_path": f"train/{index}.png", "transform_matrix": pose})
        save(folder / f"train/{index}.png", np.zeros((40, 40, 3), np.uint8))
    write_json(folder, frames, name, camera_angle_x=angle)


def ring(count=8, radius=1.0):
    angles = 2 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles), 0.2 + 0.1 * np.sin(3 * angles)], axis=1)


@no_points
def test_random_points_of_nerfs_objects_fill_their_cube(tmp_path):
    """Cameras 4.031 from the origin with 39.6° see objects within ±1.3 (github.com/bmild/nerf)."""
    places = ring()
    places *= 4.031128874 / np.linalg.norm(places, axis=1, keepdims=True)
    write_poses(tmp_path, places, -places, "transforms_train.json")
    scene = load_scene(tmp_path)
    sights = [assembly.Sight.of_camera(view.camera) for view in scene.train]
    points = assembly.random_points(sights, scene.transform.rotation)
    original = scene.transform.inverse().apply(points[: len(points) // 2])
    np.testing.assert_allclose(np.abs(original).max(axis=0), 1.3, atol=2e-3)


LOOKS = {
    "inward": lambda places: -places,
    "outward": lambda places: places * [1, 1, 0],
    "ahead": lambda places: np.tile([1.0, 0, 0], (len(places), 1)),
    "scattered": lambda places: np.random.default_rng(3).normal(size=places.shape),
}


@no_points
@pytest.mark.parametrize("name", ["transforms.json", "transforms_train.json"])
@pytest.mark.parametrize("look", LOOKS)
def test_every_view_sees_random_points(tmp_path, look, name):
    """Black photographs are too plain to be compared."""
    places = ring()
    write_poses(tmp_path, places, LOOKS[look](places), name)
    scene = load_scene(tmp_path)
    assert len(scene.points) == 10_000 and shares_seen(scene).min() >= 0.12


@pytest.mark.parametrize(
    ("file", "values"),
    [("points3d.ply", {}), ("points3D.ply", {}), ("sparse_pc.ply", {}), ("p/x.ply", {"ply_file_path": "p/x.ply"})],
)
@pytest.mark.parametrize("name", ["transforms.json", "transforms_train.json"])
def test_points_beside_a_transforms_file(tmp_path, file, values, name):
    (tmp_path / file).parent.mkdir(exist_ok=True)
    write_ply(tmp_path / file)
    write_json(tmp_path, write_frames(tmp_path), name, **FOCAL, **SIZE, **values)
    scene = load_scene(tmp_path)
    assert len(scene.points) == 4
    np.testing.assert_allclose(scene.points[0], scene.transform.apply(TARGET), atol=1e-6)


# Rows of (x, y, z), as ns-process-data moves COLMAP's world: now, in its first versions, with
# --keep-original-world-coordinate, and as a user may.
WORLDS = {
    "now": np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]),
    "first": np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]),
    "kept": np.eye(4)[:3],
    "scaled": np.array([[0.0, 0, -2, 5], [2, 0, 0, -3], [0, -2, 0, 1]]),
}


def write_colmap(folder, world, names):
    """COLMAP's model of the cameras and points of a transforms file, in the world from which `world` [3, 4] leads to
    the file's."""
    scale = np.cbrt(np.linalg.det(world[:, :3]))
    back = np.linalg.inv(np.concatenate([world, [[0, 0, 0, 1.0]]]))[:3]
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} 100 104 58 47\n")
    lines = []
    for index, name in enumerate(names):
        pose = camera_to_world(index, len(names))
        rotation = (scale * back[:, :3] @ pose[:3, :3] @ np.diag([1.0, -1, -1])).T
        center = back[:, :3] @ pose[:3, 3] + back[:, 3]
        numbers = [*Rotation.from_matrix(rotation).as_quat(scalar_first=True), *(-rotation @ center)]
        lines.append(f"{index + 1} {' '.join(map(repr, map(float, numbers)))} 1 {name}\n\n")
    (folder / "images.txt").write_text("".join(lines))
    points = np.concatenate([TARGET[None], np.eye(3)]) @ back[:, :3].T + back[:, 3]
    lines = [f"{i} {' '.join(map(repr, map(float, point)))} 255 0 51 0.5\n" for i, point in enumerate(points)]
    (folder / "points3D.txt").write_text("".join(lines))


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("name", ["transforms.json", "transforms_train.json"])
def test_points_of_the_colmap_model_beside_a_transforms_file(tmp_path, world, name):
    frames = write_frames(tmp_path)
    write_json(tmp_path, frames, name, **FOCAL, **SIZE)
    write_colmap(tmp_path / "colmap/sparse/0", WORLDS[world], [f"{index:02d}.png" for index in range(8)])
    scene = load_scene(tmp_path)
    np.testing.assert_allclose(scene.points, scene.transform.apply([TARGET, *np.eye(3)]), atol=1e-6)
    np.testing.assert_allclose(scene.colors, np.tile(np.float32([1, 0, 0.2]), (4, 1)), atol=1e-6)


@no_points
@pytest.mark.parametrize("names", [[f"other{index}.png" for index in range(8)], NAMES[::-1], NAMES[:1]])
def test_a_colmap_model_of_other_poses_has_no_points_for_the_scene(tmp_path, names):
    write_json(tmp_path, write_frames(tmp_path), **FOCAL, **SIZE)
    write_colmap(tmp_path / "colmap/sparse/0", WORLDS["now"], names)
    with pytest.warns(UserWarning, match="other photographs or poses than the scene: its points are not used"):
        scene = load_scene(tmp_path)
    assert len(scene.points) > 4


@pytest.mark.parametrize(
    ("encoding", "kinds"),
    [
        ("ascii", ("float", "uchar")),
        ("binary_little_endian", ("float", "uchar")),
        ("binary_little_endian", ("double", "uint8")),
        ("binary_big_endian", ("float", "uint8")),
    ],
)
def test_point_files(tmp_path, encoding, kinds):
    write_scene(tmp_path)
    write_ply(tmp_path / "sparse_pc.ply", encoding, kinds)
    scene = load_scene(tmp_path)
    np.testing.assert_allclose(scene.points[0], scene.transform.apply(TARGET), atol=1e-6)
    np.testing.assert_allclose(scene.colors, np.tile(np.float32([1, 0, 0.2]), (4, 1)), atol=1e-6)


@pytest.mark.parametrize(
    ("names", "kind", "given", "wanted"),
    [
        ("red green blue", "uchar", [255, 0, 51], [1, 0, 0.2]),
        ("red green blue", "ushort", [65535, 0, 13107], [1, 0, 0.2]),
        ("red green blue", "ushort", [255, 0, 51], [1, 0, 0.2]),
        ("red green blue", "int", [255, 0, 51], [1, 0, 0.2]),
        ("red green blue", "float", [1, 0, 0.2], [1, 0, 0.2]),
        ("red green blue", "float", [255, 0, 51], [1, 0, 0.2]),
        ("red green blue", "float", [1.3, 0.2, -0.1], [1, 0.2, 0]),
        ("diffuse_red diffuse_green diffuse_blue", "uchar", [51, 102, 0], [0.2, 0.4, 0]),
        ("r g b", "uchar", [51, 102, 0], [0.2, 0.4, 0]),
        ("f_dc_0 f_dc_1 f_dc_2", "float", [0.1 / DC, -0.5 / DC, 0.3 / DC], [0.6, 0, 0.8]),
    ],
)
def test_colors_of_points(tmp_path, names, kind, given, wanted):
    """16 bits, whole numbers of 8 bits in wider types, floats in 0..1 or 0..255, other names; Gaussians as points."""
    write_scene(tmp_path)
    write_points(tmp_path / "sparse_pc.ply", TARGET + 0.1 * np.eye(2, 3), [given] * 2, kind, names.split())
    np.testing.assert_allclose(load_scene(tmp_path).colors, [wanted] * 2, atol=1e-6)


def test_points_that_some_or_all_views_do_not_see(tmp_path):
    """Close before the camera of one view, out of the picture of others; and far beyond all, which are replaced."""
    write_scene(tmp_path)
    pose = camera_to_world(1, 8)
    write_points(tmp_path / "sparse_pc.ply", pose[:3, 3] - pose[:3, 2] * np.array([[0.9], [1.0], [1.1]]))
    with pytest.warns(UserWarning, match=r"\d of 7 training views see none of its points, such as images/0\d\.png: n"):
        scene = load_scene(tmp_path)
    assert len(scene.points) == 3 and (shares_seen(scene) > 0).any() and not (shares_seen(scene) > 0).all()
    write_points(tmp_path / "sparse_pc.ply", TARGET + np.array([[0, 0, 300.0], [5, 0, 300], [0, 5, 320]]))
    with pytest.warns(UserWarning, match="no training view sees any of its sparse points; starts from 10,000 random"):
        assert shares_seen(load_scene(tmp_path)).min() > 0.1


def written(change=lambda frames: None, **values):
    """Function that writes a scene's frames again, changed."""

    def write(folder):
        frames = write_frames(folder)
        change(frames)
        write_json(folder, frames, **values)

    return write


def moved(place, value):
    return written(lambda frames: frames[2]["transform_matrix"][0].__setitem__(place, value), **FOCAL)


def all_at_one_place(frames):
    for frame in frames:
        frame["transform_matrix"] = frames[0]["transform_matrix"]


def as_texts(value):
    """The same JSON with texts for numbers."""
    if isinstance(value, dict):
        return {key: as_texts(item) for key, item in value.items()}
    return [as_texts(item) for item in value] if isinstance(value, list) else str(value)


@no_points
def test_numbers_may_be_texts(tmp_path):
    write_json(tmp_path, write_frames(tmp_path), k1=0.01, **FOCAL, **SIZE)
    wanted = load_scene(tmp_path)
    write_json(tmp_path, as_texts(write_frames(tmp_path)), k1="0.01", **as_texts(FOCAL), **as_texts(SIZE))
    for view, other in zip(load_scene(tmp_path).train, wanted.train, strict=True):
        np.testing.assert_array_equal(view.camera.K, other.camera.K)
        np.testing.assert_array_equal(view.camera.viewmat, other.camera.viewmat)
    write_json(tmp_path, as_texts(write_frames(tmp_path)), camera_angle_x="1.2", w="0", h="0")
    assert load_scene(tmp_path).train[0].camera.width == WIDTH


@no_points
def test_the_angle_of_a_frame_replaces_the_focal_length_of_the_file(tmp_path):
    frames = write_frames(tmp_path)
    frames[1]["camera_angle_x"] = 2 * np.arctan(WIDTH / 2 / 70)
    write_json(tmp_path, frames, **FOCAL, **SIZE)
    views = load_scene(tmp_path, test_every=0).train
    np.testing.assert_allclose(np.diag(views[1].camera.K), [70, 70, 1], rtol=1e-6)
    assert views[0].camera.K[0, 0] == views[2].camera.K[0, 0] == FOCAL["fl_x"]


@no_points
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le"])
def test_encodings(tmp_path, encoding):
    """As editors and shells of Windows write files."""
    frames = write_frames(tmp_path)
    write_json(tmp_path, frames, **FOCAL, **SIZE)
    file = tmp_path / "transforms.json"
    file.write_bytes(file.read_text().replace("\n", "\r\n").encode(encoding))
    assert len(load_scene(tmp_path, test_every=0).train) == len(frames)


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (lambda folder: (folder / "transforms.json").write_text("{"), ValueError, "cannot be read as JSON"),
        (written(**FOCAL | {"cx": "left"}), ValueError, "images/00.png: cx must be a number; got 'left'"),
        (written(**FOCAL | {"cx": "nan"}), ValueError, "images/00.png: cx must be a number; got 'nan'"),
        (written(**FOCAL | {"cx": None}), ValueError, "images/00.png: cx must be a number; got None"),
        (written(**FOCAL | {"cx": True}), ValueError, "images/00.png: cx must be a number; got True"),
        (written(w="wide", h=9, **FOCAL), ValueError, "images/00.png: w must be a number; got 'wide'"),
        (written(lambda frames: frames[1].update(transform_matrix="a"), **FOCAL), ValueError, "4x4 numbers; got a"),
        (lambda folder: write_json(folder, []), ValueError, "lists no frames"),
        (lambda folder: (folder / "images/03.png").unlink(), FileNotFoundError, "03.png: no such image"),
        (lambda folder: (folder / "sparse_pc.ply").unlink(), FileNotFoundError, "sparse_pc.ply: no such point file"),
        (lambda folder: (folder / "sparse_pc.ply").write_bytes(b"solid"), ValueError, "ply: is not a PLY file"),
        (written(**SIZE), ValueError, "images/00.png: has no focal length"),
        (moved(0, 5.0), ValueError, "images/02.png: its pose is not a rigid motion"),
        (moved(3, float("nan")), ValueError, "images/02.png: its pose is not finite"),
        (written(camera_model="EQUIRECTANGULAR", **FOCAL), ValueError, "camera_model EQUIRECTANGULAR"),
        (lambda folder: write_json(folder, write_frames(folder)[:1], **FOCAL), ValueError, "at least two are needed"),
        (written(all_at_one_place, **FOCAL), ValueError, "one place"),
        (written(lambda frames: frames.append(frames[1]), **FOCAL), ValueError, "lists images/01.png twice"),
    ],
)
def test_bad_input_is_named(tmp_path, spoil, error, message):
    write_scene(tmp_path)
    spoil(tmp_path)
    with pytest.raises(error, match=message) as caught:
        load_scene(tmp_path)
    assert "\n" not in str(caught.value)
