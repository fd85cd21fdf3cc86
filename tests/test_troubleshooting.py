"""The messages that the page on troubleshooting quotes are still in the program."""

import ast
import re
from functools import cache
from pathlib import Path

from a2tg_jax.cli.main import _with_flags

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
NOT_OURS = {
    "Killed",
    "a2tg render",
    "os.fork() was called … this will likely lead to a deadlock",
    "DEADLINE_EXCEEDED",
    "the JAX distributed service detected fatal errors",
}
"""Code in bold that is no message of the program, but of others."""
QUOTED = {
    " ".join(code.split())
    for bold in re.findall(r"\*\*(.+?)\*\*", PAGE, re.DOTALL)
    for code in re.findall(r"`([^`]+)`", bold)
} - NOT_OURS


@cache
def texts() -> tuple[str, ...]:
    """All texts of the package, options as flags; what an f-string fills in is …."""
    found = []
    for path in (ROOT / "a2tg_jax").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = (part.value if isinstance(part, ast.Constant) else "…" for part in node.values)
                found.append("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return tuple(_with_flags(text) for text in found)


def pieces(message: str) -> list[str]:
    return [piece for piece in (piece.strip() for piece in message.split("…")) if re.search(r"\w{2}", piece)]


def is_told(message: str) -> bool:
    """Whether some text has all pieces of a message in their order."""
    pattern = re.compile(".*".join(map(re.escape, pieces(message))), re.DOTALL)
    return any(pattern.search(text) for text in texts())


def test_the_program_has_the_messages():
    assert len(QUOTED) > 25 and not is_told("… has been told by nobody; …")
    missing = [message for message in sorted(QUOTED) if not is_told(message)]
    assert not missing, "no text of the package has these messages"
