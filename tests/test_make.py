"""`a2tg make`, from photographs to a page, and the training that fits into given minutes."""

import dataclasses
import json
import re
import signal
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.experimental.compilation_cache.compilation_cache import reset_cache
from PIL import Image
from run_folders import circle

import a2tg_jax as a2tg
from a2tg_jax.cli import main as cli, make
from a2tg_jax.host.signals import Stopped
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.frames import unseen_angle
from a2tg_jax.results.images import save_picture
from a2tg_jax.results.minutes import Speed, TimedTraining, measured_speed, training_within
from a2tg_jax.results.record import read_record

SPEED = Speed(pixel_seconds=4e-7, other_seconds=30)
"""About two cores of a laptop."""
CACHE_OPTIONS = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")


@pytest.mark.parametrize("size", [(320, 240), (640, 480), (1000, 750), (250, 1000)])
@pytest.mark.parametrize("downscale", [1, 4])
@pytest.mark.parametrize("minutes", [3, 10, 60])
def test_a_training_takes_the_minutes_that_are_given(size, downscale, minutes):
    found = training_within(60 * minutes, SPEED, size, downscale)
    assert found.seconds <= 60 * minutes
    is_longest = found.iterations == 30_000 or (found.downscale == 1 and found.iterations > 3_000)
    assert is_longest or found.seconds > 0.97 * 60 * minutes
    assert found.width == size[0] * downscale // found.downscale
    assert found.memory_budget == pytest.approx(4e-6 * found.width * found.height, rel=0.05)
    flags = dict(zip(found.flags[::2], found.flags[1::2], strict=True))
    assert int(flags["--stage1-iterations"]) + int(flags["--stage2-iterations"]) == found.iterations
    assert flags["--downscale"] == str(found.downscale)


def test_more_minutes_bring_more_pixels_and_more_iterations():
    short, long = (training_within(60 * minutes, SPEED, (1000, 750), 4) for minutes in (4, 60))
    assert long.downscale < short.downscale and long.iterations > short.iterations
    assert long.memory_budget > short.memory_budget


def test_too_few_minutes_are_refused_with_the_number_that_is_needed():
    with pytest.raises(
        ValueError, match=r"minutes are too few: 0\.5 are left .* 1\.0 at least.* with more: .* are kept$"
    ):
        training_within(30, SPEED, (1000, 750), 4)
    assert training_within(1.1 * 60, SPEED, (1000, 750), 4).iterations >= 1_000
    with pytest.raises(ValueError, match=r"0\.0 are left"):
        training_within(-5, SPEED, (1000, 750), 4)


def test_the_speed_is_of_a_gradient():
    speed = measured_speed(a2tg.synthetic_scene(num_views=4, width=32, height=24))
    assert 1e-9 < speed.pixel_seconds < 1e-2 and speed.other_seconds > 0.1


def test_the_speed_is_measured_without_programs_on_disk(tmp_path):
    """The second time, reading the gradient from disk would pass for a machine that compiles in no time."""
    before = {name: jax.config.values[name] for name in CACHE_OPTIONS}
    for name, value in zip(CACHE_OPTIONS, (str(tmp_path), 0.0), strict=True):
        jax.config.update(name, value)
    reset_cache()
    try:
        measured_speed(a2tg.synthetic_scene(num_views=4, width=36, height=24))
        assert jax.config.values["jax_compilation_cache_dir"] == str(tmp_path)
        jax.block_until_ready(jax.jit(lambda x: x * 3 + 1)(np.ones(7)))
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        reset_cache()
    kept = [path.name for path in tmp_path.iterdir()]
    assert any(name.startswith("jit__lambda") for name in kept), "other programs are kept, also afterwards"
    assert not any(name.startswith("jit_loss") for name in kept)


def write_scene(folder):
    """Photographs of the built-in scene with their cameras, as OpenGL poses."""
    scene = a2tg.synthetic_scene(num_views=6, width=64, height=48, num_points=200)
    frames = []
    for index, view in enumerate(scene.train):
        name = f"images/{index}.png"
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.uint8(255 * np.asarray(a2tg.view_image(view)))).save(folder / name)
        pose = np.linalg.inv(np.asarray(view.camera.viewmat)) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    K = np.asarray(scene.train[0].camera.K)
    lens = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    (folder / "transforms.json").write_text(json.dumps({**lens, "w": 64, "h": 48, "frames": frames}))


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*has no sparse points")
def test_a_scene_becomes_a_page_by_printed_commands_and_the_same_command_continues(tmp_path, monkeypatch, capsys):
    write_scene(tmp_path / "toy")
    tiny = TimedTraining(1, 64, 48, iterations=30, memory_budget=0.06, seconds=60)
    monkeypatch.setattr("a2tg_jax.results.minutes.choose_training", lambda scene, seconds: tiny)
    monkeypatch.setattr(make, "NUM_FRAMES", 2)
    words = ["make", str(tmp_path / "toy"), "--out", str(tmp_path / "out"), "--no-open"]
    assert cli.main(words) == 0
    printed = capsys.readouterr().out
    assert re.findall(r"^\$ a2tg (\w+)", printed, flags=re.MULTILINE) == ["train", "export", "render", "render"]
    assert "64×48 pixels, 60.0 kB, 30 iterations" in printed
    assert read_record(RunFolder(tmp_path / "out" / "run")).options.stage1_iterations == 20
    for name in ("toy.html", "toy.png", "run/report.html"):
        assert (tmp_path / "out" / name).is_file(), name
    assert len(list((tmp_path / "out" / "flight").glob("frame_*.png"))) == 2

    # The run exists: nothing is chosen or trained again.
    monkeypatch.setattr("a2tg_jax.results.minutes.choose_training", None)
    assert cli.main(words) == 0
    printed = capsys.readouterr().out
    assert re.findall(r"^\$ a2tg (\w+)", printed, flags=re.MULTILINE) == ["export", "render", "render"]
    assert f"\n$ cp {tmp_path / 'out/flight/front.png'} {tmp_path / 'out/toy.png'}\n" in printed

    # Other cameras are not in the run, nor another photograph.
    cameras = tmp_path / "toy/transforms.json"
    before = cameras.read_text()
    cameras.write_text(before.replace('"w": 64', '"w": 63'))
    assert cli.main(words) == 2
    assert f"cameras changed since {tmp_path / 'out'} was made from them: 1 changed (toy/transforms.json)" in (
        capsys.readouterr().err
    )
    cameras.write_text(before)
    (tmp_path / "toy/images/7.png").touch()
    assert cli.main(words) == 2 and "1 new (toy/images/7.png)" in capsys.readouterr().err


def raising(error):
    def fail(*_):
        raise error

    return fail


def is_answered(capsys, words, *parts):
    assert cli.main(["make", *map(str, words), "--no-open"]) == 2
    error = capsys.readouterr().err
    for part in parts:
        assert part in error


def test_photographs_that_changed_since_the_scene_was_made_are_noticed(tmp_path, monkeypatch, capsys):
    steps = []

    def find_cameras(name, words, run):
        steps.append(name)
        if len(steps) == 1:
            raise ValueError("no cameras are found")
        write_scene(Path(words[-1]))
        raise ValueError("enough")

    monkeypatch.setattr(make, "run_step", find_cameras)
    monkeypatch.chdir(tmp_path)
    photos = Path("miku")
    for name in ("0.jpg", "1.jpg", "room/2.JPG", "notes.txt", "@eaDir/0.jpg"):
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        (photos / name).write_bytes(b"1234")
    words = [photos, "--out", "out"]
    (photos / "blurred.jpg").touch()
    is_answered(capsys, words, "no cameras are found")
    (photos / "blurred.jpg").unlink()  # Without a scene, nothing was made from it.
    is_answered(capsys, words, "enough")
    assert steps == ["sfm", "sfm"] and (tmp_path / "out/scene/transforms.json").is_file()

    # Changes that are none: another way to give the same files, and what is no photograph.
    reached = "the training is chosen"
    monkeypatch.setattr("a2tg_jax.results.minutes.choose_training", raising(ValueError(reached)))
    (photos / "notes.txt").write_text("longer")
    (photos / "@eaDir/1.jpg").touch()
    (photos / "masks/room").mkdir(parents=True)
    (photos / "masks/room/2.JPG.png").write_bytes(b"1234")
    (photos / "1_mask.png").touch()
    save_picture(photos / "cameras.png", np.zeros((4, 4, 3), np.uint8))
    is_answered(capsys, words, reached)
    monkeypatch.setenv("HOME", str(tmp_path))
    for same in (tmp_path / "miku", "~/miku"):
        is_answered(capsys, [same, "--out", "out"], reached)
    is_answered(
        capsys, [*(photos / name for name in ("0.jpg", "1.jpg")), photos / "room", "--out", "out"], "1 new (room/2.JPG)"
    )

    for number in range(3, 15):
        (photos / f"{number}.jpg").touch()
    is_answered(
        capsys, words, "changed since out was made from them: 12 new (miku/10.jpg, miku/11.jpg, miku/12.jpg, …);"
    )
    is_answered(capsys, words, "; give another --out, or remove out to begin again")
    for number in range(3, 15):
        (photos / f"{number}.jpg").unlink()
    (photos / "0.jpg").unlink()
    (photos / "1.jpg").write_bytes(b"12345")
    is_answered(capsys, words, "from them: 1 removed (miku/0.jpg), 1 of another size (miku/1.jpg);")
    (tmp_path / "stitch").mkdir()
    (tmp_path / "stitch/0.jpg").touch()
    is_answered(capsys, [photos, "stitch", "--out", "out"], "1 new (stitch/0.jpg)")
    is_answered(capsys, [photos, "stich", "--out", "out"], "stich: no such file or folder")
    is_answered(capsys, [photos, "--out", "other"], "enough")


def test_cameras_that_changed_since_a_scene_was_trained_are_noticed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("a2tg_jax.results.minutes.choose_training", raising(ValueError("the training is chosen")))
    write_scene(Path("toy"))
    is_answered(capsys, ["toy"], "the training is chosen")
    Path("runs/toy/run").mkdir()
    Path("runs/toy/run/run.toml").touch()
    cameras = Path("toy/transforms.json")
    before = cameras.read_text()
    cameras.write_text(before.replace('"w": 64', '"w": 63'))
    is_answered(
        capsys, ["./toy"], "the cameras changed since runs/toy was made from them: 1 changed (toy/transforms.json);"
    )
    cameras.write_text(before)
    (tmp_path / "toy/transforms (1).json").write_text(before)
    is_answered(capsys, [tmp_path / "toy"], "1 new (toy/transforms (1).json)")
    Path("runs/toy/.a2tg-cameras.json").unlink()  # An earlier version made it.
    is_answered(capsys, ["toy"], "run.toml")


def test_a_folder_with_a_dot_gives_its_whole_name(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(make, "run_step", raising(ValueError("enough")))
    Path("fox.v2").mkdir()
    is_answered(capsys, ["fox.v2"], "enough")
    assert Path("runs/fox.v2").is_dir()


def test_cameras_that_look_outwards_surround_no_subject():
    """a2tg make must not choose an orbit for a room that was photographed from its middle."""
    inward = circle(12)
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    outward = [dataclasses.replace(camera, viewmat=turned @ np.asarray(camera.viewmat)) for camera in inward]
    names = [str(index) for index in range(12)]
    assert unseen_angle(a2tg.Origin.of_cameras(inward, names)) == pytest.approx(np.pi / 6)
    assert unseen_angle(a2tg.Origin.of_cameras(outward, names)) == 2 * np.pi
    with pytest.raises(ValueError, match="`path` smooth"):
        a2tg.turntable(outward, 3)


def test_another_video_is_noticed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("clip.mp4").write_bytes(b"123")
    write_scene(Path("runs/clip/scene"))
    Path("runs/clip/.a2tg-photographs.json").write_text(json.dumps(make.photograph_sizes([Path("clip.mp4")])))
    Path("clip.mp4").write_bytes(b"1234")
    is_answered(capsys, ["clip.mp4"], "runs/clip was made from them: 1 of another size", f"({tmp_path.name}/clip.mp4)")


def test_an_interrupted_make_is_continued_by_the_same_command(tmp_path, monkeypatch, capsys):
    (tmp_path / "my photos").mkdir()

    stopped = Stopped(signal.SIGINT, "continue with: a2tg train --resume")
    monkeypatch.setattr(make, "run_step", raising(stopped))
    words = ["make", str(tmp_path / "my photos"), "--out", str(tmp_path / "out"), "--minutes", "7"]
    assert cli.main(words) == 130
    command = f"a2tg make '{tmp_path / 'my photos'}' --out {tmp_path / 'out'} --minutes 7"
    assert capsys.readouterr().err == f"a2tg: interrupted; repeat the same command to continue: {command}\n"


def test_files_of_another_origin_are_not_replaced(tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos.html").write_text("mine")
    assert cli.main(["make", str(tmp_path / "photos"), "--out", str(tmp_path)]) == 2
    capsys.readouterr()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "photos.html").write_text("mine")
    assert cli.main(["make", str(tmp_path / "photos"), "--out", str(tmp_path / "out")]) == 2
    assert "photos.html exists, and was made from no run" in capsys.readouterr().err
    assert (tmp_path / "out" / "photos.html").read_text() == "mine"
