"""Mistakes of users, on the command line and in Python: an error names the argument, what was wanted and what came.

Tables map each mistake to the words of its message that matter, with … between them.
"""

import dataclasses
import functools
import json
import os
import re
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from run_folders import create_run
from scenes_random import as_camera, as_gaussians, draw_scene
from small_models import origin_of
from small_values import some_gaussians, some_world
from test_data_colmap import write_scene as write_colmap

import a2tg_jax as a2tg
from a2tg_jax import Appearance, Checkpoint, Geometry, History, appearance, mcmc, pytree, render_appearance, static
from a2tg_jax.appearance import Arguments, StaticShading, elementwise_functions, takes_arrays
from a2tg_jax.cli import main as cli
from a2tg_jax.data.load import SceneSource
from a2tg_jax.rasterize.kernels import platforms
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.results import run_training
from a2tg_jax.results.record import RunRecord, write_record
from a2tg_jax.training import corrections, losses, options
from a2tg_jax.training.start import initial_model


def assert_says(message: str, words: str) -> None:
    missing = [word for word in words.split(" … ") if word not in message]
    assert not missing, f"no {missing} in: {message}"


def cases(table, takes_long):
    return [pytest.param(code, marks=[pytest.mark.long] * takes_long(code)) for code in table]


# On the command line: one line or one box of tyro on stderr, exit code 2, and nothing is trained or written.

NEW = "train synthetic --system a2tg --out new"
COMMANDS = {
    # Commands, flags and their values
    "trian": "no command 'trian' … did you mean train? … demo",
    "--verbose": "'--verbose'",
    "train": "SCENE",
    "train synthetic": "--out PATH",
    "train --out new": "SCENE",
    "train synthetic more --out new": "Unrecognized … more",
    f"{NEW} --texture.fracton 0.5": "--texture.fraction",
    f"{NEW} --sytem bytewise": "--sytem … --system NAME",
    "convert done b.ply --bake --bake-growth 0.5": "--bake-growth … at least 1 … got 0.5",
    "convert done b.ply --bake --bake-iterations -1": "--bake-iterations … at least 0 … got -1",
    "convert done b.ply --bake-iterations 0": "--bake-iterations … --bake",
    "convert done b.xyz": "b.xyz … suffix",
    f"{NEW} --itertions 5": "--itertions",
    f"{NEW} --cap 5": "--densify.cap",
    f"{NEW} --seed 0.5": "--seed",
    f"{NEW} --batch-size two": "'two'",
    f"{NEW} --texture.select best": "'best'",
    f"{NEW} --texture.at soon": "--texture.at",
    f"{NEW} --system bytwise": "did you mean bytewise?",
    f"{NEW} --system nowhere:B": "'nowhere:B' … No module named 'nowhere'",
    f"{NEW} --system os:sep": "'os:sep'",
    f"{NEW} --compare a2tg": "two systems … 'a2tg'",
    f"{NEW} --compare gaussians-2d --densify.cap 1": "densify.cap … at least 2",
    f"{NEW} --preset quik": "did you mean quick?",
    f"{NEW} --system gaussians-2d --texture.cap 4": "--texture.cap",
    # Numbers out of range
    f"{NEW} --batch-size 0": "--batch-size … at least 1 … got 0",
    f"{NEW} --seed -1": "seed … got -1",
    f"{NEW} --rates.means nan": "rates.means … finite … got nan",
    f"{NEW} --texture.fraction 2": "texture.fraction … at least 0 … at most 1",
    f"{NEW} --texel-rate -0.1": "--texel-rate … at least 0",
    f"{NEW} --texture.cap 32": "texture.cap … at least 1 … at most 16",
    f"{NEW} --texture.at 0.5 0.2": "--texture.at … ascending",
    f"{NEW} --stage1-iterations 0": "at least 1 iteration",
    f"{NEW} --memory-budget 5XB": "--memory-budget … MB … 5XB",
    f"{NEW} --memory-budget 0.0003": "memory_budget … must be 2",
    f"{NEW} --memory-budget 1kB --initial-gaussians 800": "memory_budget … initial_gaussians … 800",
    f"{NEW} --texture.select budget --texture.budget-mb 0.001": "budget-mb … one texel",
    f"{NEW} --texture.select budget": "budget_mb",
    f"{NEW} --downscale 0": "downscale",
    f"{NEW} --test-every -1": "--test-every … got -1",
    # Places and files
    "train nowhere --out new": "nowhere",
    "train s3://me:secret@bucket/fox --out new": "s3://…: is a URL; mount the bucket (rclone mount)",
    "train synthetic --out=s3://bucket/new": "s3://…: is a URL; mount the bucket (rclone mount)",
    "sfm https://host/fox?sig=secret out": "https://…: is a URL; mount the bucket (rclone mount)",
    "train photos --out new": "a2tg sfm photos SCENE",
    "train bad.toml --out new": "bad.toml … transforms.json … Metashape",
    "train synthetic --out bad.toml/run": "run cannot be made",
    "train scene --out scene/run": "overlap",
    f"{NEW[:-3]}photo.png": "photo.png is a file",
    f"{NEW[:-3]}photos": "not a run folder",
    f"{NEW[:-3]}photos --overwrite": "not a run folder",
    "demo --out photos": "not a run folder",
    f"{NEW[:-3]}run": "--resume … --overwrite",
    "train --out nowhere --resume": "is not a run folder",
    f"{NEW[:-3]}run --resume --overwrite": "--resume … --overwrite",
    "train --out run --resume --overwrite": "--resume continues … --overwrite replaces it: give one",
    f"{NEW[:-3]}run --resume --seed 5": "--resume … leave out --seed",
    "train --out run --resume --preset quick": "leave out --preset",
    "train photos --out run --resume": "trained on synthetic",
    f"{NEW} --lpips-weights photo.png": "photo.png",
    f"{NEW} --config nowhere.toml": "nowhere.toml",
    "train --config bad.toml --out new": "bad.toml … TOML",
    "train --config wrong.toml --out new": "scenes … did you mean scene",
    "eval run --lpips-weights nowhere.npz": "nowhere.npz",
    "eval photos": "is not a run folder",
    "finish done": "--out PATH",
    "finish done --out done/new": "overlap",
    "finish done --out photos": "not a run folder",
    "finish done --out run": "run is not empty … --out",
    "finish done --out new --max-loss -1": "--max-loss … at least 0",
    "finish done --out new --polish-steps -1": "--polish-steps … at least 0",
    "finish done --out new --polish-steps 0": "nothing",
    "finish run --out new": "has no finished",
    "finish done --out new": "a2tg-gaussians.npz is missing … put it back",
    "eval run": "a2tg-gaussians-0000000001.npz … is damaged",
    "info": "RUN",
    "render done --frames -3": "frames … at least 1",
    "render done --fps 0": "frames per second … 1..1000",
    "render done --path test --frames 9": "--frames … --path test",
    "mesh done --texture-size 512": "--texture-size … --texture renders",
    "render done --size 640": "size … WIDTHxHEIGHT",
    "render done --path orbt": "orbt … did you mean orbit?",
    "mesh done --resolution 10 --voxel 0.1": "--resolution … --voxel",
    "render done --out photo.png": "photo.png",
    "render run": "a2tg-gaussians-0000000001.npz … is damaged",
    "compress nowhere.npz": "nowhere.npz",
    "compress done --max-loss nan": "--max-loss",
    "compress done --max-loss 1 --file-budget 9kB": "--max-loss and --file-budget exclude each other",
    "compress done --out photos": "--out … .a2tgz … got photos",
    "convert done done/models/a2tg-textures.npz --overwrite": "a2tg-textures.npz … belongs",
    "edit done --floaters 40": "--out FILE",
    "edit done --out folder.json --floaters 40": "folder.json is a folder; give the path of a file … --out",
    "edit done --out folder.ply --floaters 40": "folder.ply is a folder; give the path of a file … --out",
    "mesh done --out folder.glb": "folder.glb is a folder; give the path of a file … --out",
    "compress done --out folder.a2tgz": "folder.a2tgz is a folder; give the path of a file … --out",
    "compare done done --out folder.html": "folder.html is a folder; give the path of a file … --out",
    "convert done folder.ply": "folder.ply is a folder; give the path of a file … OUT",
    "edit nowhere --out e.json --floaters 40": "nowhere",
    "edit photo.png --out e.json --croop 0:1 0:1 0:1": "--croop … --crop LOW:HIGH",
    "compare done": "RUN_OR_FILE",
    "compare nowhere done": "nowhere",
    "compress done --out done/models/a2tg-textures.npz --overwrite": ".a2tgz … got done/models",
    "compress done --tune-iterations -1": "--tune-iterations … at least 0",
    "view photo.png": "photo.png … run folder … *.npz, *.a2tgz, *.compressed.ply, *.ply",
    "view nowhere": "nowhere",
    "view .": "done, run",
    "view scene": "a2tg train scene --out runs/scene",
    "view photos": "run folder … run.toml",
    "export done --web photo.png": "photo.png … --web … .html",
    "export done --web photos --single-file": "photos … --single-file",
    "view done --port 99999": "port",
    "export done": "--web",
    "export done --ply x.ply": "--web PATH … --ply",
    "sfm nowhere new": "nowhere",
    "sfm photo.png new": "1 photograph … given … at least 3",
    "sfm many photo.png": "photo.png … file … comes last … --out SCENE",
    "sfm photos new": "1 photograph … at least 3",
    "sfm many many/scene": "overlap",
    "sfm": "PHOTOS is missing",
    "sfm photos": "SCENE is missing … --out",
    "sfm photos many": "many … photographs … --out SCENE",
    "sfm many new --frames 2": "--frames … at least 3 … got 2",
    "download mipnerf": "'mipnerf' … did you mean mipnerf360?",
}  # fmt: skip


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a run that never began, one that is finished, a scene, photographs and broken files."""
    place = tmp_path_factory.mktemp("mistakes")
    scene = a2tg.synthetic_scene(num_views=8, width=40, height=30, num_points=60)
    system = a2tg.A2tg(stage1_iterations=1, stage2_iterations=1, initial_gaussians=50)
    for name in ("run", "done"):
        run = create_run(place / name)
        write_record(run, RunRecord(SceneSource("synthetic"), "a2tg", system))
        run.own(run.checkpoint("a2tg-gaussians", 1)).parent.mkdir()
        run.checkpoint("a2tg-gaussians", 1).write_bytes(b"")
    model = dataclasses.replace(initial_model(scene, system), origin=origin_of(scene))
    a2tg.save_model(run.own(run.model("a2tg-textures")), model)
    for name in ("photos/a", "scene/a", "photo", "many/a", "many/b", "many/c"):
        (place / name).parent.mkdir(exist_ok=True)
        Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(place / f"{name}.png")
    for suffix in ("json", "glb", "a2tgz", "html", "ply"):
        (place / f"folder.{suffix}").mkdir()
    (place / "scene/transforms.json").write_text(json.dumps({"frames": []}))
    (place / "bad.toml").write_text("scene = {")
    (place / "wrong.toml").write_text('scenes = "synthetic"')
    return place


BOXES = {"Required options", "Missing argument", "Unrecognized options", "Value error", "Invalid choice"}
"""Titles of tyro's errors."""


@pytest.mark.usefixtures("untouched_jax")
@pytest.mark.parametrize(
    "mistake", cases(COMMANDS, lambda code: "budget-mb" in code or "finish done --out new" in code)
)
def test_a_mistake_on_the_command_line(capsys, monkeypatch, place, mistake):
    monkeypatch.chdir(place)
    monkeypatch.setattr(run_training, "train_run", lambda *_, **__: pytest.fail("training began"))
    before = sorted(place.rglob("*"))
    assert cli.main(mistake.split()) == 2
    printed = capsys.readouterr()
    assert_says(printed.err, COMMANDS[mistake])
    first, *others = printed.err.splitlines()
    assert first.strip("╭─╮ ") in BOXES or (first.startswith("a2tg: error: ") and not others and len(first) < 600)
    assert printed.out == "" and "Traceback" not in printed.err and sorted(place.rglob("*")) == before


@pytest.mark.usefixtures("untouched_jax")
def test_a_deleted_current_folder(capsys, monkeypatch):
    monkeypatch.setattr(os, "getcwd", functools.partial(os.stat, "/nowhere"))
    assert cli.main(["info", "run"]) == 2
    assert_says(capsys.readouterr().err, "a2tg: error: … current folder was deleted")


@pytest.mark.parametrize("words, value", [(["0.1", "0.2"], (0.1, 0.2)), (["None"], None), ([], ())])
def test_values_that_may_be_none(words, value):
    command = cli.parsed(
        "train", ["s", "--system", "a2tg", "--out", "o", "--texture.at", *words, "--memory-budget", "None"]
    )
    assert command.record.options.texture.at == value and command.record.options.memory_budget is None


# In Python: values that the code in the tables uses, besides the public names of the library

CAMERA = a2tg.Camera(jnp.eye(4).at[2, 3].set(3), jnp.array([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]), 16, 12)
IMAGE = jnp.ones((12, 16, 3))
MAP = jnp.ones((12, 16))
SIZES = np.ones((7, 2), int)
SCALES = np.ones((7, 2), np.float32)
SETTINGS = a2tg.RenderSettings(capacity=1024)
KEY = jax.random.key(0)
MODEL = a2tg.Model(some_gaussians())
GAUSSIANS = some_gaussians()
TEXTURES = a2tg.allocate_textures(SIZES)
WRONG_TEXTURES = dataclasses.replace(TEXTURES, buckets=(jnp.ones((7, 1, 1, 3)),))
TEXTURED = a2tg.Model(GAUSSIANS, Appearance(texture=a2tg.Texture(TEXTURES)))
TEMPLATE = a2tg.Model(GAUSSIANS, Appearance(texture=a2tg.Texture()))
VIEW = a2tg.View("a.png", CAMERA, np.zeros((12, 16, 3), np.uint8))
OUTPUT = a2tg.RenderOutput(IMAGE, MAP, jnp.zeros((), bool), Geometry(MAP, IMAGE, MAP))
SCENE = a2tg.Scene("toy", (VIEW, VIEW), (VIEW,), np.eye(9, 3), np.zeros((9, 3)), some_world(), 1.0)


def changed(**fields) -> a2tg.Gaussians:
    return dataclasses.replace(GAUSSIANS, **fields)


FLAT_SH = changed(sh=jnp.zeros((7, 2, 3)))


def render(gaussians=GAUSSIANS, **options):
    of_camera = {name: options.pop(name) for name in ("viewmat", "K", "width") if name in options}
    camera = dataclasses.replace(CAMERA, **of_camera)
    return a2tg.render_image(gaussians, camera, **options)


def fitted(**changes):
    return a2tg.fit(dataclasses.replace(SCENE, **{"train": (VIEW,), **changes}), a2tg.A2tg())


def moved(**changes):
    return MODEL.transform(dataclasses.replace(a2tg.Similarity(1.0, np.eye(3), np.zeros(3)), **changes))


def started(colors=SCENE.colors, **arguments):
    return a2tg.init_from_points(SCENE.points, colors, **arguments)


def relocated(gaussians=GAUSSIANS, moments=(), num_live=7):
    return a2tg.relocate(KEY, gaussians, moments, num_live)


def sizes_after(sizes, scales, **options):
    return a2tg.next_sizes(sizes, scales, **{"k_a": 4.0, "k_s": 0.01, "cap": 4, **options})


def adam(params, grads, rates=0.1):
    return a2tg.adam_update(params, grads, a2tg.adam_init(params), rates)


def mean_color(model, target, output):
    return jnp.mean(output.color)


@dataclasses.dataclass(frozen=True, kw_only=True)
class OneStage(a2tg.A2tg):
    def stages(self):
        return super().stages()[0]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Own(a2tg.System):
    """One stage, some of whose fields are given."""

    given: Any = None

    def stages(self):
        first = a2tg.Stage("own", Appearance(), (), self.loss.terms(), self.rates, 2)
        return (dataclasses.replace(first, **self.given),)


@functools.cache
def tiny(side=16) -> a2tg.Scene:
    return a2tg.synthetic_scene(num_views=3, width=side, height=side, num_points=50)


def trained(scene=None, **given):
    return a2tg.fit(scene or tiny(), Own(given=given, loss=a2tg.LossConfig(ssim_weight=0)))


def staged(**given):
    Own(given=given).stages()[0].check()


def roughness(model, target, output):
    return jnp.mean(jnp.abs(jnp.diff(output.depth, axis=0)))


def each_pixel(model, target, output):
    return jnp.abs(output.color - target.image)


def made(base, name="Mine", **methods):
    """An object of a subclass with some methods."""
    return a2tg.pytree(type(name, (base,), methods))()


def shaded(shade, name="Mine"):
    return made(Appearance, name, shade=lambda self, numbers, values, u, v: shade(u, v))


def applied(change):
    """An event of each step that returns something for its iteration, model, moments and state."""
    return (made(a2tg.StepEvent, apply=lambda self, *arguments: change(*arguments)),)


def nothing_left(self, due, model, moments, state):
    return a2tg.keep_rows(model, moments, state, np.zeros(len(model.gaussians.means), bool))


class Undecorated(a2tg.StepEvent):
    pass


@a2tg.pytree
class Named(a2tg.StepEvent):
    title: str = "a"


SPLATS, SEEN = (f(draw_scene(1, num=10, width=16, height=12), "float32") for f in (as_gaussians, as_camera))


def drawn(splats, compositor="xla"):
    return render_appearance(SPLATS, SEEN, splats, settings=a2tg.RenderSettings(compositor=compositor)).color


@pytree(kw_only=True)
class Glow(Appearance):
    strength: jax.Array
    used: str = static()

    def shade(self, numbers, values, u, v):
        return (eval(self.used, {"u": u, "strength": self.strength, "jnp": jnp}),) * 3, None


FIELDS = {
    "means=jnp.zeros((7, 4))": "means … [N, 3] … [7, 4]",
    "means=jnp.zeros(())": "means … [N, 3] … []",
    "quats=jnp.zeros((6, 4))": "quats … [7, 4] … [6, 4]",
    "log_scales=jnp.zeros((7, 3))": "log_scales … [7, 2] … [7, 3]",
    "logit_opacities=jnp.zeros((7, 1))": "logit_opacities … [7] … [7, 1]",
    "sh=jnp.zeros((7, 2, 3))": "sh … [7, K, 3] … K = 2",
    "sh=jnp.zeros((7, 16, 3), int)": "sh … floats … int32",
    "sh=jnp.zeros((7, 16, 3), jnp.float16)": "sh … float32 … float16",
}
TRACED = "jax.eval_shape(lambda g: render(g, settings=SETTINGS), changed({}))"
CALLS = {
    **{f"render(changed({code}))": f"gaussians.{words}" for code, words in FIELDS.items()},
    **{TRACED.format(code): f"gaussians.{words}" for code, words in FIELDS.items()},
    # Rendering
    "render(background=IMAGE)": "background … one colour [3] … [12, 16, 3]",
    "render(background=0.5)": "background … [3] … []",
    "MODEL.render(CAMERA, background='white')": "background … [3] … (1, 1, 1) … 'white'",
    "render(textures=WRONG_TEXTURES)": "textures.buckets[0] … [capacity, 1, 1, 4]",
    "render(textures=replace(TEXTURES, buckets=()))": "textures … one bucket for each",
    "render_image(GAUSSIANS, IMAGE)": "camera … Camera … Array",
    "render(viewmat=jnp.eye(3))": "camera.viewmat … [4, 4] … [3, 3]",
    "render(viewmat=tuple(np.eye(4)))": "camera.viewmat … array … tuple",
    "render(viewmat=jnp.diag(jnp.array([1.0, -1, 1, 1])))": "camera.viewmat … rigid motion … OpenCV … mirrors",
    "render(viewmat=jnp.diag(jnp.array([2.0, 2, 2, 1])))": "camera.viewmat … rigid motion … R·Rᵀ − I up to 3",
    "render(viewmat=CAMERA.viewmat.at[3, 2].set(3))": "camera.viewmat … last row … 0, 0, 0, 1",
    "render(width=0)": "camera.width … positive … pixels … 0",
    "render(width=jnp.int32(80))": "camera.width … Python int",
    "render(K=CAMERA.K.at[0, 2].set(jnp.nan))": "camera.K … [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]",
    "render(K=CAMERA.K.at[1, 1].multiply(-1))": "camera.K … pixels",
    "render(K=CAMERA.K.T)": "camera.K … pixels",
    "render(settings=None)": "settings … RenderSettings … NoneType",
    "MODEL.render(CAMERA, settings={'tile_size': 8})": "settings … RenderSettings … dict",
    "RenderSettings(capacity=0)": "capacity … at least 1 … None … 0",
    "RenderSettings(capacity=True)": "capacity … int … True",
    "RenderSettings(tile_size=8.0)": "tile_size … int, 1 to 64 … 8.0",
    "RenderSettings(tile_batch=-1)": "tile_batch … int, at least 0 … None … -1",
    "RenderSettings(near_plane='1')": "near_plane … number above 0 … '1'",
    "plan_render(CAMERA, GAUSSIANS)": "gaussians … Model or Gaussians … Camera",
    "plan_render(GAUSSIANS, None)": "cameras … Camera or an Iterable … NoneType",
    "plan_render(GAUSSIANS, [VIEW])": "cameras[0] … Camera … View … view.camera",
    "plan_render(MODEL, [CAMERA], appearance=MODEL.appearance)": "appearance … a model has its own … the model alone",
    "Renderer(FLAT_SH)": "gaussians.sh … [7, K, 3] … K = 2",
    "Renderer(GAUSSIANS, CAMERA)": "appearance … Appearance … Camera",
    "render_image(changed(means=np.zeros((7, 3))), CAMERA)": "gaussians.means must be float32 as quats, log_scales, "
    "logit_opacities, sh are; got float64",
    "RenderSettings(compositor='gpu')": "compositor must be one of auto, cuda, native, xla, autodiff … 'gpu'",
    "view_gradients(lambda m, o: 0.0, GAUSSIANS, CAMERA)": "model … Gaussians … Model(gaussians)",
    "view_gradients(lambda m, o: 0.0, MODEL, CAMERA, statistic='foo')": "statistic … position, screen, center … 'foo'",
    "value_and_grad(jnp.sum)(jnp.arange(3))": "first argument … pytree with floats … ArrayImpl",
    "resize_camera(CAMERA, 0, 12)": "width … int, at least 1 … 0",
    "smooth_path([CAMERA, CAMERA], '5')": "num_frames … int, at least 1 … '5'",
    "smooth_path(SCENE.train, 5)": "cameras[0] … Camera … View … view.camera",
    "look_at([0, 0, 1], [0, 0, 0], width=64, height=48)": "up is [0. 0. 1.]",
    # Models
    "Model(SCENE)": "gaussians … Gaussians … Scene",
    "Model(GAUSSIANS, TEXTURES)": "appearance … Appearance … Textures … Appearance(texture=Texture(textures))",
    "MODEL.with_textures(TEXTURES)": "plain Gaussians … Appearance(texture=Texture(textures))",
    "Model(jax.tree.map(lambda x: x.astype(jnp.bfloat16), GAUSSIANS)).render(CAMERA)": "gaussians … float32 … bfloat16",
    "concatenate([])": "at least one model",
    "concatenate([MODEL, GAUSSIANS])": "models[1] … Model … Gaussians",
    "concatenate([MODEL, TEXTURED])": "one appearance … plain Gaussians … Gaussians with texture",
    "concatenate([MODEL, Model(GAUSSIANS, Appearance(max_alpha=0.5))])": "one appearance … different options",
    "MODEL[3]": "model[3:4]",
    "MODEL[-1]": "model[-1:]",
    "MODEL[7]": "7 Gaussians; got 7",
    "MODEL.transform(np.eye(4))": "similarity … Similarity … ndarray",
    "moved(scale=0.0)": "similarity … positive scale",
    "moved(rotation=-np.eye(3))": "similarity … rotation … [[-1.0",
    "moved(rotation=np.eye(4))": "similarity.rotation … [3, 3] … [4, 4]",
    "moved(rotation=[[1, 0, 0]])": "similarity.rotation … array … list … np.asarray",
    "parameter_bytes(MODEL)": "Model … model.num_bytes",
    "TEMPLATE.render(CAMERA)": "model.appearance.texture.texels is None … template … Model(gaussians, ",
    "TEMPLATE.live": "model.appearance.texture.texels is None … template",
    "save_model('m.npz', TEMPLATE)": "model.appearance.texture.texels is None … template",
    "evaluate(SCENE.test, TEMPLATE)": "model.appearance.texture.texels is None … template",
    "Model(GAUSSIANS, Appearance(bands=Bands())).live": "model.appearance.bands.coefficients is None … template",
    "Model(GAUSSIANS, Appearance(exponents=Exponents())).live": "model.appearance.exponents.shapes is None … template",
    # Files
    "save_model('g.npz', GAUSSIANS)": "model … Model … Gaussians … Model(gaussians)",
    "save_model('x.ply', MODEL)": "x.ply … *.npz … save_ply",
    "save_compact('x.npz', MODEL)": "*.a2tgz … save_model",
    "save_ply('x.a2tgz', MODEL)": "*.ply … save_compact",
    "load_model('flat.ply')": "flat.ply … *.npz … load_ply",
    "load_model('/')": "folder … file",
    "load_scene('s3://me:secret@bucket/fox')": "s3://…: is a URL; mount the bucket (rclone mount)",
    "load_scene(5)": "a path must be text or a Path; got 5",
    "load_scene('synthetic')": "synthetic … no such scene folder … synthetic_scene()",
    "load_scene('cells')": "cells … no such scene folder … cells_scene()",
    # Points
    "started(num=3.5)": "num … int, at least 2 … 3.5",
    "started(sh_degree=4)": "sh_degree … int, 0 to 3 … 4",
    "started(opacity=1.0)": "opacity … above 0 and below 1 … 1.0",
    "started(np.full((9, 3), 200, np.uint8))": "colors … floats in [0, 1] … uint8 … 255",
    "started(np.full((9, 3), 200.0))": "colors … [0, 1] … 200 … 255",
    "started(np.full((9, 3), -0.5))": "colors … [0, 1] … -0.5",
    # Scenes and views
    "View('a.png', CAMERA, np.zeros((12, 16, 3)))": "uint8 [H, W, 3], or [H, W, 4] … float64 [12, 16, 3] … np.rint(255",
    "View('a.png', CAMERA, np.zeros((3, 12, 16), np.uint8))": "with alpha … uint8 [3, 12, 16]",
    "View('a.png', None, np.zeros((12, 16, 3), np.uint8))": "view a.png … camera … Camera",
    "replace(VIEW, mask=[[True]])": "view a.png … mask … bool [H, W] … list",
    "replace(VIEW, depth=[[1.0]])": "view a.png … depth map … floats [H, W] … list",
    "view_image(CAMERA)": "view … View … Camera",
    "fitted(train=(replace(VIEW, camera=replace(CAMERA, viewmat=jnp.eye(4)[:3])),))": "a.png … camera.viewmat … [3, 4]",
    "fitted(train=SCENE.test * 2)": "scene.train … two views called 'a.png'",
    "fitted(train=(np.zeros(3),))": "scene.train … tuple of views",
    "fitted(transform=None)": "scene.transform … Similarity … NoneType",
    "fitted(points=np.zeros((0, 3)), colors=np.zeros((0, 3)))": "scene.points … two points … 0",
    "fitted(colors=np.zeros((2, 3)))": "scene.colors … [9, 3] … [2, 3]",
    # Systems and training
    "fit('synthetic', A2tg())": "scene … Scene … load_scene('synthetic')",
    "fit(Path('fox'), A2tg())": "scene … Scene … load_scene",
    "fit(SCENE, 'a2tg')": "system … a name … find_system('a2tg')",
    "fit(SCENE, A2tg)": "system … System … the class A2tg … A2tg()",
    "fit(SCENE, A2tg(), resume='cp.npz')": "resume … Checkpoint … str … load_checkpoint",
    "fit(SCENE, OneStage())": "OneStage.stages … tuple of stages … Stage(",
    "fit(SCENE, A2tg(background='grey'))": "background … black, white, random … 'grey'",
    "evaluate(SCENE, MODEL)": "views … scene.train … Scene … evaluate(scene.test",
    "evaluate(MODEL, SCENE.test)": "Model … evaluate(scene.test, model)",
    "polish(MODEL, SCENE)": "Scene … polish(model, scene.train)",
    "align_poses(CAMERA, GAUSSIANS)": "Camera … align_poses(scene.test, model)",
    "A2tg(texture={'cap': 8}).check()": "texture … Upscale … dict … Upscale(cap=8)",
    "A2tg(batch_size='4').check()": "batch_size … int … '4'",
    "A2tg(corrections=Corrections(exposure_kind='foo')).check()": "corrections.exposure_kind … one of",
    "A2tg.preset('quick', **{'texture.cap': 4})": "A2tg.texture.cap … unknown … texture={'cap': …}",
    "A2tg.preset('quick', iterations=10)": "A2tg.iterations … did you mean stage",
    "A2tg.preset('quick', texture={'cep': 10})": "A2tg.texture.cep … did you mean cap?",
    "FillingMcmc(50).num_rows(20, 9)": "cap … 50 Gaussians … 9 iterations … 20",
    # Functions of arrays
    "photometric_loss(OUTPUT, IMAGE)": "image … array … RenderOutput … output.color",
    "photometric_loss(IMAGE, VIEW)": "target … array … View … view_image(",
    "photometric_loss(IMAGE, IMAGE, ssim_weight=2)": "ssim_weight … at least 0 and at most 1",
    "ssim(IMAGE, IMAGE.astype(int))": "floats",
    "psnr(np.full((16, 16, 3), 200.0), np.full((16, 16, 3), 201.0))": "image … floats in [0, 1] … mean of 200 … by 255",
    "ssim(np.ones((16, 16, 3)), jnp.full((16, 16, 3), 99.0))": "target … floats in [0, 1] … mean of 99 … by 255",
    "photometric_loss(255 * np.ones((16, 16, 3)), np.ones((16, 16, 3)))": "image … [0, 1] … mean of 255 … by 255",
    "jax.grad(photometric_loss)(np.ones((16, 16, 3)), 255 * np.ones((16, 16, 3)))": "target … [0, 1] … mean of 255",
    "psnr(IMAGE, IMAGE, np.full((12, 16), 255, np.uint8))": "mask … bools … uint8",
    "normal_consistency(IMAGE, MAP[None], MAP, CAMERA)": "depth … [12, 16] … [1, 12, 16]",
    "normal_consistency(None, MAP, MAP, CAMERA)": "normal … [12, 16, 3] … NoneType",
    "normal_consistency(IMAGE, MAP, MAP, VIEW)": "camera … Camera … View … view.camera",
    "depth_normals(MAP, MAP[:5] > 0, CAMERA)": "is_valid … [12, 16] … [5, 16]",
    "color_fit(IMAGE, IMAGE, np.ones((12, 16), int))": "mask … bools … int64",
    "relocated(num_live=jnp.ones(7))": "num_live … whole number in 0..7 … [1. 1. 1. 1. 1. 1. 1.]",
    "relocated(moments=(jnp.ones((6, 3)),))": "moments … 7 rows",
    "grow(KEY, GAUSSIANS, (), 3, jnp.ones(2))": "cap … whole number in 0..7 … [1. 1.]",
    "select(np.ones((7, 1)), SIZES, SIZES, fraction=0.5)": "statistic … [N] … [7, 1]",
    "reallocate(TEXTURES, SIZES, (WRONG_TEXTURES,))": "moments.buckets[0]",
    "reallocate(TEXTURES, SIZES[:6])": "new_sizes … [7, 2] … [6, 2]",
    "reallocate(TEXTURES, SIZES, kept=np.arange(7))": "kept … bools … int64",
    "textures_from_arrays([np.ones((1, 1, 4), int)])": "texture 0 … floats … int64",
    "allocate_textures(SIZES, rgb=(1, 1, 1))": "rgb … number … (1, 1, 1)",
    "sizes_after(SCALES, SIZES)": "sizes … integers [N, 2] as (Tv, Tu) … float32 (7, 2)",
    "sizes_after(TEXTURES, SCALES)": "sizes … integers [N, 2] … Textures … textures.sizes",
    "sizes_after(100 * SIZES, SCALES)": "sides … 1..16 … both 0 … 100..100",
    "sizes_after(SIZES, -SCALES)": "scales … positive standard deviations … -1",
    "sizes_after(SIZES, SCALES, k_a=np.nan)": "k_a … at least 1 … nan",
    "sizes_after(SIZES, SCALES, k_a=0.5)": "k_a … at least 1 … 0.5",
    "sizes_after(SIZES, SCALES, cap=4.5)": "cap … int, 1 to 16 … 4.5",
    "GradientStatistics.init(7).observe(jnp.ones((7, 1)), jnp.ones(7, bool))": "norms … [7] … [7, 1]",
    "adam({'a': jnp.ones(7)}, {'a': jnp.ones((7, 1))})": "grads['a'] … [7] … [7, 1]",
    "adam({'a': jnp.ones(7)}, {'b': jnp.ones(7)})": "grads … structure of params",
    "adam({'a': jnp.ones(7, int)}, {'a': jnp.ones(7)})": "params['a'] … floats … int32",
    "adam(jnp.ones((7, 3)), jnp.ones((7, 3)), jnp.ones(3))": "rates … broadcast to [7, 3]",
    "adam(GAUSSIANS, GAUSSIANS, LearningRates().of_gaussians(1e-3, 1))": "rates.sh … [7, 16, 3] … [1, 4, 1]",
    "adam(GAUSSIANS, GAUSSIANS, {'means': 1e-3})": "rates … one for all … fields of params",
    "adam_update(IMAGE, IMAGE, None, 0.1)": "state … AdamState … NoneType … adam_init",
    "adam_update(IMAGE, IMAGE, adam_init(IMAGE), 0.1, b1=1.0)": "b1 … at least 0 and below 1",
    "exponential_decay('1', 0.1, 3, 10)": "start … number, or an array",
    "exponential_decay(1.0, 0.0, 3, 10)": "final_factor … above 0 … 0.0",
    # Custom appearances
    "drawn(shaded(lambda u, v: (u, None)))": "Mine.shade … (residual, factor) … residual is float32[]",
    "drawn(shaded(lambda u, v: ((u, v), None)))": "Mine.shade … residual is (float32[], float32[])",
    "drawn(shaded(lambda u, v: (None, (u,))))": "Mine.shade … factor is (float32[],)",
    "drawn(shaded(lambda u, v: (u, v, u)))": "Mine.shade … (float32[], float32[], float32[])",
    "drawn(made(Appearance, falloff=lambda self, numbers, rho: (rho, rho)))": "Mine.falloff … one number … float32[]",
    "drawn(made(Appearance, own_colors=lambda self, g, *_: g.opacities))": "own_colors … [N, 3] … Mine … (10,)",
    "drawn(dataclass(frozen=True)(type('Loose', (Appearance,), {}))())": "appearance … Loose … @a2tg_jax.pytree",
    **{
        f"drawn(Glow(strength=jnp.ones(10), used='{used}'))": "Glow.strength … array … numbers()"
        for used in ("jnp.sin(strength) * u", "jnp.where(u > 0, strength, 0.0)", "u * strength", "u @ strength")
    },
    # Custom stages
    "staged(appearance=Appearance)": "stage 'own' … appearance … Appearance … the class Appearance … Appearance(…)",
    "staged(rates=0.1)": "stage 'own' … rates … LearningRates … float",
    "staged(appearance=Appearance(exponents=Exponents()))": "stage 'own' … appearance_rate … learning rate … exponents",
    "staged(appearance=Appearance(texture=Texture()))": "stage 'own' … appearance_rate … learning rate … texture",
    "staged(appearance_rate={'texture': -1e-2})": "stage 'own' … appearance_rate … at least 0 … -0.01",
    "staged(iterations='30')": "stage 'own' … iterations … integer … '30'",
    "staged(events=Noise())": "stage 'own' … events … tuple or a list … Noise",
    "staged(events=(Noise(), Noise))": "stage 'own' … events[1] … StepEvent or a HostEvent … the class Noise",
    "staged(events=(Undecorated(),))": "stage 'own' … events[0] … pytree … Undecorated",
    "staged(events=(Named(),))": "stage 'own' … events[0] … numbers … 'a' … Named",
    "staged(events=(made(HostEvent, times=lambda self, num: (0.5,)),))": "Mine.times … ascending … (0.5,)",
    "staged(events=(made(HostEvent, times=lambda self, num: range(1, num, 0)),))": "Mine.times … zero",
    "staged(events=(made(StepEvent, times=lambda self, num: range(num, 0, -1)),))": "Mine.times … ascending … range(",
    "staged(losses=roughness)": "stage 'own' … losses … tuple or a list … function",
    "staged(losses=())": "stage 'own' … losses",
    "staged(losses=(roughness,))": "stage 'own' … losses[0] … loss term … function … Term(roughness)",
    "staged(losses=(Photometric,))": "stage 'own' … losses[0] … loss term … the class",
    "staged(corrections=('exposure',))": "stage 'own' … corrections[0] … Correction … str",
    "trained(events=applied(lambda now, *result: result))": "stage 'own' … Mine.apply … Change … tuple",
    "trained(events=applied(lambda now, model, *rest: Change(model.gaussians, *rest)))": "Mine.apply … model",
    "trained(events=applied(lambda now, m, *rest: Change(replace(m, gaussians=m.gaussians[:9]), *rest)))": (
        "Mine.apply … moments.mu.gaussians.means"
    ),
    "trained(events=applied(lambda now, model, moments, state: Change(model, moments, (now.iteration,))))": (
        "Mine.apply … state … structure"
    ),
    "trained(events=(made(StepEvent, observes=True, observe=lambda self, state, model, seen: seen.colors),))": (
        "Mine.observe … structure"
    ),
    "trained(events=(made(HostEvent, times=lambda self, num: (1,), apply=lambda self, due, *result: result),))": (
        "stage 'own' … Mine.apply … Change … tuple"
    ),
    "trained(events=(made(HostEvent, times=lambda self, num: (1,), apply=nothing_left),))": (
        "Mine.apply … is_kept … at least 2 … 0 of 50"
    ),
    "TextureOptions(extent=0)": "extent must be at least 0.001 and at most 1000; got 0",
    "TextureOptions(extent=np.nan)": "extent must be at least 0.001 and at most 1000; got nan",
    "TextureOptions(uv='texel-center')": "uv must be one of texel-centre, align-corners; got 'texel-center'",
    "trained(events=(Upscale(select='most'),))": "Upscale.select … fraction, threshold, budget; got 'most'",
    "trained(losses=(Term(each_pixel),))": "'each_pixel' … scalar … jnp.mean(…) … float32[16, 16, 3]",
    "trained(corrections=(made(Exposure, camera=lambda self, row, camera: row),))": "Mine.camera … structure",
    "trained(corrections=(made(Exposure, color=lambda self, row, c: c.mean((0, 1))),))": "Mine.color … [16, 16, 3]",
    "trained(corrections=(made(Exposure, project=lambda self, rows: rows[:1]),))": "Mine.project",
    "trained(losses=(Term(lambda model, target, output: target.depth.sum()),))": "target.depth … has_depths=True",
    "trained(losses=(Photometric(), Term(roughness)))": "depth … has_geometry=True",
    "trained(tiny(10), losses=(Photometric(1),))": "10 by 10 pixels … SSIM … 11 by 11",
    "trained(losses=(Term(mean_color, has_depths=True),))": "needs depth maps",
}  # fmt: skip
NAMES: dict[str, Any] = {}
for module in (appearance, corrections, dataclasses, losses, mcmc, options, a2tg):
    NAMES |= {name: getattr(module, name) for name in dir(module)}
NAMES |= {**globals(), "Path": Path}


@pytest.mark.parametrize("mistake", cases(CALLS, lambda code: "trained(" in code and "target.depth" not in code))
def test_a_mistake_in_python(mistake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ValueError, FileNotFoundError)) as printed_text:
        eval(mistake, NAMES)
    assert_says(str(printed_text.value), CALLS[mistake])
    assert not list(tmp_path.iterdir()), "nothing is written"


ADVICE = {
    "fit(Path('fox'), A2tg())": a2tg.Scene,
    "fit(SCENE, 'a2tg')": a2tg.System,
    "fit(SCENE, A2tg)": a2tg.System,
    "save_model('g.npz', GAUSSIANS)": a2tg.Model,
    "TEMPLATE.live": a2tg.Model,
    "View('a.png', CAMERA, np.zeros((12, 16, 3)))": np.ndarray,
    "MODEL[3]": a2tg.Model,
    "MODEL[-1]": a2tg.Model,
    "A2tg(texture={'cap': 8}).check()": a2tg.Upscale,
}
"""What a message says to write, and the class that this makes."""


@pytest.mark.parametrize("mistake", ADVICE)
def test_what_a_message_says_to_write_works(mistake, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="use ") as printed_text:
        eval(mistake, NAMES)
    monkeypatch.chdir(tmp_path)
    write_colmap(tmp_path / "fox")
    given = {"gaussians": GAUSSIANS, "model": MODEL, "image": np.zeros((12, 16, 3)), "key": jax.random.key(0)}
    given["appearance"] = TEMPLATE.appearance
    for code in str(printed_text.value).rpartition("use ")[2].partition(" of ")[0].split(" or "):
        assert isinstance(eval(code, NAMES | given), ADVICE[mistake])


# What is no mistake, or none under a transformation


def test_transformations_may_put_anything_into_values():
    """No validation when a pytree is made, and none of values that are traced."""
    wrong = jnp.diag(jnp.array([1.0, -1, 1, 1]))
    jax.eval_shape(lambda viewmat, K: render(viewmat=viewmat, K=K, settings=SETTINGS), wrong, CAMERA.K.T)
    render(viewmat=jnp.diag(jnp.array([1.01, 0.995, 1, 1])))
    axes = a2tg.Model(0, None)
    assert jax.tree.map(lambda x: None, MODEL).gaussians.means is None and axes.gaussians == 0


def test_options_of_any_kind_of_number():
    for at in ((np.float32(0.25), 0.5), np.array((0.25, 0.5))):
        a2tg.A2tg(seed=np.int64(3), initial_opacity=jnp.float32(0.2), texture=a2tg.Upscale(at=at)).check()

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Unresolved(a2tg.A2tg):
        table: "OnlyInThisFunction" = ()  # type: ignore[name-defined] # noqa: F821

    Unresolved().check()


def test_a_preset_takes_other_values_of_options():
    system = a2tg.A2tg.preset("quick", stage1_iterations=10, texture={"cap": 8}, rates=a2tg.LearningRates(quats=0.5))
    plain = a2tg.A2tg.preset("quick")
    texture = dataclasses.replace(plain.texture, cap=8)
    rates = a2tg.LearningRates(quats=0.5)
    assert system == dataclasses.replace(plain, stage1_iterations=10, texture=texture, rates=rates)


def test_a_redefined_class_is_another_one():
    def defined() -> type[a2tg.System]:
        @dataclasses.dataclass(frozen=True, kw_only=True)
        class Redefined(a2tg.A2tg):
            pass

        return Redefined

    with pytest.raises(ValueError, match=r"before it was defined again\): resume with checkpoint.system, or"):
        a2tg.fit(
            dataclasses.replace(SCENE, train=(VIEW,)),
            defined()(),
            resume=Checkpoint(defined()(), 0, None, History.empty()),
        )


def test_a_capacity_that_is_too_small_warns_eagerly():
    model = a2tg.Model(some_gaussians(40))
    settings = a2tg.RenderSettings(capacity=1)
    with pytest.warns(a2tg.CapacityWarning, match=re.escape("plan_render(model, cameras)")) as caught:
        assert model.render(CAMERA, settings=settings).overflow
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert jax.jit(lambda camera: model.render(camera, settings=settings))(CAMERA).overflow
        planned = a2tg.plan_render(model, [CAMERA])
        assert planned == a2tg.plan_render(model.gaussians, [CAMERA], appearance=model.appearance)
        assert not model.render(CAMERA, settings=planned).overflow


def test_a_camera_that_sees_nothing_warns_eagerly():
    model = a2tg.Model(some_gaussians(40))
    planned = a2tg.plan_render(model, [CAMERA])
    opengl = dataclasses.replace(CAMERA, viewmat=np.diag(np.float32([1, -1, -1, 1])) @ CAMERA.viewmat)
    away = dataclasses.replace(CAMERA, viewmat=CAMERA.viewmat.at[2, 3].set(-100.0))
    loss = lambda model, output: jnp.mean(output.color)  # noqa: E731
    for camera in (opengl, away):
        for see in (
            lambda: model.render(camera),  # noqa: B023
            lambda: a2tg.render_image(model.gaussians, camera),  # noqa: B023
            lambda: jax.grad(lambda g: jnp.mean(a2tg.render_image(g, camera).color))(model.gaussians),  # noqa: B023
            lambda: a2tg.view_gradients(loss, model, camera),  # noqa: B023
            lambda: a2tg.plan_render(model, [camera, camera]),  # noqa: B023
        ):
            with pytest.warns(a2tg.EmptyRenderWarning, match="world to camera .* OpenCV axes"):
                see()
    # With a planned capacity the first render of a kind is waited for, later ones are reported with the next.
    small = dataclasses.replace(opengl, width=31)
    with pytest.warns(a2tg.EmptyRenderWarning) as caught:
        model.render(small, settings=planned)
    assert caught[0].filename == __file__
    with pytest.warns(a2tg.EmptyRenderWarning):
        model.render(dataclasses.replace(away, width=31), settings=planned)
        jax.block_until_ready(jax.live_arrays())  # The number of pairs, which is read, is no part of the output.
        model.render(CAMERA, settings=planned)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.jit(lambda camera: model.render(camera, settings=planned))(opengl)
        a2tg.Renderer(model)(opengl)
        a2tg.plan_render(model, [CAMERA, opengl])
        for nothing in (model[:0], dataclasses.replace(model, num_live=jnp.int32(0))):
            nothing.render(opengl)
            nothing.render(opengl, settings=planned)
            a2tg.plan_render(nothing, [opengl])


def test_nan_in_a_ply_file(tmp_path):
    bad = changed(means=GAUSSIANS.means.at[jnp.array([2, 5]), 1].set(jnp.nan))
    with pytest.raises(ValueError, match=r"means must be finite; 2 of 7 rows .* first is row 2 \(from 0\)"):
        a2tg.save_ply(tmp_path / "bad.ply", bad)
    assert not (tmp_path / "bad.ply").exists()
    a2tg.save_ply(tmp_path / "good.ply", GAUSSIANS)
    header, rows = (tmp_path / "good.ply").read_bytes().split(b"end_header\n")
    numbers = np.frombuffer(rows, "<f4").reshape(GAUSSIANS.num, -1).copy()
    numbers[[2, 5], 1] = np.nan
    (tmp_path / "bad.ply").write_bytes(header + b"end_header\n" + numbers.tobytes())
    with pytest.warns(UserWarning, match=r"2 Gaussians of 7 left out, .* first is row 2 \(from 0\)"):
        assert a2tg.load_ply(tmp_path / "bad.ply").num == 5


def test_depth_that_was_not_rendered_is_no_zero():
    model = a2tg.Model(a2tg.init_from_points(tiny().points, tiny().colors))
    camera = tiny().test[0].camera
    arguments = model.gaussians, camera, model.appearance, jnp.zeros(3), dataclasses.replace(SETTINGS, supersample=2)
    output = jax.eval_shape(lambda: render_traced(*arguments, has_geometry=False)[0])
    assert output.alpha.shape == (16, 16) and output.geometry is None
    for name in ("depth", "normal", "distortion"):
        with pytest.raises(ValueError, match=f"{name} was not rendered"):
            getattr(output, name)


@pytest.mark.long
def test_a_stage_without_ssim_takes_small_photographs():
    assert trained(tiny(10), losses=(a2tg.Term(mean_color),)).model.num == 50


def test_an_error_in_shade_names_the_appearance():
    with pytest.raises(ZeroDivisionError) as caught:
        drawn(shaded(lambda u, v: 1 // 0))
    assert_says(" ".join(caught.value.__notes__), "Mine.shade … K = 0 numbers … C = 0 texture values")
    with pytest.raises(jax.errors.TracerBoolConversionError) as branched:
        drawn(shaded(lambda u, v: (None, u) if u > 0 else (None, v)))
    assert_says(" ".join(branched.value.__notes__), "jnp.where instead of if")


MATRIX = np.asarray([[0.2, -0.1], [0.3, 0.1], [-0.2, 0.1]], np.float32)
MIXED = shaded(lambda u, v: (tuple(jnp.asarray(MATRIX) @ jnp.stack([u, v])), None), "Mixed")
MIXED_BY_HAND = shaded(lambda u, v: (tuple(float(a) * u + float(b) * v for a, b in MATRIX), None))
WHOLE = shaded(lambda u, v: ((jnp.stack([u, v]).sum(), u, u), v))
BY_HAND = shaded(lambda u, v: ((u + v, u, u), v))


@pytest.mark.long
def test_a_matrix_product_in_shade_is_composited_by_xla(monkeypatch):
    printed_text = r"the primitive '(stack|broadcast_in_dim)' in Mixed\.shade"
    with pytest.warns(UserWarning, match=rf"Mixed is composited by XLA, which is slower: .*{printed_text}") as caught:
        found = drawn(MIXED, "auto")
    assert caught[0].filename == __file__, "not a line of JAX, which traces"
    by_hand = np.asarray(drawn(MIXED_BY_HAND, "auto"))
    # XLA and the native loops round places on splats differently, where colours rise to 10.
    np.testing.assert_allclose(found, by_hand, rtol=0, atol=3e-6 * np.abs(by_hand).max())
    monkeypatch.setitem(platforms.PLATFORMS, "cuda", "cpu")
    monkeypatch.setattr("a2tg_jax.rasterize.kernels.cuda.nvrtc.find", lambda: True)
    for name in ("native", "cuda"):
        with pytest.raises(
            ValueError, match=rf"compositor='{name}' cannot run Mixed: .*{printed_text}\. Say 'xla', or 'auto'"
        ):
            drawn(MIXED, name)


@pytest.mark.long
@pytest.mark.parametrize(("whole", "by_hand"), [(MIXED, MIXED_BY_HAND), (WHOLE, BY_HAND)], ids=["product", "sum"])
def test_shading_of_scalars_is_applied_pixel_by_pixel(whole, by_hand):
    """A product of matrices fails on arrays of pixels; a sum over them would be one number for all pixels."""
    arguments = Arguments(num_numbers=0, num_values=0, num_colors=3, dtype="float32")
    assert not takes_arrays(StaticShading.of(whole), arguments) and takes_arrays(StaticShading.of(by_hand), arguments)
    functions = elementwise_functions(StaticShading.of(whole), arguments)
    u, v = np.random.default_rng(0).normal(size=(2, 4, 5)).astype(np.float32)

    def total(shade, u, v):
        residual, factor = shade((), (), u, v)[:2]
        return sum(jnp.sum(jnp.sin(color)) for color in residual) + (0 if factor is None else jnp.sum(factor * u))

    found = jax.value_and_grad(total, argnums=(1, 2))(functions.shade, u, v)
    wanted = jax.value_and_grad(total, argnums=(1, 2))(by_hand.shade, u, v)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), found, wanted)
