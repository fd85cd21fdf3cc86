"""Files of TensorBoard beside the histories."""

import importlib.util

import numpy as np
import pytest
from test_results import some_history

from a2tg_jax.cli import main as cli
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.history import EventWriter

pytest.importorskip("tensorboardX", reason="the extra [tensorboard] is not installed")
from tensorboard_events import scalars


def written(run, *histories, skipped=None):
    writer = EventWriter(run, "a2tg-gaussians")
    if skipped is not None:
        writer.skip(skipped)
    for history in histories:
        writer.add(history)
    writer.close()


def test_rows_are_written_once(tmp_path):
    """A file has the new rows of each call, and another process those after the checkpoint."""
    run = RunFolder(tmp_path)
    written(run, some_history(num=3), some_history(num=3), some_history(num=7))
    written(run, some_history(num=9), skipped=some_history(num=7))
    found, wanted = scalars(run.tensorboard), some_history(num=9)
    columns = {"loss", "psnr", "num_gaussians", "megabytes", "seconds"}
    assert set(found) == {f"{column}/a2tg-gaussians" for column in columns}
    for column in columns:
        steps, values = zip(*found[f"{column}/a2tg-gaussians"], strict=True)
        assert steps == (*range(1, 10),)
        np.testing.assert_allclose(values, getattr(wanted, column), rtol=1e-6)


def test_loss_terms_are_written_where_there_are_any(tmp_path):
    run, history = RunFolder(tmp_path), some_history(num=2).with_point(1, 3, 0.3, 20.0, 5, 0.1, 2.0, l1=0.25)
    written(run, history)
    ((step, value),) = scalars(run.tensorboard)["loss_l1/a2tg-gaussians"]
    assert step == 3 and value == 0.25


def test_the_files_are_the_run_s_own(tmp_path):
    """A run that is replaced takes them along."""
    run = RunFolder(tmp_path)
    written(run, some_history(num=2))
    assert run.own_files(run.written()) == [*run.tensorboard.iterdir()]
    run.clear()
    assert not run.tensorboard.exists()


def test_without_the_library_one_line_says_what_to_do(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(cli, "configure_cpu", lambda: None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert cli.main(["train", "synthetic", "--out", str(tmp_path / "run"), "--tensorboard"]) == 2
    told = "a2tg: error: --tensorboard needs tensorboardX: pip install 'a2tg-jax[tensorboard]'\n"
    assert capsys.readouterr().err == told and not (tmp_path / "run").exists()
