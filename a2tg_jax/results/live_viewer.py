"""A training as it runs, for the viewer: a snapshot every few seconds, figures beside it, pause and resume.

Between steps the state is copied to the host; a thread makes a scene of it. Both together take no more than `SHARE` of
the time: the slower they are, the rarer snapshots become.
"""

import contextlib
import dataclasses
import json
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from a2tg_jax.data import Scene
from a2tg_jax.data.scene import origin_of_scene
from a2tg_jax.io.web_scene import encode_web_scene
from a2tg_jax.model import Model
from a2tg_jax.results.viewing import ServedPhotographs
from a2tg_jax.training.fitting import BACKGROUNDS
from a2tg_jax.training.loop import IsStopped, StageRun
from a2tg_jax.web.page import SCENE_NAME, STATUS_NAME, viewer_html
from a2tg_jax.web.server import Route, served

SECONDS = 3.0
"""Shortest time between two snapshots in seconds."""
SHARE = 0.03
"""Largest share of the time that snapshots take."""
WAIT = 0.1
QUICK = 1
"""Compression level; a scene viewed once need not be small."""


class LiveView:
    """View of a training, called between its steps (`training.loop.Watch`)."""

    def __init__(self, scene: Scene, title: str, now: Callable[[], float] = time.perf_counter):
        """Args:
        scene: that is trained on.
        title: what the page is called.
        now: a clock in seconds.
        """
        self._scene, self._title, self._now = scene, title, now
        self._due = -np.inf
        self._paused, self._lock = threading.Event(), threading.Lock()
        self._encoder: threading.Thread | None = None
        self._scene_bytes: bytes | None = None
        self._status: dict[str, Any] = {"version": 0, "message": "", "stage": ""}

    def __call__(self, run: StageRun, is_stopped: IsStopped) -> float:
        """Record metrics, take a snapshot when one is due, and wait while the training is paused."""
        self._note(run)
        is_free = self._encoder is None or not self._encoder.is_alive()
        if is_free and (self._now() >= self._due or self._paused.is_set()):
            self._take(run)
        began = self._now()
        while self._paused.is_set() and not is_stopped():
            time.sleep(WAIT)
        return self._now() - began

    @property
    def routes(self) -> dict[str, Route]:
        """Routes of the viewer's server."""
        photographs = ServedPhotographs(origin_of_scene(self._scene), lambda: self._scene)
        return {
            "/": Route("text/html; charset=utf-8", viewer_html(is_training=True).encode()),
            f"/{SCENE_NAME}": Route("application/octet-stream", lambda: self._scene_bytes),
            f"/{STATUS_NAME}": Route("application/json", self._status_json),
            "/pause": Route("application/json", self._status_json, act=self._paused.set),
            "/resume": Route("application/json", self._status_json, act=self._paused.clear),
            **photographs.routes,
        }

    def _status_json(self) -> bytes:
        with self._lock:
            return json.dumps(self._status | {"is_paused": self._paused.is_set()}).encode()

    def _note(self, run: StageRun) -> None:
        history = run.history
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

    def _take(self, run: StageRun) -> None:
        """Copy the state, and have a thread encode it as a scene."""
        began = self._now()
        background, origin = BACKGROUNDS[run.system.background], origin_of_scene(self._scene)
        model = dataclasses.replace(jax.device_get(run.state.model), background=background, origin=origin)
        self._due = np.inf
        self._encoder = threading.Thread(target=self._encode, args=(model, began), daemon=True)
        self._encoder.start()

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
    """Serve the view of a training within the block.

    Args:
      scene: that is trained on.
      title: what the page is called.
      on_start: called with the address.

    Raises:
      ValueError: as `serve` does.
    """
    live = LiveView(scene, title)
    with served(live.routes) as address:
        on_start(address)
        yield live
