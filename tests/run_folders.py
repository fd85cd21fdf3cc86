"""Run folders that tests fill themselves, results and histories without training, and cameras on a circle."""

import struct
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from a2tg_jax import A2tg, Camera, Evaluation, History, ViewMetrics
from a2tg_jax.results.folder import RunFolder, check_free
from a2tg_jax.results.record import RunRecord, SceneSource
from a2tg_jax.results.report import ModelResult, RunResult

RECORD = RunRecord(SceneSource("/scenes/a b", downscale=2), "a2tg", A2tg.preset("quick"), ("gaussians-2d-mcmc",))
NAMES = ["a2tg-gaussians", "a2tg-textures", "gaussians-2d-mcmc-continued"]


def create_run(path: Path) -> RunFolder:
    """A new run folder with its marker, in a folder that is free."""
    check_free(path)
    run = RunFolder(path)
    run.path.mkdir(parents=True, exist_ok=True)
    run.own(run.marker)
    return run


def some_result(record: RunRecord = RECORD) -> RunResult:
    def measured(psnr: float, texels: int) -> ModelResult:
        views = (ViewMetrics("a<b.png", psnr, 0.5, 0.25, 9.0), ViewMetrics("c.png", psnr + 2, 0.7, 0.75, 7.0))
        found = Evaluation(views, "alex", 20.0, ())
        num_bytes = 23_200 + 16 * texels
        return ModelResult({"test": found, "train": found}, 100, texels, num_bytes, num_bytes, 0, 62.0)

    models = dict(zip(NAMES, (measured(20, 0), measured(23, 300), measured(22, 0)), strict=True))
    return RunResult("scene", record, record.plan, models)


def some_history(stage: int = 1, num: int = 60) -> History:
    steps, ones = np.arange(1, num + 1), np.ones(num)
    return History(stage * np.ones(num, int), steps, 1 / steps, 20 + np.log(steps), 5 * steps, 0.1 * ones, 0.5 * steps)


def circle(num: int) -> list[Camera]:
    """Cameras on a circle of radius 2 around the origin, looking at it, y down along -z of the world."""
    cameras = []
    for angle in np.linspace(0, 2 * np.pi, num, endpoint=False):
        center = 2 * np.array([np.cos(angle), np.sin(angle), 0])
        z, y = -center / 2, np.array([0, 0, -1.0])
        rotation = np.stack([np.cross(y, z), y, z])
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ center
        K = jnp.asarray([[50, 0, 20], [0, 50, 15], [0, 0, 1]], jnp.float32)
        cameras.append(Camera(jnp.asarray(viewmat, jnp.float32), K, 40, 30))
    return cameras


def tensorboard_scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Steps and values of each tag in TensorBoard files, in the order of the files."""
    from tensorboardX.proto.event_pb2 import Event

    found: dict[str, list[tuple[int, float]]] = {}
    for path in sorted(folder.glob("events.*")):
        data = path.read_bytes()
        while data:  # A record: its length of 8 bytes, a checksum of 4, the event, and a checksum.
            (length,) = struct.unpack_from("<Q", data)
            event = Event.FromString(data[12 : 12 + length])
            for value in event.summary.value:
                found.setdefault(value.tag, []).append((event.step, value.simple_value))
            data = data[16 + length :]
    return found
