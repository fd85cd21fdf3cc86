"""Paths that a user gives: ~ for the home folder, outputs that are links, and pointers of git-lfs instead of files."""

import os
import pathlib
import re

import numpy as np
import pytest
from PIL import Image
from run_folders import create_run
from small_models import some_checkpoint, some_model, write_random_squeeze

import a2tg_jax as a2tg
from a2tg_jax.base.atomic import write_whole
from a2tg_jax.base.json_text import read_json
from a2tg_jax.cli.main import main, parsed
from a2tg_jax.data.colmap_files import read_file
from a2tg_jax.data.decoding import picture_facts, read_pixels
from a2tg_jax.data.photo_reading import read_depths
from a2tg_jax.data.ply import read_ply_points
from a2tg_jax.data.video import extract_frames
from a2tg_jax.io.formats import FORMATS, format_of
from a2tg_jax.results.folder import claimed, write_json
from a2tg_jax.results.record import read_run_file


@pytest.fixture
def home(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    (tmp_path / "home").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("HOME" if os.name != "nt" else "USERPROFILE", str(tmp_path / "home"))
    yield tmp_path / "home"
    assert not any(entry.name.startswith("~") for entry in pathlib.Path().iterdir())


# The home folder


def test_files_of_models_are_written_and_read_in_the_home_folder(home):
    model = some_model(a2tg.Gaussians2d(sh_degree=0))
    names = ("a.npz", "a.a2tgz", "a.ply", "a.glb", "a.gltf", "a.splat", "a.ksplat", "a.spz")
    for name in names:
        a2tg.save_splats(f"~/{name}", model)
        assert a2tg.load_splats(f"~/{name}").num == model.num, name
    assert {path.name for path in home.iterdir()} == {*names, "a.bin"}


@pytest.mark.parametrize("name", ["model", "compact", "ply", "gltf", "checkpoint", "mesh"])
def test_each_function_takes_the_home_folder(home, name):
    model = some_model(a2tg.Gaussians2d(sh_degree=0))
    content = {
        "ply": model.gaussians, "checkpoint": some_checkpoint(a2tg.Gaussians2d(sh_degree=0)),
        "mesh": a2tg.Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)),
    }.get(name, model)  # fmt: skip
    suffix = {"model": ".npz", "compact": ".a2tgz", "gltf": ".glb", "checkpoint": ".npz"}
    path = f"~/own{suffix.get(name, '.ply')}"
    getattr(a2tg, f"save_{name}")(path, content)
    assert [file.name for file in home.iterdir()] == [path[2:]]
    if name != "mesh":
        getattr(a2tg, f"load_{name}")(path)


def test_scenes_and_weights_are_read_in_the_home_folder(home):
    (home / "scene").mkdir()
    with pytest.raises(FileNotFoundError, match=r"home.scene: has no sparse model"):
        a2tg.load_scene("~/scene")
    with pytest.raises(FileNotFoundError, match=r"home.photos: no such folder of photographs"):
        a2tg.run_sfm("~/photos", "~/new")
    with pytest.raises(FileNotFoundError, match=r"home.view\.json: no such edit"):
        a2tg.load_edit("~/view.json")
    write_random_squeeze(home / "lpips.npz")
    assert a2tg.load_lpips("~/lpips.npz").network == "squeeze"


def test_a_name_in_a_scene_is_no_path_of_the_user(home):
    """In the scene ".", a photograph called ~/x.png is one of a folder ~."""
    pathlib.Path("images").mkdir()
    Image.new("RGB", (32, 24)).save(home / "x.png")
    frames = [{"file_path": "~/x.png", "transform_matrix": np.eye(4).tolist()}]
    write_json(pathlib.Path("transforms.json"), {"camera_angle_x": 1.0, "frames": frames})
    with pytest.raises(FileNotFoundError, match=r"no such image"):
        a2tg.load_scene(".")


@pytest.mark.parametrize("words", [["~/out"], ["--out=~/out"], ["--out", "~/out"]])
def test_a_command_takes_the_home_folder(home, words):
    words = ["~/a.ply", *words] if words[0] != "~/out" else ["~/photos", "~/out"]
    name = "render" if "a.ply" in words[0] else "sfm"
    command = parsed(name, words)
    found = [value for value in vars(command).values() if isinstance(value, pathlib.Path | tuple)]
    assert home / "out" in [path for value in found for path in (value if isinstance(value, tuple) else [value])]


def test_only_a_path_is_no_url():
    title = "https://host/fox"
    assert parsed("export", ["run", "--web", "page", "--title", title]).title == title
    for words in (["export", title, "--web", "page"], ["export", "run", f"--web={title}"], ["sfm", "a", title]):
        with pytest.raises(ValueError, match="is a URL"):
            parsed(words[0], words[1:])


def test_training_takes_the_home_folder(home):
    (home / "run.toml").write_text('scene = "~/scene"\nsystem = "a2tg"\ninit = "~/start.ply"\n')
    record = read_run_file(home / "run.toml")
    assert (record.scene.path, record.init) == (str(home / "scene"), str(home / "start.ply"))
    command = parsed("train", ["~/scene", "--out=~/run", "--config=~/run.toml"])
    assert (command.record.scene.path, command.out) == (str(home / "scene"), home / "run")


# Links


def test_an_output_is_written_through_its_link(tmp_path):
    big = tmp_path / "big"
    big.mkdir()
    (big / "old.txt").write_text("old")
    for link, target in (("old", "big/old.txt"), ("new", "big/new.txt"), ("twice", "new")):
        (tmp_path / link).symlink_to(target)
    for link in ("old", "new"):
        write_whole(tmp_path / link, link)
        assert (tmp_path / link).is_symlink()
    assert (big / "old.txt").read_text() == "old" and (big / "new.txt").read_text() == "new"
    write_whole(tmp_path / "twice", "again")
    assert (big / "new.txt").read_text() == "again"
    assert sorted(path.name for path in big.iterdir()) == ["new.txt", "old.txt"]


def test_a_link_that_leads_nowhere_is_an_error(tmp_path):
    (tmp_path / "circle").symlink_to("circle")
    (tmp_path / "unmounted").symlink_to("disk/new.txt")
    with pytest.raises(OSError, match="circle"):
        write_whole(tmp_path / "circle", "")
    with pytest.raises(FileNotFoundError, match=r"unmounted is a link to .*new\.txt, but there is no folder"):
        write_whole(tmp_path / "unmounted", "")
    assert not (tmp_path / "disk").exists()
    (tmp_path / "disk-link").symlink_to("disk")
    with pytest.raises(FileNotFoundError, match=r"disk-link is a link to disk, which does not exist: make it first"):
        write_whole(tmp_path / "disk-link/new.txt", "")


def test_links_in_a_circle_are_an_error(tmp_path, capsys):
    a2tg.save_splats(tmp_path / "a.ply", some_model(a2tg.Gaussians2d(sh_degree=0)))
    (tmp_path / "circle.ply").symlink_to("circle.ply")
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "circle.ply")]) == 2
    assert "Too many levels of symbolic links" in capsys.readouterr().err


def test_a_device_is_not_replaced(tmp_path, capsys):
    a2tg.save_splats(tmp_path / "a.ply", some_model(a2tg.Gaussians2d(sh_degree=0)))
    pipe = tmp_path / "pipe.ply"
    os.mkfifo(pipe)
    (tmp_path / "link.ply").symlink_to(pipe)
    for path in (pipe, tmp_path / "link.ply"):
        with pytest.raises(FileExistsError, match="is a device, pipe or socket, or a link to one"):
            write_whole(path, "")
        assert main(["convert", str(tmp_path / "a.ply"), str(path), "--overwrite"]) == 2
        assert "give the path of a file" in capsys.readouterr().err
    assert pipe.is_fifo()


@pytest.mark.parametrize("suffix", ["ply", "splat", "npz", "glb", "a2tgz"])
def test_conversion_keeps_links(tmp_path, capsys, suffix):
    a2tg.save_splats(tmp_path / "a.ply", some_model(a2tg.Gaussians2d(sh_degree=0)))
    target = tmp_path / f"target.{suffix}"
    target.write_text("old")
    link = tmp_path / f"link.{suffix}"
    link.symlink_to(target)
    assert main(["convert", str(tmp_path / "a.ply"), str(link)]) == 2
    assert "exists; add --overwrite" in capsys.readouterr().err and target.read_text() == "old"
    assert main(["convert", str(tmp_path / "a.ply"), str(link), "--overwrite"]) == 0
    assert link.is_symlink() and a2tg.load_splats(target).num == 12
    target.unlink()
    assert main(["convert", str(tmp_path / "a.ply"), str(link)]) == 0
    assert link.is_symlink() and a2tg.load_splats(target).num == 12


def test_a_run_writes_into_its_own_folder(tmp_path):
    """Its folder may come from a stranger, with links to files of the user."""
    run = create_run(tmp_path / "run")
    (tmp_path / "outside").write_text("mine")
    run.report.symlink_to("../outside")
    (run.path / "elsewhere.html").write_text("")
    run.viewer.symlink_to("elsewhere.html")
    with pytest.warns(UserWarning, match=r"report\.html was a link to \.\./outside, which stays"):
        write_whole(run.own(run.report), "page")
    write_whole(run.own(run.viewer), "page")
    assert (tmp_path / "outside").read_text() == "mine" and not run.report.is_symlink()
    assert run.viewer.is_symlink() and (run.path / "elsewhere.html").read_text() == "page"
    (tmp_path / "outside").write_text("")
    run.marker.unlink()
    run.marker.symlink_to("../outside")
    with pytest.warns(UserWarning, match=r"was a link to \.\./outside") as caught, claimed(run):
        pass
    assert caught[0].filename == __file__, "not a line of contextlib"


# Pointers of git-lfs

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 123456\n"


@pytest.mark.parametrize("suffix", sorted(set(FORMATS) - {".pt", ".pth", ".ckpt"}))  # Checkpoints are not read.
def test_models_that_git_lfs_did_not_fetch(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(POINTER)
    if format_of(path).import_library is not None:
        pytest.importorskip("pxr")
    with pytest.raises(ValueError, match=r"pointer of git-lfs.* run `git lfs pull`"):
        a2tg.load_splats(path)


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("a.jpg", read_pixels), ("a.jpg", picture_facts), ("a.npy", read_depths), ("a.png", read_depths),
        ("a.json", read_json), ("a.npz", a2tg.load_lpips), ("a.ply", read_ply_points),
        ("cameras.bin", lambda path: read_file(path, "cameras")), ("run.toml", read_run_file),
        ("a.mp4", lambda path: extract_frames(path, path.parent / "frames", 3)),
    ],
)  # fmt: skip
def test_files_that_git_lfs_did_not_fetch(tmp_path, name, read):
    if name.endswith("mp4"):
        pytest.importorskip("av", reason="the extra [video] is not installed")
    (tmp_path / name).write_bytes(POINTER)
    with pytest.raises(ValueError, match=r"pointer of git-lfs, .* run `git lfs pull`"):
        read(tmp_path / name)


# Output folders of other programs


@pytest.mark.parametrize(
    ("program", "names", "newest"),
    [
        ("3DGS", ["point_cloud/iteration_7000/point_cloud.ply", "point_cloud/iteration_30000/point_cloud.ply"], 1),
        ("gsplat", ["ckpts/ckpt_29999_rank0.pt", "ckpts/ckpt_6999_rank0.pt"], 0),
        ("gsplat", ["ply/point_cloud_29999.ply", "ply/point_cloud_6999.ply"], 0),
        ("nerfstudio", ["nerfstudio_models/step-000029999.ckpt"], 0),
    ],
)
def test_what_other_programs_trained_is_named(tmp_path, capsys, monkeypatch, program, names, newest):
    monkeypatch.chdir(tmp_path)
    for name in names:
        pathlib.Path("out", name).parent.mkdir(parents=True, exist_ok=True)
        pathlib.Path("out", name).touch()
    model = f"out{os.sep}{pathlib.Path(names[newest])}"
    instead = (
        f"give its model {model}" if model.endswith(".ply") else f"its checkpoint {model} is not read; write a PLY"
    )
    wanted = f"it is an output folder of {program}; {instead}"
    for words in (["view", "out"], ["convert", "out", "x.spz"], ["info", "out"], ["render", "out"], ["mesh", "out"]):
        assert main(words) == 2
        assert wanted in capsys.readouterr().err
    for load in (a2tg.load_splats, a2tg.load_ply):
        with pytest.raises((ValueError, FileNotFoundError), match=re.escape(wanted)):
            load("out")
    with pytest.raises(FileNotFoundError, match=rf"out: is an output folder of {program}.* the scene that it was made"):
        a2tg.load_scene("out")
    pathlib.Path("out/cfg_args").write_text("Namespace(eval=True, source_path='/data/truck', sh_degree=3)")
    with pytest.raises(FileNotFoundError, match=r"to train, give its scene, /data/truck$"):
        a2tg.load_scene("out")
    with pytest.raises(ValueError, match=r"holds no photographs.* to train, give its scene, /data/truck"):
        a2tg.run_sfm("out", "scene")


def test_a_run_is_no_scene(tmp_path):
    run = create_run(tmp_path / "run")
    run.own(run.record).write_text("")
    with pytest.raises(FileNotFoundError, match=r"run\.toml is the record of a run of a2tg train"):
        a2tg.load_scene(run.path)
