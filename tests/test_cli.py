"""The command line, from bad input to a whole tiny run that is interrupted and resumed."""

import dataclasses
import hashlib
import importlib.util
import json
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import tomllib
import warnings
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from PIL import Image
from run_folders import create_run
from small_files import taken_apart
from small_models import origin_of

from a2tg_jax import configure_cpu, find_system, load_model, load_ply, save_model
from a2tg_jax.cli import doctor, main as cli
from a2tg_jax.cli.arguments import deciding_options
from a2tg_jax.cli.train import train_defaults
from a2tg_jax.data.load import SceneSource
from a2tg_jax.data.synthetic import BUILT_IN
from a2tg_jax.host import startup
from a2tg_jax.results import finishing, page_export, run_training, stage_training
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.history import read_history
from a2tg_jax.results.model_source import open_source
from a2tg_jax.results.record import read_record, write_record
from a2tg_jax.results.viewing import routes_of
from a2tg_jax.training import SYSTEMS

TINY = [
    *("--system", "a2tg", "--downscale", "5", "--stage1-iterations", "20", "--stage2-iterations", "20", "--baseline"),
    *("--initial-gaussians", "60", "--densify.cap", "60", "--texture.cap", "2", "--texture.at", "0.5"),
    *("--loss.ssim-weight", "0"),
]
"""One upscaling event and few shapes: what takes time is compiling."""
TENSORBOARD = ("--tensorboard",) if importlib.util.find_spec("tensorboardX") else ()


pytestmark = pytest.mark.usefixtures("untouched_jax")


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory):
    """A run interrupted after the first checkpoint of its textures and resumed, with both exit codes."""
    out = tmp_path_factory.mktemp("cli") / "run"
    arguments = ["train", "synthetic", "--out", str(out), *TENSORBOARD]
    save = stage_training.save_checkpoint

    def save_and_interrupt(path, checkpoint):
        save(path, checkpoint)
        if path.name.startswith("a2tg-textures"):
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "configure_cpu", lambda: None)
        patch.setattr(stage_training, "save_checkpoint", save_and_interrupt)
        interrupted = cli.main([*arguments, *TINY])
        patch.undo()
        patch.setattr(cli, "configure_cpu", lambda: None)
        resumed = cli.main(["train", "--out", str(out), "--resume", *TENSORBOARD])
    return RunFolder(out), interrupted, resumed


@pytest.fixture
def run(tiny_run):
    return tiny_run[0]


def fails(capsys, *arguments: str) -> str:
    """Runs a command that must end with code 2, and returns its one line."""
    assert cli.main([str(argument) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("a2tg: error: ") and error.count("\n") == 1
    return error


# Bad input


@pytest.mark.parametrize(
    "mistake",
    [
        ("--texture.select", "budget"),
        ("--lpips-weights", "nowhere.npz"),
        ("--downscale", "0"),
        ("--compare", "a2tg"),
    ],
)
def test_nothing_is_overwritten_before_the_new_run_is_checked(capsys, tmp_path, mistake):
    run = create_run(tmp_path / "run")
    run.own(run.report).write_text("old")
    fails(capsys, "train", "synthetic", "--system", "a2tg", "--out", run.path, "--overwrite", *mistake)
    assert run.report.read_text() == "old"


def test_training_without_a_scene_says_so(capsys, tmp_path):
    assert "SCENE is missing" in fails(capsys, "train", "--out", tmp_path / "run")


def run_python(*words: str, cwd: Path | None = None, **environment: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, **environment}
    return subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, check=False, env=environment, cwd=cwd
    )


def test_a_mistyped_command_is_one_line():
    done = run_python("-m", "a2tg_jax", "trian")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("a2tg: error: ") and done.stderr.count("\n") == 1


SLOW = ("jax", "scipy", "matplotlib")
"""Modules whose import takes tenths of a second."""
ANSWERED_AT_ONCE = (
    "",
    "trian",
    "--help",
    "--version",
    "train nowhere --out new",
    "train --out nowhere --resume",
    "render nowhere --frames 9",
    "convert nowhere.ply out.sog",
    "sfm nowhere scene",
    *(f"{name} --help" for name in cli.COMMANDS if name not in ("train", "download")),
    *(f"{name} --nosuch" for name in cli.COMMANDS if name not in ("train", "download")),
)
"""Words that are answered without JAX."""


def test_words_that_need_no_jax_import_none(tmp_path):
    script = f"""
import sys
from a2tg_jax.cli.main import main
for words in {ANSWERED_AT_ONCE!r}:
    code = main(words.split())
    imported = [name for name in {SLOW!r} if name in sys.modules]
    assert not imported, (words, imported)
    assert code == (0 if words in ("", "--version") or words.endswith("--help") else 2), (words, code)
"""
    done = run_python("-c", script, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]


def test_the_short_help_of_train_precedes_the_import_of_jax():
    script = """
import sys
from a2tg_jax.cli.main import TRAIN_HELP, main
class Output:
    def write(self, text):
        if TRAIN_HELP in text:
            assert "jax" not in sys.modules
            sys.__stdout__.write("first")
    def flush(self): pass
sys.stdout = Output()
assert main(["train", "--help"]) == 0 and "jax" in sys.modules
"""
    done = run_python("-c", script)
    assert (done.returncode, done.stdout) == (0, "first"), done.stderr


def test_built_in_scenes_need_no_folder():
    assert set(BUILT_IN) == cli.BUILT_IN


def test_debugging_shows_the_traceback(tmp_path, monkeypatch):
    monkeypatch.setenv("A2TG_DEBUG", "1")
    with pytest.raises(FileNotFoundError, match="is not a run folder"):
        cli.main(["info", str(tmp_path)])


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_during_the_imports_ends_in_one_line(monkeypatch, capsys, number, code):
    monkeypatch.setattr(cli, "command_class", lambda name: signal.raise_signal(number))
    assert cli.main(["info", "."]) == code and capsys.readouterr().err == "a2tg: interrupted\n"


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="Windows ends a process without asking it")
def test_a_command_that_imported_pycolmap_ends_by_a_signal_with_one_line():
    """pycolmap's import replaces the handlers of signals with some that print a C++ stack."""
    script = """
import sys, time
from a2tg_jax.cli import main as cli, runs
from a2tg_jax.data.colmap_library import pycolmap
runs.Info.run = lambda _: (pycolmap(), print("ready", flush=True), time.sleep(60))
sys.exit(cli.main(["info", "."]))
"""
    process = subprocess.Popen([sys.executable, "-c", script], stdout=-1, stderr=-1, text=True)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    process.terminate()
    assert process.communicate()[1] == "a2tg: interrupted\n" and process.returncode == 128 + signal.SIGTERM


# Help


def test_overview_names_every_command(capsys):
    for arguments in ([], ["--help"]):
        assert cli.main(arguments) == 0
        text = capsys.readouterr().out
        assert all(f"a2tg {name} " in text for name in cli.COMMANDS)
        assert set(SYSTEMS) <= set(re.findall(r"[\w-]+", text))
    assert cli.main(["--version"]) == 0


def help_of(capsys, name: str, *arguments: str) -> str:
    assert cli.main([name, *arguments, "--help-all"]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_of_each_command(capsys, monkeypatch, name):
    monkeypatch.setenv("COLUMNS", "80")
    assert cli.main([name, "--help"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: a2tg {name}") and cli.command_class(name).__doc__.splitlines()[0] in text
    options = re.split(r"\n[│ ]*-", help_of(capsys, name) if name == "train" else text)
    assert len(options) > 1 and all(option.count("(default:") < 2 for option in options)
    assert "None}" not in "".join(options)


def test_the_help_of_training(capsys, monkeypatch):
    """The short one fits on a screen, and every flag that it names exists. The long one fills its lines."""
    assert cli.main(["train", "--help"]) == 0
    text = capsys.readouterr().out
    monkeypatch.setenv("COLUMNS", "100")
    whole = help_of(capsys, "train")
    flags = set(re.findall(r"--[\w.-]*\w", text)) - {"--help", "--help-all"}
    assert text.count("\n") <= 45 and len(flags) > 12
    assert "Defaults of bytewise with the preset paper: --stage1-iterations 30000" in text
    assert cli.main(["train", "--help", "--preset", "quick", "--system", "a2tg"]) == 0
    assert "Defaults of a2tg with the preset quick: --stage1-iterations 1500" in capsys.readouterr().out
    assert flags <= set(re.findall(r"--[\w.-]*\w", whole))
    assert "it needs more. Photographs beyond" in whole
    assert "Adam's learning rates of the Gaussians." in whole, "groups keep their description"
    presets = whole.rpartition("--preset NAME")[2].partition("--on-nan")[0]
    assert all(preset in presets for name in SYSTEMS for preset in find_system(name).presets())


@pytest.mark.parametrize("name", SYSTEMS)
def test_help_lists_the_options_of_a_system(capsys, name):
    text = help_of(capsys, "train", "--system", name)
    assert ("--densify.threshold" in text) == (name in ("gaussians-2d", "supergaussians"))
    assert ("--texture-side" in text) == (name == "textured-gaussians")
    assert ("--lookup.uv" in text) == (name in ("textured-gaussians", "a2tg", "bytewise"))
    assert ("--billboard.side" in text) == (name == "bbsplat")


# Configuration files


FILE = """
scene = "synthetic"
downscale = 2
system = "textured-gaussians"
preset = "quick"
compare = ["gaussians-2d-mcmc"]
[options]
texture_side = 2
"""


def parsed_with_file(folder, text: str, *flags: str):
    (folder / "mine.toml").write_text(text)
    return cli.parsed("train", ["--config", str(folder / "mine.toml"), "--out", "run", *flags])


def test_flags_win_over_the_file(tmp_path):
    said = parsed_with_file(tmp_path, FILE)
    assert said.record.scene == SceneSource("synthetic", downscale=2)
    assert (said.record.options.texture_side, said.record.options.stage1_iterations) == (2, 2_000)
    won = parsed_with_file(tmp_path, FILE, "--texture-side", "3", "--downscale", "1", "--compare", "gaussians-2d")
    options = won.record.options
    assert (options.texture_side, options.stage1_iterations, won.record.scene.downscale) == (3, 2_000, 1)
    assert won.record.compare == ("gaussians-2d-mcmc", "gaussians-2d")
    other_preset = parsed_with_file(tmp_path, FILE, "--preset", "paper").record.options
    assert (other_preset.texture_side, other_preset.stage1_iterations) == (4, 30_000)
    other_system = parsed_with_file(tmp_path, FILE, "--system", "gaussians-2d")
    assert (other_system.record.system, other_system.record.options.stage1_iterations) == ("gaussians-2d", 30_000)


def test_own_systems_are_found_in_the_current_directory(tmp_path, monkeypatch):
    (tmp_path / "systems_of_mine.py").write_text(
        "import dataclasses\n"
        "from a2tg_jax.adapt import Upscale\nfrom a2tg_jax.systems.a2tg import A2tg\n"
        "@dataclasses.dataclass(frozen=True, kw_only=True)\n"
        "class Mine(A2tg):\n"
        "    strength: float = 2.0\n"
        "VARIANT = Mine(texture=Upscale(cap=8))\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert cli.main(["info", "nowhere"]) == 2
    arguments = ("scene", "--out", "run", "--preset", "quick", "--strength", "3")
    own = cli.parsed("train", [*arguments, "--system", "systems_of_mine:Mine"]).record.options
    assert (type(own).__name__, own.strength, own.densify.cap, own.texture.cap) == ("Mine", 3.0, 10_000, 4)
    variant = cli.parsed("train", [*arguments, "--system", "systems_of_mine:VARIANT"]).record.options
    assert (variant.strength, variant.densify.cap, variant.texture.cap) == (3.0, 10_000, 8)


# Settings of JAX


KEPT_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000"
WIDE = "--xla_cpu_prefer_vector_width=512"


@pytest.mark.parametrize(
    ("version", "features", "flags"),
    [
        ((0, 12), {"avx512f"}, [KEPT_LOOPS, WIDE]),
        ((0, 11), set(), [KEPT_LOOPS]),
        ((0, 10), {"avx512f"}, [KEPT_LOOPS, WIDE, "--xla_cpu_use_fusion_emitters=false"]),
        ((9, 9), {"avx512f"}, []),
    ],
)
def test_flags_of_xla(monkeypatch, version, features, flags):
    """They fit the processor and the version; the user's own stay."""
    monkeypatch.setattr(startup, "processor_features", lambda: frozenset(features))
    monkeypatch.setattr(jax, "__version_info__", (*version, 0))
    for given, added in (("--xla_dump_to=x", flags), (f"{WIDE[:-3]}256", [flag for flag in flags if flag != WIDE])):
        monkeypatch.setenv("XLA_FLAGS", given)
        configure_cpu(use_cache=False)
        assert os.environ["XLA_FLAGS"].split() == [given, *added]


CACHED = """
import logging, jax
from a2tg_jax.host import startup
before = jax.config.values["jax_logging_level"], logging.getLogger("jax").level
startup.configure_cpu()
jax.jit(lambda x: jax.numpy.sort(x) @ x)(jax.numpy.ones((9, 9))).block_until_ready()
assert (jax.config.values["jax_logging_level"], logging.getLogger("jax").level) == before
print("kept" if jax.config.values["jax_compilation_cache_dir"] else "no cache")
"""


@pytest.mark.long
def test_programs_are_kept_and_read_again_in_silence(tmp_path, monkeypatch):
    """In a program that has imported JAX already, on any processor. XLA accepts our flags, or it would end there."""
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL", raising=False)
    counts = []
    for _ in range(2):
        done = run_python("-c", CACHED, XDG_CACHE_HOME=str(tmp_path), XLA_FLAGS="")
        assert (done.returncode, done.stdout, done.stderr) == (0, "kept\n", "")
        counts.append(len([path for path in tmp_path.rglob("*") if path.name.endswith("-cache")]))
    assert counts[0] == counts[1] > 0


@pytest.fixture
def no_cache():
    """JAX keeps no programs on disk, whatever commands of this process asked for before."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    jax.config.update("jax_compilation_cache_dir", folder)


@pytest.mark.usefixtures("no_cache")
def test_a_user_who_asks_for_the_log_gets_it(monkeypatch):
    asked = []
    monkeypatch.setattr(startup, "processor_features", lambda: frozenset({"avx512f"}))
    monkeypatch.setattr(jax, "__version_info__", (0, 11, 0))
    monkeypatch.setenv("XLA_FLAGS", os.environ["XLA_FLAGS"])
    with monkeypatch.context() as patch:
        patch.setattr(jax.config, "update", lambda *given: asked.append(given))
        patch.setenv("TF_CPP_MIN_LOG_LEVEL", "0")
        configure_cpu()
        assert [name for name, _ in asked] == [
            "jax_compilation_cache_dir",
            "jax_persistent_cache_min_compile_time_secs",
        ]
        patch.setenv("TF_CPP_MIN_LOG_LEVEL", "1")
        configure_cpu()
        assert asked[4:] == [("jax_logging_level", "CRITICAL"), ("jax_logging_level", "NOTSET")]


# A whole run


def test_interrupted_and_resumed(run, tiny_run):
    assert tiny_run[1:] == (130, 0)
    assert not any(run.checkpoints(name) for name in read_record(run).plan.names)
    assert tomllib.loads(run.record.read_text())["options"]["densify"]["cap"] == 60


@pytest.mark.long
def test_interruption_changes_nothing(run, tmp_path):
    """An interrupted run is bit for bit one that was not; run.toml repeats it."""
    again = RunFolder(tmp_path / "again")
    assert cli.main(["train", "--config", str(run.record), "--out", str(again.path)]) == 0
    assert read_record(again) == read_record(run)
    for path in (run.path / "models").iterdir():
        with np.load(path) as model, np.load(again.model(path.stem)) as other:
            assert model.files == other.files
            for name in model.files:
                np.testing.assert_array_equal(model[name], other[name])


def test_an_interrupted_run_says_how_to_continue(run, tmp_path, monkeypatch, capsys):
    copy = RunFolder(shutil.copytree(run.path, tmp_path / "copy"))
    copy.model("gaussians-2d-mcmc-continued").write_bytes(b"PK")
    assert "continued.npz: is not an a2tg-jax model, or is damaged" in fails(capsys, "eval", copy.path)
    copy.model("gaussians-2d-mcmc-continued").unlink()

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    assert "--resume" in fails(capsys, "demo", "--out", copy.path)
    monkeypatch.setattr(run_training, "fit_stage", interrupt)
    for words in (["train", "--out", str(copy.path), "--resume"], ["demo", "--out", str(copy.path), "--resume"]):
        assert cli.main(words) == 130
        error = capsys.readouterr().err
        shows = f"show it with: a2tg view {copy.path} --model a2tg-textures"
        continues = f"continue with: a2tg train --out {copy.path} --resume (add --finish-now to finish soon)"
        assert f"a2tg-textures.npz; {shows}; {continues}" in error


def test_run_folder_is_complete(run):
    metrics = json.loads(run.metrics.read_text())
    assert list(metrics["models"]) == ["a2tg-gaussians", "a2tg-textures", "gaussians-2d-mcmc-continued"]
    main, other = metrics["models"]["a2tg-textures"], metrics["models"]["gaussians-2d-mcmc-continued"]
    assert main["num_gaussians"] == 60 and main["num_texels"] > 60
    assert main["num_bytes"] == 232 * 60 + 16 * main["num_texels"]
    gain = main["test"]["psnr"] - other["test"]["psnr"]
    assert metrics["gains_db"] == pytest.approx({"gaussians-2d-mcmc-continued": gain})
    for name in ("curves", "sizes", "resolutions", "textures", "depth", "normals"):
        assert (run.figures / f"{name}.png").is_file()
    assert len(list(run.test.glob("*.png"))) == main["test"]["views"]
    assert load_ply(run.point_cloud).num == 60
    assert "http" not in run.report.read_text(encoding="utf-8").replace("http-equiv", "")
    assert '<a href="viewer.html">' in run.report.read_text(encoding="utf-8")
    assert 'id="scene-data"' in run.viewer.read_text(encoding="utf-8")


@pytest.mark.skipif(not TENSORBOARD, reason="the extra [tensorboard] is not installed")
def test_tensorboard_has_the_rows_of_the_histories_once(run):
    from run_folders import tensorboard_scalars as scalars

    found = scalars(run.tensorboard)
    for name in ("a2tg-gaussians", "a2tg-textures", "gaussians-2d-mcmc-continued"):
        history = read_history(run.history(name))
        steps, values = zip(*found[f"psnr/{name}"], strict=True)
        assert [*steps] == history.iteration.tolist()
        np.testing.assert_allclose(values, history.psnr, rtol=1e-6)


def test_info(run, capsys):
    assert cli.main(["info", str(run.path)]) == 0
    text = capsys.readouterr().out
    assert f"a2tg train --config {run.record} --out" in text and "60 Gaussians" in text and "1×1: " in text


@pytest.mark.long
def test_validation_views_replace_test_views(run, tmp_path, capsys):
    """No figure of a run for choosing is of a test view, and each says of which views it is."""
    copy = RunFolder(shutil.copytree(run.path, tmp_path / "copy"))
    record = dataclasses.replace(read_record(run), scene=SceneSource("synthetic", 5, validation=True))
    write_record(copy, record)
    given = deciding_options(["--config", str(copy.record)])
    assert read_record(copy) == record and train_defaults(given).record.scene.validation
    assert cli.main(["eval", str(copy.path)]) == 2
    assert "was trained on 3 views that synthetic now holds out" in capsys.readouterr().err
    origin = origin_of(record.scene.load())
    for file in (copy.path / "models").glob("*.npz"):
        save_model(file, dataclasses.replace(load_model(file), origin=origin))
    assert cli.main(["eval", str(copy.path)]) == 0
    assert "validation PSNR (dB)" in capsys.readouterr().out
    per_view = json.loads(copy.per_view.read_text())["a2tg-textures"]
    whole = json.loads(run.per_view.read_text())["a2tg-textures"]
    assert per_view.keys() == {"train", "validation"}
    assert list(per_view["validation"]) == list(whole["train"])[::8]
    assert per_view["train"].keys() == whole["train"].keys() - per_view["validation"].keys()
    report = copy.report.read_text(encoding="utf-8")
    assert "held out for validation" in report and "validation views: PSNR" in report and "test views" not in report
    assert cli.main(["info", str(copy.path)]) == 0
    assert "; validation " in capsys.readouterr().out


def test_render(run, tmp_path, monkeypatch, capsys):
    """Frames of both kinds, without the scene; ffmpeg is a stand-in that writes its arguments into the last one."""
    monkeypatch.delattr(SceneSource, "load")
    program = tmp_path / "bin" / "ffmpeg"
    program.parent.mkdir()
    program.write_text('#!/bin/sh\nfor last; do :; done\necho "$PWD: $@" > "$last"\n')
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    assert cli.main(["render", str(run.path), "--frames", "3", "--fps", "12"]) == 0
    frames = sorted((run.path / "frames").glob("*.png"))
    assert [path.name for path in frames] == [f"frame_{index:04d}.png" for index in range(3)]
    words = (run.path / "frames" / "flight.mp4").read_text()
    assert all(pair in words for pair in ("-framerate 12.0 ", "-frames:v 3 ", "-i frame_%04d.png "))
    assert words.startswith(f"{run.path}/frames: "), "ffmpeg would take a % in the folder's name for a number"
    assert "right=0:bottom=0:mode=smear" in words
    with Image.open(frames[0]) as frame:
        assert frame.width * frame.height == pytest.approx(1280 * 720, rel=0.01) and np.asarray(frame).std() > 1
    assert cli.main(["render", str(run.path), "--path", "test", "--out", str(tmp_path / "test")]) == 0
    assert len(list((tmp_path / "test").glob("*.png"))) == len(list(run.test.glob("*.png")))
    capsys.readouterr()
    assert "the run has the models a2tg-gaussians, " in fails(capsys, "render", run.path, "--model", "stage2")


def test_render_a_path_saved_in_the_viewer(run, tmp_path, capsys):
    view = {"viewmat": np.eye(4).ravel().tolist(), "K": [20, 0, 10, 0, 20, 8, 0, 0, 1], "size": [20, 16]}
    path, out = tmp_path / "path.json", tmp_path / "out"
    to = ("--out", str(out))
    path.write_text(json.dumps({"format": "a2tg-jax path", "version": 1, "views": [view, view]}))
    assert cli.main(["render", str(run.path), "--path", str(path), "--frames", "2", "--size", "20x16", *to]) == 0
    with Image.open(out / "frame_0001.png") as frame:
        assert frame.size == (20, 16)
    assert f"wrote 2 frames to {out}/\n" in capsys.readouterr().out


@pytest.mark.long
def test_export_and_what_view_would_serve(run, tmp_path, monkeypatch, capsys):
    """With the run's photographs; a model of the run by its name."""
    assert cli.main(["export", str(run.path), "--web", str(tmp_path / "site"), "--photographs"]) == 0
    assert re.search(r"\d\.\d{3} dB of PSNR (lost|gained), test views\n", capsys.readouterr().out)
    listed = json.loads((tmp_path / "site" / "photographs.json").read_text())
    assert listed and len(list((tmp_path / "site" / "photographs").glob("*.jpg"))) == len(listed)
    (tmp_path / "site" / "photographs" / "mine.jpg").touch()
    monkeypatch.setattr(page_export, "loss_measures", lambda *a: {})
    assert cli.main(["export", str(run.path), "--web", str(tmp_path / "site"), "--overwrite"]) == 0
    assert [path.name for path in (tmp_path / "site" / "photographs").iterdir()] == ["mine.jpg"]
    routes = routes_of(open_source(run.path, "a2tg-gaussians"))
    assert "sizes" not in taken_apart(routes["/scene.a2tgz"].read())[0]
    assert json.loads(routes["/photographs.json"].read()) == listed


def test_export_for_other_programs(run, tmp_path, capsys):
    """Flat 3D Gaussians, which this program's reader takes for what they were; so is the run's own point cloud."""
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert cli.main(["convert", str(run.path), str(tmp_path / "new" / "fox.ply")]) == 0
    printed, error = capsys.readouterr()
    assert f"a2tg: warning: {tmp_path / 'new'} does not exist and will be made\n" in error
    assert "fox.ply: 60 Gaussians" in printed
    assert "not kept by this format: textures (bake turns them into plain splats)" in printed
    for path in (tmp_path / "new" / "fox.ply", run.point_cloud):
        assert b"property float scale_2\n" in path.read_bytes()
        assert load_ply(path).num == 60


@pytest.mark.long
def test_finish(run, tmp_path, monkeypatch, capsys):
    """A new run folder, evaluated; the old run does not change. Both steps are stand-ins."""
    kept = {path: path.read_bytes() for path in (run.record, run.metrics, run.model("a2tg-textures"))}
    small, asked = load_model(run.model("a2tg-gaussians")), []

    def shrink(model, views, *, max_loss):
        asked.append((max_loss, {view.name for view in views}))
        return small

    def polish(model, views, *, num_steps):
        asked.append((num_steps, {view.name for view in views}))
        return model

    monkeypatch.setattr(finishing, "shrink_textures", shrink)
    monkeypatch.setattr(finishing, "polish", polish)
    new = RunFolder(tmp_path / "new")
    command = ["finish", str(run.path), "--out", str(new.path), "--max-loss", "0.5", "--polish-steps", "2"]
    assert cli.main(command) == 0
    names = {view.name for view in read_record(run).scene.load().train}
    assert [number for number, _ in asked] == [0.5, 2] and asked[0][1] <= names == asked[1][1]
    assert {path: path.read_bytes() for path in kept} == kept
    title, sizes, train, *_ = capsys.readouterr().out.splitlines()
    old = load_model(run.model("a2tg-textures"))
    assert title.split() == ["before", "shrunk", "polished"]
    assert sizes.split()[1:] == [f"{model.num_bytes:,}" for model in (old, small, small)]
    before, after = (json.loads(folder.metrics.read_text())["models"] for folder in (run, new))
    psnrs = [before["a2tg-textures"], before["a2tg-gaussians"], after["a2tg-textures"]]
    assert train.split()[3:] == [f"{found['train']['psnr']:.2f}" for found in psnrs]
    assert after["a2tg-textures"]["num_bytes"] == load_model(new.model("a2tg-textures")).num_bytes == small.num_bytes
    assert after["gaussians-2d-mcmc-continued"]["sha256"] == before["gaussians-2d-mcmc-continued"]["sha256"]
    assert (
        json.loads(new.finish.read_text())["sha256"]
        == hashlib.sha256(run.model("a2tg-textures").read_bytes()).hexdigest()
    )
    assert read_record(new) == read_record(run) and set(new.written()) >= {"finish.json", "report.html"}
    again = f"a2tg finish {new.path}-trained --out {new.path}-again --max-loss=0.5 --polish-steps=2"
    assert again in new.record.read_text()
    assert cli.main(["info", str(new.path)]) == 0 and again in capsys.readouterr().out
    assert "is not empty" in fails(capsys, *command)


@pytest.mark.parametrize("killed_in", ["write_json", "write_record", "evaluate_run"])
def test_a_killed_finish_continues_with_the_same_command(run, tmp_path, monkeypatch, capsys, killed_in):
    """From the evaluation on, once the model is written; a finish with other options does not continue there."""
    polished, new = [], RunFolder(tmp_path / "new")
    monkeypatch.setattr(SceneSource, "load", lambda self: SimpleNamespace(train=()))
    monkeypatch.setattr(finishing, "_measured", lambda model, *_: finishing.Measured(model, 20.0, None))
    monkeypatch.setattr(finishing, "polish", lambda model, *_, **__: polished.append(1) or model)
    monkeypatch.setattr(finishing, "evaluate_run", lambda run, *_, **__: run.own(run.report).touch())
    command = ["finish", str(run.path), "--out", str(new.path), "--max-loss", "0"]

    def stop(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(finishing, killed_in, stop)
        assert cli.main(command) == 130 and capsys.readouterr().err.endswith("a2tg: interrupted\n")
        new.finish.with_name(".finish.json.1.partial").touch()
        if killed_in != "write_json":
            assert "is not empty; choose another --out" in fails(capsys, *command, "--polish-steps", "2")
        (new.path / "mine.txt").touch()
        if killed_in == "write_json":
            (new.path / "mine.txt").unlink()
    assert cli.main(command) == 0 and len(polished) == (1 if killed_in == "evaluate_run" else 2)
    assert (new.path / "mine.txt").exists() is (killed_in != "write_json")
    assert load_model(new.model("a2tg-textures")).num_bytes == load_model(run.model("a2tg-textures")).num_bytes
    assert read_record(new) == read_record(run) and not list(new.path.glob(".*.partial"))
    capsys.readouterr()  # Its progress.
    assert "is not empty; choose another --out" in fails(capsys, *command)


def test_an_overtaken_finish_deletes_nothing(run, tmp_path, monkeypatch, capsys):
    """Another process finishes in the same folder while this one loads the scene."""
    new, command = RunFolder(tmp_path / "new"), ["finish", str(run.path), "--out", str(tmp_path / "new")]
    loads = [lambda: None, lambda: cli.main(command), lambda: None]

    def load(self):
        loads.pop(0)()
        return SimpleNamespace(train=())

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(SceneSource, "load", load)
    monkeypatch.setattr(finishing, "_measured", lambda model, *_: finishing.Measured(model, 20.0, None))
    monkeypatch.setattr(finishing, "_changed", lambda model, *_: iter([("polished", model)]))
    monkeypatch.setattr(finishing, "evaluate_run", lambda run, *_, **__: run.own(run.report).touch())
    with monkeypatch.context() as patch:
        patch.setattr(finishing, "write_record", stop)
        assert cli.main(command) == 130
    capsys.readouterr()
    assert "is not empty; choose another --out" in fails(capsys, *command)
    assert new.report.is_file() and new.model("a2tg-textures").is_file() and not loads


def test_a_step_that_loses_quality_is_left_out():
    def steps(*psnrs):
        return {name: finishing.Measured(None, psnr, None) for name, psnr in psnrs}

    assert finishing.kept_step(steps(("before", 20.0), ("shrunk", 19.9), ("polished", 20.1))) == "polished"
    assert finishing.kept_step(steps(("before", 20.0), ("shrunk", 19.9), ("polished", 19.8))) == "shrunk"
    assert finishing.kept_step(steps(("before", 20.0), ("shrunk", 19.9))) == "shrunk"


def test_flights_without_ffmpeg(run, tmp_path, monkeypatch, capsys):
    """They become an animation. A shorter flight leaves no frames of a longer one, and other files stay."""
    monkeypatch.setattr(shutil, "which", lambda name: None)
    others = {"frame_00003.png", "frame_3.png", "frame_0003.jpg", "my_frame_0003.png"}
    for name in others:
        (tmp_path / name).touch()
    command = ["render", str(run.path), "--out", str(tmp_path), "--size", "48x20", "--fps", "8", "--frames"]
    for num, names in ((4, others | {"frame_0002.png", "frame_0003.png"}), (2, others)):
        assert cli.main([*command, str(num)]) == 0
        made = {"frame_0000.png", "frame_0001.png", "flight.webp", ".a2tg-frames"}
        assert {path.name for path in tmp_path.iterdir()} == names | made
    printed = capsys.readouterr().out
    assert (
        "no video: ffmpeg is not installed; install it" in printed
        and f"animation: {tmp_path / 'flight.webp'}" in printed
    )
    with Image.open(tmp_path / "flight.webp") as animation:
        assert (animation.size, animation.n_frames) == ((48, 20), 2)
        animation.seek(1)
        animation.load()
        assert animation.info["duration"] == 125


@pytest.mark.parametrize("name", ["frame_0001.png", "flight.webp"])
def test_render_replaces_only_what_it_wrote(run, tmp_path, monkeypatch, capsys, name):
    """Files of somebody else stay, unless overwriting is allowed."""
    monkeypatch.setattr(shutil, "which", lambda name: None)
    command = ["render", str(run.path), "--frames", "2", "--out", str(tmp_path), "--size", "12x8"]
    (tmp_path / "frame_0007.png").write_text("mine")
    (tmp_path / name).write_text("mine")
    assert f"{name} exists; add --overwrite to replace it, or choose another --out" in fails(capsys, *command)
    assert {path.name for path in tmp_path.iterdir()} == {name, "frame_0007.png"}
    assert (tmp_path / name).read_text() == "mine"
    assert cli.main([*command, "--overwrite"]) == 0 and cli.main(command) == 0
    assert (tmp_path / "frame_0007.png").read_text() == "mine"


@pytest.mark.long
def test_doctor_compares_the_compositors(capsys, monkeypatch):
    assert cli.main(["doctor"]) == 0
    printed = capsys.readouterr().out
    assert f"jax {jax.__version__}" in printed and re.search(r"native: .* at most \de-\d\d from XLA's image", printed)
    assert "cuda is not available: it needs JAX on an NVIDIA GPU" in printed
    assert "devices     the CPU\n" in printed and re.search(r"memory +[\d.]+ GB may be used\n", printed)
    assert printed.splitlines()[-1].split(maxsplit=1) == ["verdict", "everything works on this machine"]
    assert "but on the CPU" in doctor._verdict("cpu", {}, has_driver=True)
    assert "but slowly: native is not available" in doctor._verdict("cpu", {"native": "…"}, has_driver=False)
    monkeypatch.setattr(doctor, "_compare", lambda available: float("inf"))
    assert "the compositors differ by inf" in fails(capsys, "doctor")


def test_help_into_a_closed_pipe_ends_in_silence():
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "a2tg_jax", "--help"]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")
