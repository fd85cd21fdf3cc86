"""Plain photographs to a scene: on renders of the built-in scene, whose cameras are known."""

import numpy as np
import pytest
from PIL import Image

from a2tg_jax.data import load_scene, run_sfm, synthetic_scene


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


def test_too_little_in_common(tmp_path):
    (tmp_path / "photos").mkdir()
    for index in range(3):
        noise = np.random.default_rng(index).integers(0, 255, (64, 64, 3), np.uint8)
        Image.fromarray(noise).save(tmp_path / "photos" / f"{index}.png")
    with pytest.raises(ValueError, match="only 0 of 3 photographs could be placed"):
        run_sfm(tmp_path / "photos", tmp_path / "scene", progress=False)


def test_no_photographs(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such folder of photographs"):
        run_sfm(tmp_path / "photos", tmp_path / "scene")
    (tmp_path / "photos").mkdir()
    with pytest.raises(ValueError, match="holds 0 photographs"):
        run_sfm(tmp_path / "photos", tmp_path / "scene")


def test_unreadable_photograph_is_named(tmp_path):
    (tmp_path / "photos").mkdir()
    for index in range(3):
        (tmp_path / "photos" / f"{index}.jpg").write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"0\.jpg: cannot be read as an image"):
        run_sfm(tmp_path / "photos", tmp_path / "scene", progress=False)
