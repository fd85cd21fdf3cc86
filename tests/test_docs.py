"""Pages point at what exists: files, headings, modules and their names."""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
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
