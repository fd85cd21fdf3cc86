"""Scenes that are cut off, have wrong counts, or hold numbers that no camera has: one clear line each."""

import json
import os
import struct
import time
import warnings

import numpy as np
import pytest
from hostile_files import put
from PIL import Image
from test_data_colmap import CAMERAS, write_scene as write_colmap
from test_data_transforms import (
    FOCAL,
    SIZE,
    write_blender,
    write_frames,
    write_json,
    write_ply,
    write_scene as write_transforms,
)

from a2tg_jax import load_scene
from a2tg_jax.data.colmap_files import KINDS, read_file
from a2tg_jax.data.ply import read_ply_points


def refused(path, match, error=ValueError):
    """Loading fails at once and in one line."""
    start = time.perf_counter()
    with warnings.catch_warnings(), pytest.raises(error, match=match) as caught:
        warnings.simplefilter("ignore")  # That points are left out is said as well.
        load_scene(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 1000
    assert time.perf_counter() - start < 20


@pytest.mark.parametrize("kind", KINDS)
def test_every_cut_of_a_binary_file_is_noticed(tmp_path, kind):
    """Read by pycolmap, most of these hang and eat memory, or load wrong numbers in silence."""
    write_colmap(tmp_path, models=tuple(CAMERAS), num_points=5)
    file = tmp_path / "sparse" / "0" / f"{kind}.bin"
    whole = file.read_bytes()
    for size in range(len(whole)):
        file.write_bytes(whole[:size])
        with pytest.raises(ValueError, match=rf"{kind}\.bin: is cut off or damaged"):
            read_file(file, kind)
    refused(tmp_path, rf"{kind}\.bin: is cut off")
    file.write_bytes(whole + b"\0")
    refused(tmp_path, rf"{kind}\.bin: .* is followed by 1 bytes")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [2**64 - 1, 2**32, 10])
def test_wrong_counts_are_refused(tmp_path, kind, count):
    write_colmap(tmp_path, num_points=5)
    file = tmp_path / "sparse" / "0" / f"{kind}.bin"
    file.write_bytes(struct.pack("<Q", count) + file.read_bytes()[8:])
    refused(tmp_path, rf"{kind}\.bin: is cut off or damaged: number \d+ of {count} {kind}")


def test_points_and_names_of_images_that_do_not_end_are_refused(tmp_path):
    write_colmap(tmp_path, num_points=5)
    file = tmp_path / "sparse" / "0" / "images.bin"
    whole = file.read_bytes()
    at = whole.index(b"img_00.png\0") + 11
    file.write_bytes(whole[:at] + struct.pack("<Q", 2**61) + whole[at + 8 :])
    refused(tmp_path, r"images\.bin: .* needs \d+ bytes")
    file.write_bytes(whole[: at - 1] + b"x" * 5000)
    refused(tmp_path, r"images\.bin: .* has a name that does not end")


@pytest.mark.parametrize("kind", KINDS)
def test_lines_that_are_cut_off_are_noticed(tmp_path, kind):
    write_colmap(tmp_path, models=tuple(CAMERAS), num_points=5, text=True)
    file = tmp_path / "sparse" / "0" / f"{kind}.txt"
    lines = [line for line in file.read_text().splitlines() if not line.startswith("#")]
    words = lines[0].split()
    for count in range(1, len(words)):
        file.write_text("\n".join([" ".join(words[:count]), *lines[1:]]) + "\n")
        with pytest.raises(ValueError, match=rf"{kind}\.txt: line 1 cannot be read"):
            read_file(file, kind)
    refused(tmp_path, rf"{kind}\.txt: line 1 cannot be read")


@pytest.mark.parametrize(
    ("kind", "line", "message"),
    [
        ("cameras", "1 PINHOLE 128 96 110 120 70", "PINHOLE has 4 parameters; got 3"),
        ("cameras", "1 MAGIC 128 96 110", "COLMAP has no camera model MAGIC"),
        ("cameras", "1 PINHOLE wide 96 110 120 70 40", "line 1"),
        ("images", "1 1 0 0 0 0 0 0 1", "it is cut off"),
        ("images", "1 1 0 0 0 0 0 0 1 a.png\n2 1 0 0 0 0 0 0 1 b.png\n", "the line of its points is missing"),
        (
            "images",
            "1 1 0 0 0 0 0 0 1 my a.png\n2 1 0 0 0 0 0 0 1 my photo b.png\n",
            "the line of its points is missing",
        ),
        ("points3D", "1 0 0 0 1 2 3.5.1 0.5", "line 1"),
        ("points3D", "1.5 0 0 0 1 2 3 0.5", "1.5 is not a whole number of at least 0"),
        ("cameras", "1 PINHOLE nan 96 110 120 70 40", "nan is not a whole number"),
        ("images", "1 1 0 0 0 0 0 0 1 a.png\n1 2 3 4", "the line of its points is missing or cut off"),
        ("points3D", "1 0 0 zero 1 2 3 0.5", "line 1"),
    ],
)
def test_wrong_lines_of_text_are_refused(tmp_path, kind, line, message):
    file = tmp_path / f"{kind}.txt"
    file.write_text(line)
    with pytest.raises(ValueError, match=rf"{kind}\.txt: line 1.*" if message == "line 1" else message):
        read_file(file, kind)


def test_a_text_that_ends_too_early(tmp_path):
    """Comments may be copied from elsewhere, so that it is no error."""
    write_colmap(tmp_path, num_points=5, text=True)
    for kind, size in (("points3D", 1), ("images", 2)):
        file = tmp_path / "sparse" / "0" / f"{kind}.txt"
        file.write_text("".join(file.read_text().splitlines(keepends=True)[:-size]))
        with pytest.warns(UserWarning, match=rf"{kind}\.txt: says that it has . {kind}, and has ."):
            read_file(file, kind)


# Numbers

ABSURD = [np.nan, np.inf, -np.inf, -100.0, 0.0, 1e300, 1e-300]
"""Focal lengths."""


@pytest.mark.parametrize("value", ABSURD)
@pytest.mark.parametrize("index", [0, 1])
def test_focal_lengths_that_no_camera_has(tmp_path, value, index):
    write_colmap(tmp_path)
    file = tmp_path / "sparse" / "0" / "cameras.bin"
    data = bytearray(file.read_bytes())
    struct.pack_into("<d", data, 8 + 24 + 8 * index, value)
    file.write_bytes(bytes(data))
    refused(tmp_path, "camera 1: its (focal lengths|camera's parameters)")


SPOILED = [
    *({"fl_x": value} for value in (*ABSURD, None, "wide", [1], True, 10**20)),
    *({key: value} for key in ("cx", "cy") for value in (np.nan, np.inf, 1e300, -1e9, "left", None)),
    *({key: value} for key in ("k1", "p1", "k3") for value in (np.nan, -np.inf, 1e9, -1e9, {})),
    {"w": 0.5}, {"w": -4}, {"h": 10**18}, {"w": np.nan}, {"h": "tall"}, {"w": [1]},
    {"ply_file_path": "../points.ply"}, {"ply_file_path": 5}, {"train_filenames": 5}, {"test_filenames": [1]},
    {"camera_model": ["OPENCV"]}, {"camera_model": {"a": "x" * 10**5}},
]  # fmt: skip
MESSAGES = {
    "fl_x": "has no focal length|its focal lengths must|fl_x must be a number|parameters must be finite",
    "cx": "principal point|cx must be a number|parameters must be finite",
    "cy": "principal point|cy must be a number|parameters must be finite",
    "w": r"w must (be in 1\.\.100000|be a number)",
    "h": r"h must (be in 1\.\.100000|be a number)",
    "ply_file_path": "leads out of the scene's folder|ply_file_path must be the name of a file",
    "train_filenames": "train_filenames must be a list of names",
    "test_filenames": "test_filenames must be a list of names",
    "camera_model": "has the camera_model",
}


@pytest.mark.parametrize("values", SPOILED)
def test_values_of_transforms_that_no_camera_has(tmp_path, values):
    write_transforms(tmp_path, **values)
    (key,) = values
    refused(tmp_path, MESSAGES.get(key, f"distortion|{key} must be a number|parameters must be finite"))


MATRICES = [None, 1, "one", [], [[]], [[1, 2], [3]], *([[x] * 4] * 4 for x in ("a", None, {}, 10**22))]


@pytest.mark.parametrize("matrix", MATRICES)
def test_poses_of_wrong_types(tmp_path, matrix):
    frames = write_frames(tmp_path)
    frames[1]["transform_matrix"] = matrix
    write_json(tmp_path, frames, **FOCAL)
    refused(tmp_path, r"images/01\.png: its (transform_matrix must be|pose)")


@pytest.mark.parametrize("angle", [0.0, -1.0, 4.0, np.nan, np.inf, 1e300])
def test_angles_of_view_that_no_camera_has(tmp_path, angle):
    write_blender(tmp_path)
    file = tmp_path / "transforms_train.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "camera_angle_x": angle}))
    refused(tmp_path, "has no focal length")


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, 1e15])
@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_poses_that_are_nowhere(tmp_path, kind, value):
    if kind == "colmap":
        write_colmap(tmp_path)
        file = tmp_path / "sparse" / "0" / "images.bin"
        data = bytearray(file.read_bytes())
        struct.pack_into("<d", data, 8 + 4 + 32, value)
        file.write_bytes(bytes(data))
    else:
        frames = write_frames(tmp_path)
        frames[1]["transform_matrix"][0][3] = value
        write_json(tmp_path, frames, **FOCAL, **SIZE)
    refused(tmp_path, "its pose (is not finite|exceeds)|cannot be read as a COLMAP model")


def test_a_camera_far_beyond_the_others_is_named(tmp_path):
    frames = write_frames(tmp_path)
    frames[1]["transform_matrix"][0][3] = 1e9
    write_json(tmp_path, frames, **FOCAL, **SIZE)
    refused(tmp_path, r"images/01\.png is more than 100000 times as far away")


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
def test_points_that_are_nowhere_are_left_out(tmp_path, value):
    write_colmap(tmp_path, num_points=5)
    file = tmp_path / "sparse" / "0" / "points3D.bin"
    data = bytearray(file.read_bytes())
    struct.pack_into("<d", data, 16, value)
    file.write_bytes(bytes(data))
    with pytest.warns(UserWarning, match="1 point left out, not finite or beyond"):
        assert len(load_scene(tmp_path).points) == 4


# JSON


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([1, 2, 3], "frame 0 must be an object; got 1"),
        ([None], "frame 0 must be an object"),
        ({"a": 1}, "lists no frames"),
        ("abc", "lists no frames"),
        ([{"file_path": ["a"], "transform_matrix": [[1]]}], "file_path must be the name of a file"),
        ([{"file_path": 7, "transform_matrix": [[1]]}], "file_path must be the name of a file"),
        ([{"file_path": "", "transform_matrix": [[1]]}], "file_path must be the name of a file"),
        ([{"file_path": "../a.png", "transform_matrix": [[1]]}], "leads out of the scene's folder"),
        ([{"file_path": "/etc/passwd", "transform_matrix": [[1]]}], "leads out of the scene's folder"),
        ([{"file_path": "a.png", "mask_path": "../a.png", "transform_matrix": 1}], "leads out of the scene's folder"),
        ([{"file_path": "a.png"}], "lacks file_path or transform_matrix"),
    ],
)
def test_frames_of_wrong_types(tmp_path, frames, message):
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    refused(tmp_path, message)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "nested more than 64 deep"),
        ('{"frames": [' + '{"a":' * 900 + "1" + "}" * 900 + "]}", "nested more than 64 deep"),
        ('{"frames": [{"file_path": "a", "transform_matrix": 1}], "fl_x": ' + "1" * 401 + "}", "401 digits"),
        ('{"frames": [{"file_path": "a", "transform_matrix": 1}], "fl_x": ' + "1" * 5000 + "}", "5000 digits"),
        ("\xff\xfe", "cannot be read as JSON"),
        ("", "cannot be read as JSON"),
    ],
)
def test_json_made_to_do_harm(tmp_path, text, message):
    (tmp_path / "transforms.json").write_text(text, encoding="latin-1")
    refused(tmp_path, message)


# Points


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("count", ["2000000000", str(2**64 - 1), "-1", "1" * 30, "many", "5"])
def test_wrong_counts_of_point_files(tmp_path, encoding, count):
    file = tmp_path / "points.ply"
    write_ply(file, encoding)
    file.write_bytes(file.read_bytes().replace(b"element vertex 4", b"element vertex " + count.encode()))
    with pytest.raises(ValueError, match=r"points\.ply: (is cut off|announces|row 4 .* got the end of the file)"):
        read_ply_points(file)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (b"ply\n" + b"comment\n" * 20_000, "header does not end"),
        (b"ply\n" + b"x" * 10**6, "header does not end"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n", "cannot read the vertex"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\nend_header\n", "cannot read the vertex property"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\n" + b"property float x\n" * 2 + b"end_header\n", "cannot read"),
        (b"ply\nformat secret 1.0\nelement vertex 1\nend_header\n", "is a PLY in secret"),
        (b"ply\nformat ascii 1.0\nelement face 1\nend_header\n", r"has no vertices; its elements are \['face'\]"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "has no attribute y, z"),
    ],
)
def test_wrong_headers_of_point_files(tmp_path, header, message):
    file = tmp_path / "points.ply"
    file.write_bytes(header)
    with pytest.raises(ValueError, match=message):
        read_ply_points(file)


# Links


def circle(first, second):
    first.symlink_to(second)
    second.symlink_to(first)


def test_circles_of_links(tmp_path):
    """A scene, and an image of one."""
    circle(tmp_path / "a", tmp_path / "b")
    refused(tmp_path / "a", "no such scene folder", FileNotFoundError)
    write_colmap(tmp_path / "scene")
    images = tmp_path / "scene" / "images"
    (images / "img_03.png").unlink()
    circle(images / "img_03.png", images / "x.png")
    refused(tmp_path / "scene", r"img_03\.png: no such image", FileNotFoundError)


def test_a_folder_that_holds_itself_is_walked_once(tmp_path):
    write_colmap(tmp_path)
    (tmp_path / "images" / "again").symlink_to(tmp_path)
    assert len(load_scene(tmp_path).train) == 7


def test_names_in_a_model_do_not_lead_out(tmp_path):
    scene = tmp_path / "scene"
    write_colmap(scene, names=["a.png", "secret.png", "c.png"])
    Image.new("RGB", (128, 96)).save(tmp_path / "secret.png")
    file = scene / "sparse" / "0" / "images.bin"
    file.write_bytes(file.read_bytes().replace(b"secret.png\0", b"../../secret.png\0"))
    refused(scene, "leads out of the scene's folder")


# Things that are no files


@pytest.mark.parametrize("name", ["transforms.json", "masks/01.png", "points.ply", "images/01.png"])
@pytest.mark.parametrize("kind", ["device", "pipe", "sparse"])
def test_scenes_whose_files_are_none(tmp_path, name, kind):
    write_ply(tmp_path / "points.ply")
    write_json(tmp_path, write_frames(tmp_path), ply_file_path="points.ply", **FOCAL, **SIZE)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    put(tmp_path / name, kind)
    refused(tmp_path, "is not a regular file" if kind != "sparse" else "has 100,000,000,000 bytes")


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("kind", ["device", "pipe", "sparse"])
def test_models_of_colmap_whose_files_are_none(tmp_path, name, kind):
    write_colmap(tmp_path)
    put(tmp_path / "sparse" / "0" / name, kind)
    refused(tmp_path, "is not a regular file" if kind != "sparse" else "has 100,000,000,000 bytes")


def test_a_text_of_colmap_of_one_endless_line(tmp_path):
    (tmp_path / "points3D.txt").touch()
    os.truncate(tmp_path / "points3D.txt", 10**9)
    with pytest.raises(ValueError, match=r"points3D\.txt: has a line of more than"):
        read_file(tmp_path / "points3D.txt", "points3D")


@pytest.mark.filterwarnings("ignore:.*views see none of its points")
def test_points_that_are_nowhere_in_the_normalised_world_are_left_out(tmp_path):
    """Cameras that are close together make its unit small."""
    frames = write_frames(tmp_path)
    for frame in frames:
        for row in frame["transform_matrix"][:3]:
            row[3] *= 1e-6
    write_ply(tmp_path / "points.ply")
    text = (tmp_path / "points.ply").read_text().splitlines()
    text[-1] = " ".join(["9e11", "0", "0", *text[-1].split()[3:]])
    (tmp_path / "points.ply").write_text("\n".join(text) + "\n")
    write_json(tmp_path, frames, ply_file_path="points.ply", **FOCAL, **SIZE)
    with pytest.warns(UserWarning, match="1 point left out, not finite or beyond"):
        assert np.abs(load_scene(tmp_path).points).max() <= 1e12
