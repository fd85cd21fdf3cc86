"""Run folders that tests fill themselves."""

from pathlib import Path

from a2tg_jax.results.folder import RunFolder, check_free


def create_run(path: Path) -> RunFolder:
    """A new run folder with its marker, in a folder that is free."""
    check_free(path)
    run = RunFolder(path)
    run.path.mkdir(parents=True, exist_ok=True)
    run.own(run.marker)
    return run
