"""The live view of a training: snapshots, metrics, pause and resume. The result does not depend on them."""

import datetime
import json
import threading
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from small_files import taken_apart
from small_models import billboards, with_row
from test_compact import plain, textured

from a2tg_jax import (
    Gaussians2dMcmc,
    History,
    LossConfig,
    Mcmc,
    Model,
    Session,
    allocate_appearance,
    fit_stage,
    synthetic_scene,
)
from a2tg_jax.results.run_training import unseen
from a2tg_jax.results.viewing import LiveView, shown_live
from a2tg_jax.web.server import Door, application

SCENE = synthetic_scene(num_views=4, width=24, height=16, num_points=40)
SYSTEM = Gaussians2dMcmc(stage1_iterations=24, densify=Mcmc(cap=50), sh_degree=0, loss=LossConfig(ssim_weight=0.0))


class Clock:
    """A clock that is set by hand, or advances by `step` with each look."""

    def __init__(self, step: float = 0.0):
        self.seconds = 0.0
        self.step = step

    def __call__(self) -> float:
        self.seconds += self.step
        return self.seconds


def stage_run():
    """A stand-in for a stage under way."""
    state = SimpleNamespace(model=textured())
    stage = SimpleNamespace(name="textures", iterations=30)
    history = with_row(History.empty(), 1, 20, 0.5, 17.0, 40, 1.25, 3.0)
    left = datetime.timedelta(seconds=70)
    return SimpleNamespace(state=state, stage=stage, history=history, system=SYSTEM, time_left=left, session=Session())


def encoded(live: LiveView) -> None:
    """Waits for the thread."""
    live._encoder.join(timeout=60)


def status(live: LiveView) -> dict:
    return json.loads(live.routes["/training.json"].read())


def test_snapshots_and_figures():
    clock = Clock()
    live = LiveView(SCENE, "scene", clock)
    run = stage_run()
    assert b'<html data-training="yes" ' in live.routes["/"].read()
    assert live.routes["/scene.a2tgz"].read() is None and status(live)["version"] == 0
    assert live(run, lambda: False) == 0
    encoded(live)
    scene, _ = taken_apart(live.routes["/scene.a2tgz"].read())
    assert scene["page"]["title"] == "scene" and scene["num"] == run.state.model.num
    found = status(live)
    assert (found["version"], found["stage"], found["iteration"], found["psnr"]) == (
        1,
        "textures, 0:01:10 left in all",
        20,
        17.0,
    )
    assert found["bytes"] == 1.25e6 and not found["is_paused"]
    live(run, lambda: False)
    clock.seconds = 2.9
    live(run, lambda: False)
    assert status(live)["version"] == 1
    clock.seconds = 3.1
    live(run, lambda: False)
    encoded(live)
    assert status(live)["version"] == 2


def test_the_infinite_psnr_of_equal_pictures_is_told():
    """Browsers do not parse Infinity, and would take the training for ended."""
    live = LiveView(SCENE, "scene", Clock())
    run = stage_run()
    run.history = with_row(History.empty(), 1, 20, 0.5, np.inf, 40, 1.25, 3.0)
    live(run, lambda: False)
    encoded(live)
    found = json.loads(live.routes["/training.json"].read(), parse_constant=pytest.fail)
    assert (found["iteration"], found["psnr"]) == (20, None)


def test_slow_snapshots_are_rare():
    live = LiveView(SCENE, "scene", Clock(0.5))
    live(stage_run(), lambda: False)
    encoded(live)
    # It took more than a second to make.
    assert live._due > 1.0 / 0.03


def test_pause_holds_the_training_until_it_is_resumed_or_stopped():
    live = LiveView(SCENE, "scene")
    run = stage_run()
    app = application(live.routes, Door(port=80))

    def post(path: str, **more) -> str:
        printed = []
        environ = {"REQUEST_METHOD": "POST", "PATH_INFO": path, "HTTP_HOST": "127.0.0.1:80", **more}
        list(app(environ, lambda status, headers: printed.append(status)))
        return printed[0]

    own = {"HTTP_ORIGIN": "http://127.0.0.1:80"}
    assert post("/pause").startswith("403") and post("/pause", HTTP_ORIGIN="http://evil.example").startswith("403")
    assert post("/", **own).startswith("405") and not status(live)["is_paused"]
    assert post("/pause", **own).startswith("200") and status(live)["is_paused"]
    threading.Timer(0.3, lambda: post("/resume", **own)).start()
    began = time.perf_counter()
    held = live(run, lambda: False)
    assert 0.2 < held <= time.perf_counter() - began and not status(live)["is_paused"]
    assert post("/pause", **own).startswith("200")
    assert live(run, lambda: True) < 0.2
    assert not run.session.is_shortened
    assert post("/finish", **own).startswith("200")
    assert status(live)["is_finishing"] and not status(live)["is_paused"]
    live(run, lambda: False)
    assert run.session.is_shortened


def test_systems_that_cannot_be_shown_are_reported():
    gaussians = plain(1).gaussians
    appearance = allocate_appearance(billboards(), jax.random.key(0), gaussians)
    run = stage_run()
    run.state.model = Model(gaussians, appearance)
    live = LiveView(SCENE, "scene")
    live(run, lambda: False)
    encoded(live)
    assert "has Billboards" in status(live)["message"] and status(live)["version"] == 0


def test_a_training_that_is_looked_at_gives_the_same_bits():
    seen: list[int] = []
    addresses: list[str] = []
    with shown_live(SCENE, "scene", addresses.append) as live:

        def watch(run, is_stopped):
            seen.append(int(run.state.iteration))
            live._due = -np.inf  # A snapshot at every occasion.
            return live(run, is_stopped)

        looked_at = fit_stage(SCENE, SYSTEM, 0, session=Session(watch=watch))
        encoded(live)
    assert seen == [10, 20, 24] and addresses[0].startswith("http://127.0.0.1:")
    # Time in which a watcher holds the training is not counted.
    session = Session(watch=lambda run, is_stopped: 1000.0)
    alone = fit_stage(SCENE, SYSTEM, 0, session=session)
    assert alone.seconds < -1000
    jax.tree.map(np.testing.assert_array_equal, looked_at.model, alone.model)
    with unseen(SCENE) as watch:
        assert watch(stage_run(), lambda: False) == 0.0
