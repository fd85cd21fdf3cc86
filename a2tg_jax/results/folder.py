"""The run folder: what lies where, and when an existing one may be used.

    RUN/
      .a2tg-run                  the marker: this program made the folder, and what it wrote there
      run.toml                   the scene, the system with every number, the systems compared: repeats the run
      checkpoints/NAME-*.npz     the newest two of each stage, to resume from
      models/NAME.npz            what each finished stage left behind, with cameras, world and background
      history/NAME.csv           loss, PSNR, Gaussians, MB over the iterations
      metrics.json, per_view.json
      test/NAME.png              photograph, renders and error side by side
      figures/                   curves, texture resolutions, some textures, depth, normals, a flight
      point_cloud.ply            the Gaussians in the original world
      report.html                all of it on one page

NAME is that of a stage, such as `a2tg-gaussians` or `a2tg-textures`: the system's, and the stage's in it (`plan`).
"""

import dataclasses
import glob
import json
import os
import re
from pathlib import Path
from typing import Any

from a2tg_jax.io.atomic import replacing
from a2tg_jax.json_text import parse_json

KEPT_CHECKPOINTS = 2
MARKER = "a2tg-jax run"


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Paths within one run folder."""

    path: Path

    @property
    def marker(self) -> Path:
        return self.path / ".a2tg-run"

    def own(self, path: Path) -> Path:
        """The path, noted in the marker as one that this program writes: nothing else is ever replaced or deleted."""
        name = path.relative_to(self.path).as_posix()
        if name not in self.written():
            self.path.mkdir(parents=True, exist_ok=True)
            is_new = not self.marker.is_file()
            with open(self.marker, "a", encoding="utf-8") as file:
                file.write(f"{MARKER}\n{name}\n" if is_new else f"{name}\n")
        return path

    def written(self) -> list[str]:
        """What the marker lists, relative to the folder; nothing where there is no marker.

        Raises:
          ValueError: if the marker is not this program's.
        """
        if not self.marker.is_file():
            return []
        first, *names = self.marker.read_text(encoding="utf-8").splitlines() or [""]
        if first != MARKER:
            raise ValueError(f"{self.marker} is not the marker of a run; choose another folder with --out")
        return names

    @property
    def record(self) -> Path:
        return self.path / "run.toml"

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

    def model(self, name: str) -> Path:
        return self.path / "models" / f"{name}.npz"

    def history(self, name: str) -> Path:
        return self.path / "history" / f"{name}.csv"

    def checkpoint(self, name: str, iteration: int) -> Path:
        return self.path / "checkpoints" / f"{name}-{iteration:06d}.npz"

    def checkpoints(self, name: str) -> list[Path]:
        """The checkpoints of a stage, oldest first."""
        pattern = re.compile(re.escape(name) + r"-\d{6,}\.npz")
        found = (self.path / "checkpoints").glob(f"{glob.escape(name)}-*.npz")
        return sorted((path for path in found if pattern.fullmatch(path.name)), key=iteration_of)

    def drop_old_checkpoints(self, name: str, keep: int = KEPT_CHECKPOINTS) -> None:
        """Deletes all checkpoints of a stage but the newest `keep`."""
        for path in self.checkpoints(name)[: -keep or None]:
            path.unlink()


def iteration_of(checkpoint: Path) -> int:
    """The iteration after which a checkpoint was written."""
    return int(checkpoint.stem.rpartition("-")[2])


def check_free(path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """Refuses a folder that `create_run` would refuse, without touching it.

    Raises:
      FileExistsError: if there is something at `path` already that must not be lost: with `overwrite`, anything in a
        folder that no run was made in.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file; choose another folder with --out")
    run = RunFolder(path)
    unused = {run.marker.name, run.record.name} if run.marker.is_file() else set()
    if not path.is_dir() or all(entry.name in unused for entry in path.iterdir()):
        return
    if not run.written():
        raise FileExistsError(f"{path} is not empty and not a run folder; choose another folder with --out")
    if not overwrite:
        raise FileExistsError(
            f"{path} is not empty; add --resume to go on with it, --overwrite to start anew, or choose another --out"
        )


def create_run(path: str | os.PathLike, *, overwrite: bool = False) -> RunFolder:
    """A new run folder, made with its parents.

    Args:
      path: where; an existing folder must be empty, or hold no more than the run.toml of a run that never began.
      overwrite: delete first what an earlier run wrote there, as its marker lists it, and nothing else. Check all that
        the new run needs before.

    Raises:
      FileExistsError: as `check_free` does.
    """
    check_free(path, overwrite=overwrite)
    run = RunFolder(Path(path))
    if overwrite:
        _clear(run)
    run.path.mkdir(parents=True, exist_ok=True)
    run.own(run.marker)
    return run


def open_run(path: str | os.PathLike) -> RunFolder:
    """An existing run folder.

    Raises:
      FileNotFoundError: if there is none at `path`.
    """
    run = RunFolder(Path(path))
    if not run.record.is_file():
        raise FileNotFoundError(f"{path} is not a run folder (it has no run.toml); a2tg train --out makes one")
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
        return parse_json(path.read_bytes(), allow_nan=True)  # The PSNR of equal images is infinite.
    except ValueError as error:
        raise ValueError(f"{path}: is not valid JSON: {error}") from error


def _clear(run: RunFolder) -> None:
    """Deletes what runs wrote into their folder, and the folders that are empty then; the marker last."""
    for name in run.written():
        path = run.path / name
        is_inside = path.resolve().is_relative_to(run.path.resolve())
        # A line that a crash has cut off may name a folder.
        if is_inside and path != run.marker and not path.is_dir():
            path.unlink(missing_ok=True)
            if path.parent != run.path and path.parent.is_dir() and not any(path.parent.iterdir()):
                path.parent.rmdir()
    run.marker.unlink(missing_ok=True)
