"""Tables and pages of experiments say what is so."""

import csv
import dataclasses
import json
import re
import shutil
from types import SimpleNamespace

import choose_plain
import claims
import efficiency
import findings
import numpy as np
import pytest
import small_models
from experiment_records import CELL, GRID, record, result
from lab import pages, spreadsheet, tables
from lab.cli import EXPERIMENTS, Lab, argument_parser
from lab.grid import Grid, Method, Run, read_grid
from lab.jobs import Folders, Job
from lab.kept import read_kept
from lab.plan import duration
from lab.scenes import SceneAt
from run import experiments, main, parse_arguments

import a2tg_jax as a2tg


def test_gains_are_means_over_seeds():
    gains = [(25.3, 25.0), (25.5, 25.1)]
    results = [result("own", a, seed) for seed, (a, _) in enumerate(gains)]
    results += [result("other", b, seed, equal="bytes") for seed, (_, b) in enumerate(gains)]
    text = tables.gains_table(results, "own", ["other" + tables.EQUAL_BYTES])
    assert "| 2 | +0.35 · +0.000 · +0.35 |" in text and "0.50 a pixel" in text


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
    assert "| +0.75 ± 9.53 |" in tables.gains_table(results, "own", ["other"])


def test_an_interval_over_scenes_is_that_of_students_t():
    """The half-width of four values is 3.182 standard errors, as tables of t say."""
    found = tables.over_scenes([1.0, 2.0, 3.0, 6.0])
    error = np.sqrt(14 / 3 / 4)
    assert found.mean == 3.0 and found.half_width == pytest.approx(3.18245 * error, rel=1e-5)
    assert found.as_text(2) == "+3.00 ± 3.44" and tables.over_scenes([2.0]).as_text(2) == "+2.00"
    assert np.isnan(tables.over_scenes([]).mean) and tables.over_scenes([1.0, np.nan]).as_text(2) == tables.MISSING


def test_lpips_without_weights_is_a_dash_in_every_table():
    results = [at(scene, label, 20.0, lpips=None) for scene in "ab" for label in ("own", "other")]
    texts = [tables.gains_table(results, "own", ["other"]), tables.choices_table(results, "own")]
    texts.append(tables.quality_tables(GRID, results))
    for text in texts:
        assert "nan" not in text
        assert f"· {tables.MISSING}" in text or f"/ {tables.MISSING}" in text


def test_short_times_are_not_zero():
    times = {"fps": 10.0, "ms_per_step": [12.0, 10.0], "iterations": [60, 40], "machine": "cpu"}
    assert efficiency._row(result("own", 20.0), times)[-2] == "0.02"
    assert efficiency._row(result("own", 20.0), {**times, "iterations": [6000, 4000]})[-2] == "1.9"
    assert duration(59) == "a minute"


def test_times_of_the_efficiency_page_are_measured_once(tmp_path, monkeypatch):
    """Every stage so far with all Gaussians of the first stage's model; a second page measures nothing."""
    given = ["efficiency", "--scale", "smoke", "--out", str(tmp_path / "out"), "--work", str(tmp_path / "work")]
    lab = Lab(parse_arguments(experiments(), given))
    grid, fitted = lab.grid("efficiency"), []
    for job in (one for last in grid.jobs({}) for one in last.chain):
        path = lab.folders.model(job)
        path.parent.mkdir(parents=True, exist_ok=True)
        a2tg.save_model(path, small_models.some_model())
        lab.records[job.key] = record(mb=0.5)

    def fit(scene, system, index, start):
        fitted.append((index, system.stages()[index].iterations, start.num))
        pace = 10.0 + 5 * index
        history = SimpleNamespace(seconds=np.arange(3) * pace, iteration=1000 * np.arange(3))
        return SimpleNamespace(history=history)

    monkeypatch.setattr(Folders, "load_scene", lambda *_: SimpleNamespace(test=()))
    monkeypatch.setattr(efficiency, "fit_stage", fit)
    monkeypatch.setattr(a2tg, "evaluate", lambda *_: SimpleNamespace(frames_per_second=40.0))
    for _ in range(2):
        efficiency.present(lab, [grid])
    num = small_models.some_model().num
    assert fitted == [(0, 20, num), (1, 20, num), (0, 20, num)]
    page = (lab.out / "efficiency.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if "| built-in |" in line]
    assert "| A²TG | 1,000 | 0.50 | 40.0 | 25.0 | 10.0, 15.0 | 0.01 |" in rows[0]
    assert "| 2DGS*-MCMC, first stage | 1,000 | 0.50 | 40.0 | 25.0 | 10.0 | 0.01 |" in rows[1] and len(rows) == 2


def test_finished_runs_are_rows_of_a_spreadsheet():
    text = spreadsheet.rows_text([("claim", result("own, equal", 25.0, lpips=None))])
    header, row = csv.reader(text.splitlines())
    found = dict(zip(header, row, strict=True))
    assert (found["grid"], found["scene"], found["method"], found["psnr"]) == ("claim", "fox", "own, equal", "25.0")
    assert found["lpips"] == found["budget_mb"] == "" and (found["size"], found["gaussians"]) == ("100", "1000")
    text = spreadsheet.rows_text([("claim", result("own", 25.123456789, seconds=3.14159, ms_per_step=float("nan")))])
    assert ",25.1235," in text and ",3.1," in text and "num" not in header


def test_pages_say_which_rows_are_from_before(tmp_path, capsys):
    grid = read_grid("fixed_memory", "smoke")
    records = {job.key: {**record(system="bytewise"), "sizes": {}} for job in grid.jobs({})}
    (tmp_path / "records.json").write_text(json.dumps(records), encoding="utf-8")
    main(
        ["fixed_memory", "--scale", "smoke", "--tables-only", "--out", str(tmp_path), "--work", str(tmp_path / "work")]
    )
    assert "--renew trains them again" in capsys.readouterr().out
    last = (tmp_path / "fixed_memory.md").read_text(encoding="utf-8").splitlines()[-1]
    assert last == f"*Runs from before: 1 of bytewise (version 1, now {a2tg.Bytewise.version}).*"


def test_experiments_and_benchmarks_have_one_writer_of_tables():
    folders = (EXPERIMENTS, EXPERIMENTS.parent / "benchmarks")
    writers = [path for folder in folders for path in folder.rglob("*.py") if "---" in path.read_text(encoding="utf-8")]
    assert [path.name for path in writers] == ["markdown.py"]
    assert tables.markdown(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |\n"


def test_choices_are_compared_with_the_default():
    results = [result("own", 20.0), result("own", 21.0, 1), result("variant", 20.25, lpips=0.19)]
    text = tables.choices_table([*results, result("variant", 20.75, 1)], "own")
    assert "| variant | +0.00 · -0.005 | +0.00 · -0.005 | 1.00 |" in text


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
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "x.md").write_text("# Title\n\n## Part\n\n| a |\n")
    page = tmp_path / "page.md"
    monkeypatch.setattr(pages, "PAGES", (page,))
    monkeypatch.setattr(pages, "EXPERIMENTS", tmp_path)
    page.write_text("Before.\n\n<!-- results/x.md -->\nold\n<!-- end -->\n\nAfter.\n")
    pages.refresh()
    wanted = "Before.\n\n<!-- results/x.md -->\n\n### Part\n\n| a |\n\n<!-- end -->\n\nAfter.\n"
    assert page.read_text() == wanted == pages.with_tables(wanted, tmp_path)
    assert pages.names(wanted) == ["results/x.md"]


RESULTS = EXPERIMENTS.parent / "docs" / "results.md"
NOTEBOOK = EXPERIMENTS / "NOTEBOOK.md"
MADE_OF_MODELS = {"efficiency"}


@pytest.mark.parametrize("scale", ["small", "long", "protocol160", "claims"])
def test_committed_tables_are_those_of_the_committed_records(tmp_path, scale):
    committed = EXPERIMENTS / "results" / scale
    shutil.copytree(committed.parent, tmp_path / "results")
    arguments = ["--scale", scale, "--tables-only", "--out", str(tmp_path / "results" / scale)]
    lab = Lab(argument_parser("").parse_args([*arguments, "--work", str(tmp_path / "none")]))
    names = {path.stem for path in committed.glob("*.md")} - MADE_OF_MODELS
    assert names
    for name in names:
        (lab.out / f"{name}.md").unlink()
    for name in names & experiments().keys():
        experiment = experiments()[name]
        lab.present(experiment, [lab.grid(grid) for grid in experiment.grids])
    for name in names:
        text = (committed / f"{name}.md").read_text(encoding="utf-8")
        assert (lab.out / f"{name}.md").read_text(encoding="utf-8") == text, name


def test_the_papers_rows_have_the_runs_that_there_are():
    """Chair lacks plain Gaussians; half-widths are 2.776 standard errors of five values, 2.571 of six."""
    grid = read_grid("paper_degree_0", "paper160")
    improved = Method(f"{findings.IMPROVED}, degree 0", "a2tg")
    grid = dataclasses.replace(grid, at_equal_bytes=(*grid.at_equal_bytes[:2], improved))
    assert findings.rows_at_length(grid, 0, {}, "here") == []
    scenes = [cell.scene.label for cell in grid.cells]
    records = {}
    for run in grid.runs(records):
        scene = run.cell.scene.label
        gain = 1 + scenes.index(scene) / 10 if run.method == grid.reference else 2 if run.method == improved else 0
        if (scene, run.method.label) != ("chair", "2DGS*-MCMC, degree 0"):
            records[run.job.key] = record(20 + gain, per_view={"a": [20 + gain, 0.8 - gain / 100, 0.2]})
    rows = findings.rows_at_length(grid, 0, records, findings.PLACES["paper160"])
    lines = findings.short_table(rows).splitlines()[2:]
    assert lines == [
        "| **at the paper's length, degree 0** |  |  |  |  |  |",
        "| A²TG − plain (5 of 6 scenes) | +1.24 ± 0.26 | -0.012 | +0.000 | 5/5 | .062 |",
        "| A²TG − plain, first stage | **+1.25 ± 0.20** | **-0.013** | +0.000 | 6/6 | .031 |",
        "| A²TG, improved − plain (5 of 6 scenes) | +2.00 ± 0.00 | -0.020 | +0.000 | 5/5 | .062 |",
        "| A²TG, improved − plain, first stage | **+2.00 ± 0.00** | **-0.020** | +0.000 | 6/6 | .031 |",
    ]


def test_the_chart_shows_psnr_by_bytes_of_each_capture():
    """A²TG is 1 dB above the same kernels without textures, and each size 1 dB above the smaller one."""
    grid = read_grid("quick_degree_0", "protocol160")
    records = {}
    for run in grid.runs(records):
        size = findings.bytes_per_pixel(tables.Result(run, record()))
        psnr = (16, 60, 180).index(size) + (run.method.label == "A²TG, quick, degree 0")
        records[run.job.key] = record(psnr, mb=run.cell.budget)
    chart = findings.psnr_by_bytes(tables.results_of(grid, records))
    assert [axes.get_title() for axes in chart.axes] == list(dict.fromkeys(cell.scene.label for cell in grid.cells))
    for axes in chart.axes:
        curves = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
        assert curves["A²TG, degree 0"] == [[16, 1], [60, 2], [180, 3]]
        assert curves["without textures, degree 0"] == [[16, 0], [60, 1], [180, 2]]
        assert curves["A²TG, degree 3"] == curves["without textures, degree 3"] == []


def test_the_page_has_one_size_of_the_papers_size():
    places = {}
    for degree in (3, 0):
        grid = read_grid(f"paper_degree_{degree}", "full_size")
        records = {grid.reference_job(cell).key: record() for cell in grid.cells}
        for row in findings.rows_at_length(grid, degree, records, findings.PLACES["full_size"]):
            places[row.place] = row.is_on_page
    sizes = {
        f"at the paper's size, {num},000 Gaussians, degree {degree}": False for num in (100, 300) for degree in (3, 0)
    }
    assert places == {**sizes, "at the paper's size, 100,000 Gaussians, degree 3": True}


def test_the_chosen_plain_methods_are_those_of_the_committed_validation_records():
    records = read_kept(EXPERIMENTS / "results" / "claims-validation" / "records.json")
    grid = read_grid("choose_plain", "claims", validation=True)
    best = choose_plain.best_methods(tables.results_of(grid, records), 1 + len(grid.methods))
    assert best == json.loads(choose_plain.CHOICES.read_text(encoding="utf-8"))


def test_pages_show_the_committed_tables():
    for page in pages.PAGES:
        text = page.read_text(encoding="utf-8")
        assert text == pages.with_tables(text, EXPERIMENTS), f"{page} is old: python experiments/run.py pages"
    folder = EXPERIMENTS / "results"
    shown = {EXPERIMENTS / name for page in pages.PAGES for name in pages.names(page.read_text(encoding="utf-8"))}
    assert shown <= set(folder.glob("*/*.md"))


def protocol_tables():
    """Return all tables of the protocol's experiments."""
    files = [path for scale in ("protocol160", "claims") for path in (EXPERIMENTS / "results" / scale).glob("*.md")]
    return " ".join(path.read_text(encoding="utf-8") for path in files)


def test_figures_in_sentences_on_results_are_in_tables():
    """On the page of results and in README's findings. The paper's gains are differences of its own figures."""
    readme = (EXPERIMENTS.parent / "README.md").read_text(encoding="utf-8")
    (sentences,) = re.findall(r"^## Findings\n(.*?)^## ", readme, re.DOTALL | re.MULTILINE)
    sentences += pages.BLOCK.sub("", RESULTS.read_text(encoding="utf-8"))
    shown = protocol_tables()
    with_interval = r"\d\.\d{2,}(?: ± \d\.\d{2,})?"
    figures = {f"{gain:.2f}" for gain in gains_in_the_paper()}
    figures |= {*re.findall(r"\d\.\d{2,}", shown), *re.findall(with_interval, shown)}
    missing = set(re.findall(with_interval, sentences)) - figures
    assert not missing, f"{missing} are in no table"


def test_intervals_in_sentences_of_the_notebook_are_in_tables():
    """In sections that show or link to tables, except for what was measured before the protocol."""
    shown = protocol_tables()
    interval = r"\d\.\d{2,} ± \d\.\d{2,}"
    found = set()
    for section in NOTEBOOK.read_text(encoding="utf-8").split("\n## "):
        if "<!-- results/protocol160/" in section or "(#all-intervals-and-captures)" in section:
            sentences = pages.BLOCK.sub("", section)
            sentences = re.sub(r"^- \*\*Before the protocol\*\*.*?(?=^- |^$)", "", sentences, flags=re.DOTALL | re.M)
            found |= set(re.findall(interval, " ".join(sentences.split())))
    assert len(found) > 10
    missing = found - set(re.findall(interval, shown))
    assert not missing, f"{missing} are in no table"


def gains_in_the_paper():
    """PSNR of A²TG − 2DGS*-MCMC in each memory and data set of the paper's Table 1."""
    psnr = {(row["method"], row["dataset"], row["budget_mb"]): row["psnr"] for row in tables.PAPER["fixed_memory"]}
    places = [place for method, *place in psnr if method == "A²TG"]
    return [psnr["A²TG", *place] - psnr["2DGS*-MCMC", *place] for place in places]


def test_the_results_page_is_short():
    assert len(RESULTS.read_text(encoding="utf-8").split()) <= 1_300


def test_the_notebook_is_read_in_one_sitting():
    """It has at most 4,500 words besides generated tables, and its contents are the titles of its sections."""
    text = re.sub(r"^<!-- \S+ -->$.*?^<!-- end -->$", "", NOTEBOOK.read_text(encoding="utf-8"), flags=re.DOTALL | re.M)
    assert len(text.split()) <= 4_500
    contents = text.split("\n# ")[1]
    assert re.findall(r"^- \[(.*)\]\(#", contents, re.MULTILINE) == re.findall(r"^## (.*)$", text, re.MULTILINE)


def claims_result(capture, label, psnr, budget=0.3, equal="", **others):
    """Return a run of one view of a capture."""
    found = result(label, psnr, equal=equal, **others)
    cell = dataclasses.replace(CELL, scene=SceneAt(capture, capture), budget=budget)
    return dataclasses.replace(found, run=dataclasses.replace(found.run, cell=cell))


def test_registered_endpoints_are_decided_by_interval_and_corrected_p_value():
    """Nine captures: gains of PSNR on all, none of LPIPS; and one capture that nothing was tuned on."""
    results = []
    for index in range(9):
        capture, wobble = f"capture {index}", 0.1 * index
        results += [
            claims_result(capture, claims.BYTEWISE, 26.0 + wobble),
            claims_result(capture, claims.STRONGEST, 25.0 + 2 * wobble),
            claims_result(capture, claims.STRONGEST, 25.0, equal="time"),
        ]
    unseen = [
        claims_result("alexander", claims.BYTEWISE, 30.0),
        claims_result("alexander", claims.STRONGEST, 30.5, equal="time"),
    ]
    rows = [line.split(" | ") for line in claims.endpoints_table(results, unseen, {0.3: 9}).splitlines()]
    assert rows[0][-1] == "alexander |"
    primary, iterations, lpips = rows[2:]
    # 2 of 2^9 sign flips are as far from 0; the smaller of two secondary p-values counts twice.
    assert primary[:1] + primary[3:] == ["| primary", "+1.40 ± 0.21", "9/9", ".004", "**decided**", "-0.50 |"]
    assert iterations[:1] + iterations[3:] == ["| secondary", "+0.60 ± 0.21", "9/9", ".008", "**decided**", "– |"]
    assert lpips[3:] == ["+0.000 ± 0.000", "0/9", "1.000", "undecided", "+0.000 |"]
    unfinished = claims.endpoints_table(results, unseen, {0.3: 18}).splitlines()[2:]
    assert all("| unfinished, 9 of 18 pairs |" in line for line in unfinished)


def test_equal_time_is_the_time_of_all_stages():
    """Of stages alone, the ratios would be 0.4 and 38 / 30."""
    seconds = {
        claims.BYTEWISE: (Job("fox", 2, a2tg.Bytewise(), 1), "", (30.0, 10.0)),
        claims.STRONGEST: (Job("fox", 2, a2tg.A2tg(), 1), "time", (38.0, 4.0)),
    }
    results, records = [], {}
    for label, (job, equal, times) in seconds.items():
        one = claims_result("fox", label, 25.0, equal=equal)
        results.append(dataclasses.replace(one, run=dataclasses.replace(one.run, job=job)))
        records |= {stage.key: record(training_seconds=time) for stage, time in zip(job.chain, times, strict=True)}
    text = claims.times_text(results, records)
    assert text.startswith("The trainings of equal time took 1.05 to 1.05 times as long"), text
    del records[results[0].run.job.start.key]
    assert claims.times_text(results, records) == "", "a stage has no time"
