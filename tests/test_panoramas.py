"""Panoramas are cut into perspective views that agree with direct renders of the built-in scene."""

from pathlib import PurePosixPath

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import map_coordinates
from test_data_sfm import cameras_of, staged

from a2tg_jax.core.cameras import looking
from a2tg_jax.data import synthetic
from a2tg_jax.data.assembly import with_validation_views
from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.data.load import load_scene
from a2tg_jax.data.staging import cut_view, directions, is_panorama, view_size

CENTER = np.array([0.3, -1.2, 1.2])
WIDTH, FACE = 640, 224


def camera(rotation):
    """World to camera of a view with a rotation from the panorama's frame."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation @ looking(CENTER, synthetic.TARGET - CENTER, synthetic.DOWN)[:3, :3]
    viewmat[:3, 3] = -viewmat[:3, :3] @ CENTER
    return viewmat


def render(surfaces, rotation, focal, side):
    K = np.array([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
    with np.errstate(invalid="ignore"):
        return synthetic.render(surfaces, camera(rotation), K, side, side)


@pytest.fixture(scope="module")
def surfaces():
    rng = np.random.default_rng(0)
    return synthetic.light(synthetic.still_life(rng), rng)


@pytest.fixture(scope="module")
def panorama(surfaces):
    """Six renders of a cube, resampled: longitude grows to the right, from -π; latitude falls from π/2."""
    longitude, latitude = np.meshgrid(
        (np.arange(WIDTH) + 0.5) / WIDTH * 2 * np.pi - np.pi,
        np.pi / 2 - (np.arange(WIDTH // 2) + 0.5) / WIDTH * 2 * np.pi,
    )
    rays = np.stack([np.cos(latitude) * np.sin(longitude), -np.sin(latitude), np.cos(latitude) * np.cos(longitude)], -1)
    seen = np.zeros((*rays.shape[:2], 3))
    axis, focal = np.abs(rays).argmax(-1), FACE / 2
    for number in range(3):
        for sign in (1, -1):
            z = sign * np.eye(3)[number]
            x = np.eye(3)[number - 1]
            rotation = np.stack([x, np.cross(z, x), z])
            face = render(surfaces, rotation, focal, FACE)
            is_on = (axis == number) & (np.sign(rays[..., number]) == sign)
            at = rays[is_on] @ rotation.T
            places = (at[:, 1::-1] / at[:, 2:] * focal + FACE / 2 - 0.5).T
            seen[is_on] = np.stack(
                [map_coordinates(face[..., c] * 1.0, places, order=1, mode="nearest") for c in range(3)], -1
            )
    return np.rint(seen).astype(np.uint8)


@pytest.mark.parametrize("name", ["heading000", "heading120", "heading240", "up", "down"])
def test_views_agree_with_direct_renders(surfaces, panorama, name):
    (direction,) = [direction for direction in directions() if direction.name == name]
    side, focal = view_size(WIDTH)
    direct = render(surfaces, direction.rotation, focal, side)
    cut = cut_view(panorama, direction).astype(float)
    error = np.abs(cut - direct)
    assert np.median(error) <= 2 and error.mean() < 6
    assert np.abs(np.roll(cut, 3, 1) - direct).mean() > 1.5 * error.mean()


def test_views_show_every_direction():
    rays = np.random.default_rng(0).normal(size=(20_000, 3))
    tangent = np.tan(np.deg2rad(50))
    is_seen = np.zeros(len(rays), bool)
    for direction in directions():
        x, y, z = direction.rotation @ rays.T
        is_seen |= (z > 0) & (np.abs(x) <= tangent * z) & (np.abs(y) <= tangent * z)
    assert is_seen.all()


def test_panoramas_are_recognised_by_their_seam(panorama):
    assert is_panorama(panorama)
    assert not is_panorama(panorama[:, 1:])
    assert not is_panorama(np.asarray(Image.fromarray(panorama[100:250, 100:400])))


@pytest.mark.parametrize("choice", ["auto", "no"])
def test_panoramas_become_a_rig(tmp_path, panorama, choice):
    """The views of one panorama share a place: a frame of the rig, with cameras that are known."""
    for index in range(3):
        Image.fromarray(panorama[::4, ::4]).save(tmp_path / f"{index}.png")
    printed = []
    found = staged([tmp_path], tmp_path / "work", choice, printed.append)
    cameras, frames = cameras_of(found, tmp_path)
    if choice == "no":
        assert (len(cameras), len(frames), printed) == (1, 3, [])
        return
    assert printed == ["3 panoramas of 160x80, each cut into 8 views of 60x60; panorama='no' leaves them whole"]
    assert (len(cameras), len(frames), found.num_places, len(found.names)) == (8, 3, 3, 24)
    assert all(len(frame.data_ids) == 8 for frame in frames)
    assert all(camera.model.name == "PINHOLE" and camera.has_prior_focal_length for camera in cameras)


def test_views_of_panoramas_have_names_of_their_own(tmp_path, panorama):
    (tmp_path / "panorama").mkdir()
    for name in ("0.png", "0.png.jpg", "panorama/flat.png"):
        pixels = panorama[::16, ::16] if name[0] == "0" else panorama[:10, :15]
        Image.fromarray(pixels).save(tmp_path / name)
    found = staged([tmp_path], tmp_path / "work", "yes")
    assert len(set(found.names)) == 17 and found.rigs[0].folder == "panorama~2"
    assert all((found.folder / name).is_file() for name in found.names)


@pytest.fixture(params=["panoramas", "refined", "stereo"])
def rig_scene(request, tmp_path):
    """Three views at each of five places, of one point (refined: nearly) or apart, named 0/0.png, 0/1.png, ..."""
    apart = {"panoramas": 0.0, "refined": 1e-5, "stereo": 0.1}[request.param]
    options = pycolmap().SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=3, num_frames_per_rig=5, num_points3D=9, camera_width=16, camera_height=12,
        camera_model_id=pycolmap().CameraModelId.PINHOLE, camera_params=[16.0, 16.0, 8.0, 6.0],
        sensor_from_rig_translation_stddev=apart,
    )  # fmt: skip
    model = pycolmap().synthesize_dataset(options)
    for image in model.images.values():
        image.name = f"{image.camera_id}/{image.frame_id}.png"
        (tmp_path / "images" / image.name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (16, 12)).save(tmp_path / "images" / image.name)
    (tmp_path / "sparse").mkdir()
    model.write(tmp_path / "sparse")
    return request.param, tmp_path


def test_the_views_of_a_panorama_are_held_out_together(rig_scene):
    kind, folder = rig_scene
    scene = load_scene(folder, test_every=2)
    sizes, common = [], []
    for made in (scene, with_validation_views(scene)):
        train, test = ([PurePosixPath(view.name).stem for view in views] for views in (made.train, made.test))
        sizes.append((len(train), len(test)))
        common.append(bool({*train} & {*test}))
    assert sizes == ([(6, 9), (3, 3)] if kind != "stereo" else [(7, 8), (6, 1)])
    assert common == [kind == "stereo"] * 2
    if kind != "stereo":
        one = load_scene(folder, test_every=4)
        assert {view.name for view in one.test} == {f"{camera}/{place}.png" for camera in (1, 2, 3) for place in (1, 5)}
        with pytest.raises(ValueError, match="there is 1 panorama, cut into 3 views"):
            with_validation_views(with_validation_views(scene))
