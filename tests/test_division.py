"""Scenes that several processes read together: threads instead of processes, each with its own folder."""

import collections
import functools
import json
import re
import shutil
import threading

import numpy as np
import pytest
from PIL import Image
from test_captures import write_polycam
from test_data_colmap import write_scene as write_colmap
from test_masks import left_half, write_mask
from test_pictures import KINDS, write_scene

from a2tg_jax import load_scene
from a2tg_jax.data import decoding, load, photo_reading, photo_store
from a2tg_jax.data.division import Division, sharing_errors
from a2tg_jax.data.load import SceneSource

pytestmark = pytest.mark.filterwarnings("ignore:.*sparse points")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def decoded(monkeypatch):
    """Number of decodings by folder of the scene."""
    num = collections.Counter()

    def counted(file):
        num[next(part for part in file.parts if part.startswith("scene"))] += 1
        return decoding.read_pixels(file)

    for module in (photo_reading, photo_store):
        monkeypatch.setattr(module, "read_pixels", counted)
    return num


@pytest.fixture
def together(monkeypatch):
    """Function that calls others, one in each process, and returns their results or errors. A process that waits for
    another in vain gets a BrokenBarrierError."""
    own = threading.local()
    monkeypatch.setattr(load, "among_processes", lambda: own.division)

    def call(*functions, seconds=60):
        barrier, gathered, found = threading.Barrier(len(functions), timeout=seconds), {}, {}

        def run(index, function):
            def gather(data):
                gathered[index] = data
                barrier.wait()
                parts = [gathered[number] for number in range(len(functions))]
                barrier.wait()
                return parts

            own.division = Division(index, len(functions), gather)
            try:
                found[index] = function()
            except (ValueError, OSError, threading.BrokenBarrierError) as error:
                found[index] = error

        threads = [threading.Thread(target=run, args=item) for item in enumerate(functions)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return [found[index] for index in range(len(functions))]

    return call


def copies(folder, count):
    """Copies of a scene, as processes have it on disks of their own."""
    return [shutil.copytree(folder, folder.parent / f"scene{index}") for index in range(count)]


def loading(folders, **options):
    return [lambda folder=folder: load_scene(folder, is_divided=True, **options) for folder in folders]


def error_of_all(found, kind=ValueError):
    """Text of the error that all processes raise."""
    assert {(type(error), str(error)) for error in found} == {(kind, str(found[0]))}
    return str(found[0])


def assert_same_views(found, expected):
    for one, other in zip((*found.train, *found.test), (*expected.train, *expected.test), strict=True):
        assert one.name == other.name and one.picture.shape == other.picture.shape
        np.testing.assert_array_equal(one.camera.K, other.camera.K)
        np.testing.assert_array_equal(one.camera.viewmat, other.camera.viewmat)
        assert one.mask == other.mask
        for _ in range(2):
            np.testing.assert_array_equal(one.picture.read(), other.picture.read())


@pytest.mark.parametrize(("kind", "count"), [*((kind, 2) for kind in KINDS), ("as in their files", 4)])
def test_each_process_decodes_its_share_of_the_photographs(tmp_path, together, decoded, kind, count):
    changes = dict(KINDS[kind])
    options = {"downscale": changes.pop("downscale", 1), "room": 0}
    folder = write_scene(tmp_path / "scene", **changes)
    alone = load_scene(folder, **options)
    assert decoded["scene"] == 6, "one process decodes all"
    scenes = together(*loading(copies(folder, count), **options))
    assert [decoded[f"scene{index}"] for index in range(count)] == ([3, 3] if count == 2 else [2, 2, 1, 1])
    for scene in scenes:
        assert not any(view.picture.is_held for view in scene.train)
        assert_same_views(scene, alone)


@pytest.mark.parametrize(("room", "num"), [(2 * 40 * 32 * 3, 3), (4 * 40 * 32 * 3, 4), (None, 6)])
def test_each_process_reads_what_it_holds_in_memory(tmp_path, together, decoded, room, num):
    folder = write_scene(tmp_path / "scene")
    alone = load_scene(folder)
    for index, scene in enumerate(together(*loading(copies(folder, 2), room=room))):
        held = sum(view.picture.is_held for view in (*scene.train, *scene.test))
        assert held == (6 if room is None else room // (40 * 32 * 3)) and decoded[f"scene{index}"] == num
        assert_same_views(scene, alone)


def share(folder, index, count=2):
    """Image files that a process reads at the start."""
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    return [folder / frame["file_path"] for frame in frames][index::count]


def test_a_photograph_of_another_process_is_compared_with_its_first_reading(tmp_path, together):
    folders = copies(write_scene(tmp_path / "scene", alpha=True), 2)
    _, scene = together(*loading(folders, room=0))
    views = {folders[1] / view.name: view for view in (*scene.train, *scene.test)}
    changed, broken, opaque = (file for file in share(folders[1], 0))
    pixels = np.asarray(Image.open(changed))
    views[changed].picture.read()
    Image.fromarray(255 - pixels).save(changed)
    with pytest.raises(ValueError, match=rf"{changed.name}: has changed since the scene was loaded"):
        views[changed].picture.read()
    broken.write_bytes(b"no image")
    with pytest.raises(ValueError, match=rf"{broken.name}: cannot be read as an image"):
        views[broken].picture.read()
    Image.fromarray(pixels[..., :3]).save(opaque)
    with pytest.raises(ValueError, match=rf"{opaque.name}: has pixels \[32, 40, 3\], but \[32, 40, 4\] where another"):
        views[opaque].picture.read()


@pytest.mark.parametrize("index", [0, 1])
def test_every_process_is_told_of_a_photograph_that_one_cannot_read(tmp_path, together, index):
    folders = copies(write_scene(tmp_path / "scene"), 2)
    broken = share(folders[index], index)[1]
    broken.write_bytes(broken.read_bytes()[:-60])
    message = error_of_all(together(*loading(folders, room=0), seconds=20))
    assert message.startswith(f"{broken}: cannot be read as an image")


@pytest.mark.parametrize("room", [0, None])
def test_a_photograph_of_another_size_than_elsewhere_is_told_to_all(tmp_path, together, room):
    """The size is compared after the common reading. The other process waits at the end."""
    folders = copies(write_scene(tmp_path / "scene", alpha=True), 2)
    Image.fromarray(np.zeros((64, 80, 4), np.uint8)).save(share(folders[1], 0)[0])
    message = error_of_all(together(*loading(folders, room=room), seconds=20))
    assert "is 80x64, but 40x32 where another process reads it" in message


@pytest.mark.parametrize("index", [0, 1])
def test_a_file_missing_in_one_copy_is_told_to_all(tmp_path, together, index):
    folders = copies(write_scene(tmp_path / "scene"), 2)
    missing = share(folders[index], 0)[1]
    missing.unlink()
    message = error_of_all(together(*loading(folders), seconds=20), FileNotFoundError)
    assert message.startswith(f"{missing}: no such image")
    (folders[index] / "transforms.json").unlink()
    message = error_of_all(together(*loading(folders), seconds=20), FileNotFoundError)
    assert message.startswith(f"{folders[index]}: has no sparse model")


def divided(folder, together, decoded, num, **options):
    """The scene as one process loads it; two processes find the same, and decode `num` photographs and masks."""
    alone = load_scene(folder, **options)
    decoded.clear()
    scenes = together(*loading(copies(folder, 2), room=0, **options))
    assert decoded["scene0"] + decoded["scene1"] == num
    for scene in scenes:
        assert_same_views(scene, alone)
    return alone


def test_masks_are_told_to_all(tmp_path, together, decoded):
    write_colmap(tmp_path / "scene")
    for view in load_scene(tmp_path / "scene").train[::2]:
        write_mask(tmp_path / "scene" / "masks" / f"{view.name}.png", left_half())
    with pytest.warns(UserWarning, match="photographs have no mask"):
        divided(tmp_path / "scene", together, decoded, 9 + 4)  # photographs and masks


def test_masks_of_another_programs_pixels_are_made_by_one_process_each(tmp_path, together, decoded):
    write_polycam(tmp_path / "scene")
    for file in sorted((tmp_path / "scene" / "keyframes" / "corrected_images").iterdir())[::2]:
        pixels = np.full_like(Image.open(file), 200)
        pixels[:, :10] = 0
        Image.fromarray(pixels).save(file)
    alone = divided(tmp_path / "scene", together, decoded, 4 + 2 * 2)  # Both compare 2 photographs, without points.
    masks = [view.mask for view in (*alone.train, *alone.test)]
    assert len({mask for mask in masks if mask is not None}) > 1, "borders of two kinds"


def test_masks_of_opacity_are_made_by_one_process_each(tmp_path, together, decoded):
    folder = write_scene(tmp_path / "scene", alpha=True)
    for name in sorted((folder / "images").iterdir())[::2]:
        pixels = np.array(Image.open(name))
        pixels[4:20, 5:30, 3] = 255
        Image.fromarray(pixels).save(name)
    for name in sorted((folder / "images").iterdir())[1::2]:
        Image.open(name).convert("RGB").save(name)
    stored = load_scene(folder)
    num = sum(view.has_alpha for view in (*stored.train, *stored.test))
    assert num == 2, "three files have an alpha channel; one of these is opaque, and is dropped"
    alone = divided(folder, together, decoded, 6, alpha="mask")
    assert any(view.mask is not None for view in alone.train)


def test_processes_must_have_the_same_photographs(tmp_path, together):
    folders = copies(write_scene(tmp_path / "scene"), 3)
    (folders[1] / "images_2").mkdir()
    for name in (folders[1] / "images").iterdir():
        Image.open(name).resize((20, 16)).save(folders[1] / "images_2" / name.name)
    message = error_of_all(together(*loading(folders, downscale=2), seconds=20))
    first = share(folders[1], 0)[0].relative_to(folders[1])
    names = rf"{first} downscaled by 1, not {first} downscaled by 2; give all processes .* such as images_2"
    assert re.fullmatch(f"process 1 has other photographs than process 0: {names}", message)
    meta = json.loads((folders[2] / "transforms.json").read_text())
    last = meta["frames"].pop()["file_path"]
    (folders[2] / "transforms.json").write_text(json.dumps(meta))
    message = error_of_all(together(*loading(folders), seconds=20))
    assert message.startswith(f"process 2 has other photographs than process 0: none, not {last} downscaled by 1; ")


def test_processes_must_have_the_same_options(tmp_path, together):
    folder = write_scene(tmp_path / "scene")
    options = {"downscale": (1, 2), "test_every": (8, 4), "alpha": ("transparency", "mask"), "lens": ("undistort", "x")}
    options |= {"mask_as": ("ignored", "background")}
    for option, values in options.items():
        calls = [functools.partial(load_scene, folder, is_divided=True, **{option: value}) for value in values]
        difference = f"{option}={values[1]}, not {option}={values[0]}; "
        message = error_of_all(together(*calls, seconds=20))
        assert message.startswith(f"process 1 has other options of the scene than process 0: {difference}")


def test_processes_of_a_run_must_have_the_same_options(tmp_path, together):
    folder = str(write_scene(tmp_path / "scene"))
    for path, changes, difference in (
        ("synthetic", {}, "scene=synthetic, not scene=from files"),
        (folder, {"validation": True}, "validation=True, not validation=False"),
        (folder, {"alpha": "mask"}, "alpha=mask, not alpha=transparency"),
    ):
        sources = SceneSource(folder), SceneSource(path, **changes)
        message = error_of_all(together(*(functools.partial(one.load, is_divided=True) for one in sources), seconds=20))
        assert message.startswith(f"process 1 has other options of the scene than process 0: {difference}; ")


def test_processes_at_different_steps_end(together):
    def at(step):
        with sharing_errors(load.among_processes()):
            load.among_processes().exchange(step)

    message = error_of_all(together(*(functools.partial(at, step) for step in ("masks", "photographs")), seconds=20))
    assert message.startswith("process 1 has other steps of loading than process 0: photographs, not masks; ")


def test_an_error_of_the_connection_is_not_told(together):
    """The others cannot be reached, so that telling them would only wait."""

    def fail():
        with sharing_errors(load.among_processes()):
            raise ValueError("Gloo AllGather failed")

    assert str(together(fail, lambda: None, seconds=5)[0]) == "Gloo AllGather failed"
