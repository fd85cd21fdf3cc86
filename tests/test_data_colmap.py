"""COLMAP scenes: written here in every variant, read back, compared with pycolmap's own projection."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from test_data_transforms import shares_seen

from a2tg_jax.data import load_scene, view_image
from a2tg_jax.data.colmap_library import pycolmap

TARGET = np.array([0.3, -0.2, 0.1])
"""A point that every camera sees; it comes first in the model, and the images show it as a white dot."""
CAMERAS = {
    "PINHOLE": [110.0, 120, 70, 40],
    "SIMPLE_PINHOLE": [110.0, 70, 40],
    "SIMPLE_RADIAL": [110.0, 64, 48, -0.08],
    "RADIAL": [110.0, 60, 50, 0.1, -0.02],
    "OPENCV": [110.0, 115, 60, 50, -0.1, 0.02, 0.004, -0.003],
    "FULL_OPENCV": [110.0, 115, 60, 50, -0.1, 0.02, 0.004, -0.003, 0.01, 0, 0, 0],
    "OPENCV_FISHEYE": [80.0, 82, 62, 47, 0.02, -0.004, 0, 0],
    "FOV": [110.0, 112, 64, 48, 0.6],
    "THIN_PRISM_FISHEYE": [80.0, 82, 62, 47, 0.02, 0, 0.002, 0.001, 0, 0, 0.001, 0.001],
}
WIDTH, HEIGHT = 128, 96


def camera_pose(index, count):
    """World to camera [3, 4] of camera `index` on an arc around the target, looking a little past it."""
    angle = np.pi * (index / count - 0.5)
    center = TARGET + 4 * np.array([np.cos(angle), np.sin(angle), 0.3])
    forward = TARGET - center + np.array([0.1, 0.2, 0.15])
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.concatenate([rotation, -rotation @ center[:, None]], axis=1)


def dot_image(place, width=WIDTH, height=HEIGHT):
    """A black image with a smooth white dot around a place (x, y); pixel centres are at +0.5."""
    y, x = np.indices((height, width)) + 0.5
    dot = np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 8)
    return np.repeat(np.rint(255 * dot)[..., None], 3, axis=2).astype(np.uint8)


def dot_place(image):
    """(x, y) of the centre of the dot."""
    weights = image[..., 0].astype(float)
    y, x = np.indices(weights.shape) + 0.5
    return np.array([(weights * x).sum(), (weights * y).sum()]) / weights.sum()


def write_scene(folder, *, models=("PINHOLE",), num_views=9, num_points=50, text=False, names=None):
    """Writes images and sparse/0; view i has a camera of its own, of the i-th model (taken in turns)."""
    colmap = pycolmap()
    reconstruction = colmap.Reconstruction()
    names = names or [f"img_{index:02d}.png" for index in range(num_views)]
    for index, name in enumerate(names):
        model = models[index % len(models)]
        camera = colmap.Camera(
            camera_id=index + 1, model=model, width=WIDTH, height=HEIGHT, params=np.array(CAMERAS[model])
        )
        reconstruction.add_camera_with_trivial_rig(camera)
        pose = colmap.Rigid3d(camera_pose(index, len(names)))
        image = colmap.Image(image_id=index + 1, camera_id=index + 1, name=name)
        reconstruction.add_image_with_trivial_frame(image, pose)
        file = folder / "images" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(dot_image(camera.img_from_cam(pose * TARGET))).save(file)
    rng = np.random.default_rng(0)
    for index in range(num_points):
        point = TARGET if index == 0 else rng.normal(size=3)
        reconstruction.add_point3D(point, colmap.Track(), np.array([255, 128, index], np.uint8))
    (folder / "sparse" / "0").mkdir(parents=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(str(folder / "sparse" / "0"))
    return reconstruction


def project(camera, points):
    """Pixels [P, 2] of world points, in float64."""
    viewmat, K = np.asarray(camera.viewmat, np.float64), np.asarray(camera.K, np.float64)
    homogeneous = (points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def check_dots(scene, tolerance):
    """Every view shows the first point where its camera says."""
    for view in (*scene.train, *scene.test):
        assert view.image.shape == (view.camera.height, view.camera.width, 3)
        expected = project(view.camera, scene.points[:1].astype(np.float64))[0]
        np.testing.assert_allclose(dot_place(view.image), expected, atol=tolerance)


@pytest.mark.parametrize("text", [False, True])
def test_pinhole_scene(tmp_path, text):
    reconstruction = write_scene(tmp_path, text=text)
    scene = load_scene(tmp_path)
    assert scene.name == tmp_path.name
    assert [view.name for view in scene.test] == ["img_00.png", "img_08.png"]
    assert len(scene.train) == 7
    np.testing.assert_allclose(scene.colors[3], np.array([255, 128, 3]) / 255, rtol=1e-6)
    original = np.array([reconstruction.points3D[key].xyz for key in sorted(reconstruction.points3D)])
    for view in scene.train:
        image = reconstruction.find_image_with_name(view.name)
        expected = np.array([image.camera.img_from_cam(image.cam_from_world() * point) for point in original])
        np.testing.assert_allclose(project(view.camera, scene.transform.apply(original)), expected, atol=2e-3)
    np.testing.assert_allclose(scene.transform.inverse().apply(scene.points), original, atol=1e-5)
    check_dots(scene, 0.02)


@pytest.mark.parametrize("model", CAMERAS)
def test_every_camera_model_becomes_a_pinhole(tmp_path, model):
    write_scene(tmp_path, models=(model,), num_views=4)
    check_dots(load_scene(tmp_path), 0.05)


def test_several_cameras_at_a_downscale_made_in_memory(tmp_path):
    write_scene(tmp_path, models=tuple(CAMERAS))
    scene = load_scene(tmp_path, downscale=3)
    sizes = {(view.camera.width, view.camera.height) for view in (*scene.train, *scene.test)}
    assert (43, 32) in sizes and len(sizes) > 3
    check_dots(scene, 0.1)


def test_downscaled_folder_is_preferred(tmp_path):
    write_scene(tmp_path, models=("PINHOLE", "OPENCV"))
    (tmp_path / "images_2").mkdir()
    for file in (tmp_path / "images").iterdir():
        Image.open(file).reduce(2).save(tmp_path / "images_2" / file.name)
    shutil.rmtree(tmp_path / "images")
    check_dots(load_scene(tmp_path, downscale=2), 0.05)


def test_images_of_another_resolution_than_the_camera(tmp_path):
    """K follows the images' actual size on each axis."""
    write_scene(tmp_path)
    for file in (tmp_path / "images").iterdir():
        Image.open(file).resize((101, 75), Image.Resampling.HAMMING).save(file)
    check_dots(load_scene(tmp_path), 0.05)


@pytest.mark.parametrize("folder", [".", "sparse", "sparse/0"])
def test_any_folder_of_the_scene_will_do(tmp_path, folder):
    write_scene(tmp_path)
    scene = load_scene(tmp_path / folder)
    assert (scene.name, len(scene.train)) == (tmp_path.name, 7)


def test_model_beside_the_images_in_subfolders(tmp_path):
    names = [f"{side}/{index}.png" for side in ("left", "right") for index in range(3)]
    write_scene(tmp_path, names=names)
    for file in (tmp_path / "sparse" / "0").iterdir():
        file.rename(tmp_path / file.name)
    shutil.rmtree(tmp_path / "sparse")
    scene = load_scene(tmp_path, test_every=0)
    assert [view.name for view in scene.train] == sorted(names)
    assert scene.test == ()


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("is_missing", [False, True])
def test_model_without_points_starts_from_random_ones(tmp_path, text, is_missing):
    write_scene(tmp_path, num_points=0, text=text)
    if is_missing:
        (tmp_path / "sparse" / "0" / f"points3D.{'txt' if text else 'bin'}").unlink()
    with pytest.warns(UserWarning, match="no sparse points"):
        scene = load_scene(tmp_path)
    assert scene.points.shape == scene.colors.shape == (10_000, 3)
    assert shares_seen(scene).min() > 0.1


def test_unregistered_images_are_left_aside(tmp_path, caplog):
    write_scene(tmp_path)
    Image.new("RGB", (10, 10)).save(tmp_path / "images" / "zzz.png")
    with caplog.at_level("INFO"):
        assert len(load_scene(tmp_path).train) == 7
    assert "1 files have no pose" in caplog.text


def test_alpha_and_greyscale(tmp_path):
    write_scene(tmp_path, num_views=3)
    files = sorted((tmp_path / "images").iterdir())
    color = Image.open(files[1])
    color.putalpha(Image.new("L", color.size, 64))
    color.save(files[1])
    Image.open(files[2]).convert("L").save(files[2])
    first, second = load_scene(tmp_path).train
    assert second.alpha is None and second.image.shape == (HEIGHT, WIDTH, 3)
    assert first.alpha is not None and (first.alpha == 64).all()
    opacity = np.float32(64 / 255)
    expected = opacity * first.image / np.float32(255) + (1 - opacity) * np.float32([1, 0, 0.5])
    seen = view_image(first, (1, 0, 0.5))
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen, expected, atol=1e-6)


def break_missing_path(folder):
    return folder / "nowhere"


def break_no_model(folder):
    shutil.rmtree(folder / "sparse")


def break_no_images_folder(folder):
    (folder / "images").rename(folder / "photos")


def break_missing_image(folder):
    (folder / "images" / "img_04.png").unlink()


def break_unreadable_image(folder):
    (folder / "images" / "img_04.png").write_bytes(b"no image")


def break_cut_off_image(folder):
    file = folder / "images" / "img_04.png"
    file.write_bytes(file.read_bytes()[:200])


def break_aspect(folder):
    Image.new("RGB", (WIDTH, HEIGHT + 4)).save(folder / "images" / "img_04.png")


def break_model_file(folder):
    (folder / "sparse" / "0" / "images.bin").write_bytes(b"\x05" + bytes(20))


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (break_missing_path, FileNotFoundError, "nowhere: no such scene folder"),
        (break_no_model, FileNotFoundError, "has no sparse model"),
        (break_no_images_folder, FileNotFoundError, "no folder 'images'"),
        (break_missing_image, FileNotFoundError, "img_04.png: no such image"),
        (break_unreadable_image, ValueError, "img_04.png: cannot be read as an image"),
        (break_cut_off_image, ValueError, "img_04.png: cannot be read as an image"),
        (break_aspect, ValueError, "img_04.png: is 128x100, but its camera is 128x96"),
        (break_model_file, ValueError, "images.bin: is cut off or damaged: number 1 of 5 images"),
    ],
)
def test_bad_input_is_named(tmp_path, spoil, error, message):
    write_scene(tmp_path)
    with pytest.raises(error, match=message) as caught:
        load_scene(spoil(tmp_path) or tmp_path)
    assert "\n" not in str(caught.value)


def test_names_with_spaces_need_a_binary_model(tmp_path):
    """pycolmap ends names of text files at the first space."""
    names = [f"my photo {index}.png" for index in range(4)]
    write_scene(tmp_path / "binary", names=names)
    assert [view.name for view in load_scene(tmp_path / "binary", test_every=0).train] == names
    write_scene(tmp_path / "text", names=names, text=True)
    with pytest.raises(ValueError, match=r"images\.txt: line \d+ has the image name 'my photo \d.png'.* as \.bin"):
        load_scene(tmp_path / "text")


@pytest.mark.parametrize("text", [False, True])
def test_names_that_are_not_utf_8_are_told(tmp_path, text):
    write_scene(tmp_path, text=text)
    model = tmp_path / "sparse" / "0" / f"images{'.txt' if text else '.bin'}"
    model.write_bytes(model.read_bytes().replace(b"img_03.png", b"img_\xe93.png"))
    with pytest.raises(ValueError, match=r"images\.\w+: the image name img_\\xe93.png is not UTF-8; rename"):
        load_scene(tmp_path)


def test_panorama_is_refused(tmp_path):
    reconstruction = write_scene(tmp_path)
    for camera in reconstruction.cameras.values():
        camera.model, camera.params = pycolmap().CameraModelId.EQUIRECTANGULAR, [WIDTH, HEIGHT]
    reconstruction.write_binary(str(tmp_path / "sparse" / "0"))
    with pytest.raises(ValueError, match="EQUIRECTANGULAR cannot be undistorted"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"downscale": 0}, "downscale must be"), ({"test_every": 1}, "test_every must be")],
)
def test_bad_options(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        load_scene(tmp_path, **options)


def test_one_view_is_too_few(tmp_path):
    write_scene(tmp_path, num_views=1)
    with pytest.raises(ValueError, match="at least two are needed"):
        load_scene(tmp_path)


def test_zlib_survives_pycolmap_in_a_fresh_process(tmp_path):
    """pycolmap breaks Python's zlib unless that is loaded first."""
    write_scene(tmp_path, num_views=2)
    script = f"""
import sys
import a2tg_jax.data
assert "pycolmap" not in sys.modules, "importing the package is slower than it need be"
a2tg_jax.data.load_scene({str(tmp_path)!r})
import gzip, io, numpy as np
np.savez_compressed(io.BytesIO(), a=np.zeros(1000))
gzip.compress(bytes(1000))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("name", "num_train", "num_test"), [("fox", 58, 9), ("herz_jesus_p25", 21, 4), ("snowmiku", 84, 13)]
)
def test_real_scenes(shared, name, num_train, num_test):
    """Counts of views, and the model's own observations reproject within the error that COLMAP states."""
    folder = shared / "scenes" / name
    scene = load_scene(folder, downscale=2)
    assert (len(scene.train), len(scene.test)) == (num_train, num_test)
    reconstruction = pycolmap().Reconstruction(str(folder / "sparse" / "0"))
    for view in scene.test:
        image = reconstruction.find_image_with_name(view.name)
        observed = [point for point in image.points2D if point.has_point3D()]
        places = np.array([point.xy for point in observed])
        points = np.array([reconstruction.points3D[point.point3D_id].xyz for point in observed])
        scale = np.array([view.camera.width / image.camera.width, view.camera.height / image.camera.height])
        errors = np.linalg.norm(project(view.camera, scene.transform.apply(points)) / scale - places, axis=1)
        assert np.median(errors) < 1


def test_threads_wait_for_the_whole_library(tmp_path):
    """Photographs are read by several threads, of which each may be the first to need pycolmap."""
    (tmp_path / "pycolmap.py").write_text("import time\ntime.sleep(0.2)\nCamera = int\n")
    code = (
        "from concurrent.futures import ThreadPoolExecutor as Pool\n"
        "from a2tg_jax.data.colmap_library import pycolmap\n"
        "print(list(Pool(2).map(lambda _: pycolmap().Camera(1), range(2))))\n"
    )
    path = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "[1, 1]\n", done.stderr
