"""Commit of the project's repository that the running package comes from."""

import json
import os
import subprocess
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
"""Folder of the package's folder: a checkout, or site-packages."""
GIT_SECONDS = 10
VARIABLE = "A2TG_COMMIT"
"""Environment variable with the commit of a copy without a repository, such as in a container."""


def source_commit() -> str | None:
    """Return the commit of the checkout, with "-dirty" appended if files were changed; without a checkout, the
    environment variable A2TG_COMMIT, or the commit that pip recorded when it installed from a repository
    (direct_url.json, PEP 610); None if none is known."""
    given = os.environ.get(VARIABLE) or None
    try:
        if (CHECKOUT / ".git").exists():
            # --exclude=* leaves out tags, whose names would be printed.
            command = ["git", "-C", str(CHECKOUT), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty"]
            done = subprocess.run(command, capture_output=True, text=True, timeout=GIT_SECONDS, check=True)
            return done.stdout.strip()
        if given is not None:
            return given
        recorded = distribution("a2tg-jax").read_text("direct_url.json")
        return json.loads(recorded).get("vcs_info", {}).get("commit_id") if recorded else None
    except (OSError, subprocess.SubprocessError, PackageNotFoundError):
        return given
