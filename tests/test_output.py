"""Places to write to, and budgets too small to show a scene, are told before any work."""

import sys
from pathlib import Path

import pytest

import a2tg_jax as a2tg
from a2tg_jax.core.display import in_bytes
from a2tg_jax.results.folder import create_run
from a2tg_jax.results.forecast import RunForecast
from a2tg_jax.results.info import describe_run
from a2tg_jax.results.output import check_output
from a2tg_jax.results.preflight import warn_of_small_budget
from a2tg_jax.results.record import RunRecord, SceneSource, write_record
from a2tg_jax.training.cost import Bytes


def test_a_file_in_the_way_is_told(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"run cannot be made, for .*file is a file$"):
        check_output(tmp_path / "file" / "run")
    check_output(tmp_path / "file")


@pytest.mark.skipif(sys.platform != "linux", reason="/proc is Linux's")
def test_a_folder_that_takes_nothing_is_told():
    with pytest.raises(ValueError, match=r"^/proc/x cannot be made, for nothing can be written in /proc: "):
        check_output(Path("/proc/x"))


def test_only_several_levels_are_told(tmp_path, capsys):
    for path in (tmp_path, tmp_path / "run"):
        check_output(path)
    assert capsys.readouterr().err == ""
    check_output(tmp_path / "usb stick" / "runs" / "run")
    assert capsys.readouterr().err == f"a2tg: {tmp_path / 'usb stick'} does not exist and will be made\n"
    assert not list(tmp_path.iterdir())


def test_levels_below_the_current_folder_are_not_told(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    check_output(Path("runs/demo"))
    assert capsys.readouterr().err == ""


def test_a_budget_for_few_gaussians_is_warned_of(recwarn):
    warn_of_small_budget(a2tg.A2tg(memory_budget="1MB"))
    warn_of_small_budget(a2tg.A2tg())
    assert not recwarn.list
    with pytest.warns(UserWarning, match=r"^memory_budget has room for 4 Gaussians of 232 bytes; "):
        warn_of_small_budget(a2tg.A2tg(memory_budget="1kB"))


def test_a_limit_below_the_program_itself_says_so():
    forecast = RunForecast({"evaluation": Bytes(program=1.1e9, pixels=1e6)}, 1e6, 0)
    with pytest.raises(
        ValueError, match=r"20.0 MB may be used: the program itself takes about 1.10 GB of it: allow more"
    ):
        forecast.check(20e6)


def test_sizes_have_three_digits_and_a_unit_that_suits_them():
    told = {1: "1 byte", 999: "999 bytes", 9_996: "10.0 kB", 999_600: "1.00 MB", 2.5e6: "2.50 MB", 12.34e9: "12.3 GB"}
    assert {size: in_bytes(size) for size in told} == told and in_bytes(1234e9) == "1,234 GB"


def test_info_shows_what_is_intact_and_names_what_is_damaged(tmp_path):
    run = create_run(tmp_path / "run")
    write_record(run, RunRecord(SceneSource("synthetic"), "a2tg", a2tg.A2tg()))
    run.metrics.write_text("{")
    run.model("a2tg-gaussians").parent.mkdir()
    run.model("a2tg-gaussians").write_bytes(b"PK")
    told = describe_run(run)
    assert f"damaged  {run.metrics}" in told and f"a2tg eval {run.path} rewrites it" in told
    assert "a2tg-gaussians  damaged: " in told and "a2tg-textures   not begun" in told
    assert told.endswith(f"training is not finished; continue with: a2tg train --out {run.path} --resume")
