"""What the viewer's server shows: a model or a running training, and photographs.

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
from collections.abc import Callable, Iterator
from typing import Any

import jax
from PIL import Image

from a2tg_jax import Model, Origin, Scene, View, view_image
from a2tg_jax.core.origin import Color
from a2tg_jax.io.web_scene import encode_web_scene
from a2tg_jax.results.images import to_uint8
from a2tg_jax.results.model_source import Source
from a2tg_jax.training.loop import StageRun
from a2tg_jax.web.page import (
    PHOTOGRAPHS_NAME,
    SCENE_NAME,
    STATUS_NAME,
    photograph_name,
    viewer_html,
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


class CameraPhotographs:
    """Photographs of a model's cameras as JPEG, read on demand; RGB `background` is behind transparent ones."""

    def __init__(
        self,
        origin: Origin | None,
        load_scene: Callable[[], Scene | None],
        background: Color = (0.0, 0.0, 0.0),
    ):
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
        **CameraPhotographs(source.model.origin, source.load_scene_or_warn, source.model.background).routes,
    }


class LiveView:
    """View of a training, called between its steps (`Session.watch`); `now` is a clock in seconds."""

    def __init__(self, scene: Scene, title: str, now: Callable[[], float] = time.perf_counter):
        self._scene = scene
        self._title = title
        self._now = now
        self._due = -math.inf
        """Time of the next snapshot; infinite while one is made."""
        self._noted = -math.inf
        self._paused = threading.Event()
        self._is_finishing = threading.Event()
        self._lock = threading.Lock()
        self._encoder: threading.Thread | None = None
        self._scene_bytes: bytes | None = None
        self._status: dict[str, Any] = {"version": 0, "message": "", "stage": ""}

    def __call__(self, run: StageRun, is_stopped: Callable[[], bool]) -> float:
        """Record metrics, take a snapshot when one is due, and wait while the training is paused. Shorten the training
        once you have asked for it."""
        if self._is_finishing.is_set():
            run.session.is_shortened = True
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
            background=run.system.background_color,
            origin=self._scene.origin,
        )
        self._due = math.inf
        self._encoder = threading.Thread(target=self._encode, args=(model, began), daemon=True)
        self._encoder.start()

    @property
    def routes(self) -> dict[str, Route]:
        """Routes of the viewer's server."""
        status = Route("application/json", self._status_json)
        return {
            "/": Route("text/html; charset=utf-8", viewer_html(is_training=True).encode()),
            f"/{SCENE_NAME}": Route("application/octet-stream", lambda: self._scene_bytes),
            f"/{STATUS_NAME}": status,
            "/pause": dataclasses.replace(status, act=self._paused.set),
            "/resume": dataclasses.replace(status, act=self._paused.clear),
            "/finish": dataclasses.replace(status, act=self._finish),
            **CameraPhotographs(self._scene.origin, lambda: self._scene).routes,
        }

    def _status_json(self) -> bytes:
        with self._lock:
            flags = {"is_paused": self._paused.is_set(), "is_finishing": self._is_finishing.is_set()}
            return json.dumps(self._status | flags).encode()

    def _finish(self) -> None:
        self._is_finishing.set()
        self._paused.clear()

    def _note(self, run: StageRun) -> None:
        self._noted = self._now()
        left = f", {run.time_left} left in all" if run.time_left else ""
        status: dict[str, Any] = {"stage": f"{run.stage.name}{left}", "iterations": run.stage.iterations}
        history = run.history  # Assembling a long history takes time.
        if len(history.iteration):
            psnr = float(history.psnr[-1])
            status |= {
                "iteration": int(history.iteration[-1]),
                "loss": float(history.loss[-1]),
                # JSON has no infinity, the PSNR of equal pictures.
                "psnr": psnr if math.isfinite(psnr) else None,
                "num": int(history.num_gaussians[-1]),
                "bytes": float(history.megabytes[-1]) * 1e6,
            }
        with self._lock:
            self._status |= status

    def _encode(self, model: Model, began: float) -> None:
        try:
            # Viewed once, on this machine.
            encoded = encode_web_scene(model, title=self._title, coder="none", finds_subject=False)
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
