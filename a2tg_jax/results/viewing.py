"""Content of the viewer: a model or a training as it runs, and photographs.

A training is shown by a snapshot every few seconds. Between steps the state is copied to the host; a thread makes a
scene of it. Both together take no more than `SHARE` of the time: the slower they are, the rarer snapshots become.
"""

import contextlib
import dataclasses
import functools
import io
import json
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from PIL import Image

from a2tg_jax.core.origin import BLACK, Color, Origin
from a2tg_jax.data import Scene, View, view_image
from a2tg_jax.data.scene import origin_of_scene
from a2tg_jax.io.web_scene import encode_web_scene
from a2tg_jax.model import Model
from a2tg_jax.results.images import to_uint8
from a2tg_jax.results.model_source import Source
from a2tg_jax.training.fitting import BACKGROUNDS
from a2tg_jax.training.loop import IsStopped, StageRun
from a2tg_jax.web.page import PHOTOGRAPHS_NAME, SCENE_NAME, STATUS_NAME, photograph_name, viewer_html
from a2tg_jax.web.server import Route, served

JPEG_QUALITY = 90
SECONDS = 3.0
"""Shortest time between two snapshots in seconds."""
NOTED_SECONDS = 0.5
"""Time between two updates of the figures."""
SHARE = 0.03
"""Largest share of the time that snapshots take."""
WAIT = 0.1
QUICK = 1
"""Compression level; a scene viewed once need not be small."""


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
                scene = None if self._origin is None else self._load_scene()
                by_name = {} if scene is None else {view.name: view for view in (*scene.train, *scene.test)}
                names = () if self._origin is None else self._origin.names
                self._views = {index: by_name[name] for index, name in enumerate(names) if name in by_name}
            return self._views

    def jpeg(self, index: int) -> bytes | None:
        """Return a photograph over the model's background, of its camera's size."""
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
        names = () if self._origin is None else self._origin.names
        listed = Route("application/json", lambda: json.dumps(sorted(self.views)).encode())
        each = {
            f"/{photograph_name(index)}": Route("image/jpeg", functools.partial(self.jpeg, index))
            for index in range(len(names))
        }
        return {f"/{PHOTOGRAPHS_NAME}": listed, **each}


def routes_of(source: Source) -> dict[str, Route]:
    """Return the routes of the viewer's server. Photographs that cannot be read are left out, with a warning."""
    return {
        "/": Route("text/html; charset=utf-8", viewer_html().encode()),
        f"/{SCENE_NAME}": Route("application/octet-stream", source.encoded),
        **ServedPhotographs(source.model.origin, source.load_scene_or_warn, source.model.background).routes,
    }


class LiveView:
    """View of a training, called between its steps (`training.loop.Watch`)."""

    def __init__(self, scene: Scene, title: str, now: Callable[[], float] = time.perf_counter):
        """Args:
        scene: the scene that is trained on.
        title: title of the page.
        now: a clock in seconds.
        """
        self._scene, self._title, self._now = scene, title, now
        self._due = self._noted = -np.inf
        self._paused, self._lock = threading.Event(), threading.Lock()
        self._encoder: threading.Thread | None = None
        self._scene_bytes: bytes | None = None
        self._status: dict[str, Any] = {"version": 0, "message": "", "stage": ""}

    def __call__(self, run: StageRun, is_stopped: IsStopped) -> float:
        """Record metrics, take a snapshot when one is due, and wait while the training is paused."""
        if self._now() >= self._noted + NOTED_SECONDS:
            self._note(run)
        is_free = self._encoder is None or not self._encoder.is_alive()
        if is_free and (self._now() >= self._due or self._paused.is_set()):
            began = self._now()
            background, origin = BACKGROUNDS[run.system.background], origin_of_scene(self._scene)
            model = dataclasses.replace(jax.device_get(run.state.model), background=background, origin=origin)
            self._due = np.inf
            self._encoder = threading.Thread(target=self._encode, args=(model, began), daemon=True)
            self._encoder.start()
        began = self._now()
        while self._paused.is_set() and not is_stopped():
            time.sleep(WAIT)
        return self._now() - began

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
        history, self._noted = run.history, self._now()  # A long history takes time to put together.
        found: dict[str, Any] = {"stage": run.stage.name, "iterations": run.stage.iterations}
        if len(history.iteration):
            found |= {
                "iteration": int(history.iteration[-1]),
                "loss": float(history.loss[-1]),
                "psnr": float(history.psnr[-1]),
                "num": int(history.num_gaussians[-1]),
                "bytes": float(history.megabytes[-1]) * 1e6,
            }
        with self._lock:
            self._status |= found

    def _encode(self, model: Model, began: float) -> None:
        try:
            found = encode_web_scene(model, title=self._title, level=QUICK)
            with self._lock:
                self._scene_bytes = found
                self._status |= {"version": self._status["version"] + 1, "message": ""}
        except ValueError as error:
            with self._lock:
                self._status |= {"message": str(error)}
        self._due = self._now() + max(SECONDS, (self._now() - began) / SHARE)


@contextlib.contextmanager
def shown_live(scene: Scene, title: str, on_start: Callable[[str], None]) -> Iterator[LiveView]:
    """Serve the view of a training within the block. `on_start` is called with the address. Raises ValueError as
    `serve`."""
    live = LiveView(scene, title)
    with served(live.routes) as address:
        on_start(address)
        yield live
