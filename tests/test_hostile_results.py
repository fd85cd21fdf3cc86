"""Files of a run that are damaged: metrics, histories, records."""

import json
import time
import tracemalloc

import numpy as np
import pytest
from hostile_files import put
from run_folders import create_run

from a2tg_jax import Bytewise, History
from a2tg_jax.base.json_text import parse_json, parse_toml, read_json
from a2tg_jax.cli import main as cli
from a2tg_jax.results.figures import curves_figure
from a2tg_jax.results.folder import RunFolder, open_run
from a2tg_jax.results.history import read_history, write_history
from a2tg_jax.results.info import read_psnrs
from a2tg_jax.results.record import RunRecord, SceneSource, read_record, read_run_file, write_record

HEAD = "stage,iteration,loss,psnr,num_gaussians,megabytes,seconds"


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
    with pytest.raises(ValueError, match=r"metrics\.json: has no "):
        read_psnrs(file)
    file.write_text(json.dumps({"models": {"a": {"train": {"psnr": 30, "ssim": 1.0}, "test": {"psnr": float("inf")}}}}))
    assert read_psnrs(file) == {"a": {"test": np.inf, "train": 30.0}}


@pytest.mark.parametrize("text", [b"[" * 10**5, b"{", b"\xff\xff", b"1" * 5000, b"[" * 100 + b"]" * 100])
def test_json_made_to_do_harm(tmp_path, text):
    file = tmp_path / "metrics.json"
    file.write_bytes(text)
    with pytest.raises(ValueError, match=r"metrics\.json: cannot be read as JSON") as caught:
        read_json(file)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "", "\n", "stage,loss\n", f"{HEAD}\n1,2,3\n", f"{HEAD}\n1,2,3,4,5,6,many\n", f"{HEAD}\n1,2,nan,4,5,6,7\n",
        f"{HEAD}\n1,2,inf,4,5,6,7\n", f"{HEAD}\n1,1e300,3,4,5,6,7\n", f"{HEAD}\n1,2,3,4,5,6,7\n1,2\n",
        f"{HEAD}\n{'1' * 200_000},2,3,4,5,6,7\n", "\0\0\0", f"{HEAD},loss_a,loss_a\n", f"{HEAD},roughness\n",
    ],
)  # fmt: skip
def test_histories_that_are_none(tmp_path, text):
    file = tmp_path / "a.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=r"a\.csv: .*delete models/a\.npz to train the stage again") as caught:
        read_history(file)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


def test_a_history_may_be_missing_or_without_rows(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"a\.csv is missing: .*delete models/a\.npz to train the stage again"):
        read_history(tmp_path / "a.csv")
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
        (b'scene = ["' + b"x" * 200_000 + b'"]', "scene must be"),
        (b'scene = ["' + b"x" * 10**6 + b'"]', "the most that such a file may have"),
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
    assert read_run_file(tmp_path / "run.toml").scene.path.startswith(str(tmp_path))


@pytest.mark.parametrize("line", [b"x" * 5000, b"../outside", b"/etc/hostname", b"\xff\xfe", b"a\0b", b".", b"loop"])
def test_a_marker_names_no_file_but_those_in_its_folder(tmp_path, line):
    (tmp_path / "outside").touch()
    run = RunFolder(tmp_path / "run")
    run.own(run.metrics).write_text("{}")
    (run.path / "loop").symlink_to(run.path / "loop")
    with open(run.marker, "ab") as file:
        file.write(line + b"\n")
    assert run.files() == [run.metrics]


# Records whose options cannot be


@pytest.fixture
def bytewise_run(tmp_path):
    run = create_run(tmp_path / "run")
    write_record(run, RunRecord(SceneSource("synthetic"), "bytewise", Bytewise.preset("smoke"), (), "smoke"))
    return run


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("base_degree", 7, "base_degree must be"),
        ("base_degree", -9, "base_degree must be"),
        ("base_degree", 2**63, "base_degree must be"),
        ("stage1_iterations", 0, "at least 1 iteration"),
        ("stage1_iterations", -5, "must"),
        ("stage1_iterations", 2**63, "fewer than 2.31"),
        ("seed", -1, "seed must be"),
        ("cap", 0, "densify.cap must"),
        ("memory_budget", "1e-300", "memory_budget"),
        ("compare", json.dumps(["a" * 5000]), "there is no system"),
        ("compare", '["bytewise"]', "two systems of the run"),
        ("compare", '[":"]', "there is no system|cannot be imported"),
        ("system", json.dumps("x:" + "y" * 5000), "cannot be imported"),
    ],
)
def test_every_command_refuses_options_out_of_range_in_one_line(bytewise_run, capsys, monkeypatch, key, value, message):
    run = bytewise_run
    text = run.record.read_text()
    found = [line for line in text.splitlines() if line.startswith(f"{key} = ")]
    text = text.replace(found[0], f"{key} = {value}", 1) if found else f"{key} = {value}\n{text}"
    run.record.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_record(open_run(run.path))
    monkeypatch.setattr(cli, "configure_cpu", lambda: None)
    folder, record, new = str(run.path), str(run.record), str(run.path.with_name("new"))
    resume = ["train", "--out", folder, "--resume"]
    commands = (
        ["info", folder],
        ["eval", folder],
        ["train", "--config", record, "--out", new],
        resume,
        ["info", "x" * 5000],
    )
    for command in commands:
        assert cli.main(command) == 2
        printed = capsys.readouterr()
        assert printed.out == "" and printed.err.count("\n") == 1 and len(printed.err) < 1200


# Texts that would take memory or time


def peak_of(read, *arguments):
    """Bytes and seconds that a refusal takes."""
    tracemalloc.start()
    start = time.perf_counter()
    try:
        with pytest.raises(ValueError):
            read(*arguments)
        return tracemalloc.get_traced_memory()[1], time.perf_counter() - start
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("parse", "text"),
    [
        (parse_json, b"[" + b",".join([b'{"a":' * 900 + b"1" + b"}" * 900] * 1000) + b"]"),
        (parse_json, b"[" + b"{}," * 1_500_000 + b"1]"),
        (parse_json, b"[" * 10**7),
        (parse_json, b" " * (1 << 26)),
        (parse_toml, "\n".join(f"a{i}{'.a' * 1000} = 1" for i in range(2000)).encode()),
        (parse_toml, "\n".join(f"a{i}{'.a' * 1000} = 1" for i in range(100)).encode()),
        (parse_toml, b"\n".join(b"a%d = " % i + b"[" * 500 + b"]" * 500 for i in range(200))),
        (parse_toml, b" " * (1 << 20)),
    ],
)
def test_texts_are_measured_before_they_are_parsed(parse, text):
    num_bytes, seconds = peak_of(parse, text)
    assert num_bytes < 6 * len(text) + 10**6 and num_bytes < 70e6 and seconds < 5


def test_brackets_in_strings_do_not_count():
    deep = "[" * 100
    printed_text = json.dumps({'a"' + deep: ["\\", deep, '\\"' + deep]})
    assert parse_json(printed_text) == json.loads(printed_text)
    text = f"a = '{deep}' # {deep}\nb = \"\\\"{deep}\"\nc = \"\"\"\n\"{deep}\"\"\"\nd = '''{deep}'''\n'{deep}' = 1\n"
    assert parse_toml(text.encode())["b"] == '"' + deep
    assert parse_toml(b"a = [" + b"0.5," * 100 + b"]") == {"a": [0.5] * 100}
    assert parse_json("[" * 64 + "]" * 64)
    with pytest.raises(ValueError, match="nested more than"):
        parse_json("[" * 65 + "]" * 65)


# Files of many lines


def test_markers_of_many_files_are_written_at_once_and_refused_above_the_limit(tmp_path):
    run, names = create_run(tmp_path / "run"), [f"test/{i}.png" for i in range(100_000 - 10)]
    start = time.process_time()
    run.own_all([*names, *names])
    run.own_all(names)
    assert run.written().count(names[7]) == 1 and set(names) <= set(run.written())
    with open(run.marker, "a") as file:
        file.writelines(f"x/{i}.png\n" for i in range(900_000))
    with pytest.raises(ValueError, match=r"lists 999,99\d files, and 100,000 are the most"):
        run.written()
    assert time.process_time() - start < 5


def test_a_history_of_200_000_rows_is_read_and_drawn_in_seconds(tmp_path):
    num = 200_000
    iteration, values = np.arange(1, num + 1), np.linspace(1.0, 2.0, num)
    history = History(
        np.ones(num, int), iteration, values, np.where(iteration == 5, np.inf, 20.0), iteration, values, values
    )
    start = time.process_time()
    write_history(tmp_path / "a.csv", history)
    found = read_history(tmp_path / "a.csv")
    curves_figure({"a": found}, {"a": 0})
    assert time.process_time() - start < 15
    np.testing.assert_array_equal(found.iteration, iteration)
    np.testing.assert_array_equal(found.psnr, history.psnr)


def test_a_history_of_rows_has_its_dtypes_and_nan_where_a_row_lacks_a_term():
    names = ("stage", "iteration", "loss", "psnr", "num_gaussians", "megabytes", "seconds")
    rows = [dict(zip(names, (1, index, 0.5, 20.0, 7, 0.1, 1.0), strict=True)) for index in range(3)]
    found = History.of_rows([rows[0], rows[1] | {"loss_l1": 0.25}, rows[2]])
    assert all(getattr(found, name).dtype == getattr(History.empty(), name).dtype for name in names)
    assert found.iteration.tolist() == [0, 1, 2] and np.isnan(found.terms["l1"]).tolist() == [True, False, True]
    assert all(len(column) == 0 for column in History.of_rows([]).to_dict().values())


# Things that are no files


@pytest.mark.parametrize("name", ["run.toml", "metrics.json", ".a2tg-run"])
@pytest.mark.parametrize("kind", ["device", "pipe", "sparse"])
def test_runs_whose_files_are_none(bytewise_run, capsys, monkeypatch, name, kind):
    path = bytewise_run.path / name
    put(path, kind)
    monkeypatch.setattr(cli, "configure_cpu", lambda: None)
    command, is_shown = "eval" if name == ".a2tg-run" else "info", name == "metrics.json"
    assert cli.main([command, str(bytewise_run.path)]) == (0 if is_shown else 2)
    captured = capsys.readouterr()
    (printed,) = [line for line in (captured.out if is_shown else captured.err).splitlines() if name in line]
    assert printed.startswith("damaged" if is_shown else "a2tg: error: ")
    assert ("is not a regular file" if kind != "sparse" else "100,000,000,000 bytes") in printed


def test_histories_that_are_no_files(tmp_path):
    put(tmp_path / "a.csv", "pipe")
    with pytest.raises(ValueError, match=r"a\.csv: is not a regular file"):
        read_history(tmp_path / "a.csv")
