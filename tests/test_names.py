"""Within the package, the name of a class or of a public function stands for one thing."""

import ast
from collections import defaultdict
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "a2tg_jax"
SAME_MEANING = {
    "forward": "the three back-ends of the compositor",
    "backward": "the three back-ends of the compositor",
    "refusal": "why a back-end cannot run",
    "tile_lists": "XLA and native loops",
    "mean_score": "XLA and native loops",
    "value_and_slopes": "XLA and native loops",
    "main": "the command line, and its start",
}
"""Functions that several modules define, and what they have in common."""


def defined() -> dict[str, set[str]]:
    """The modules that define each class or public function at their top level."""
    found = defaultdict(set)
    for path in PACKAGE.rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                found[node.name].add(path.relative_to(PACKAGE).as_posix())
    return found


def test_no_name_stands_for_two_things():
    several = {name: sorted(paths) for name, paths in defined().items() if len(paths) > 1}
    wrong = {name: paths for name, paths in several.items() if name not in SAME_MEANING}
    assert not wrong
