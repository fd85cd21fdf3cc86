"""Tables and pages of experiments say what is so."""

import csv
import dataclasses
import pathlib
import re
import shutil
import subprocess

import efficiency
import equal_bytes
import few_views
import numpy as np
import polish
import pytest
import shrink
import summary
import upscale_gains
from experiment_records import CELL, GRID, record, result
from lab import pages, spreadsheet, tables
from lab.cli import EXPERIMENTS, Lab, argument_parser
from lab.grid import Grid, Method, Run
from lab.jobs import Job
from lab.kept import read_kept
from lab.plan import duration
from lab.scenes import SceneAt
from run import experiments, main

import a2tg_jax as a2tg


def test_gains_have_the_verdict_that_seeds_allow():
    gains = [(25.3, 25.0), (25.5, 25.1)]
    results = [result("own", a, seed) for seed, (a, _) in enumerate(gains)]
    results += [result("other", b, seed, equal="bytes") for seed, (_, b) in enumerate(gains)]
    others = ["other" + tables.EQUAL_BYTES]
    assert tables.seed_spread(results, "own", others) == pytest.approx(0.1)
    text = tables.gains_table(results, "own", others)
    assert "+0.35 (above)" in text and "0.50 a pixel" in text and "differ by 0.10 dB" in text
    assert tables.verdict([0.05, -0.01], 0.1) == "undecided"
    assert tables.verdict([-0.3], 0.1) == "below"


def test_the_best_plain_method_is_that_of_each_cell_which_has_all():
    first, *others = summary.PLAIN_METHODS
    results = [result(label, 20.0 + place) for place, label in enumerate([first, *reversed(others)])]
    results += [result(label, 24.0 - place, 1) for place, label in enumerate([first, *others])]
    results += [result(first, 30.0, 2), result(summary.BYTEWISE, 24.0), result(summary.BYTEWISE, 26.0, 1)]
    best = summary.best_plain(results, summary.PLAIN_METHODS, summary.BEST)
    assert [(one.run.cell.seed, one["psnr"]) for one in best] == [(0, 23), (1, 24)]
    assert {one.label for one in best} == {summary.BEST}
    printed = summary.bytes_table([dataclasses.replace(one, run=with_budget(one.run, 0.3)) for one in results])
    assert "Bytewise less the best plain method: fox | +1.50" in printed
    assert "less the best plain method without pruning: mean** | +1.50" in printed
    assert "less MCMC of degree 0: mean** | +3.00" in printed


def with_budget(run: Run, megabytes: float) -> Run:
    return dataclasses.replace(run, cell=dataclasses.replace(run.cell, budget=megabytes))


def test_quality_is_averaged_over_seeds_and_what_is_missing_is_a_dash():
    text = tables.quality_tables(GRID, [result("own", 20.0), result("own", 22.0, 1), result("other", 30.0, lpips=None)])
    assert "| own | 30,000 | 1,000 | 21.00 / .800 / .200 · 1.00 (+331 %) | 21.00 / .800 / .200 · 1.00 |" in text
    assert "30.00 / .800 / – · 1.00 (+331 %) |" in text


def at(scene, label, psnr, seed=0, **others):
    found = result(label, psnr, seed, **others)
    cell = dataclasses.replace(found.run.cell, scene=SceneAt(scene, scene, 2))
    return tables.Result(dataclasses.replace(found.run, cell=cell), found.record)


def test_a_mean_counts_each_scene_once_however_many_seeds_it_has():
    results = [at("a", "own", 20.0), at("a", "own", 22.0, 1), at("b", "own", 31.0)]
    results += [at("a", "other", 19.0), at("a", "other", 20.0, 1), at("b", "other", 31.0)]
    assert tables.mean(results[:3], "psnr") == 26.0
    assert tables.gains_by_scene(results, "own", "other", "psnr") == {"a": 1.5, "b": 0.0}


def test_an_interval_over_scenes_is_that_of_students_t():
    """The half-width of four values is 3.182 standard errors, as tables of t say."""
    found = tables.over_scenes([1.0, 2.0, 3.0, 6.0])
    error = np.sqrt(14 / 3 / 4)
    assert found.mean == 3.0 and found.half_width == pytest.approx(3.18245 * error, rel=1e-5)
    assert found.as_text(2) == "+3.00 ± 3.44" and 0.05 < found.p_value < 0.1, "0 is inside the interval"
    assert tables.over_scenes([2.0, 2.1, 1.9]).p_value < 0.001
    alone = tables.over_scenes([2.0])
    assert alone.as_text(2) == "+2.00" and np.isnan(alone.p_value)
    assert np.isnan(tables.over_scenes([]).mean) and tables.over_scenes([1.0, np.nan]).as_text(2) == tables.MISSING


def test_lpips_without_weights_is_a_dash_in_every_table():
    results = [at(scene, label, 20.0, lpips=None) for scene in "ab" for label in ("own", "other")]
    texts = [tables.gains_table(results, "own", ["other"]), tables.choices_table(results, "own")]
    texts += [equal_bytes.gain_text(results, "own", "other"), tables.quality_tables(GRID, results)]
    for text in texts:
        assert "nan" not in text
        assert f"· {tables.MISSING}" in text or f"/ {tables.MISSING}" in text


def test_figures_that_are_missing_are_dashes_in_pages_of_models():
    nan = float("nan")
    figures = {"psnr": 20.0, "lpips": nan, "train": 21.0}
    assert polish._as_text(figures, figures) == "+0.00 · – · +0.00"
    sizes = {"bytes": 1000, "texels": 10, "psnr": 20.0, "lpips": None}
    assert shrink._as_text(sizes, {**sizes, "lpips": 0.1}).endswith(": +0.00 · –")
    group = {"criterion": "paper", "train": nan, "scores": {}}
    assert upscale_gains._quarters({"groups": [group]}, "paper") == tables.MISSING


def test_short_times_are_not_zero():
    times = {"fps": 10.0, "ms_per_step": [12.0, 10.0], "iterations": [60, 40], "machine": "cpu"}
    assert efficiency._row(result("own", 20.0), times)[-2] == "0.02"
    assert efficiency._row(result("own", 20.0), {**times, "iterations": [6000, 4000]})[-2] == "1.9"
    assert duration(59) == "a minute"


def test_finished_runs_are_rows_of_a_spreadsheet():
    text = spreadsheet.rows_text([("claim", result("own, equal", 25.0, lpips=None))])
    header, row = csv.reader(text.splitlines())
    found = dict(zip(header, row, strict=True))
    assert (found["grid"], found["scene"], found["method"], found["psnr"]) == ("claim", "fox", "own, equal", "25.0")
    assert found["lpips"] == found["budget_mb"] == "" and (found["size"], found["gaussians"]) == ("100", "1000")
    text = spreadsheet.rows_text([("claim", result("own", 25.123456789, seconds=3.14159, ms_per_step=float("nan")))])
    assert ",25.1235," in text and ",3.1," in text and "num" not in header


def test_pages_say_which_rows_are_from_before(tmp_path, capsys):
    shutil.copy(EXPERIMENTS / "results" / "small" / "records.json", tmp_path)
    main(["equal_bytes", "claim", "--tables-only", "--out", str(tmp_path), "--work", str(tmp_path / "work")])
    assert "--renew trains them again" in capsys.readouterr().out
    last = (tmp_path / "equal_bytes.md").read_text(encoding="utf-8").splitlines()[-1]
    assert re.match(r"\*Runs from before: [1-9]\d* of bytewise \(version 1, now 2\)", last)
    assert "from before" not in (tmp_path / "claim.md").read_text(encoding="utf-8")


def test_experiments_and_benchmarks_have_one_writer_of_tables():
    folders = (EXPERIMENTS, EXPERIMENTS.parent / "benchmarks")
    writers = [path for folder in folders for path in folder.rglob("*.py") if "---" in path.read_text(encoding="utf-8")]
    assert [path.name for path in writers] == ["markdown.py"]
    assert tables.markdown(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |\n"


def test_choices_are_compared_with_the_default():
    results = [result("own", 20.0), result("own", 21.0, 1), result("variant", 20.25, lpips=0.19)]
    text = tables.choices_table([*results, result("variant", 20.75, 1)], "own")
    assert "| variant | +0.00 · -0.005 | +0.00 · -0.005 | 1.00 |" in text


def test_without_a_second_seed_nothing_is_said_to_be_above():
    text = tables.gains_table([result("own", 21.0), result("other", 20.0)], "own", ["other"])
    assert "| +1.00 · +0.000 · +1.00 |" in text and "No cell has two seeds" in text


def test_columns_are_data_sets_and_what_is_missing_in_one_is_reported():
    """A mean over all of them counts each once, as the paper does."""
    scenes = [SceneAt(label, label, 1) for label in ("A/x", "A/y", "B/z")]
    cells = [dataclasses.replace(CELL, scene=scene) for scene in scenes]
    method = Method("own", "a2tg")
    results = [
        tables.Result(Run(method, cell, False, Job(cell.scene.path, 1, a2tg.A2tg(), 0)), record(psnr))
        for cell, psnr in zip(cells, (20.0, 22.0, 30.0), strict=True)
    ]
    grid = Grid("x", "X", "small", "quick", tuple(cells), method, (), ())
    text = tables.quality_tables(grid, results)
    assert "1.00 (+331 %) | 30.00 / .800 / .200 · 1.00 (+331 %) | 25.50 / .800 / .200 · 1.00 |" in text
    other = dataclasses.replace(results[0], run=dataclasses.replace(results[0].run, method=Method("other", "a2tg")))
    assert "20.00 / .800 / .200 · 1.00 (+331 %) (1 of 2 scenes) | – | – |" in tables.quality_tables(
        grid, [*results, other]
    )


def test_a_page_shows_the_tables_that_it_names(tmp_path, monkeypatch):
    """The page in place, the appendix from its text."""
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "x.md").write_text("# Title\n\n## Part\n\n| a |\n")
    for name in ("PAGE", "TEXT", "APPENDIX"):
        monkeypatch.setattr(pages, name, tmp_path / f"{name}.md")
    before = "Before.\n\n<!-- results/x.md -->\nold\n<!-- end -->\n\nAfter.\n"
    pages.PAGE.write_text(before)
    pages.TEXT.write_text(before)
    pages.refresh(tmp_path)
    wanted = "Before.\n\n<!-- results/x.md -->\n\n### Part\n\n| a |\n\n<!-- end -->\n\nAfter.\n"
    assert pages.PAGE.read_text() == pages.APPENDIX.read_text() == wanted == pages.with_tables(wanted, tmp_path)
    assert pages.TEXT.read_text() == before and pages.names(wanted) == ["results/x.md"]


UNCOMMITTED = (
    "quick_preset", "plain", "choose_plain", "degree_0", "degree_1", "degree_3", "bytewise", "parts", "findings",
)  # fmt: skip
"""Experiments whose runs are not among the committed ones."""


def test_the_documented_results_are_those_of_the_committed_records(tmp_path):
    """Both pages show the committed tables, and every table made of records is made anew."""
    shown = set()
    for page, text in pages.pages().items():
        assert page.read_text(encoding="utf-8") == text, f"{page} is old: python experiments/run.py appendix"
        shown |= {pathlib.Path(name).name for name in pages.names(text) if name.startswith("results/small/")}
    made_from_models = {
        "decomposition", "efficiency", "equal_bytes_speed", "on_disk", "polish", "shrink", "upscale_gains",
        "comparison_pictures",
    }  # fmt: skip
    committed = EXPERIMENTS / "results" / "small"
    shutil.copy(committed / "records.json", tmp_path)
    arguments = ["--tables-only", "--out", str(tmp_path), "--work", str(tmp_path / "none")]
    lab = Lab(argument_parser("").parse_args(arguments))
    for name, experiment in experiments().items():
        if name not in made_from_models and name not in UNCOMMITTED:
            lab.present(experiment, [lab.grid(grid) for grid in experiment.grids])
    made = {path.name for path in tmp_path.glob("*.md")}
    assert shown == made | {f"{name}.md" for name in made_from_models} - {"comparison_pictures.md"}
    unshown = {path.name for path in committed.glob("*.md")} - shown
    assert unshown <= {"quick_preset.md"}, "a table is on no page"
    for name in made:
        assert (tmp_path / name).read_text() == (committed / name).read_text(), name


@pytest.mark.parametrize(
    ("name", "methods"), [("few_views", few_views.METHODS), ("few_views_small", few_views.SMALL_METHODS)]
)
def test_tables_of_few_views_are_those_of_the_committed_figures(name, methods):
    folder = EXPERIMENTS / "results"
    table = few_views.table(methods, read_kept(folder / f"{name}.json"))
    assert (folder / f"{name}.md").read_text(encoding="utf-8") == table
    assert "| herz_jesus_p25, mean of folds | – |" in table


def test_every_picture_on_a_page_is_committed_and_every_committed_one_is_on_a_page():
    folder = EXPERIMENTS / "results" / "small"
    texts = "".join(path.read_text(encoding="utf-8") for path in pages.pages())
    shown = set(re.findall(r"\(\.\./experiments/results/small/([\w-]+\.png)\)", texts))
    assert shown and all((folder / name).is_file() for name in shown)
    listed = subprocess.run(["git", "ls-files", "."], cwd=folder, capture_output=True, text=True, check=False)
    if listed.returncode == 0:
        assert shown == {name for name in listed.stdout.split() if name.endswith(".png")}
