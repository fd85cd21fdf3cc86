"""Models to show, export, convert, mesh, render or compress: the last of a run, another of its stages, or a file."""

import dataclasses
import functools
import shlex
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from a2tg_jax.data import Scene
from a2tg_jax.data.load import is_scene
from a2tg_jax.host.regular_files import is_regular
from a2tg_jax.io.formats import FORMATS, file_bytes, load_splats
from a2tg_jax.io.model_file import load_model
from a2tg_jax.io.web_scene import encode_web_scene
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.results.folder import RunFolder, open_run, resuming_command
from a2tg_jax.results.plan import PlannedStage
from a2tg_jax.results.record import RunRecord, read_record
from a2tg_jax.training import System

SHOWN = f"a run folder, or a file *{', *'.join(FORMATS)}"
MOST_LISTED = 5
"""Largest number of run folders that a message lists."""


@dataclasses.dataclass(frozen=True)
class Source:
    """Model with its title, file, render settings and photographs."""

    model: Model
    title: str
    note: str = ""
    """Note that the viewer shows."""
    settings: RenderSettings = RenderSettings()
    """Render settings."""
    load_scene: Callable[[], Scene | None] = lambda: None
    """Loader of the photographs; None if they are missing. Raises ValueError or OSError if they cannot be read."""
    path: Path = Path()
    """Its file."""
    system: System | None = None
    """System that trained the model of a run; None for a file."""

    @functools.cached_property
    def near_plane(self) -> float:
        """Distance of the near plane; small for files whose world has an unknown size."""
        if (self.model.origin is not None and self.model.origin.names) or not self.model.num:
            return self.settings.near_plane
        means = np.asarray(self.model.live.gaussians.means, np.float64)
        # The radius that holds three quarters of the Gaussians.
        radius = np.quantile(np.linalg.norm(means - np.median(means, axis=0), axis=1), 0.75)
        return min(self.settings.near_plane, 0.02 * float(max(radius, 1e-6)))

    @functools.cached_property
    def encoded(self) -> bytes:
        """Return the scene for browsers. Raises ValueError if they cannot show it."""
        return encode_web_scene(self.model, title=self.title, note=self.note, near_plane=self.near_plane)

    @property
    def num_bytes(self) -> int:
        """Size of its file, and of those that belong to it."""
        return file_bytes(self.path)

    def load_scene_or_warn(self) -> Scene | None:
        """Return the scene; None if the photographs are missing or, with a warning, if they cannot be read."""
        try:
            return self.load_scene()
        except (OSError, ValueError) as error:
            warnings.warn(f"the photographs are left out: {error}", stacklevel=2)
            return None


def finished_stage(run: RunFolder, name: str | None = None) -> tuple[RunRecord, PlannedStage]:
    """Return the record of a run and one of its stages; None: the last one of its main system. Raises ValueError or
    FileNotFoundError if there is no such stage, or it is not finished."""
    record = read_record(run)
    plan = record.plan
    planned = plan[plan.main[-1] if name is None else name]
    if not is_regular(run.model(planned.name)):
        raise FileNotFoundError(f"{run.path} has no finished {planned.name}; continue with: {resuming_command(run)}")
    return record, planned


def open_source(path: Path, name: str | None = None) -> Source:
    """Open a run folder or a file.

    Args:
      path: a run folder, or a file of any format that `load_splats` reads.
      name: which model of a run, by the name that `a2tg info` prints; None is the last of its main system.

    Raises:
      FileNotFoundError: if there is no such file, or the run's stage is not finished.
      ValueError: if it cannot be read.
    """
    if path.is_dir():
        run = _run_at(path)
        record, planned = finished_stage(run, name)

        def load_scene() -> Scene | None:
            try:
                return record.scene.load()
            except FileNotFoundError:
                return None

        title, file = f"{record.scene.name} · {planned.name}", run.model(planned.name)
        settings = settings_of(planned.system)
        return Source(load_model(file), title, "", settings, load_scene, file, planned.system)
    if not is_regular(path):
        raise FileNotFoundError(f"{path}: no such file or folder")
    if name is not None:
        raise ValueError(f"--model needs a run folder; {path} is not a folder")
    if not path.name.lower().endswith(tuple(FORMATS)):
        raise ValueError(f"{path}: is not a scene to show; give {SHOWN}")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = load_splats(path)
    notes = [str(warning.message).removeprefix(f"{path}: ") for warning in caught]
    for note in notes:
        warnings.warn(f"{path}: {note}", stacklevel=2)
    return Source(model, path.stem, ". ".join(notes), path=path)


def settings_of(system: System) -> RenderSettings:
    """Return the render settings of a system's models."""
    return RenderSettings(tile_size=system.tile_size)


def _run_at(folder: Path) -> RunFolder:
    """Return the run folder; if the folder is none, raise FileNotFoundError with what is in it instead."""
    if is_regular(RunFolder(folder).record):
        return open_run(folder)
    if is_scene(folder):
        command = ["a2tg", "train", str(folder), "--out", f"runs/{folder.resolve().name}", "--preset", "quick"]
        raise FileNotFoundError(f"{folder} is a scene that must be trained first: {shlex.join(command)}")
    runs = sorted(below for below in folder.iterdir() if RunFolder(below).record.is_file())
    if not runs:
        raise FileNotFoundError(f"{folder} is not a run folder (it has no run.toml); give {SHOWN}")
    listed = [shlex.quote(str(run)) for run in runs[:MOST_LISTED]] + ["…"] * (len(runs) > MOST_LISTED)
    raise FileNotFoundError(f"{folder} holds run folders; give one of them: {', '.join(listed)}")
