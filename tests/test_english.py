"""Pages, help, messages and docstrings avoid wordings that readers stumble over: a table of them and plainer ones."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
PLAINER = {
    r"(that|those) of": "the noun again",
    r"in place of|takes? the place of": "instead of, replaces",
    r"of your own": "custom",
    r"anew|beforehand|unasked|hardly": "again, before, without being asked, barely",
    r"go(es)? on": "continue",
    r"as far as": "where, if",
    r"will do": "works",
    r"\S*, too(?=[.;:)])": "also",
    r"so many": "the number, this many",
    r"as it is|in silence|at hand": "unchanged, without a message, available",
    r"(left|leaves?|leaving) aside": "ignored",
    r"(is|are) looked for": "is searched",
    r"nobody|somebody": "the noun",
    r"must say|(?<=[:;] )say": "must be, use",
    r"tells|told|mends?|hears?": "reports, prints, fixes",
    r"(program|run|message|page|viewer|command|file|event|option|library|system) (sees|wants|asks|knows)":
        "checks, needs",
    r"(lies?|stands?|lives?) (in|at|under|on|beside|there|before|near|behind|between|within|close|where)": "is",
    r"\[[\w-]+\.md\]": "a link text that says what is there",
}  # fmt: skip
PATTERN = re.compile("|".join(rf"(?<!\w)(?:{pattern})(?!\w)" for pattern in PLAINER), re.IGNORECASE)
CODE = re.compile(r"^```.*?^```|`[^`\n]*`|(?<=\])\([^)\s]*\)", re.DOTALL | re.MULTILINE)


def texts() -> Iterator[tuple[str, str]]:
    """All prose that users read, without code: (where, text)."""
    for page in [ROOT / "README.md", ROOT / "experiments" / "NOTEBOOK.md", *(ROOT / "docs").rglob("*.md")]:
        yield page.name, page.read_text(encoding="utf-8")
    for path in (ROOT / "a2tg_jax").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
                yield f"{path.relative_to(ROOT)}:{node.lineno}", node.value


def stumbles(text: str) -> list[str]:
    return [found[0] for found in PATTERN.finditer(" ".join(CODE.sub("…", text).split()))]


def test_words_are_plain():
    assert stumbles("A run tells `that of` it, too. [a.md](a.md)") == ["tells", "it, too", "[a.md]"]
    found = [f"{where}: {' '.join(words)}" for where, text in texts() if (words := stumbles(text))]
    assert not found, "\n".join(["plainer words are in PLAINER:", *found])
