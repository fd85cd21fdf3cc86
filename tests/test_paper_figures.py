"""The figures in experiments/lab/paper.json are those that the paper prints, in every one of its tables."""

import json
import math
import pathlib
import re

import pytest

FILE = pathlib.Path(__file__).resolve().parents[1] / "experiments" / "lab" / "paper.json"
PAPER = json.loads(FILE.read_text(encoding="utf-8"))
DATASETS = ["Mip-NeRF 360", "Tanks and Temples", "Deep Blending"]
QUALITY = ["psnr", "ssim", "lpips"]
KEYS = {
    "fixed_memory": ["dataset", "budget_mb", "method", *QUALITY, "gaussians", "mb"],
    "fixed_number": ["dataset", "gaussians", "method", *QUALITY, "mb", "extra_percent"],
    "ablation": ["gaussians", "method", *QUALITY, "mb"],
    "texture_resolution": ["gaussians", "method", "side", *QUALITY, "mb"],
    "efficiency": ["method", "gaussians", "mb", "fps", "seconds_per_frame", "training_minutes"],
    "resolution_shares": ["scene", "dataset", "1x1"],
}
COUNTS = {"fixed_memory": 33, "fixed_number": 72, "ablation": 12, "texture_resolution": 16, "efficiency": 3}
METHODS = ["2DGS", "2DGS*", "2DGS*-MCMC", "SuperGaussians", "BBSplat", "Textured Gaussians*", "A²TG"]
PRINTED = {
    "Super Gaussians": "SuperGaussians",
    r"Textured Gaussians$^\ast$": "Textured Gaussians*",
    r"{\modelAbbrev} (Ours)": "A²TG",
    r"\modelAbbrev\ (Ours)": "A²TG",
    r"{\modelAbbrev}": "A²TG",
    r"\ablaone": "w/o upscaling",
    r"\ablatwo": "w/o anisotropy",
    r"\ablathree": "A²TG",
}


@pytest.fixture
def tex(shared):
    path = shared / "paper" / "a2tg.tex"
    if not path.is_file():
        pytest.skip(f"the paper is not at {path}")
    return path.read_text(encoding="utf-8")


def table_lines(tex: str, label: str) -> list[list[str]]:
    """The cells of every line of the tabulars above a label, without colours and rules."""
    end = tex.index(rf"\label{{{label}}}")
    bodies = re.findall(
        r"\\begin\{tabular\}\{\w+\}(.*?)\\end\{tabular\}", tex[tex.rindex(r"\begin{table", 0, end) : end], re.S
    )
    text = re.sub(r"\\(?:best|second|third|bestmem|textbf)\{([^{}]*)\}", r"\1", r" \\ ".join(bodies))
    text = re.sub(r"\\(?:(?:top|mid|bottom)rule|cmidrule\(lr\)\{[\d-]+\}|addlinespace\[2pt\])", "", text)
    return [[cell.strip() for cell in re.split(r"(?<!\\)&", line)] for line in text.split(r"\\")]


def counted(lines):
    """(number of Gaussians, method, other cells) of each line below a heading "#GS = 500k"."""
    gaussians = None
    for first, *cells in lines:
        if heading := re.search(r"#GS = (\d+)([kM])", first):
            gaussians = int(heading[1]) * {"k": 1000, "M": 1_000_000}[heading[2]]
        elif gaussians and first:
            yield gaussians, PRINTED.get(first, first), cells


def number(printed: str) -> float:
    """The number of a cell; int where it is printed whole."""
    digits = re.fullmatch(r"([\d.]+)(?:MB)?", printed)[1]
    return float(digits) if "." in digits else int(digits)


def quality(cells: list[str]) -> dict:
    return dict(zip(QUALITY, map(number, cells), strict=True))


def fixed_number(tex: str, label: str) -> dict:
    """The rows of a table of fixed numbers of Gaussians, by dataset, number and method."""
    rows = {}
    for gaussians, method, cells in counted(table_lines(tex, label)):
        for name, four in zip(DATASETS, (cells[:4], cells[4:8], cells[8:]), strict=True):
            if four != ["--"] * 4:
                mb, extra = map(int, re.fullmatch(r"(\d+) \((\d+)\\%\)", four[3]).groups())
                rows[name, gaussians, method] = {**quality(four[:3]), "mb": mb, "extra_percent": extra}
    return rows


def same_rows(table: str, expected: list[dict]) -> None:
    """The stored rows are the expected ones, in whatever order, each once."""

    def texts(rows):
        return sorted(json.dumps(row, sort_keys=True) for row in rows)

    assert texts(PAPER[table]) == texts(expected)


def test_fixed_memory_is_what_the_paper_prints(tex):
    lines = [line for line in table_lines(tex, "tbl:fixed_memory") if line[-1].endswith("MB")]
    second = [line[0] for line in lines].index("2DGS*")  # only the smaller budgets have it
    expected = []
    for index, (method, *cells) in enumerate(lines):
        budgets = (200, 200, 200) if index < second else (60, 50, 60)
        for name, budget, five in zip(DATASETS, budgets, (cells[:5], cells[5:10], cells[10:]), strict=True):
            gaussians = int(re.fullmatch(r"(\d+)k", five[3])[1]) * 1000
            row = {"dataset": name, "budget_mb": budget, "method": PRINTED.get(method, method), **quality(five[:3])}
            expected.append({**row, "gaussians": gaussians, "mb": number(five[4])})
    same_rows("fixed_memory", expected)


def test_fixed_number_is_what_the_appendix_prints_with_the_other_numbers_of_the_main_text(tex):
    appendix = fixed_number(tex, "tbl:appendix_full_all_reranked")
    main = fixed_number(tex, "tbl:fixed_gs")
    assert len(main) == 45 and main.keys() < appendix.keys()
    expected = []
    for (name, gaussians, method), numbers in appendix.items():
        other = main.get((name, gaussians, method), numbers)
        other = {key: value for key, value in other.items() if value != numbers[key]}
        row = {"dataset": name, "gaussians": gaussians, "method": method, **numbers}
        expected.append({**row, "main_text": other} if other else row)
    same_rows("fixed_number", expected)


def test_ablation_is_what_the_paper_prints(tex):
    found = counted(table_lines(tex, "tbl:full_ablation_study_gs_avg_only"))
    found = [(gaussians, method, cells) for gaussians, method, cells in found if method != "Method"]
    same_rows("ablation", [{"gaussians": n, "method": m, **quality(c[:3]), "mb": number(c[3])} for n, m, c in found])


def test_texture_resolution_is_what_the_paper_prints(tex):
    expected = []
    for gaussians, method, (size, *cells) in counted(table_lines(tex, "tab:texture_res_exp")):
        side, other = map(int, re.search(r"(\d+)\{\\times\}(\d+)", size).groups())
        assert side == other
        row = {"gaussians": gaussians, "method": method, "side": side, **quality(cells[:3])}
        expected.append({**row, "mb": number(cells[3])})
    same_rows("texture_resolution", expected)


def test_efficiency_is_what_the_paper_prints(tex):
    lines = [line for line in table_lines(tex, "tbl:addtional_render_speed") if line[0]]
    names, counts, *rest = ([PRINTED.get(cell, cell) for cell in cells] for _, *cells in lines)
    assert counts == ["500k"] * 3
    columns = (names, [500_000] * 3, *([number(cell) for cell in cells] for cells in rest))
    same_rows("efficiency", [dict(zip(KEYS["efficiency"], row, strict=True)) for row in zip(*columns, strict=True)])


def test_the_share_of_single_texels_is_what_the_paper_prints(tex):
    percent = re.search(r"\$([\d.]+)\\%\$ of Gaussians retain \$1\\times1\$ textures", tex)[1]
    same_rows("resolution_shares", [{"scene": "garden", "dataset": DATASETS[0], "1x1": round(float(percent) / 100, 3)}])


def test_every_row_has_the_keys_of_its_table_and_numbers_that_can_be():
    assert {table: len(rows) for table, rows in PAPER.items()} == {**COUNTS, "resolution_shares": 1}
    for table, rows in PAPER.items():
        for row in rows:
            assert [key for key in row if key != "main_text"] == KEYS[table]
            assert row.get("method", "A²TG") in [*METHODS, "w/o upscaling", "w/o anisotropy"]
            assert row.get("dataset", DATASETS[0]) in DATASETS
            assert 10 <= row.get("psnr", 20) <= 40 and row.get("mb", 1) > 0
            assert all(0 <= row.get(key, 0) <= 1 for key in ("ssim", "lpips", "1x1"))


def test_plain_gaussians_take_232_bytes():
    """Within 3%, or rounded up to whole megabytes: the appendix prints 2.32 MB as 3."""
    plain = [row for rows in PAPER.values() for row in rows if row.get("method", "").startswith("2DGS")]
    assert len(plain) == 37
    for row in plain:
        exact = 232e-6 * row["gaussians"]
        for mb in (row["mb"], row.get("main_text", row)["mb"]):
            assert abs(mb / exact - 1) < 0.03 or mb == math.ceil(exact)


@pytest.mark.parametrize("method, same", [("A²TG", "A²TG"), ("w/o upscaling", "2DGS*-MCMC")])
def test_the_ablation_is_the_mean_over_the_datasets(method, same):
    """Of the full method, and of 2DGS*-MCMC, whose figures the paper prints as those without upscaling."""
    for row in (row for row in PAPER["ablation"] if row["method"] == method):
        wanted = (row["gaussians"], same)
        three = [other for other in PAPER["fixed_number"] if (other["gaussians"], other["method"]) == wanted]
        assert len(three) == 3
        for key, rounding in (("psnr", 0.01), ("ssim", 0.001), ("lpips", 0.001), ("mb", 1)):
            assert abs(sum(other[key] for other in three) / 3 - row[key]) <= rounding
