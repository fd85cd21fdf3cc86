"""Files of a run that are damaged: metrics, histories, records."""

import json

import numpy as np
import pytest

from a2tg_jax.results.figures import curves_figure
from a2tg_jax.results.folder import RunFolder, read_json
from a2tg_jax.results.history import NAMES, read_history, write_history
from a2tg_jax.results.info import read_psnrs
from a2tg_jax.results.record import read_run_file
from a2tg_jax.training import History

HEAD = ",".join(NAMES)


@pytest.mark.parametrize(
    "value",
    [
        {}, [], 3, None, "models", {"models": []}, {"models": {"a": 1}}, {"models": {"a": {"test": 3}}},
        {"models": {"a": {"test": {}}}}, {"models": {"a": {"train": {"psnr": "high"}}}},
        {"models": {"a": {"test": {"psnr": True}}}},
    ],
)  # fmt: skip
def test_metrics_of_wrong_types(tmp_path, value):
    file = tmp_path / "metrics.json"
    file.write_text(json.dumps(value))
    with pytest.raises(ValueError, match=r"metrics\.json: has no .*a2tg eval writes it anew"):
        read_psnrs(file)


def test_metrics_are_read(tmp_path):
    file = tmp_path / "metrics.json"
    file.write_text(json.dumps({"models": {"a": {"train": {"psnr": 30, "ssim": 1.0}, "test": {"psnr": float("inf")}}}}))
    assert read_psnrs(file) == {"a": {"test": np.inf, "train": 30.0}}


@pytest.mark.parametrize("text", [b"[" * 10**5, b"{", b"\xff\xff", b"1" * 5000, b"[" * 100 + b"]" * 100])
def test_json_made_to_do_harm(tmp_path, text):
    file = tmp_path / "metrics.json"
    file.write_bytes(text)
    with pytest.raises(ValueError, match=r"metrics\.json: is not valid JSON") as caught:
        read_json(file)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "", "\n", "stage,loss\n", f"{HEAD}\n1,2,3\n", f"{HEAD}\n1,2,3,4,5,6,many\n", f"{HEAD}\n1,2,nan,4,5,6,7\n",
        f"{HEAD}\n1,2,inf,4,5,6,7\n", f"{HEAD}\n1,1e300,3,4,5,6,7\n", f"{HEAD}\n1,2,3,4,5,6,7\n1,2\n",
        f"{HEAD}\n{'1' * 200_000},2,3,4,5,6,7\n", "\0\0\0",
    ],
)  # fmt: skip
def test_histories_that_are_none(tmp_path, text):
    file = tmp_path / "a.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=r"a\.csv: .*train the stage again") as caught:
        read_history(file)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


def test_a_history_without_rows_is_shown(tmp_path):
    write_history(tmp_path / "a.csv", History.empty())
    found = read_history(tmp_path / "a.csv")
    assert found.last_seconds == 0 and found.iteration.dtype == np.int64
    curves_figure({"a": found}, {"a": 0})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"scene = " + b"[" * 100_000, "is not valid TOML"),
        (b"a" + b".a" * 100 + b" = 1", "is not valid TOML: .* nested"),
        (b"downscale = " + b"1" * 401, "downscale must be int"),
        (b"downscale = " + b"1" * 5000, "is not valid TOML"),
        (b"\xff\xfe", "is not valid TOML"),
        (b"scene = 1979-05-27", "scene must be"),
        (b"options = 3", "options must be"),
        (b'scene = ["' + b"x" * 10**6 + b'"]', "scene must be"),
    ],
)
def test_records_made_to_do_harm(tmp_path, text, message):
    file = tmp_path / "run.toml"
    file.write_bytes(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_run_file(file)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


def test_a_scene_in_a_circle_of_links_is_read_as_it_stands(tmp_path):
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    (tmp_path / "run.toml").write_text('scene = "a"')
    assert read_run_file(tmp_path / "run.toml").scene.startswith(str(tmp_path))


@pytest.mark.parametrize("line", [b"x" * 5000, b"../outside", b"/etc/hostname", b"\xff\xfe", b"a\0b", b".", b"loop"])
def test_a_marker_names_no_file_but_those_in_its_folder(tmp_path, line):
    (tmp_path / "outside").touch()
    run = RunFolder(tmp_path / "run")
    run.own(run.metrics).write_text("{}")
    (run.path / "loop").symlink_to(run.path / "loop")
    with open(run.marker, "ab") as file:
        file.write(line + b"\n")
    assert run.own_files(run.written()) == [run.metrics]
