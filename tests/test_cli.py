"""The command line, from bad input to a whole tiny run that is interrupted and resumed."""

import json
import os
import shutil
import stat
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from a2tg_jax import cli, startup
from a2tg_jax.io.ply import load_ply
from a2tg_jax.results import train_run as train_run_module
from a2tg_jax.results.folder import RunFolder

TINY = [
    *("--downscale", "5", "--stage1-iterations", "20", "--stage2-iterations", "20", "--baseline"),
    *("--initial-gaussians", "60", "--densify.cap", "60", "--texture.cap", "2", "--texture.upscale-at", "0.5"),
]
"""One upscaling event and few shapes: what takes time is compiling."""


@pytest.fixture(autouse=True)
def untouched_jax(monkeypatch):
    """The tests' process keeps its flags, and runs have no terminal to draw a progress bar on."""
    monkeypatch.setattr(cli, "configure_cpu", lambda: None)


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory):
    """A run interrupted after the first checkpoint of stage 2 and resumed, with both exit codes and messages."""
    out = tmp_path_factory.mktemp("cli") / "run"
    arguments = ["train", "synthetic", "--out", str(out)]
    save = train_run_module.save_checkpoint

    def save_and_interrupt(path, checkpoint):
        save(path, checkpoint)
        if path.name.startswith("stage2"):
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "configure_cpu", lambda: None)
        patch.setattr(train_run_module, "save_checkpoint", save_and_interrupt)
        interrupted = cli.main([*arguments, *TINY])
        patch.undo()
        patch.setattr(cli, "configure_cpu", lambda: None)
        resumed = cli.main([*arguments, "--resume"])
    return RunFolder(out), interrupted, resumed


def fails(capsys, *arguments: str) -> str:
    """Runs a command that must end with code 2, and returns its one line."""
    assert cli.main([str(argument) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("a2tg: error: ") and error.count("\n") == 1
    return error


# Bad input


def test_unknown_command(capsys):
    assert "no command 'trian'; the commands are demo, train" in fails(capsys, "trian")


@pytest.mark.parametrize("command", ["eval", "render", "info"])
def test_no_run_folder(capsys, tmp_path, command):
    assert "is not a run folder" in fails(capsys, command, tmp_path)


def test_no_scene_makes_no_run_folder(capsys, tmp_path):
    assert "nowhere" in fails(capsys, "train", tmp_path / "nowhere", "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_used_folder_is_refused(capsys, tmp_path):
    (tmp_path / "photo.jpg").touch()
    assert "is not empty; add --resume" in fails(capsys, "train", "synthetic", "--out", tmp_path)
    assert "is not empty" in fails(capsys, "demo", "--out", tmp_path)


def test_resume_and_overwrite_exclude_each_other(capsys, tmp_path):
    assert "give one of them" in fails(capsys, "train", "synthetic", "--out", tmp_path, "--resume", "--overwrite")


def test_no_photographs(capsys, tmp_path):
    assert "photos" in fails(capsys, "sfm", tmp_path / "photos", tmp_path / "scene")


def test_error_in_a_process_of_its_own(tmp_path):
    """Exit code and one line are what a shell sees; A2TG_DEBUG adds the traceback."""
    command = [sys.executable, "-m", "a2tg_jax.cli", "info", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("a2tg: error: ") and done.stderr.count("\n") == 1
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, "A2TG_DEBUG": "1"})
    assert done.returncode == 1 and "Traceback" in done.stderr


# Help


def test_overview_names_every_command(capsys):
    for arguments in ([], ["--help"]):
        assert cli.main(arguments) == 0
        text = capsys.readouterr().out
        assert all(f"a2tg {name} " in text for name in cli.COMMANDS)
    assert cli.main(["--version"]) == 0


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_of_each_command(capsys, name):
    with pytest.raises(SystemExit) as raised:
        cli.main([name, "--help"])
    text = capsys.readouterr().out
    assert raised.value.code == 0
    assert text.startswith(f"usage: a2tg {name}") and cli.COMMANDS[name].__doc__.splitlines()[0] in text


def test_preset_decides_the_defaults_of_the_numbers():
    for preset, iterations in (("quick", 2_000), ("paper", 30_000)):
        for flag in (["--preset", preset], [f"--preset={preset}"]):
            command = cli._parse("train", ["scene", "--out", "run", *flag, "--texture.cap", "8"])
            assert (command.config.stage1_iterations, command.config.texture.cap) == (iterations, 8)


# Settings of JAX


def test_a_wrong_number_of_threads_is_one_clear_line(monkeypatch, capsys):
    monkeypatch.setenv("A2TG_NUM_THREADS", "many")
    monkeypatch.setattr(cli, "configure_cpu", startup.configure_cpu)
    assert cli.main(["info", "nowhere"]) == 2
    assert "A2TG_NUM_THREADS must be a positive integer; got 'many'" in capsys.readouterr().err


def test_users_own_flags_stay(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_prefer_vector_width=256 --xla_dump_to=x")
    startup.add_xla_flags(("--xla_cpu_prefer_vector_width=512", "--xla_other=1"))
    assert os.environ["XLA_FLAGS"] == "--xla_cpu_prefer_vector_width=256 --xla_dump_to=x --xla_other=1"


def test_flags_fit_the_processor_and_the_version():
    avx512 = frozenset({"avx512f"})
    assert startup.cpu_flags(avx512, (0, 10)) == (startup.WHOLE_LOOPS_FLAG, startup.WIDE_VECTORS_FLAG)
    assert startup.cpu_flags(frozenset(), (0, 10)) == (startup.WHOLE_LOOPS_FLAG,)
    assert startup.cpu_flags(avx512, (0, 12)) == startup.cpu_flags(avx512, (0, 10))
    assert startup.cpu_flags(avx512, (9, 9)) == ()


def test_xla_accepts_the_flags():
    """A flag that this jaxlib does not have would end the process."""
    script = "from a2tg_jax.startup import configure_cpu; configure_cpu(); import jax; jax.numpy.ones(3).sum()"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


CACHED = """
import logging, jax
from a2tg_jax import startup
before = jax.config.values["jax_logging_level"], logging.getLogger("jax").level
startup.configure_cpu()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.jit(lambda x: jax.numpy.sort(x) @ x)(jax.numpy.ones((9, 9))).block_until_ready()
assert (jax.config.values["jax_logging_level"], logging.getLogger("jax").level) == before
print("kept" if jax.config.values["jax_compilation_cache_dir"] else "no cache")
"""


def test_programs_are_kept_and_read_again_in_silence(tmp_path):
    """In a program that has imported JAX already, on any processor."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "XLA_FLAGS": ""}
    environment.pop("TF_CPP_MIN_LOG_LEVEL", None)
    counts = []
    for _ in range(2):
        command = [sys.executable, "-c", CACHED]
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
        assert (done.stdout, done.stderr) == ("kept\n", "")
        counts.append(len([path for path in tmp_path.rglob("*") if path.name.endswith("-cache")]))
    assert counts[0] == counts[1] > 0


def test_a_user_who_asks_for_the_log_gets_it(monkeypatch):
    asked = []
    monkeypatch.setattr(startup.jax.config, "update", lambda *given: asked.append(given))
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "0")
    startup.silence_xla()
    assert not asked
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "1")
    startup.silence_xla()
    assert asked == [("jax_logging_level", "CRITICAL"), ("jax_logging_level", "NOTSET")]


# A whole run


def test_interrupted_and_resumed(tiny_run):
    run, interrupted, resumed = tiny_run
    assert (interrupted, resumed) == (130, 0)
    assert len(run.checkpoints("stage2")) == 2
    assert json.loads(run.config.read_text())["config"]["densify"]["cap"] == 60


def test_run_folder_is_complete(tiny_run):
    run, *_ = tiny_run
    metrics = json.loads(run.metrics.read_text())
    assert list(metrics["phases"]) == ["stage1", "stage2", "baseline"]
    stage2 = metrics["phases"]["stage2"]
    assert stage2["num_gaussians"] == 60 and stage2["num_texels"] > 60
    assert stage2["megabytes"] == pytest.approx((232 * 60 + 16 * stage2["num_texels"]) / 1e6)
    assert metrics["gain_db"] == pytest.approx(stage2["test"]["psnr"] - metrics["phases"]["baseline"]["test"]["psnr"])
    for name in ("curves", "sizes", "resolutions"):
        assert (run.figures / f"{name}.png").is_file()
    assert len(list(run.test.glob("*.png"))) == stage2["test"]["views"]
    assert load_ply(run.point_cloud).num == 60
    assert "http" not in run.report.read_text(encoding="utf-8")


def test_info(tiny_run, capsys):
    run, *_ = tiny_run
    assert cli.main(["info", str(run.path)]) == 0
    text = capsys.readouterr().out
    assert "a2tg train synthetic --out" in text and "60 Gaussians" in text and "1×1: " in text


def test_finished_run_resumes_to_the_same_metrics(tiny_run, capsys):
    run, *_ = tiny_run
    before = json.loads(run.metrics.read_text())["phases"]["stage2"]["test"]
    assert cli.main(["eval", str(run.path)]) == 0
    assert "stage 2, textured" in capsys.readouterr().out
    assert json.loads(run.metrics.read_text())["phases"]["stage2"]["test"] == before


def test_resume_refuses_other_numbers(tiny_run, capsys):
    run, *_ = tiny_run
    again = ("train", "synthetic", "--out", run.path, "--resume")
    assert "leave out --texture.k-a" in fails(capsys, *again, "--texture.k-a", "9")
    assert "was trained on synthetic" in fails(capsys, "train", run.path, "--out", run.path, "--resume")


def test_damaged_model_is_one_clear_line(tiny_run, capsys, tmp_path):
    run, *_ = tiny_run
    copy = RunFolder(shutil.copytree(run.path, tmp_path / "copy"))
    copy.model("stage2").write_bytes(b"PK")
    assert "stage2.npz: is not an a2tg-jax model, or is damaged" in fails(capsys, "eval", copy.path)


def test_render(tiny_run, tmp_path, monkeypatch, capsys):
    """Frames of both kinds; ffmpeg is a stand-in that writes its last argument."""
    run, *_ = tiny_run
    program = tmp_path / "bin" / "ffmpeg"
    program.parent.mkdir()
    program.write_text('#!/bin/sh\nfor last; do :; done\necho video > "$last"\n')
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    assert cli.main(["render", str(run.path), "--frames", "3"]) == 0
    frames = sorted((run.path / "frames").glob("*.png"))
    assert [path.name for path in frames] == [f"frame_{index:04d}.png" for index in range(3)]
    assert (run.path / "frames" / "flight.mp4").read_text() == "video\n"
    assert np.asarray(Image.open(frames[0])).std() > 1
    assert cli.main(["render", str(run.path), "--path", "test", "--out", str(tmp_path / "test")]) == 0
    assert len(list((tmp_path / "test").glob("*.png"))) == len(list(run.test.glob("*.png")))


def test_render_without_ffmpeg_says_so(tiny_run, tmp_path, monkeypatch, capsys):
    run, *_ = tiny_run
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert cli.main(["render", str(run.path), "--frames", "1", "--out", str(tmp_path)]) == 0
    assert "no video: ffmpeg is not installed" in capsys.readouterr().out
