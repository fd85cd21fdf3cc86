"""The documentation as a site: every page is in its navigation, every public name and option on a page."""

import json
import re
from pathlib import Path

import options
import pytest
import site_pages

import a2tg_jax as a2tg

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
NAVIGATION = re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"))


def test_every_page_is_in_the_navigation_once():
    pages = {str(path.relative_to(DOCS).as_posix()) for path in DOCS.rglob("*.md")}
    notebooks = {f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert sorted(NAVIGATION) == sorted(pages | notebooks | set(site_pages.PAGES.values()))


def test_every_public_name_is_in_the_reference_once():
    pages = [path.read_text(encoding="utf-8") for path in (DOCS / "api").glob("*.md")]
    assert sorted(re.findall(r"^::: a2tg_jax\.(\w+)$", "\n".join(pages), re.MULTILINE)) == a2tg.__all__


def test_the_table_of_the_reference_has_the_names_of_its_pages():
    text = (DOCS / "api" / "index.md").read_text(encoding="utf-8")
    for page, names in re.findall(r"^\| \[.*\]\((\w+\.md)\) \| (.*) \|$", text, re.MULTILINE):
        found = re.findall(r"^::: a2tg_jax\.(\w+)$", (DOCS / "api" / page).read_text(encoding="utf-8"), re.MULTILINE)
        assert re.findall(r"`(\w+)`", names) == found, page


def test_the_page_of_options_is_current():
    written = (DOCS / "options.md").read_text(encoding="utf-8")
    assert options.page() == written, "run python docs/scripts/options.py"


def test_the_page_of_options_has_every_command_with_its_arguments_and_choices():
    written = (DOCS / "options.md").read_text(encoding="utf-8")
    assert re.findall(r"^## `a2tg (\w+)`$", written, re.MULTILINE) == list(options.command_line.COMMANDS)
    assert "\n| `PHOTOS... SCENE` |" in written
    assert "OPENCV_FISHEYE}` |" in written, "choices of more than a line"


def test_options_beside_those_of_other_programs_exist():
    text = (DOCS / "coming-from.md").read_text(encoding="utf-8")
    here = [row.rsplit("|", 2)[1] for row in re.findall(r"^\|.*\|$", text.partition("## Cameras")[0], re.MULTILINE)]
    flags = {flag for cell in here for flag in re.findall(r"--[\w.-]+", cell) if flag.strip("-")}
    known = set(re.findall(r"`(--[\w.-]+)", (DOCS / "options.md").read_text(encoding="utf-8")))
    assert len(flags) > 20 and flags <= known


@pytest.mark.parametrize(
    "page, link, wanted",
    [
        ("README.md", "docs/install.md", "install.md"),
        ("docs/api/models.md", "../library.md#models", "../library.md#models"),
        ("docs/results.md", "../experiments/results/a.png", "repository/experiments/results/a.png"),
        ("docs/wild.md", "../experiments/NOTEBOOK.md#a", "repository/experiments/NOTEBOOK.md.txt#a"),
        ("docs/api/models.md", "../../notebooks/a.ipynb", "../notebooks/a.md"),
        ("docs/install.md", "../notebooks", "notebooks.md"),
        ("docs/install.md", "https://a.org/b.md", "https://a.org/b.md"),
    ],
)
def test_links_lead_to_the_place_in_the_site(page, link, wanted):
    assert site_pages.with_places(f"[a]({link})", page) == f"[a]({wanted})"


def test_a_notebook_becomes_text_code_and_outputs():
    outputs = [{"text": ["1\n"]}, {"data": {"image/png": "AA=="}}, {"data": {"text/html": ["<b>2</b>"]}}]
    cells = [
        {"cell_type": "markdown", "source": ["# [Title](../docs/a.md)"]},
        {"cell_type": "code", "metadata": {"alt": "two dots"}, "source": ["print(1)"], "outputs": outputs},
    ]
    text = site_pages.notebook_text(json.loads(json.dumps({"cells": cells})))
    assert text.split("\n\n") == [
        "# [Title](../a.md)",
        "```python\nprint(1)\n```",
        "```text\n1\n```",
        '<img alt="two dots" src="data:image/png;base64,AA==">',
        "<b>2</b>",
    ]
