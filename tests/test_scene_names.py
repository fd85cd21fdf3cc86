"""Names of files in the files of a scene: with backslashes, other capitals, absolute, or leading out."""

import json
import os
import unicodedata

import numpy as np
import pytest
from PIL import Image
from test_data_transforms import (
    FOCAL,
    HEIGHT,
    NAMES,
    SIZE,
    WIDTH,
    check_dots,
    write_frames,
    write_json,
    write_ply,
    write_scene,
)

from a2tg_jax import load_scene

KEPT = 5
"""Rows at the top that masks exclude."""


def write_masked(folder, change):
    """A scene of nerfstudio with masks, depth maps and points, whose names a function changes."""
    frames = write_frames(folder)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:KEPT] = 0
    for name in ("own_masks", "own_depths"):
        (folder / name).mkdir()
    for frame in frames:
        name = frame["file_path"].partition("/")[2]
        Image.fromarray(mask).save(folder / "own_masks" / name)
        Image.fromarray(mask).save(folder / "own_depths" / name)
        frame |= {"mask_path": f"own_masks/{name}", "depth_file_path": f"own_depths/{name}"}
        frame |= {key: change(frame[key]) for key in ("file_path", "mask_path", "depth_file_path")}
    write_ply(folder / "points.ply")
    lists = {"train_filenames": [frame["file_path"] for frame in frames[:6]]}
    lists["test_filenames"] = [frame["file_path"] for frame in frames[6:]]
    write_json(folder, frames, ply_file_path=change("points.ply"), **FOCAL, **SIZE, **lists)


def swapped(name):
    stem, suffix = os.path.splitext(name)
    return f"{stem}{suffix.upper()}"


@pytest.mark.parametrize("kind", ["backslashes", "capitals", "absolute", "dots"])
def test_every_name_in_a_transforms_file(tmp_path, monkeypatch, kind):
    change = {
        "backslashes": lambda name: name.replace("/", "\\"),
        "capitals": lambda name: swapped(name) if "/" in name else name,
        "absolute": lambda name: str(tmp_path / name),
        "dots": lambda name: f"./{name}",
    }
    write_masked(tmp_path, change[kind])
    monkeypatch.chdir(tmp_path.parent)  # The folder is given as a relative path, as most people do.
    scene = load_scene(tmp_path.name)
    check_dots(scene)
    assert [view.name.lower() for view in scene.test] == ["images/06.png", "images/07.png"]
    assert len(scene.train) == 6 and len(scene.points) == 4
    for view in scene.train:
        assert not view.mask.read()[:KEPT].any() and view.mask.read()[KEPT:].all() and view.depth is not None


def test_a_frame_is_removed_as_the_error_says(tmp_path):
    write_scene(tmp_path)
    (tmp_path / "images" / "03.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"03\.png: no such image.*, or remove its frame from "):
        load_scene(tmp_path)
    contents = json.loads((tmp_path / "transforms.json").read_text())
    contents["frames"].pop(3)
    (tmp_path / "transforms.json").write_text(json.dumps(contents))
    check_dots(load_scene(tmp_path))


def first_called(folder, name):
    """Loads a scene whose first frame has a name, and returns the name of its view."""
    contents = json.loads((folder / "transforms.json").read_text())
    contents["frames"][0]["file_path"] = name
    (folder / "transforms.json").write_text(json.dumps(contents))
    scene = load_scene(folder, test_every=0)
    (own,) = {view.name for view in scene.train} - set(NAMES)
    return own


@pytest.fixture
def scene_with(tmp_path):
    """A scene whose first photograph is in another file."""

    def written(file):
        folder = tmp_path / "scene"
        folder.mkdir()
        write_scene(folder)
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / NAMES[0]).rename(folder / file)
        return folder

    return written


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("a/b.png", "./a//b.png"),
        ("a/b.png", "a\\b.png"),
        ("a/b.png", ".\\a\\b.png"),
        ("a/b.png", "{folder}/a/b.png"),
        ("a/b.png", "{link}/a/b.png"),
        ("1:30.png", "1:30.png"),
        pytest.param("a\\b.png", "a\\b.png", marks=pytest.mark.skipif(os.sep == "\\", reason="separates folders")),
    ],
)
def test_names_inside(scene_with, tmp_path, file, name):
    folder = scene_with(file)
    (tmp_path / "link").symlink_to(folder)
    assert first_called(tmp_path / "link", name.format(folder=folder, link=tmp_path / "link")) == file


LEADING_OUT = [
    "../x.png", "/etc/x.png", "a/../../x.png", "a/../x.png", "a\0.png", "x" * 5000, "..\\x.png", "a\\..\\..\\x.png",
    "C:\\x.png", "C:/x.png", "\\\\server\\x\\y.png", "\\x.png", "{folder}/../x.png",
]  # fmt: skip


def test_names_that_lead_out(scene_with, tmp_path):
    folder = scene_with("a/b.png")
    (tmp_path / "x.png").touch()
    for name in LEADING_OUT:
        with pytest.raises(ValueError, match=r"leads out of the scene's folder|too long a name \(5000 letters\)"):
            first_called(folder, name.format(folder=folder))


def test_accents_as_letters_of_their_own(scene_with):
    """As macOS writes them, and models made elsewhere do not."""
    folder = scene_with(unicodedata.normalize("NFD", "Küche.png"))
    assert unicodedata.normalize("NFC", first_called(folder, unicodedata.normalize("NFC", "Küche.png"))) == "Küche.png"
