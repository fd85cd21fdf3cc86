"""Content of the viewer: a model or a running training, and photographs; served, or exported as files.

A training is shown by snapshots every few seconds. Between steps the state is copied to the host, and a thread encodes
it. Together they take at most `SHARE` of the time, so slow snapshots are rare.
"""

import contextlib
import dataclasses
import functools
import io
import json
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image

from a2tg_jax.base.atomic import is_left_over, left_over, write_whole
from a2tg_jax.base.json_text import read_json
from a2tg_jax.base.text import counted, in_bytes
from a2tg_jax.core.origin import BLACK, Color, Origin
from a2tg_jax.io.compact import decode_model
from a2tg_jax.io.other_programs import matrix_of
from a2tg_jax.io.web_scene import encode_web_scene
from a2tg_jax.model import Model
from a2tg_jax.results.compression import loss_measures
from a2tg_jax.results.folder import remove_if_empty
from a2tg_jax.results.images import to_uint8
from a2tg_jax.results.model_source import Source
from a2tg_jax.results.output_paths import check_new
from a2tg_jax.results.report import loss_text
from a2tg_jax.scene import Scene, View, origin_of_scene, view_image
from a2tg_jax.training.loop import IsStopped, StageRun
from a2tg_jax.training.stage import BACKGROUNDS
from a2tg_jax.web.page import (
    PHOTOGRAPHS_NAME,
    SCENE_NAME,
    STATUS_NAME,
    comparison_html,
    photograph_name,
    viewer_html,
    viewer_html_with,
)
from a2tg_jax.web.server import Route, served

JPEG_QUALITY = 90
SECONDS = 3.0
"""Shortest time between two snapshots, in seconds."""
NOTED_SECONDS = 0.5
"""Time between two updates of the metrics."""
SHARE = 0.03
"""Largest share of the time for snapshots."""
WAIT = 0.1


class ServedPhotographs:
    """Photographs of a model's cameras, served as JPEG and read on demand; RGB `background` is behind transparent
    ones."""

    def __init__(self, origin: Origin | None, load_scene: Callable[[], Scene | None], background: Color = BLACK):
        self._names = () if origin is None else origin.names
        self._load_scene = load_scene
        self._background = background
        self._lock = threading.Lock()
        self._views: dict[int, View] | None = None

    @property
    def views(self) -> dict[int, View]:
        """Views by the index of their cameras."""
        with self._lock:  # The server has several threads; the scene is read once.
            if self._views is None:
                scene = self._load_scene() if self._names else None
                views = () if scene is None else (*scene.train, *scene.test)
                by_name = {view.name: view for view in views}
                self._views = {index: by_name[name] for index, name in enumerate(self._names) if name in by_name}
            return self._views

    def jpeg(self, index: int) -> bytes | None:
        """Return a photograph over the model's background, in its camera's size."""
        view = self.views.get(index)
        if view is None:
            return None
        buffer = io.BytesIO()
        pixels = to_uint8(view_image(view, self._background))
        Image.fromarray(pixels).save(buffer, format="JPEG", quality=JPEG_QUALITY)
        return buffer.getvalue()

    @property
    def routes(self) -> dict[str, Route]:
        """Routes of the viewer's server."""
        routes = {f"/{PHOTOGRAPHS_NAME}": Route("application/json", lambda: json.dumps(sorted(self.views)).encode())}
        for index in range(len(self._names)):
            routes[f"/{photograph_name(index)}"] = Route("image/jpeg", functools.partial(self.jpeg, index))
        return routes


def routes_of(source: Source) -> dict[str, Route]:
    """Return the routes of the viewer's server. Unreadable photographs are left out, with a warning."""
    return {
        "/": Route("text/html; charset=utf-8", viewer_html().encode()),
        f"/{SCENE_NAME}": Route("application/octet-stream", source.encoded),
        **ServedPhotographs(source.model.origin, source.load_scene_or_warn, source.model.background).routes,
    }


class LiveView:
    """View of a training, called between its steps (`training.loop.Watch`); `now` is a clock in seconds."""

    def __init__(self, scene: Scene, title: str, now: Callable[[], float] = time.perf_counter):
        self._scene = scene
        self._title = title
        self._now = now
        self._due = -math.inf
        """Time of the next snapshot; infinite while one is made."""
        self._noted = -math.inf
        self._paused = threading.Event()
        self._lock = threading.Lock()
        self._encoder: threading.Thread | None = None
        self._scene_bytes: bytes | None = None
        self._status: dict[str, Any] = {"version": 0, "message": "", "stage": ""}

    def __call__(self, run: StageRun, is_stopped: IsStopped) -> float:
        """Record metrics, take a snapshot when one is due, and wait while the training is paused."""
        if self._now() >= self._noted + NOTED_SECONDS:
            self._note(run)
        # One snapshot at a time; a paused training is shown as it is now.
        is_free = self._encoder is None or not self._encoder.is_alive()
        if is_free and (self._now() >= self._due or self._paused.is_set()):
            self._take_snapshot(run)
        began = self._now()
        while self._paused.is_set() and not is_stopped():
            time.sleep(WAIT)
        return self._now() - began

    def _take_snapshot(self, run: StageRun) -> None:
        began = self._now()
        # Copied now: the next step donates the state's buffers.
        model = dataclasses.replace(
            jax.device_get(run.state.model),
            background=BACKGROUNDS[run.system.background],
            origin=origin_of_scene(self._scene),
        )
        self._due = math.inf
        self._encoder = threading.Thread(target=self._encode, args=(model, began), daemon=True)
        self._encoder.start()

    @property
    def routes(self) -> dict[str, Route]:
        """Routes of the viewer's server."""
        return {
            "/": Route("text/html; charset=utf-8", viewer_html(is_training=True).encode()),
            f"/{SCENE_NAME}": Route("application/octet-stream", lambda: self._scene_bytes),
            f"/{STATUS_NAME}": Route("application/json", self._status_json),
            "/pause": Route("application/json", self._status_json, act=self._paused.set),
            "/resume": Route("application/json", self._status_json, act=self._paused.clear),
            **ServedPhotographs(origin_of_scene(self._scene), lambda: self._scene).routes,
        }

    def _status_json(self) -> bytes:
        with self._lock:
            return json.dumps(self._status | {"is_paused": self._paused.is_set()}).encode()

    def _note(self, run: StageRun) -> None:
        self._noted = self._now()
        left = f", {run.time_left} left in all" if run.time_left else ""
        status: dict[str, Any] = {"stage": f"{run.stage.name}{left}", "iterations": run.stage.iterations}
        history = run.history  # Assembling a long history takes time.
        if len(history.iteration):
            status |= {
                "iteration": int(history.iteration[-1]),
                "loss": float(history.loss[-1]),
                "psnr": float(history.psnr[-1]),
                "num": int(history.num_gaussians[-1]),
                "bytes": float(history.megabytes[-1]) * 1e6,
            }
        with self._lock:
            self._status |= status

    def _encode(self, model: Model, began: float) -> None:
        try:
            encoded = encode_web_scene(model, title=self._title, coder="none")  # Viewed once, on this machine.
            with self._lock:
                self._scene_bytes = encoded
                self._status |= {"version": self._status["version"] + 1, "message": ""}
        except Exception as error:  # Shown on the page; training continues.
            with self._lock:
                self._status |= {"message": str(error) or type(error).__name__}
        # Waiting 1 / SHARE times as long as a snapshot took bounds its share of the time.
        self._due = self._now() + max(SECONDS, (self._now() - began) / SHARE)


@contextlib.contextmanager
def shown_live(scene: Scene, title: str, on_start: Callable[[str], None]) -> Iterator[LiveView]:
    """Serve the view of a training within the block, after a call of `on_start` with its address. Raises as `serve`."""
    live = LiveView(scene, title)
    with served(live.routes) as address:
        on_start(address)
        yield live


# Export: the page with a scene, for a web server or as one file


def check_page(out: Path, *, single_file: bool, photographs: bool, overwrite: bool) -> list[Path]:
    """Return the files of a page except photographs: one, or several in a folder. Arguments and errors as in
    `export_web`."""
    single_file = single_file or (out.suffix.lower() == ".html" and not out.is_dir())
    if single_file and photographs:
        raise ValueError("`photographs` needs a folder: leave out `single_file`, and .html at the end of `web`")
    if single_file and out.is_dir():
        raise FileExistsError(f"{out} is a folder; with `single_file`, `web` must be the path of a file")
    if not single_file and out.is_file():
        raise FileExistsError(f"{out} is a file; choose a folder with `web`, or a name that ends in .html for one file")
    # An index.html without a scene next to it is not this program's.
    if not single_file and (out / "index.html").exists() and not (out / SCENE_NAME).exists():
        raise ValueError(f"{out} holds a page other than the viewer's; choose another folder with `web`")
    files = [out] if single_file else [out / name for name in ("index.html", SCENE_NAME, PHOTOGRAPHS_NAME)]
    for file in files:
        check_new(file, "`web`", overwrite=overwrite)
    return files


def export_web(
    source: Source, out: Path, *, single_file: bool = False, photographs: bool = False, overwrite: bool = False
) -> str:
    """Write a page that shows a model, and return a summary of its files, their size and the loss of the scene file.

    The page is a folder for any web server, or one file that opens from the disk: with `single_file`, or if its name
    ends in .html and no such folder exists. `photographs` adds the cameras' photographs to the folder; with
    `overwrite`, photographs of an earlier page that this one lacks are deleted.

    Raises:
      FileExistsError: if a file exists, or is in the place of a folder or the reverse.
      ValueError: if browsers cannot show the model, or photographs are missing or requested in one file.
    """
    page, *others = check_page(out, single_file=single_file, photographs=photographs, overwrite=overwrite)
    files: dict[Path, bytes] = {}
    old: set[Path] = set()
    if others:
        files[out / SCENE_NAME] = source.encoded
        pictures = _jpegs(source) if photographs else {}
        for index, jpeg in pictures.items():
            files[out / photograph_name(index)] = jpeg
        files[out / PHOTOGRAPHS_NAME] = json.dumps(list(pictures)).encode()
        files[page] = viewer_html(is_exported=True).encode()  # Last, so that the page never refers to missing files.
        for path in files:
            check_new(path, "`web`", overwrite=overwrite)
        with contextlib.suppress(OSError, ValueError, TypeError):  # There may be no page.
            old = {out / photograph_name(int(index)) for index in read_json(out / PHOTOGRAPHS_NAME)}
        drop_left_over_pages(out)
    else:
        files[page] = viewer_html_with(source.encoded).encode()
    # Nothing is written until all files are checked and all contents made.
    for path, content in files.items():
        write_whole(path, content)
    for path in old - set(files):
        path.unlink(missing_ok=True)
        remove_if_empty(path.parent, out)
    with_others = f" with {counted(len(files) - 1, 'file')} next to it" if others else ""
    lines = _scene_lines(source)
    lines.append(f"{page}: {in_bytes(sum(map(len, files.values())))}{with_others}")
    return "\n".join(lines)


def _jpegs(source: Source) -> dict[int, bytes]:
    """Return the photographs of a model's cameras by index. Raises ValueError if there are none."""
    served_photographs = ServedPhotographs(source.model.origin, source.load_scene, source.model.background)
    if not served_photographs.views:
        raise ValueError("there are no photographs of the model's cameras: leave out `photographs`")
    return {index: served_photographs.jpeg(index) or b"" for index in sorted(served_photographs.views)}


def _scene_lines(source: Source) -> list[str]:
    """Return lines about the scene file of a page: its size and its loss."""
    model = source.model
    size = len(source.encoded)
    ratio = f"1/{model.num_bytes / max(size, 1):.1f} of the model's {in_bytes(model.num_bytes)}"
    lines = [f"{model.num:,} Gaussians, whose scene takes {in_bytes(size)}, {ratio}"]
    if model.num:
        # The page's near plane.
        settings = dataclasses.replace(source.settings, near_plane=source.near_plane)
        decoded = decode_model(source.encoded)
        for measure, loss_of in loss_measures(model, source.load_scene_or_warn(), settings).items():
            lines.append(f"{loss_text(loss_of(decoded))}, {measure}")
    return lines


def drop_left_over_pages(out: Path) -> None:
    """Delete partial files of a page that killed exports left in its folder, which may be uploaded as a whole."""
    photographs = Path(photograph_name(0)).parent
    for folder in (out, out / photographs):
        for partial, whole in left_over(folder).items():
            is_photograph = folder.name == photographs.name and whole.suffix == ".jpg"
            if (is_photograph or whole.name in ("index.html", SCENE_NAME, PHOTOGRAPHS_NAME)) and is_left_over(partial):
                partial.unlink(missing_ok=True)


def export_comparison(sources: Sequence[Source], out: Path, *, overwrite: bool = False) -> str:
    """Write a page that shows two models with one camera and a divider, and return a summary.

    Raises:
      FileExistsError: if the file exists.
      ValueError: if it does not end in .html, or the models are not in one world.
    """
    if out.suffix.lower() != ".html" or out.is_dir():
        raise ValueError(f"`out` must be the path of a file that ends in .html; got {out}")
    check_new(out, "`out`", overwrite=overwrite)
    first, second = sources
    if not np.allclose(_world(first), _world(second), rtol=1e-6, atol=1e-4):
        raise ValueError(f"{first.title} and {second.title} are in different worlds: give models of one scene")
    titles = [_place_of(source.path) for source in sources]
    if titles[0] == titles[1]:
        titles = [str(source.path) for source in sources]
    scenes = [(title, source.encoded) for title, source in zip(titles, sources, strict=True)]
    page = comparison_html(*scenes).encode()
    write_whole(out, page)
    return f"{out}: {in_bytes(len(page))}, {' against '.join(titles)}"


def _world(source: Source) -> np.ndarray:
    """Return the way of a model's world to the original one [4, 4]."""
    origin = source.model.origin or Origin.of_cameras([])
    return matrix_of(origin.transform)


def _place_of(path: Path) -> str:
    """Return the run and the model of a run's file, or the name of another file."""
    path = path.absolute()
    return f"{path.parent.parent.name} · {path.stem}" if path.parent.name == "models" else path.name
