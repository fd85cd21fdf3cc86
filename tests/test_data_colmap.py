"""COLMAP scenes: written here in every variant, read back, compared with pycolmap's own projection."""

import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps
from test_data_transforms import dot_place as place_of, save_dot, shares_seen

from a2tg_jax import load_scene, view_image
from a2tg_jax.data.colmap import _model_of, _panoramas, _read_model, viewmat_of
from a2tg_jax.data.colmap_cameras import MODELS, ColmapCamera
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


def dot_place(image):
    """(x, y) of the centre of the dot."""
    return place_of(image[..., 0].astype(float))


def write_scene(folder, *, models=("PINHOLE",), num_views=9, num_points=50, text=False, names=None):
    """Writes images and sparse/0; view i has its own camera, of the i-th model (taken in turns)."""
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
        save_dot(folder / "images" / name, camera.img_from_cam(pose * TARGET), (WIDTH, HEIGHT))
    rng = np.random.default_rng(0)
    for index in range(num_points):
        point = TARGET if index == 0 else rng.normal(size=3)
        reconstruction.add_point3D(point, colmap.Track(), np.array([255, 128, index], np.uint8))
    (folder / "sparse" / "0").mkdir(parents=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(str(folder / "sparse" / "0"))
    return reconstruction


def project(camera, points):
    """Pixels [P, 2] of world points, in float64."""
    viewmat = np.asarray(camera.viewmat, np.float64)
    K = np.asarray(camera.K, np.float64)
    homogeneous = (points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def check_dots(scene, tolerance):
    """Every view shows the first point where its camera says."""
    for view in (*scene.train, *scene.test):
        assert view.image.shape == (view.camera.height, view.camera.width, 3)
        expected = project(view.camera, scene.points[:1].astype(np.float64))[0]
        np.testing.assert_allclose(dot_place(view.image), expected, atol=tolerance)


both_formats = pytest.mark.parametrize("text", [False, True], ids=["bin", "txt"])


def loaded(folder, num_views=9, tolerance=0.05, **options):
    """The scene, in which all cameras see the target where the images show it."""
    scene = load_scene(folder, test_every=0, **options)
    assert len(scene.train) == num_views
    check_dots(scene, tolerance)
    return scene


@both_formats
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


@both_formats
@pytest.mark.parametrize("is_missing", [False, True])
def test_model_without_points_starts_where_photographs_agree(tmp_path, text, is_missing):
    write_scene(tmp_path, num_points=0, text=text)
    if is_missing:
        (tmp_path / "sparse" / "0" / f"points3D.{'txt' if text else 'bin'}").unlink()
    with pytest.warns(UserWarning, match="no sparse points"):
        scene = load_scene(tmp_path)
    assert 5_000 < len(scene.points) <= 10_000 and scene.colors.shape == scene.points.shape
    assert shares_seen(scene).min() > 0.1


def test_images_without_a_pose_are_counted(tmp_path):
    write_scene(tmp_path)
    Image.new("RGB", (10, 10)).save(tmp_path / "images" / "zzz.png")
    # Files that macOS and Synology put next to photographs.
    for name in ("notes.txt", "._img_00.png", "@eaDir/zzz.png/thumb.jpg", ".cache/zzz.png"):
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "images" / name).touch()
    with pytest.warns(UserWarning, match=r"images: 1 photograph without a pose, such as zzz\.png: not us") as caught:
        assert len(load_scene(tmp_path).train) == 7
    assert caught[0].filename == __file__, "the line that called the package"


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


FOURTH = "images/img_04.png"
MODEL = "sparse/0"


def put(file, data):
    file.write_bytes(data)


def as_panoramas(folder):
    reconstruction = pycolmap().Reconstruction(str(folder / MODEL))
    for camera in reconstruction.cameras.values():
        camera.model = pycolmap().CameraModelId.EQUIRECTANGULAR
        camera.params = [WIDTH, HEIGHT]
    reconstruction.write_binary(str(folder / MODEL))


def without_camera(folder):
    reconstruction = pycolmap().Reconstruction(str(folder / MODEL))
    reconstruction.write_text(str(folder / MODEL))
    for file in (folder / MODEL).glob("*.bin"):
        file.unlink()
    change(folder / MODEL / "cameras.txt", b"\n4 PINHOLE", b"\n44 PINHOLE")


def with_a_camera_twice(folder):
    """As lists of two models, one after the other."""
    without_camera(folder)
    change(folder / MODEL / "cameras.txt", b"\n44 PINHOLE", b"\n3 PINHOLE")


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (lambda folder: folder / "nowhere", FileNotFoundError, "nowhere: no such scene folder$"),
        (lambda folder: shutil.rmtree(folder / "sparse"), FileNotFoundError, "has no sparse model"),
        (lambda folder: folder / "images", FileNotFoundError, "is a folder in the scene .*; give that folder instead"),
        (lambda folder: (folder / "images").rename(folder / "photos") and folder, FileNotFoundError, "no folder 'imag"),
        (lambda folder: (folder / FOURTH).unlink(), FileNotFoundError, "img_04.png: no such image"),
        (lambda folder: put(folder / FOURTH, b"no image"), ValueError, "img_04.png: cannot be read as an image"),
        (lambda folder: put(folder / FOURTH, (folder / FOURTH).read_bytes()[:200]), ValueError,
         "img_04.png: cannot be read as an image"),
        (lambda folder: Image.new("RGB", (WIDTH, HEIGHT + 4)).save(folder / FOURTH), ValueError,
         "img_04.png: is 128x100, but its camera is 128x96"),
        (lambda folder: put(folder / MODEL / "images.bin", b"\x05" + bytes(20)), ValueError,
         "images.bin: is cut off or damaged: number 1 of 5 images"),
        (lambda folder: change(folder / MODEL / "images.bin", b"img_03.png", b"img_\xe93.png"), ValueError,
         r"images\.bin: the image name img_\\xe93.png is not UTF-8; rename"),
        (without_camera, ValueError, r"images\.txt: img_03\.png has the camera 4, which is not in cameras\.txt"),
        (with_a_camera_twice, ValueError, r"cameras\.txt: has two cameras of one number; give each its own"),
        (as_panoramas, ValueError, "EQUIRECTANGULAR cannot be undistorted"),
    ],
)  # fmt: skip
def test_bad_input_is_named(tmp_path, spoil, error, message):
    write_scene(tmp_path)
    with pytest.raises(error, match=message) as caught:
        load_scene(spoil(tmp_path) or tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"downscale": 0}, "downscale must be"), ({"test_every": 1}, "test_every must be"),
        ({"test_every": 2.5}, "or a whole number of at least 2; got 2.5"),
        ({"room": -1}, "room must be at least 0 bytes; got -1"),
    ],
)  # fmt: skip
def test_bad_options(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        load_scene(tmp_path, **options)


def test_camera_models_are_those_of_pycolmap():
    colmap = pycolmap()
    numbers = {int(model): name for name, model in colmap.CameraModelId.__members__.items() if name != "INVALID"}
    assert {number: model.name for number, model in MODELS.items()} == numbers
    points = np.random.default_rng(0).uniform([-0.3, -0.2, 1], [0.3, 0.2, 2], (20, 3))
    for model in MODELS.values():
        theirs = colmap.Camera.create_from_model_name(0, model.name, 40.0, 64, 48)
        own = ColmapCamera(model.name, 64, 48, tuple(theirs.params.tolist()))
        assert len(own.params) == model.num_params
        assert len(own.distortion) == len(theirs.extra_params_idxs())
        assert model.num_focal == len(theirs.focal_length_idxs())
        if own.is_undistorted:
            np.testing.assert_allclose(own.matrix, theirs.calibration_matrix())
            np.testing.assert_allclose(own.pixels(points), theirs.img_from_cam(points), rtol=1e-12)
            np.testing.assert_allclose(own.slopes(own.pixels(points)), points[:, :2] / points[:, 2:], atol=1e-12)


def test_without_pycolmap_pinholes_are_read_and_other_lenses_say_what_to_do(tmp_path, monkeypatch):
    """It has no wheel for ARM Linux, for example."""
    write_scene(tmp_path / "pinhole", num_views=2)
    write_scene(tmp_path / "opencv", num_views=2, models=("OPENCV",))
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert len(loaded(tmp_path / "pinhole", 2).train) == 2
    with pytest.raises(ValueError, match="undistorting photographs need pycolmap, which is not installed"):
        load_scene(tmp_path / "opencv")


@pytest.mark.long
def test_zlib_survives_pycolmap_in_a_fresh_process(tmp_path):
    """pycolmap breaks Python's zlib unless that is loaded first."""
    write_scene(tmp_path, num_views=2)
    script = f"""
import sys
import a2tg_jax.data.load
assert "pycolmap" not in sys.modules, "importing the package is slower than it need be"
a2tg_jax.data.load.load_scene({str(tmp_path)!r})
assert "pycolmap" not in sys.modules, "pinholes do not need it"
from a2tg_jax.data.colmap_cameras import MODELS, ColmapCamera
from a2tg_jax.data.colmap_library import pycolmap
pycolmap()
import gzip, io, numpy as np
np.savez_compressed(io.BytesIO(), a=np.zeros(1000))
gzip.compress(bytes(1000))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("name", "num_train", "num_test"),
    [
        pytest.param("fox", 58, 9, marks=pytest.mark.long),
        ("herz_jesus_p25", 21, 4),
        pytest.param("snowmiku", 84, 13, marks=pytest.mark.long),
    ],
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


# Layouts of other programs, and files changed by hand. Dots in the images say where each camera sees the target.


def change(file, old, new):
    """Replaces bytes that are there."""
    assert old in file.read_bytes()
    file.write_bytes(file.read_bytes().replace(old, new))


@both_formats
def test_the_model_of_the_most_images_is_read(tmp_path, text):
    """COLMAP numbers its models in no order of size. Of nested ones, the one whose folder is given is read."""
    names = [f"{index:02d}.png" for index in range(15)]
    for index, own in enumerate((names[:3], names[3:13], names[13:])):
        write_scene(tmp_path / str(index), names=own, text=text)
        shutil.copytree(tmp_path / str(index) / "images", tmp_path / "scene" / "images", dirs_exist_ok=True)
        shutil.copytree(tmp_path / str(index) / "sparse" / "0", tmp_path / "scene" / "sparse" / f"{index}")
    with pytest.warns(UserWarning) as printed:
        assert [view.name for view in loaded(tmp_path / "scene", 10).train] == names[3:13]
    models, photographs = (str(warning.message) for warning in printed)
    assert "3 COLMAP models; sparse/1 (10 images) is read, and not sparse/0 (3 images), sparse/2 (2 images)" in models
    assert "5 photographs without a pose, such as 00.png: not used" in photographs
    other = models.rpartition("give its folder, such as ")[2]
    with pytest.warns(UserWarning, match="12 photographs without a pose"):
        assert [view.name for view in loaded(other, 3).train] == names[:3]
    shutil.copytree(other, tmp_path / "scene" / "sparse", dirs_exist_ok=True)
    with pytest.warns(UserWarning, match=r"4 COLMAP models; its own \(3 images\) is read|12 photographs"):
        loaded(tmp_path / "scene" / "sparse", 3)


def test_text_beside_a_binary_model(tmp_path):
    """COLMAP prefers .bin; changes of the text would have no effect."""
    reconstruction = write_scene(tmp_path)
    reconstruction.write_text(str(tmp_path / MODEL))
    loaded(tmp_path)
    file = tmp_path / MODEL / "images.txt"
    file.write_text("\n".join(file.read_text().splitlines()[:-2]) + "\n")
    with pytest.warns(UserWarning, match=r"from its \.bin files, with 9 images, and not from its \.txt files, with 8;"):
        loaded(tmp_path)


@pytest.mark.parametrize("folder", [".", "sparse", "sparse/0", "colmap", "colmap/sparse", "colmap/sparse/0"])
def test_any_folder_of_the_scene_will_do(tmp_path, folder):
    """ns-process-data writes colmap/sparse/0 next to images."""
    write_scene(tmp_path)
    if folder.startswith("colmap"):
        (tmp_path / "colmap").mkdir()
        (tmp_path / "sparse").rename(tmp_path / "colmap" / "sparse")
    assert loaded(tmp_path / folder).name == tmp_path.name


@pytest.mark.parametrize("is_named_with_folder", [False, True])
def test_photographs_beside_the_model(tmp_path, is_named_with_folder):
    """As RealityScan exports them. A folder that is called yard_2 is not theirs at a downscale of 2."""
    scene = tmp_path / "yard"
    write_scene(scene, text=True, names=[f"{index}.png" for index in range(9)])
    for file in [*(scene / MODEL).iterdir()]:
        file.rename(scene / f"{file.stem.capitalize()}.txt")
    shutil.rmtree(scene / "sparse")
    if is_named_with_folder:
        for index in range(9):
            change(scene / "Images.txt", b" %d.png" % index, b" images/%d.png" % index)
    else:
        for file in [*(scene / "images").iterdir()]:
            file.rename(scene / file.name)
        (scene / "images").rmdir()
    (tmp_path / "yard_2").mkdir()
    assert loaded(scene).name == "yard"
    assert loaded(scene, downscale=2, tolerance=0.1).train[0].image.shape == (HEIGHT // 2, WIDTH // 2, 3)


def for_lines(model, function):
    lines = (model / "images.txt").read_text().splitlines()
    (model / "images.txt").write_text("\n".join(map(function, lines)) + "\n")


def for_files(model, function):
    for file in model.iterdir():
        file.write_bytes(function(file.read_bytes()))


def with_long_quaternion(line):
    words = line.split()
    if not words or not words[0].isdecimal():
        return line
    return " ".join([words[0], *(str(3 * float(word)) for word in words[1:5]), *words[5:]])


def write_floats(model):
    change(model / "cameras.txt", b" 128 96 ", b" 128.0 96.0 ")
    change(model / "points3D.txt", b" 255 128 ", b" 255.0 128.0 ")


def strip_last_line(model):
    (model / "images.txt").write_text((model / "images.txt").read_text().rstrip())


TEXTS = {
    "without the last line": strip_last_line,
    "byte order marks": lambda model: for_files(model, lambda data: b"\xef\xbb\xbf" + data),
    "floats": write_floats,
    "CRLF": lambda model: for_files(model, lambda data: data.replace(b"\n", b"\r\n")),
    "quaternions of length 3": lambda model: for_lines(model, with_long_quaternion),
}


@pytest.mark.parametrize("spoil", TEXTS.values(), ids=TEXTS)
def test_text_as_other_programs_write_it(tmp_path, spoil):
    write_scene(tmp_path, text=True)
    spoil(tmp_path / MODEL)
    scene = loaded(tmp_path)
    np.testing.assert_allclose(scene.colors[7], np.array([255, 128, 7]) / 255, rtol=1e-6)
    assert len(scene.points) == 50


def with_tracks(folder, text):
    """A model in which every image observes two points, as far as COLMAP is concerned."""
    colmap = pycolmap()
    reconstruction = write_scene(folder, text=text)
    for key in (1, 2):
        for image in reconstruction.images.values():
            if key == 1:
                image.points2D = colmap.Point2DList([colmap.Point2D(np.array([5.0, 5])) for _ in range(2)])
            reconstruction.add_observation(key, colmap.TrackElement(image.image_id, key - 1))
    (reconstruction.write_text if text else reconstruction.write_binary)(str(folder / "sparse" / "0"))


@both_formats
def test_an_image_is_removed_as_the_error_says(tmp_path, text):
    """In text, its lines of rigs, frames and tracks stay, with which pycolmap rejects the model."""
    with_tracks(tmp_path, text)
    (tmp_path / "images" / "img_04.png").unlink()
    with pytest.raises(
        FileNotFoundError, match=r"img_04\.png: no such image, but the scene has a camera for it"
    ) as printed:
        load_scene(tmp_path)
    if text:
        file = tmp_path / MODEL / "images.txt"
        assert str(printed.value).rpartition("or ")[2] == f"delete its two lines in {file}"
        lines = file.read_text().splitlines(keepends=True)
        at = next(index for index, line in enumerate(lines) if "img_04.png" in line)
        file.write_text("".join(lines[:at] + lines[at + 2 :]))
        with pytest.warns(UserWarning, match="says that it has 9 images, and has 8"):
            loaded(tmp_path, 8)
        with pytest.raises(Exception, match="Image with ID 5 does not exist"):
            pycolmap().Reconstruction(str(file.parent))
    else:
        exec(str(printed.value).partition("in Python: ")[2], {})
        loaded(tmp_path, 8)


@pytest.mark.parametrize("name", ["points3D.txt", "points3D.bin"])
def test_empty_points_do_not_hide_a_ply_file(tmp_path, name):
    write_scene(tmp_path, num_points=0, text=name.endswith(".txt"))
    header = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / MODEL / "Points3D.ply").write_text(f"{header}end_header\n0.3 -0.2 0.1\n1 0 0\n0 1 0\n")
    assert len(loaded(tmp_path).points) == 3


def test_a_photograph_on_its_side_is_turned_as_the_error_says(tmp_path):
    """Its camera was estimated from the pixels as EXIF turns them."""
    write_scene(tmp_path)
    for file in (tmp_path / "images").iterdir():
        turned = Image.open(file).transpose(Image.Transpose.ROTATE_90)
        turned.getexif()[ExifTags.Base.Orientation] = 6
        turned.save(file, exif=turned.getexif())
    with pytest.raises(ValueError, match=r"is 96x128, but its camera is 128x96.* turned as EXIF says .*-auto-orient"):
        load_scene(tmp_path)
    for file in (tmp_path / "images").iterdir():
        ImageOps.exif_transpose(Image.open(file)).save(file)
    loaded(tmp_path)


@both_formats
def test_names_from_windows(tmp_path, text):
    """Backslashes separate folders, capitals of the files may differ, and names have spaces; masks have the same."""
    write_scene(tmp_path, names=[f"left/IMG {index}.png" for index in range(9)])
    reconstruction = pycolmap().Reconstruction(str(tmp_path / MODEL))
    for image in reconstruction.images.values():
        image.name = image.name.replace("/", "\\").replace("IMG", "img")
    (tmp_path / "model").mkdir()
    (reconstruction.write_text if text else reconstruction.write_binary)(str(tmp_path / "model"))
    (tmp_path / "masks" / "Left").mkdir(parents=True)
    mask = np.where(np.arange(HEIGHT)[:, None] < 5, 0, 255) * np.ones((1, WIDTH))
    for index in range(9):
        Image.fromarray(mask.astype(np.uint8)).save(tmp_path / "masks" / "Left" / f"IMG {index}.PNG.png")
    scene = loaded(tmp_path / "model")
    assert [view.name for view in scene.train] == [f"left/img {index}.png" for index in range(9)]
    assert all(not view.mask.read()[:5].any() and view.mask.read()[5:].all() for view in scene.train)


def test_two_images_of_one_file_are_refused(tmp_path):
    """Where capitals were lost, one file would serve two photographs."""
    write_scene(tmp_path, names=["a.png", "A.png", *(f"{index}.png" for index in range(4))])
    (tmp_path / "images" / "A.png").unlink()
    with pytest.raises(ValueError, match=r"a\.png: is the only file for (a|A)\.png and (a|A)\.png; put both there"):
        load_scene(tmp_path)


def test_a_lens_that_folds_can_be_kept_as_the_error_says(tmp_path, monkeypatch):
    monkeypatch.setitem(CAMERAS, "SIMPLE_RADIAL", [110.0, 64, 48, -3.0])
    write_scene(tmp_path, models=("SIMPLE_RADIAL",))
    with pytest.raises(ValueError, match=r'folds the image .* keep the photographs .*lens="keep"'):
        load_scene(tmp_path)
    assert load_scene(tmp_path, lens="keep").train[0].camera.rays is not None


@both_formats
def test_files_say_what_pycolmap_reads_in_them(tmp_path, text):
    """Poses and points, in a model of several rigs whose images have features."""
    with_tracks(tmp_path, text)
    model = _read_model(_model_of(tmp_path))
    expected = pycolmap().Reconstruction(str(tmp_path / "sparse" / "0"))
    assert len(model.images) == expected.num_reg_images() == 9
    for image in model.images:
        own = expected.images[image.id]
        assert (image.name, image.camera_id) == (own.name, own.camera_id)
        np.testing.assert_allclose(viewmat_of(image)[:3], own.cam_from_world().matrix(), atol=1e-14)
    for point in model.points:
        assert (point["position"] == expected.points3D[point["id"]].xyz).all()
        assert (point["color"] == expected.points3D[point["id"]].color).all()


def test_a_camera_far_away_does_not_make_the_others_one_place():
    viewmats = np.tile(np.eye(4), (7, 1, 1))
    viewmats[:, 0, 3] = [0, 0, 1, 1 + 1e-5, 2, 3, 1e9]
    assert _panoramas(viewmats) == [0, 0, 2, 2, None, None, None]
