"""The subject of a capture: found in scenes of which it is known, refused where there is none."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from run_folders import create_run
from scipy.ndimage import binary_closing, binary_dilation, binary_erosion
from scipy.spatial.transform import Rotation
from small_files import model_in, taken_apart
from small_values import some_world

import a2tg_jax as a2tg
from a2tg_jax import Gaussians, Model, Origin
from a2tg_jax.cli.main import main
from a2tg_jax.io.columns import decode
from a2tg_jax.io.edit_file import Edit, save_edit
from a2tg_jax.io.subject import find_subject
from a2tg_jax.io.web_scene import encode_web_scene
from a2tg_jax.results.frames import widen_camera, with_whole_subject
from a2tg_jax.results.record import RunRecord, SceneSource, write_record

K = jnp.asarray([[80.0, 0, 40], [0, 80.0, 30], [0, 0, 1]])
UP = np.array([0.0, 0.0, 1.0])


class Splats:
    """Flat splats of surfaces, and which of them are the subject's."""

    def __init__(self, seed: int):
        self.rng = np.random.default_rng(seed)
        self.columns = []

    def add(self, means, normals, *, size, opacity, is_subject):
        """Splats in a surface: their axes are turned at random about its normals."""
        num = len(means)
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        side = np.cross(normals, self.rng.normal(size=(num, 3)))
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        axes = np.stack([side, np.cross(normals, side), normals], axis=2)
        quats = Rotation.from_matrix(axes).as_quat(scalar_first=True)
        sizes = size * self.rng.uniform(0.7, 1.4, (num, 2))
        self.columns.append((means, quats, np.log(sizes), np.full(num, opacity), np.full(num, is_subject)))

    def add_object(self, foot):
        """A ball on a column on a box."""
        for num, low, high in (
            (900, (-0.1, -0.2, 0), (0.1, 0.2, 0.15)),
            (300, (-0.03, -0.03, 0.15), (0.03, 0.03, 0.3)),
        ):
            axis = self.rng.integers(0, 3, num)
            sign = self.rng.choice([-1, 1], num)
            # No camera sees what a thing stands on.
            normals = np.eye(3)[axis] * np.where(axis == 2, 1, sign)[:, None]
            shares = np.where(normals == 0, self.rng.uniform(-1, 1, (num, 3)), normals)
            middle = (np.array(low) + high) / 2
            self.add(
                foot + middle + shares * (np.array(high) - middle), normals, size=0.012, opacity=0.9, is_subject=True
            )
        normals = self.rng.normal(size=(900, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        self.add(foot + 0.1 * normals + [0, 0, 0.4], normals, size=0.01, opacity=0.9, is_subject=True)

    def add_floor(self, size=1.5, num=4000):
        places = self.rng.uniform(-size, size, (num, 2))
        means = np.c_[places, self.rng.normal(0, 0.003, num)]
        normals = UP + self.rng.normal(0, 0.05, (num, 3))
        self.add(means, normals, size=0.03, opacity=0.8, is_subject=False)

    def add_room(self):
        """Far walls, haze, and a thing that stands on the floor as well."""
        angle = self.rng.uniform(0, 2 * np.pi, 1500)
        means = np.c_[4 * np.cos(angle), 4 * np.sin(angle), self.rng.uniform(-1, 3, 1500)]
        self.add(means, -means * [1, 1, 0], size=0.2, opacity=0.8, is_subject=False)
        haze = self.rng.uniform(-1.5, 1.5, (200, 3)) + np.array([0, 0, 1.6])
        self.add(haze, self.rng.normal(size=(200, 3)), size=0.05, opacity=0.1, is_subject=False)
        thing = self.rng.uniform(-0.1, 0.1, (400, 3)) + np.array([0.45, 0.2, 0.12])
        self.add(thing, self.rng.normal(size=(400, 3)), size=0.015, opacity=0.9, is_subject=False)

    def model(self, cameras):
        means, quats, log_scales, opacities, _ = (np.concatenate(parts) for parts in zip(*self.columns, strict=True))
        numbers = (means, quats, log_scales, np.log(opacities / (1 - opacities)), np.zeros((len(means), 1, 3)))
        gaussians = Gaussians(*(jnp.asarray(x, jnp.float32) for x in numbers))
        return Model(gaussians, origin=Origin.of_cameras(cameras))

    @property
    def is_subject(self):
        return np.concatenate([parts[-1] for parts in self.columns])


def cameras_at(centers, targets):
    """Cameras of photographs that are held a little askew."""
    rng = np.random.default_rng(5)
    cameras = []
    for center, target in zip(centers, targets, strict=True):
        viewmat = a2tg.look_at(center, target + rng.normal(0, 0.05, 3), up=UP, width=80, height=60).viewmat
        cameras.append(a2tg.Camera(viewmat, K, 80, 60))
    return cameras


def ring(num=24, radius=1.0, turn=2 * np.pi, height=0.5):
    angles = np.linspace(0, turn, num, endpoint=False)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), height + 0.2 * np.sin(3 * angles)], axis=1)


def around(target, **places):
    centers = ring(**places)
    return cameras_at(centers, np.tile(np.asarray(target, float), (len(centers), 1)))


def shares(found, wanted):
    """Precision and recall."""
    both = np.sum(found & wanted)
    return both / max(found.sum(), 1), both / wanted.sum()


@pytest.mark.parametrize("seed", range(3))
def test_an_object_on_a_floor_is_found_in_any_world(seed):
    """With another thing on the floor, walls and haze. Of what touches the floor, its thickness may go with it."""
    splats = Splats(seed)
    splats.add_object(np.zeros(3))
    splats.add_floor()
    splats.add_room()
    model = splats.model(around([0, 0, 0.25]))
    subject = find_subject(model)
    precision, recall = shares(subject.is_kept, splats.is_subject)
    assert precision > 0.99 and recall > 0.96
    assert subject.sureness > 0.9 and subject.words.endswith("% sure")
    moved = find_subject(model.transform(some_world(seed)))
    assert min(shares(moved.is_kept, subject.is_kept)) > 0.99


def test_an_object_in_front_of_a_wall_is_found_from_one_side():
    splats = Splats(0)
    splats.add_object(np.array([0.0, 0.0, -0.25]))
    places = splats.rng.uniform(-1.5, 1.5, (4000, 2))
    wall = np.c_[splats.rng.normal(-0.25, 0.003, 4000), places]
    splats.add(wall, np.tile([1.0, 0, 0], (4000, 1)), size=0.03, opacity=0.8, is_subject=False)
    # A rod that holds it.
    rod = np.c_[np.linspace(-0.25, 0, 200), splats.rng.normal(0, 0.01, (200, 2))]
    splats.add(rod, splats.rng.normal(size=(200, 3)), size=0.01, opacity=0.9, is_subject=True)
    centers = ring(turn=np.pi * 0.6, height=0.1) @ Rotation.from_euler("z", -54, degrees=True).as_matrix().T
    model = splats.model(cameras_at(centers, np.zeros_like(centers)))
    precision, recall = shares(find_subject(model).is_kept, splats.is_subject)
    assert precision > 0.99 and recall > 0.95


def test_what_ends_by_itself_is_kept_with_all_its_planes():
    """The top of the box has the area of a floor."""
    splats = Splats(0)
    splats.add_object(np.zeros(3))
    subject = find_subject(splats.model(around([0, 0, 0.25])))
    assert subject.is_kept.mean() > 0.99


def test_an_object_that_touches_a_wall_is_cut_along_the_seam_and_less_sure():
    splats = Splats(0)
    splats.add_object(np.zeros(3))
    splats.add_floor()
    splats.add_room()
    free = find_subject(splats.model(around([0, 0, 0.25])))
    # A beam through the column, which goes on beyond the cameras.
    beam = np.c_[np.linspace(-2, 2, 3000), splats.rng.normal(0, 0.01, 3000), 0.22 + splats.rng.normal(0, 0.01, 3000)]
    splats.add(beam, splats.rng.normal(size=(3000, 3)), size=0.012, opacity=0.9, is_subject=False)
    touching_model = splats.model(around([0, 0, 0.25]))
    touching = find_subject(touching_model)
    assert shares(touching.is_kept, splats.is_subject)[1] > 0.95
    distances = np.linalg.norm(np.asarray(touching_model.gaussians.means)[touching.is_kept] - [0, 0, 0.25], axis=1)
    assert distances.max() < 0.5
    assert touching.sureness < free.sureness


def looking(model, cameras):
    return dataclasses.replace(model, origin=Origin.of_cameras(cameras))


def test_without_a_subject_it_is_refused():
    splats = Splats(0)
    splats.add_floor()
    splats.add_room()
    model = splats.model([])
    centers = ring(radius=0.3)
    along = np.c_[np.linspace(-3, 3, 20), np.zeros(20), np.full(20, 0.5)]
    turned = ring(num=20, radius=4.0)
    refused = {
        "at least 3 cameras look at, and the model has 0": [],
        "the model has 2": around([0, 0, 0.25], num=2),
        "look away from the point that their axes have in common": cameras_at(centers, 9 * centers),
        "look in parallel": cameras_at(along, along + np.array([0, 5, 0])),
        "see nothing near the point": around([0, 0, 3.0], radius=1.5, height=3.0),
        "outwards or along a way": cameras_at(turned, turned + np.cross(UP, turned)),
    }
    for message, cameras in refused.items():
        with pytest.raises(ValueError, match=f"no subject: .*{message}"):
            find_subject(looking(model, cameras))


def a_capture():
    splats = Splats(0)
    splats.add_object(np.zeros(3))
    splats.add_floor()
    splats.add_room()
    return splats.model(around([0, 0, 0.25]))


def test_the_command_writes_an_edit_or_a_model_and_says_how_sure_it_is(tmp_path, capsys):
    model = a_capture()
    a2tg.save_model(tmp_path / "m.npz", model)
    for name in ("e.json", "a.npz"):
        assert main(["edit", str(tmp_path / "m.npz"), "--out", str(tmp_path / name), "--subject"]) == 0
    printed = capsys.readouterr().out
    assert printed.count(f"subject: {find_subject(model).words}") == 2 and "% sure" in printed
    edit = a2tg.load_edit(tmp_path / "e.json")
    assert edit.subject and json.loads((tmp_path / "e.json").read_text())["subject"] is True
    wanted = model[find_subject(model).is_kept]
    for edited in (a2tg.apply_edit(model, edit), a2tg.load_model(tmp_path / "a.npz")):
        np.testing.assert_array_equal(edited.gaussians.means, wanted.gaussians.means)
    a2tg.save_ply(tmp_path / "bare.ply", dataclasses.replace(model, origin=None))
    words = ["edit", str(tmp_path / "bare.ply"), "--out", str(tmp_path / "b.ply"), "--subject"]
    assert main(words) == 2
    assert "no subject: it follows from what at least 3 cameras look at, and the model has 0" in capsys.readouterr().err


def test_pages_have_the_same_subject():
    model = a_capture()
    subject = find_subject(model)
    header, body = taken_apart(data := encode_web_scene(model))
    marks = []
    start = 0
    for name, coder, length in header["parts"]:
        if name == "subject":
            count = min(header["chunk"], model.num - sum(map(len, marks)))
            marks.append(decode(coder, body[start : start + length], 1, count)[0])
        start += length
    sizes = {
        name: sum(length for other, _, length in header["parts"] if other == name) for name in ("subject", "means")
    }
    assert 0 < sizes["subject"] < 0.02 * sizes["means"]
    assert np.sum(np.concatenate(marks)) == np.sum(subject.is_kept)
    assert header["page"]["subject"] == subject.words
    assert "subject" not in taken_apart(encode_web_scene(model, finds_subject=False))[0]["page"]
    assert model_in(data).num == model.num


def test_an_orbit_shows_the_whole_subject_though_photographs_look_at_its_foot():
    splats = Splats(0)
    splats.add_object(np.zeros(3))
    splats.add_floor()
    model = splats.model(around([0, 0, 0.05]))
    zoomed = K.at[:2, :2].multiply(1.8)
    orbit = [dataclasses.replace(camera, K=zoomed) for camera in a2tg.turntable(model.origin.cameras, 5, UP)]
    orbit = [widen_camera(camera, 160, 90) for camera in orbit]

    def reach(cameras):
        """Largest distance of the subject from the middle of a frame, over the frame's half width or height."""
        points = np.asarray(model.gaussians.means)[splats.is_subject]
        offsets = []
        for camera in cameras:
            seen = points @ np.asarray(camera.viewmat)[:3, :3].T + np.asarray(camera.viewmat)[:3, 3]
            x, y, depth = np.asarray(camera.K) @ seen.T
            offsets += [np.abs(2 * x / depth / 160 - 1).max(), np.abs(2 * y / depth / 90 - 1).max()]
        return max(offsets)

    whole = with_whole_subject(orbit, model)
    assert reach(orbit) > 1.1
    assert reach(whole) == pytest.approx(0.9, abs=0.02)
    assert len({tuple(np.ravel(camera.K)) for camera in whole}) == 1
    upright = [widen_camera(camera, 60, 120) for camera in orbit]
    for unchanged, model_of in ((upright, model), (orbit, looking(model, []))):
        np.testing.assert_array_equal(with_whole_subject(unchanged, model_of)[0].K, unchanged[0].K)
    # Of photographs cut from larger ones, the optical axis may be at the border, or beyond it.
    for cx in (2.0, -30.0, 158.0):
        cut = [dataclasses.replace(camera, K=camera.K.at[0, 2].set(cx)) for camera in orbit]
        found = with_whole_subject(cut, model)
        assert float(found[0].K[0, 0]) > 0
        assert reach(found) == pytest.approx(0.9, abs=0.02)
    np.testing.assert_array_equal(with_whole_subject(cut, looking(model, []))[0].K, cut[0].K)


SIZE = (160, 120)
"""Width and height of the photographs."""


def write_photographs(folder, cameras, distortion):
    """A scene folder with photographs of noise, through a lens with radial distortion."""
    (folder / "images" / "day").mkdir(parents=True)
    frames = []
    for index, camera in enumerate(cameras):
        name = f"images/day/{index:02}.jpg"
        noise = np.random.default_rng(index).integers(0, 256, (*SIZE[::-1], 3), np.uint8)
        Image.fromarray(noise).save(folder / name)
        pose = np.linalg.inv(np.asarray(camera.viewmat, np.float64)) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    (folder / "points.ply").write_text(f"{header}end_header\n0 0 0.2\n0 0 0.3\n")
    lens = {"fl_x": 160, "fl_y": 160, "cx": 80, "cy": 60, "w": 160, "h": 120, "k1": distortion}
    scene = {"camera_model": "OPENCV", "ply_file_path": "points.ply", **lens, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(scene))


def outline(points, camera):
    """The pixels [H, W] that points near each other cover, with an edge around them, and those within that edge."""
    width, height = camera.width, camera.height
    seen = points @ np.asarray(camera.viewmat, np.float64)[:3, :3].T + np.asarray(camera.viewmat)[:3, 3]
    x, y, _ = np.asarray(camera.K, np.float64) @ (seen / seen[:, 2:]).T
    is_inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    covered = np.zeros((height, width), bool)
    covered[y[is_inside].astype(int), x[is_inside].astype(int)] = True
    whole = binary_closing(np.pad(covered, 8), iterations=4)[8:-8, 8:-8]
    return binary_dilation(whole, iterations=2), binary_erosion(whole, iterations=2)


def write_run(folder, source, model):
    """A run whose training on a scene ended with a model."""
    run = create_run(folder)
    record = RunRecord(source, "gaussians-2d", a2tg.Gaussians2d())
    write_record(run, record)
    file = run.model(record.plan.main[-1])
    file.parent.mkdir()
    a2tg.save_model(file, model)
    return run


@pytest.mark.parametrize("distortion", [0.0, -0.3])
def test_training_reads_the_masks_of_the_subject(tmp_path, capsys, distortion):
    """Their places are checked in the undistorted, smaller views that a training has. A plate between one camera and
    the subject hides half of it."""
    if distortion:
        pytest.importorskip("pycolmap")
    splats = Splats(0)
    splats.add_object(np.zeros(3))
    splats.add_floor()
    splats.add_room()
    cameras = around([0, 0, 0.25])
    eye = np.asarray(cameras[3].center, np.float64)
    towards = np.array([0, 0, 0.25]) - eye
    towards /= np.linalg.norm(towards)
    across = np.cross(towards, UP)
    places = splats.rng.uniform([0, -0.06], [0.1, 0.06], (900, 2)) @ np.stack([across, np.cross(across, towards)])
    splats.add(eye + 0.25 * towards + places, np.tile(towards, (900, 1)), size=0.003, opacity=0.95, is_subject=False)
    write_photographs(tmp_path / "scene", cameras, distortion)
    source = SceneSource(str(tmp_path / "scene"), downscale=2)
    scene = source.load()
    model = dataclasses.replace(splats.model(cameras).transform(scene.transform), origin=scene.origin)
    run = write_run(tmp_path / "run", source, model)
    masks = tmp_path / "scene" / "masks"
    words = ["mask", str(run.path), "--out", str(masks)]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert f"wrote 24 masks to {masks}/: the subject ({find_subject(model).words}) covers " in printed
    assert f"a2tg train --config {run.record} --mask-as background" in printed
    with Image.open(masks / "day" / "03.jpg.png") as mask:
        assert mask.size == SIZE
    points = np.asarray(model.gaussians.means, np.float64)
    cut_out = dataclasses.replace(source, mask_as="background").load()
    for view in (*cut_out.train, *cut_out.test):
        is_white = view.picture.read()[..., 3] > 127
        around_it, within = outline(points[splats.is_subject], view.camera)
        # Edges of splats.
        assert np.sum(is_white & ~around_it) <= 3
        if view.name == "images/day/03.jpg":
            around_plate, within_plate = outline(points[-900:], view.camera)
            assert np.sum(within & within_plate) > 100 and not is_white[within_plate].any()
            within &= ~around_plate
        # Corners of the outline are filled, and what touches the floor may go with it.
        assert np.sum(within) > 100 and is_white[within].mean() > 0.95
    assert main(words) == 2 and "exists; add --overwrite to replace it" in capsys.readouterr().err
    # This edit keeps everything.
    save_edit(tmp_path / "edit.json", Edit(background=(1.0, 1.0, 1.0)))
    assert main([*words, "--overwrite", "--edit", str(tmp_path / "edit.json")]) == 0
    assert "what the edit keeps covers 100 % of the photographs" in capsys.readouterr().out


def test_masks_that_training_would_not_read_are_refused(tmp_path, capsys):
    splats = Splats(0)
    splats.add_object(np.zeros(3))
    splats.add_floor()
    cameras = around([0, 0, 0.25])
    scene = tmp_path / "scene"
    write_photographs(scene, cameras, 0.0)
    transforms = scene / "transforms.json"
    own = transforms.read_text()

    def error_of(number):
        source = SceneSource(str(scene), downscale=8)
        loaded = source.load()
        model = dataclasses.replace(splats.model(cameras).transform(loaded.transform), origin=loaded.origin)
        run = write_run(tmp_path / f"run{number}", source, model)
        assert main(["mask", str(run.path), "--out", str(scene / "masks")]) == 2
        assert not (scene / "masks").exists()
        return capsys.readouterr().err

    # Blender's layout, with photographs next to the file of the cameras or in a folder of another name.
    (scene / "images").rename(scene / "train")
    transforms.write_text(own.replace("images/", "train/"))
    assert "masks of photographs in the folder images only, and train/day/00.jpg is elsewhere: move" in error_of(0)
    # The scene names other masks.
    (scene / "train").rename(scene / "images")
    (scene / "own").mkdir()
    Image.new("L", SIZE, 255).save(scene / "own" / "a.png")
    transforms.write_text(own.replace("{", '{"mask_path": "own/a.png", ', 1))
    assert "names masks by mask_path, which training reads instead" in error_of(1)


def test_masks_need_a_subject_and_a_scene_that_reads_them(tmp_path, capsys):
    splats = Splats(0)
    splats.add_floor()
    model = looking(splats.model([]), [])
    for scene, message in {"synthetic": "is a built-in scene", "/scenes/a": "no subject: it follows from"}.items():
        run = write_run(tmp_path / scene[-1], SceneSource(scene), model)
        assert main(["mask", str(run.path), "--out", str(tmp_path / "masks")]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "masks").exists()
