"""Mistakes on the command line: each is one line on stderr and exit code 2, before anything is trained or written."""

import dataclasses
import json
import os

import numpy as np
import pytest
from PIL import Image
from run_folders import create_run

from a2tg_jax import save_model, synthetic_scene
from a2tg_jax.cli import main as cli
from a2tg_jax.data.scene import origin_of_scene
from a2tg_jax.results import run_training
from a2tg_jax.results.record import RunRecord, SceneSource, write_record
from a2tg_jax.systems.a2tg import A2tg
from a2tg_jax.training.start import initial_model

SYNTHETIC = "train synthetic --out new"
MISTAKES = {
    # Commands, flags and their values
    "trian": "no command 'trian'; did you mean train? the commands are demo",
    "--verbose": "there is no command '--verbose'",
    "train": "SCENE",
    "train synthetic": "--out PATH",
    "train --out new": "SCENE",
    "train synthetic more --out new": "Unrecognized options: more",
    f"{SYNTHETIC} --texture.fracton 0.5": "--texture.fraction",
    f"{SYNTHETIC} --sytem bytewise": "Unrecognized options: --sytem",
    "export done --ply": "--ply",
    "convert a.ply b.ply --bake --bake-growth 0.5": "--bake-growth must be a finite number of at least 1; got 0.5",
    "convert a.ply b.ply --bake --bake-iterations -1": "--bake-iterations must be at least 0; got -1",
    "convert a.ply b.ply --bake-growth 3": "--bake-iterations have no effect without --bake: add it",
    "convert a.ply b.ply --bake-iterations 0": "--bake-iterations have no effect without --bake: add it",
    "convert a.ply b.xyz": "no format is known by this suffix",
    f"{SYNTHETIC} --itertions 5": "Unrecognized options: --itertions",
    f"{SYNTHETIC} --cap 5": "--densify.cap",
    f"{SYNTHETIC} --seed": "--seed",
    f"{SYNTHETIC} --seed 0.5": "--seed",
    f"{SYNTHETIC} --batch-size two": "'two'",
    f"{SYNTHETIC} --texture.select best": "'best'",
    f"{SYNTHETIC} --texture.at soon": "--texture.at",
    f"{SYNTHETIC} --on-nan hope": "'hope'",
    f"{SYNTHETIC} --system b2tg": "there is no system 'b2tg'",
    f"{SYNTHETIC} --system bytwise": "did you mean bytewise?",
    f"{SYNTHETIC} --system os:sep": "'os:sep' is no system",
    f"{SYNTHETIC} --preset fast": "presets paper",
    f"{SYNTHETIC} --preset quik": "did you mean quick?",
    f"{SYNTHETIC} --compare b2tg": "there is no system 'b2tg'",
    f"{SYNTHETIC} --system gaussians-2d --texture.cap 4": "Unrecognized options: --texture.cap",
    # Numbers out of range
    f"{SYNTHETIC} --batch-size 0": "--batch-size must be at least 1",
    f"{SYNTHETIC} --seed -1": "seed must be",
    f"{SYNTHETIC} --rates.means nan": "rates.means must be a finite number",
    f"{SYNTHETIC} --rates.quats -1": "rates.quats must be at least 0",
    f"{SYNTHETIC} --loss.ssim-weight inf": "--loss.ssim-weight must be a finite number",
    f"{SYNTHETIC} --texture.fraction 2": "texture.fraction must be at least 0 and at most 1",
    f"{SYNTHETIC} --texel-rate -0.1": "--texel-rate must be at least 0",
    f"{SYNTHETIC} --texture.cap 32": "texture.cap must be at least 1 and at most 16",
    f"{SYNTHETIC} --texture.at 0.5 0.2": "--texture.at must be ascending",
    f"{SYNTHETIC} --stage1-iterations 0": "at least 1 iteration",
    f"{SYNTHETIC} --densify.cap 1": "densify.cap must be at least 2",
    f"{SYNTHETIC} --system gaussians-2d --densify.threshold -1": "densify.threshold must be at least 0",
    f"{SYNTHETIC} --system bbsplat --billboard.side 1": "billboard.side must be at least 2 and at most 16",
    f"{SYNTHETIC} --system supergaussians --kernels.colors -1": "kernels.colors must be at least 0",
    f"{SYNTHETIC} --system textured-gaussians --texture-side 17": "--texture-side must be at least 1 and at most 16",
    f"{SYNTHETIC} --memory-budget 5XB": "--memory-budget must be a number of MB",
    f"{SYNTHETIC} --memory-budget 100B": "--memory-budget must be a number of MB",
    f"{SYNTHETIC} --memory-budget 0.0003": "there must be 2",
    f"{SYNTHETIC} --memory-budget 1kB --initial-gaussians 800": "fewer than training starts from",
    f"{SYNTHETIC} --texture.select budget --texture.budget-mb 0.001": "Gaussians of one texel each take",
    f"{SYNTHETIC} --texture.select budget": "budget_mb must say",
    f"{SYNTHETIC} --downscale 0": "downscale",
    f"{SYNTHETIC} --test-every -1": "--test-every must",
    # Places and files
    "train nowhere --out new": "nowhere",
    "train photos --out new": "for plain photographs, run `a2tg sfm photos SCENE` first",
    "train bad.toml --out new": "bad.toml: is neither a transforms.json nor an XML file of Metashape's cameras",
    "train synthetic --out bad.toml/run": "run cannot be made, for",
    "train scene --out scene/run": "overlap: choose an output folder",
    f"{SYNTHETIC[:-3]}photo.png": "photo.png is a file",
    f"{SYNTHETIC[:-3]}photos": "not a run folder",
    f"{SYNTHETIC[:-3]}run": "add --resume to continue it, --overwrite",
    "train --out nowhere --resume": "is not a run folder",
    f"{SYNTHETIC[:-3]}run --resume --overwrite": "give one of them",
    f"{SYNTHETIC[:-3]}run --resume --seed 5": "leave out --seed, or start a new run with a2tg train",
    "train --out run --resume --preset quick": "leave out --preset, or start a new run",
    "train photos --out run --resume": "as it was trained on synthetic",
    f"{SYNTHETIC} --lpips-weights photo.png": "photo.png",
    f"{SYNTHETIC} --config nowhere.toml": "no such configuration file",
    "train --config bad.toml --out new": "is not valid TOML",
    "train --config wrong.toml --out new": "did you mean scene",
    "demo --out photos": "not a run folder",
    "demo --out photos --resume": "is not a run folder",
    "demo --out run --resume --overwrite": "give one of them",
    "eval run --lpips-weights nowhere.npz": "nowhere.npz",
    "eval photos": "is not a run folder",
    "finish done": "--out PATH",
    "finish photos --out new": "is not a run folder",
    "finish done --out done/new": "overlap: choose an output folder",
    "finish done --out photos": "not a run folder",
    "finish done --out run": "error: run is not empty; choose another --out\n",
    "finish done --out new --max-loss -1": "--max-loss must be at least 0 dB",
    "finish done --out new --polish-steps -1": "--polish-steps must be at least 0",
    "finish done --out new --polish-steps 0": "nothing that these options can shrink or polish",
    "finish run --out new": "has no finished",
    "finish done --out new": "a2tg-gaussians.npz is missing, and a later model of the run is there: put it back, or ",
    "eval done": "a2tg-gaussians.npz is missing, and a later model of the run is there: put it back, or ",
    "eval run": "no finished stage",
    "info": "RUN",
    "info photo.png": "is not a run folder",
    "render done --frames -3": "number of frames must be at least 1",
    "render done --fps 0": "frames per second must be in 1..1000",
    "render done --path test --frames 9": "have no effect on --path test",
    "render done --path test --fps 9": "have no effect on --path test",
    "mesh done --texture-size 512": "--texture-size has no effect without a texture: add --texture renders or",
    "render done --size 640": "size must be WIDTHxHEIGHT",
    "render done --size 0x10": "size must be WIDTHxHEIGHT",
    "render done --path round": "round: no such path",
    "render done --path orbt": "makes one; did you mean orbit?",
    "mesh done --resolution 10 --voxel 0.1": "--resolution and --voxel both say the size of voxels",
    "render done --model stage2": "the run has the models",
    "render done --out photo.png": "photo.png",
    "render run": "has no finished",
    "compress nowhere.npz": "nowhere.npz",
    "compress nowhere.npz --tune-iterations 9": "nowhere.npz",
    "compress photo.png": "photo.png",
    "compress done --max-loss nan": "--max-loss",
    "compress done --max-loss -1": "--max-loss",
    "compress done --out photos": "--out must be the path of a file that ends in .a2tgz; got photos",
    "compress done --out small.ply": "--out must be the path of a file that ends in .a2tgz; got small.ply",
    "convert done done/models/a2tg-textures.npz --overwrite": "models/a2tg-textures.npz belongs to the run in ",
    "compress done --out done/models/a2tg-textures.npz --overwrite": "ends in .a2tgz; got done/models",
    "export done --ply x.ply --web x.ply": "x.ply/index.html and x.ply overlap: choose",
    "export done --ply x.ply --web x.ply/page": "x.ply/page/index.html and x.ply overlap: choose",
    "export done --ply x.html/x.ply --web x.html": "x.html and x.html/x.ply overlap: choose",
    "compress done --tune-iterations -1": "--tune-iterations must be at least 0",
    "compress done --tune-iterations many": "--tune-iterations",
    "view nowhere.npz": "nowhere.npz",
    "view photo.png": "is not a scene to show; give a run folder, or a file *.npz, *.a2tgz, *.compressed.ply, *.ply",
    "view nowhere": "nowhere: no such file or folder",
    "view .": "holds run folders; give one of them: done, run",
    "view scene": "is a scene that must be trained first: a2tg train scene --out runs/scene",
    "view photos": "is not a run folder (it has no run.toml); give a run folder, or",
    "export done --web photo.png": "photo.png is a file; choose a folder with --web, or a name that ends in .html",
    "export done --web photos --single-file": "photos is a folder; with --single-file",
    "view done --port 99999": "port",
    "export done": "give --web PATH for a page, or --ply FILE",
    "export done --ply x.ply --single-file": "--web PATH",
    "export done --ply photos": "must be the path of a file",
    "export run --web site": "no finished",
    "sfm nowhere new": "nowhere",
    "sfm photo.png new": "photo.png: is a file; give its folder",
    "sfm many photo.png": "photo.png is a file; choose a folder",
    "sfm photos new": "holds 1 photograph; at least 3 photographs are needed",
    "sfm many many/scene": "overlap: choose an output folder",
    "sfm": "PHOTOS is missing: a folder of photographs",
    "sfm photos": "SCENE is missing: the new scene folder comes last, or after --out",
    "sfm photos many": "many holds photographs, but the scene folder comes last; name that by --out SCENE",
    "sfm many .": ". holds photographs, but the scene folder comes last",
    "sfm many new --frames 2": "--frames must be at least 3; got 2",
    "download mipnerf": "there is no data set 'mipnerf'; did you mean mipnerf360?",
}  # fmt: skip


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a run that never began, one that is finished, a scene, photographs and broken files."""
    place = tmp_path_factory.mktemp("mistakes")
    scene = synthetic_scene(num_views=8, width=40, height=30, num_points=60)
    system = A2tg(stage1_iterations=1, stage2_iterations=1, initial_gaussians=50)
    record = RunRecord(SceneSource("synthetic"), "a2tg", system)
    for name in ("run", "done"):
        run = create_run(place / name)
        write_record(run, record)
        run.own(run.checkpoint("a2tg-gaussians", 1)).parent.mkdir()
        run.checkpoint("a2tg-gaussians", 1).write_bytes(b"")
    model = dataclasses.replace(initial_model(scene, system), origin=origin_of_scene(scene))
    save_model(run.own(run.model("a2tg-textures")), model)
    for name in ("photos/a", "scene/a", "photo", "many/a", "many/b", "many/c"):
        (place / name).parent.mkdir(exist_ok=True)
        Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(place / f"{name}.png")
    (place / "scene/transforms.json").write_text(json.dumps({"frames": []}))
    (place / "bad.toml").write_text("scene = {")
    (place / "wrong.toml").write_text('scenes = "synthetic"')
    return place


BOXES = {"Required options", "Missing argument", "Unrecognized options", "Value error", "Invalid choice"}
"""Titles of tyro's errors."""


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_error_and_exit_code_2(capsys, monkeypatch, place, mistake):
    """One line, or one box of tyro."""
    monkeypatch.chdir(place)
    monkeypatch.setattr(cli, "configure_cpu", lambda: None)
    monkeypatch.setattr(run_training, "train_run", lambda *_, **__: pytest.fail("training began"))
    before = sorted(place.rglob("*"))
    assert cli.main(mistake.split()) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and MISTAKES[mistake] in printed.err and "Traceback" not in printed.err
    first, *others = printed.err.splitlines()
    assert first.strip("╭─╮ ") in BOXES or (first.startswith("a2tg: error: ") and not others and len(first) < 600)
    assert sorted(place.rglob("*")) == before


def test_a_deleted_current_folder_is_told(capsys, monkeypatch):
    def gone():
        raise FileNotFoundError(2, "No such file or directory")

    monkeypatch.setattr(cli, "configure_cpu", lambda: None)
    monkeypatch.setattr(os, "getcwd", gone)
    assert cli.main(["info", "run"]) == 2
    assert capsys.readouterr().err == "a2tg: error: the current folder was deleted: change to one that exists\n"


@pytest.mark.parametrize("words, value", [(["0.1", "0.2"], (0.1, 0.2)), (["None"], None), ([], ())])
def test_values_that_may_be_none(words, value):
    command = cli.parsed("train", ["s", "--out", "o", "--texture.at", *words, "--memory-budget", "None"])
    assert command.record.options.texture.at == value and command.record.options.memory_budget is None
