"""Pages point at what exists: files, headings, modules and their names, commands and their options."""

import contextlib
import importlib
import io
import re
import shlex
import tomllib
from pathlib import Path

import pytest

from a2tg_jax.cli import main as cli

ROOT = Path(__file__).parent.parent
NOTEBOOK = ROOT / "experiments" / "NOTEBOOK.md"
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *NOTEBOOK.parent.glob("*.md")])
ROOMS = "|".join(path.parent.name for path in sorted((ROOT / "a2tg_jax").glob("*/__init__.py")))
FOLDERS = "a2tg_jax|benchmarks|docs|experiments|notebooks|tests|web"


def without_code(text: str) -> str:
    return re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", without_code(page.read_text(encoding="utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(page.read_text(encoding="utf-8"))):
        if target.startswith(("http://", "https://", "mailto:")):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.exists(), f"{target} leads nowhere"
        assert not anchor or anchor in anchors(file), f"{target}: no such heading"


def test_code_names_sections_of_the_notebook():
    """By the first words of their titles."""
    titles = [title.replace("`", "") for title in re.findall(r"^## (.*)$", NOTEBOOK.read_text(encoding="utf-8"), re.M)]
    code = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "a2tg_jax").rglob("*.py"))
    named = set(re.findall(r'experiments/NOTEBOOK\.md, "([^"]+)"', code))
    assert len(named) > 5
    missing = [words for words in named if not any(title.startswith(words) for title in titles)]
    assert not missing


def test_the_version_is_one():
    """Of the package, of the citation, and the changelog's newest."""
    package, citation, changes = (
        (ROOT / name).read_text(encoding="utf-8") for name in ("pyproject.toml", "CITATION.cff", "CHANGELOG.md")
    )
    version = tomllib.loads(package)["project"]["version"]
    assert re.findall(r"^version: (\S+)$", citation, re.MULTILINE) == [version]
    assert re.findall(r"^## \[(\d.*?)\] - \d{4}-\d\d-\d\d$", changes, re.MULTILINE)[:1] == [version]


def test_extras_that_pages_install_exist():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    installed = set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        # In small letters: NAME is a placeholder.
        for names in re.findall(r"pip install[^\n]*?(?:\.|/src|a2tg-jax)\[([a-z0-9,]+)\]", text):
            installed.update(names.split(","))
    assert {"viewer", "video", "cuda13"} <= installed <= extras.keys()


def test_supported_versions_of_python_are_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    versions = re.findall(r"Python :: (3\.\d+)", " ".join(project["classifiers"]))
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8")
    (tested,) = re.findall(r"python: \[(.*)\]", workflow)
    assert re.findall(r"3\.\d+", tested) == versions
    assert project["requires-python"] == f">={versions[0]}"
    for name in ("README.md", "CONTRIBUTING.md", "docs/install.md", "docs/tutorial.md"):
        assert f"Python {versions[0]} to {versions[-1]}" in (ROOT / name).read_text(encoding="utf-8"), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_named_files_exist(page):
    if page.name == "CHANGELOG.md":  # It names what has gone, too.
        return
    for name in re.findall(rf"`((?:{FOLDERS})/[\w./-]*)`", page.read_text(encoding="utf-8")):
        assert (ROOT / name).exists() or (ROOT / f"{name}.py").exists(), f"`{name}` is no file of the project"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_named_parts_of_the_package_exist(page):
    if page.name == "CHANGELOG.md":
        return
    for dotted in re.findall(rf"`(?:a2tg_jax\.)?((?:{ROOMS})\.\w+\.\w+)", page.read_text(encoding="utf-8")):
        found = importlib.import_module("a2tg_jax")
        for part in dotted.split("."):
            if not hasattr(found, part):
                importlib.import_module(f"{found.__name__}.{part}")
            found = getattr(found, part)


COMMANDS = sorted(
    {
        command
        for page in PAGES
        for block in re.findall(r"^```sh\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
        for line in block.replace("\\\n", " ").splitlines()
        for command in re.findall(r"(?:^|&& )(a2tg (?!COMMAND)[^#&|]*[^#&| ])", line)
    }
)
"""Command lines in blocks of pages."""


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_are_understood(command, monkeypatch):
    """All but those that read a run's or a file's options, for which there would have to be one."""
    _, name, *arguments = shlex.split(command)
    if {"--resume", "--config"} & set(arguments) or any(":" in word for word in arguments):
        pytest.skip("reads a file")
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        assert cli.parsed(name, arguments)
