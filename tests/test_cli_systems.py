"""The command line on a custom system, a file in the current folder."""

import json
import re
import shutil
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from a2tg_jax.cli import main as cli
from a2tg_jax.results import stage_training
from a2tg_jax.results.folder import RunFolder

pytestmark = pytest.mark.long
TOY = Path(__file__).with_name("toy_system.py")
MINE = ["--system", "my_toy:Toy"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a system in my_toy.py, and a run that was interrupted at its first checkpoint and resumed."""
    folder = tmp_path_factory.mktemp("mine")
    shutil.copy(TOY, folder / "my_toy.py")
    save = stage_training.save_checkpoint

    def save_and_interrupt(path, checkpoint):
        save(path, checkpoint)
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", list(sys.path))
        patch.setattr(cli, "configure_cpu", lambda: None)
        with pytest.MonkeyPatch.context() as interrupting:
            interrupting.setattr(stage_training, "save_checkpoint", save_and_interrupt)
            sizes = ["--downscale", "6", "--initial-gaussians", "60", "--stage1-iterations", "10"]
            codes = [cli.main(["train", "synthetic", *MINE, "--out", "run", *sizes, "--contrast-weight", "0.2"])]
        shutil.copytree("run", "interrupted")
        left = [path.name for path in RunFolder(Path("run")).checkpoints("Toy-rings")]
        codes.append(cli.main(["train", "--out", "run", "--resume"]))
        yield folder, codes, left
    sys.modules.pop("my_toy", None)


@pytest.fixture
def inside(folder, monkeypatch):
    """The run, seen from the folder with the system."""
    monkeypatch.chdir(folder[0])
    monkeypatch.setattr(cli, "configure_cpu", lambda: None)
    return RunFolder(Path("run"))


def test_interrupted_and_resumed(folder, inside):
    _, codes, left = folder
    assert codes == [130, 0]
    assert left == ["Toy-rings-0000000001.npz"]
    record = tomllib.loads(inside.record.read_text())
    assert (record["system"], record["options"]["contrast_weight"]) == ("my_toy:Toy", 0.2)
    measured = json.loads(inside.metrics.read_text())["models"]["Toy-rings"]
    assert measured["num_bytes"] == 4 * (58 + 4) * measured["num_gaussians"]
    assert inside.report.is_file()


def test_other_commands(inside, tmp_path, capsys):
    before = json.loads(inside.metrics.read_text())["models"]["Toy-rings"]["test"]
    assert cli.main(["eval", "run"]) == cli.main(["info", "run"]) == 0
    text = capsys.readouterr().out
    assert "my_toy:Toy" in text and "Toy-rings" in text and "60 Gaussians" in text
    assert json.loads(inside.metrics.read_text())["models"]["Toy-rings"]["test"] == before
    assert cli.main(["render", "run", "--frames", "2", "--out", str(tmp_path)]) == 0
    frames = sorted(tmp_path.glob("*.png"))
    assert [path.name for path in frames] == ["frame_0000.png", "frame_0001.png"]
    assert all(np.asarray(Image.open(path)).std() > 1 for path in frames)
    assert cli.main(["train", *MINE, "--help-all"]) == 0
    text = capsys.readouterr().out
    assert "Weight of the contrast: larger values make rings fainter. (default: 0.1)" in " ".join(
        re.split(r"[\s│]+", text)
    )
    assert "--contrast-weight" in text and "--rings-rate" in text and "--texture.cap" not in text


def test_numbers_edited_between_two_attempts_are_refused(inside, tmp_path, capsys):
    """Models and checkpoints made with other numbers than the record's are refused."""
    copy = RunFolder(shutil.copytree(inside.path, tmp_path / "copy"))
    copy.record.write_text(copy.record.read_text().replace("contrast_weight = 0.2", "contrast_weight = 0.3"))
    assert cli.main(["train", "--out", str(copy.path), "--resume"]) == 2
    assert "Toy-rings.npz was made with another contrast_weight than the run has now" in capsys.readouterr().err
    stopped = RunFolder(shutil.copytree("interrupted", tmp_path / "stopped"))
    shutil.copy(copy.record, stopped.record)
    assert cli.main(["train", "--out", str(stopped.path), "--resume"]) == 2
    assert "Toy-rings-0000000001.npz was made with another contrast_weight than" in capsys.readouterr().err
