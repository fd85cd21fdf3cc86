"""The run folder: what lies where, and when an existing one may be used.

    RUN/
      config.json                the scene, every number, the versions
      checkpoints/PHASE-*.npz    the newest two, to resume from
      models/PHASE.npz           what each finished phase left behind
      history/PHASE.csv          loss, PSNR, Gaussians, MB over the iterations
      metrics.json, per_view.json
      test/NAME.png              photograph, renders and error side by side
      figures/*.png              curves, texture resolutions
      point_cloud.ply            the Gaussians in the original world
      report.html                all of it on one page

The phases are `stage1`, `stage2` and, where asked for, `baseline`: a second stage of the same length without textures.
"""

import dataclasses
import json
import os
import shutil
from pathlib import Path
from typing import Any, Literal

from a2tg_jax.io.atomic import replacing

Phase = Literal["stage1", "stage2", "baseline"]
PHASES: tuple[Phase, ...] = ("stage1", "stage2", "baseline")
KEPT_CHECKPOINTS = 2
OWN_FOLDERS = ("checkpoints", "models", "history", "test", "figures")
OWN_FILES = ("config.json", "metrics.json", "per_view.json", "point_cloud.ply", "report.html")


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Paths within one run folder."""

    path: Path

    @property
    def config(self) -> Path:
        return self.path / "config.json"

    @property
    def metrics(self) -> Path:
        return self.path / "metrics.json"

    @property
    def per_view(self) -> Path:
        return self.path / "per_view.json"

    @property
    def point_cloud(self) -> Path:
        return self.path / "point_cloud.ply"

    @property
    def report(self) -> Path:
        return self.path / "report.html"

    @property
    def figures(self) -> Path:
        return self.path / "figures"

    @property
    def test(self) -> Path:
        return self.path / "test"

    def model(self, phase: Phase) -> Path:
        return self.path / "models" / f"{phase}.npz"

    def history(self, phase: Phase) -> Path:
        return self.path / "history" / f"{phase}.csv"

    def checkpoint(self, phase: Phase, iteration: int) -> Path:
        return self.path / "checkpoints" / f"{phase}-{iteration:06d}.npz"

    def checkpoints(self, phase: Phase) -> list[Path]:
        """The checkpoints of a phase, oldest first."""
        return sorted((self.path / "checkpoints").glob(f"{phase}-*.npz"))

    def drop_old_checkpoints(self, phase: Phase, keep: int = KEPT_CHECKPOINTS) -> None:
        """Deletes all checkpoints of a phase but the newest `keep`."""
        for path in self.checkpoints(phase)[: -keep or None]:
            path.unlink()


def check_free(path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """Refuses a folder that `create_run` would refuse, without touching it.

    Raises:
      FileExistsError: if there is something at `path` already that must not be lost.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file; choose another folder with --out")
    if path.is_dir() and not overwrite and any(entry.name != "config.json" for entry in path.iterdir()):
        raise FileExistsError(
            f"{path} is not empty; add --resume to go on with it, --overwrite to start anew, or choose another --out"
        )


def create_run(path: str | os.PathLike, *, overwrite: bool = False) -> RunFolder:
    """A new run folder, made with its parents.

    Args:
      path: where; an existing folder must be empty, or hold no more than the config.json of a run that never began.
      overwrite: delete what an earlier run left there first (nothing else).

    Raises:
      FileExistsError: if there is something at `path` already.
    """
    check_free(path, overwrite=overwrite)
    run = RunFolder(Path(path))
    if overwrite:
        _clear(run.path)
    run.path.mkdir(parents=True, exist_ok=True)
    return run


def open_run(path: str | os.PathLike) -> RunFolder:
    """An existing run folder.

    Raises:
      FileNotFoundError: if there is none at `path`.
    """
    run = RunFolder(Path(path))
    if not run.config.is_file():
        raise FileNotFoundError(f"{path} is not a run folder (it has no config.json); a2tg train --out makes one")
    return run


def write_json(path: Path, data: Any) -> None:
    """Indented JSON, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(data, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
      ValueError: if the file is damaged.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: is not valid JSON: {error}") from error


def _clear(path: Path) -> None:
    """Deletes what runs write into their folder."""
    for name in OWN_FOLDERS:
        shutil.rmtree(path / name, ignore_errors=True)
    for name in OWN_FILES:
        (path / name).unlink(missing_ok=True)
