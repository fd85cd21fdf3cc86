"""Plain photographs to a scene: on renders of the built-in scene, whose cameras are known."""

import contextlib
import re

import numpy as np
import pytest
from PIL import Image

from a2tg_jax.data import load_scene, run_sfm, sfm, synthetic_scene
from a2tg_jax.data.photo_folder import find_photos


def save_photos(folder, num_photos, width, height):
    """Neighbouring views of a long path; returns the scene they are from."""
    scene = synthetic_scene(num_views=40, width=width, height=height, test_every=0)
    folder.mkdir()
    for view in scene.train[:num_photos]:
        Image.fromarray(view.image).save(folder / view.name)
    return scene


def test_photographs_become_a_scene(tmp_path):
    truth = save_photos(tmp_path / "photos", 5, 256, 192)
    summary = run_sfm(tmp_path / "photos", tmp_path / "scene", progress=False)
    assert (summary.num_photos, summary.num_registered) == (5, 5)
    assert sorted(file.name for file in (tmp_path / "scene").iterdir()) == ["images", "sparse"]
    scene = load_scene(tmp_path / "scene", test_every=0)
    assert len(scene.points) == summary.num_points > 100
    centers = np.stack([np.asarray(view.camera.center) for view in scene.train])
    expected = np.stack([np.asarray(view.camera.center) for view in truth.train[:5]])
    steps, expected_steps = (np.linalg.norm(np.diff(c, axis=0), axis=1) for c in (centers, expected))
    np.testing.assert_allclose(steps / steps.sum(), expected_steps / expected_steps.sum(), atol=0.05)
    with pytest.raises(FileExistsError, match="exists already"):
        run_sfm(tmp_path / "photos", tmp_path / "scene", progress=False)


def test_every_phase_moves_and_colmap_is_silent(tmp_path, capfd):
    save_photos(tmp_path / "photos", 4, 128, 96)
    with contextlib.suppress(ValueError):  # The phases count, not what they find.
        run_sfm(tmp_path / "photos", tmp_path / "scene")
    lines = capfd.readouterr().err.replace("\r", "\n").splitlines()
    assert all(re.match(r"(features|matching|mapping|undistorting)\b|$", line) for line in lines)
    assert any("4/4" in line for line in lines if line.startswith("features"))
    assert any(line.startswith("matching 6 pairs: 00:0") for line in lines)


def test_too_little_in_common(tmp_path, capfd):
    (tmp_path / "photos").mkdir()
    for index in range(3):
        noise = np.random.default_rng(index).integers(0, 255, (64, 64, 3), np.uint8)
        Image.fromarray(noise).save(tmp_path / "photos" / f"{index}.png")
    with pytest.raises(ValueError, match="none of the 3 photographs could be placed"):
        run_sfm(tmp_path / "photos", tmp_path / "new" / "scene", progress=False)
    assert capfd.readouterr().err == "" and not (tmp_path / "new").exists()


def test_failure_says_what_to_do(tmp_path):
    with pytest.raises(ValueError, match=r"take more.*overlap.*texture") as told:
        sfm._check_model(None, 300, "photos", "exhaustive", 4)
    assert "sequential" not in str(told.value)
    with pytest.raises(ValueError, match="matching exhaustive"):
        sfm._check_model(None, 300, "photos", "sequential", 4)


def test_matching_is_chosen(tmp_path):
    with pytest.raises(ValueError, match="matching must be one of auto"):
        run_sfm(tmp_path, tmp_path / "scene", matching="all")


def test_no_photographs(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such folder of photographs"):
        run_sfm(tmp_path / "photos", tmp_path / "scene")
    (tmp_path / "photos").mkdir()
    with pytest.raises(ValueError, match="photos: is empty; at least 3 photographs are needed"):
        run_sfm(tmp_path / "photos", tmp_path / "scene")


@pytest.mark.parametrize(
    "names, words",
    [
        (["a.CR2", "b.cr2", "c.jpg"], ["holds 1 photograph;", "2 .cr2", "read: .jpg,", "mogrify -format jpg"]),
        (["a/clip.MOV"], ["holds no photographs;", "1 .mov", "A video is given by itself: a2tg sfm"]),
        (["notes", ".DS_Store"], ["1 without suffix;"]),
        (["a.dng", "b.png", "c.png", "d.png", "notes.txt"], ["Skipped: 1 .dng;"]),
    ],
)
def test_what_is_skipped_is_counted(tmp_path, names, words):
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(ValueError) if len(names) < 4 else pytest.warns(UserWarning) as told:
        find_photos(tmp_path)
    text = str(told.value if len(names) < 4 else told[0].message)
    assert all(word in text for word in words)


def test_a_video_is_told_how_to_become_a_scene(tmp_path):
    (tmp_path / "a clip.mp4").touch()
    with pytest.raises(ValueError, match=r"run `a2tg sfm '.*a clip\.mp4' SCENE` first"):
        load_scene(tmp_path / "a clip.mp4")


def test_a_folder_of_photographs_is_told_a_command_that_works(tmp_path, monkeypatch):
    (tmp_path / "my photos").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match="`a2tg sfm 'my photos' SCENE`"):
        load_scene(tmp_path / "my photos")


def test_unreadable_photograph_is_named(tmp_path):
    (tmp_path / "photos").mkdir()
    for index in range(3):
        (tmp_path / "photos" / f"{index}.jpg").write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"0\.jpg: cannot be read as an image"):
        run_sfm(tmp_path / "photos", tmp_path / "scene", progress=False)
