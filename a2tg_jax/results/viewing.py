"""Content of the viewer: a model as a scene for browsers, and its photographs."""

import dataclasses
import functools
import io
import json
import shlex
import threading
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from a2tg_jax.core.origin import BLACK, Color, Origin
from a2tg_jax.data import Scene, View, view_image
from a2tg_jax.data.load import is_scene
from a2tg_jax.host.regular_files import is_regular
from a2tg_jax.io.formats import FORMATS, file_bytes, load_splats
from a2tg_jax.io.model_file import load_model
from a2tg_jax.io.web_scene import encode_web_scene
from a2tg_jax.model import Model
from a2tg_jax.rasterize.render_types import RenderSettings
from a2tg_jax.results.folder import RunFolder, open_run, resuming_command
from a2tg_jax.results.images import to_uint8
from a2tg_jax.results.record import read_record
from a2tg_jax.results.run_evaluation import settings_of
from a2tg_jax.web.page import PHOTOGRAPHS_NAME, SCENE_NAME, photograph_name, viewer_html
from a2tg_jax.web.server import Route

QUALITY = 90
SHOWN = f"a run folder, or a file *{', *'.join(FORMATS)}"
MOST_LISTED = 5
"""Largest number of run folders that a message lists."""


@dataclasses.dataclass(frozen=True)
class Source:
    """Model with its title, render settings and photographs."""

    model: Model
    title: str
    note: str = ""
    """Note that the viewer shows."""
    settings: RenderSettings = RenderSettings()
    """Render settings."""
    load_scene: Callable[[], Scene | None] = lambda: None
    """Loader of the photographs; None if they are missing. Raises ValueError or OSError if they cannot be read."""
    num_bytes: int = 0
    """Bytes of the file that it was read from."""

    @functools.cached_property
    def near_plane(self) -> float:
        """Distance of the near plane; small for files whose world has an unknown size."""
        if (self.model.origin is not None and self.model.origin.names) or not self.model.num:
            return self.settings.near_plane
        return min(self.settings.near_plane, 0.02 * middle_of(self.model)[1])

    @functools.cached_property
    def encoded(self) -> bytes:
        """Return the scene for browsers. Raises ValueError if they cannot show it."""
        return encode_web_scene(self.model, title=self.title, note=self.note, near_plane=self.near_plane)


def open_source(path: Path, name: str | None = None) -> Source:
    """Open a run folder or a file for viewing.

    Args:
      path: a run folder, or a file of any format that `load_splats` reads.
      name: which model of a run, by the name that `a2tg info` tells; None is the last of its main system.

    Raises:
      FileNotFoundError: if there is no such file, or the run's stage is not finished.
      ValueError: if it cannot be read.
    """
    if path.is_dir():
        return _source_of_run(_run_at(path), name)
    if not is_regular(path):
        raise FileNotFoundError(f"{path}: no such file or folder")
    if name is not None:
        raise ValueError(f"--model needs a run folder; {path} is not a folder")
    if not path.name.lower().endswith(tuple(FORMATS)):
        raise ValueError(f"{path}: is not a scene to show; give {SHOWN}")
    return _source_of_file(path)


def _run_at(folder: Path) -> RunFolder:
    """Return the run folder; if the folder is none, raise FileNotFoundError with what lies there instead."""
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


def _source_of_run(run: RunFolder, name: str | None) -> Source:
    record = read_record(run)
    planned = record.plan[record.plan.main[-1] if name is None else name]
    path = run.model(planned.name)
    if not is_regular(path):
        raise FileNotFoundError(f"{run.path} has no finished {planned.name}; continue with: {resuming_command(run)}")

    def load_scene() -> Scene | None:
        try:
            return record.scene.load()
        except FileNotFoundError:
            return None  # The photographs are gone; the model shows itself.

    title = f"{record.scene.name} · {planned.name}"
    model, settings = load_model(path), settings_of(planned.system)
    return Source(model, title, settings=settings, load_scene=load_scene, num_bytes=path.stat().st_size)


def _source_of_file(path: Path) -> Source:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = load_splats(path)
    notes = [str(warning.message).removeprefix(f"{path}: ") for warning in caught]
    for note in notes:
        warnings.warn(f"{path}: {note}", stacklevel=3)
    return Source(model, path.stem, ". ".join(notes), num_bytes=file_bytes(path))


# Photographs


def scene_or_warning(load_scene: Callable[[], Scene | None]) -> Scene | None:
    """Return the scene of a loader; None if the photographs are missing or, with a warning, if they cannot be read."""
    try:
        return load_scene()
    except (OSError, ValueError) as error:
        warnings.warn(f"the photographs are left out: {error}", stacklevel=2)
        return None


class ServedPhotographs:
    """Photographs of a model's cameras, served as JPEG and read on demand."""

    def __init__(self, origin: Origin | None, load_scene: Callable[[], Scene | None], background: Color = BLACK):
        """Args:
        origin: the cameras; None without cameras.
        load_scene: finds the photographs, or None.
        background: RGB behind photographs that are transparent.
        """
        self._origin, self._load_scene, self._background = origin, load_scene, background
        self._lock = threading.Lock()
        self._views: dict[int, View] | None = None

    @property
    def views(self) -> dict[int, View]:
        """Views by the index of their cameras."""
        with self._lock:
            if self._views is None:
                self._views = self._found()
            return self._views

    def jpeg(self, index: int) -> bytes | None:
        """Return a photograph over the model's background, of its camera's size."""
        view = self.views.get(index)
        if view is None or self._origin is None:
            return None
        buffer = io.BytesIO()
        pixels = to_uint8(view_image(view, self._background))
        Image.fromarray(pixels).save(buffer, format="JPEG", quality=QUALITY)
        return buffer.getvalue()

    @property
    def routes(self) -> dict[str, Route]:
        """Routes of the viewer's server."""
        names = () if self._origin is None else self._origin.names
        listed = Route("application/json", lambda: json.dumps(sorted(self.views)).encode())
        each = {
            f"/{photograph_name(index)}": Route("image/jpeg", functools.partial(self.jpeg, index))
            for index in range(len(names))
        }
        return {f"/{PHOTOGRAPHS_NAME}": listed, **each}

    def _found(self) -> dict[int, View]:
        origin = self._origin
        scene = None if origin is None else self._load_scene()
        if origin is None or scene is None:
            return {}
        by_name = {view.name: view for view in (*scene.train, *scene.test)}
        return {index: by_name[name] for index, name in enumerate(origin.names) if name in by_name}


def routes_of(source: Source) -> dict[str, Route]:
    """Return the routes of the viewer's server. Photographs that cannot be read are left out, with a warning."""
    load_scene = functools.partial(scene_or_warning, source.load_scene)
    return {
        "/": Route("text/html; charset=utf-8", viewer_html().encode()),
        f"/{SCENE_NAME}": Route("application/octet-stream", source.encoded),
        **ServedPhotographs(source.model.origin, load_scene, source.model.background).routes,
    }


def middle_of(model: Model) -> tuple[np.ndarray, float]:
    """Return the centre [3] of most means, and the radius that holds three quarters of them."""
    means = np.asarray(model.live.gaussians.means, np.float64)
    centre = np.median(means, axis=0)
    return centre, float(max(np.quantile(np.linalg.norm(means - centre, axis=1), 0.75), 1e-6))
