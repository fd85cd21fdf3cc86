"""Commit of the project's repository that the running package comes from."""

import json
import subprocess
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

DISTRIBUTION = "a2tg-jax"
CHECKOUT = Path(__file__).resolve().parents[2]
"""Folder of the package's folder: a checkout, or site-packages."""
GIT_SECONDS = 10


def source_commit() -> str | None:
    """Return the commit, with "-dirty" behind it if files of the checkout were changed; None if it is unknown.

    It is that of the checkout the package runs in, or the one that pip noted when it installed from a repository.
    """
    return _of_checkout(CHECKOUT) if (CHECKOUT / ".git").exists() else _of_installation()


def _of_checkout(folder: Path) -> str | None:
    command = ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=GIT_SECONDS, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _of_installation() -> str | None:
    """Return the commit in direct_url.json (PEP 610)."""
    try:
        noted = distribution(DISTRIBUTION).read_text("direct_url.json")
    except PackageNotFoundError:
        return None
    return json.loads(noted).get("vcs_info", {}).get("commit_id") if noted else None
