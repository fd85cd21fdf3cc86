"""Jobs: one stage of one system on one scene, trained from where it stopped, measured, and written down.

A job's key says all that decides its result: the scene, its size, and every number of the stages so far. Whoever asks
for the same stage gets the same job, so that a first stage is trained once however many second stages follow it.
"""

import dataclasses
import functools
import hashlib
from pathlib import Path
from typing import Any

import numpy as np

import a2tg_jax as a2tg
from a2tg_jax.appearance import Billboards
from a2tg_jax.core.origin import WHITE
from a2tg_jax.host.memory import tidy_memory
from a2tg_jax.results.folder import read_json, write_json
from a2tg_jax.results.plan import fingerprint, is_same_so_far
from a2tg_jax.results.record import SceneSource
from a2tg_jax.training import fit_stage
from a2tg_jax.training.registry import differences, reference_of

MOST_TRAIN_VIEWS = 16
"""So many training views are measured, evenly chosen."""
Record = dict[str, Any]
"""What a finished job leaves, in JSON."""


@dataclasses.dataclass(frozen=True)
class Job:
    """One stage to train."""

    scene: str
    """Path below the folder of scenes, or "synthetic"."""
    downscale: int
    system: a2tg.System
    stage: int
    """Which of the system's stages, from 0."""

    @property
    def start(self) -> "Job | None":
        """The job whose model it starts from."""
        return dataclasses.replace(self, stage=self.stage - 1) if self.stage else None

    @property
    def iterations(self) -> int:
        """Of its stage."""
        return self.system.stages()[self.stage].iterations

    @property
    def all_iterations(self) -> tuple[int, ...]:
        """Of its stage and those before it."""
        return tuple(stage.iterations for stage in self.system.stages()[: self.stage + 1])

    @property
    def key(self) -> str:
        """Unique; a file name."""
        return _key(self)


@functools.lru_cache(maxsize=10_000)
def _key(job: Job) -> str:
    numbers = [fingerprint(job.system, index) for index in range(job.stage + 1)]
    digest = hashlib.sha256(repr((job.scene, job.downscale, numbers)).encode()).hexdigest()[:12]
    return f"{job.scene.replace('/', '-')}-{job.downscale}-{job.system.stages()[job.stage].name}-{digest}"


@dataclasses.dataclass(frozen=True)
class Folders:
    """Where an experiment reads and writes."""

    scenes: Path
    work: Path
    """Models, checkpoints and records of single jobs: large, and made again where they are gone."""
    lpips_weights: Path | None = None
    lpips_network: str | None = None
    """Of the weights; jobs measured with another are measured again."""

    def model(self, job: Job) -> Path:
        return self.work / "models" / f"{job.key}.npz"

    def record(self, job: Job) -> Path:
        return self.work / "records" / f"{job.key}.json"

    def checkpoint(self, job: Job) -> Path:
        return self.work / "checkpoints" / f"{job.key}.npz"

    def load_scene(self, job: Job) -> a2tg.Scene:
        is_folder = job.scene != "synthetic"
        return SceneSource(str(self.scenes / job.scene) if is_folder else job.scene, job.downscale).load()


def run_job(job: Job, folders: Folders) -> Record:
    """Trains a job, from its checkpoint where it was stopped, and measures what it made (host).

    One that was trained before, but measured without LPIPS or with that of another network, is measured again.
    """
    scene = folders.load_scene(job)
    path, model = folders.record(job), folders.model(job)
    if path.is_file() and model.is_file():
        record = {**read_json(path), **_quality(scene, a2tg.load_model(model), folders)}
    else:
        result = _train(job, folders, scene)
        a2tg.save_model(_ready(model), result.model)
        record = {**_told_training(job, scene, result), **_quality(scene, result.model, folders)}
    write_json(_ready(path), record)
    folders.checkpoint(job).unlink(missing_ok=True)
    return record


def _train(job: Job, folders: Folders, scene: a2tg.Scene) -> a2tg.StageResult:
    path = _ready(folders.checkpoint(job))
    start = None if job.start is None else a2tg.load_model(folders.model(job.start))
    return fit_stage(
        scene,
        job.system,
        job.stage,
        start,
        resume=_load_checkpoint(path, job) if path.is_file() else None,
        on_checkpoint=lambda checkpoint: a2tg.save_checkpoint(path, checkpoint),
        checkpoint_every=max(500, job.iterations // 10),
        progress=False,
        session=_session(),
    )


@functools.cache
def _session() -> a2tg.Session:
    """Return the session that all jobs of this process share."""
    return a2tg.Session(after_compiling=tidy_memory)


def _load_checkpoint(path: Path, job: Job) -> a2tg.Checkpoint:
    """A checkpoint of this stage, perhaps of another system that shares it."""
    checkpoint = a2tg.load_checkpoint(path)
    if not is_same_so_far(checkpoint.system, job.system, job.stage):
        raise ValueError(f"{path} was made with other numbers than {job.key} has: delete it")
    return dataclasses.replace(checkpoint, system=job.system)


def _told_training(job: Job, scene: a2tg.Scene, result: a2tg.StageResult) -> Record:
    """What was trained, and what it took."""
    first = scene.test[0].camera
    return {
        "scene": job.scene, "downscale": job.downscale, "pixels": [first.width, first.height],
        "system": reference_of(job.system), "options": differences(job.system), "stage": result.name,
        "iterations": job.iterations, "num": result.model.num, "mb": result.model.num_bytes / 1e6,
        "published_mb": result.model.num_published_bytes / 1e6, "sizes": texture_sizes(result.model),
        "seconds": result.seconds, "ms_per_step": _milliseconds(result.history),
    }  # fmt: skip


def _quality(scene: a2tg.Scene, model: a2tg.Model, folders: Folders) -> Record:
    """On the test views, and on some of those it was trained on."""
    train = scene.train[:: -(-len(scene.train) // MOST_TRAIN_VIEWS)]
    background = background_of(scene)
    on_test = a2tg.evaluate(scene.test, model, background=background, lpips_weights=folders.lpips_weights)
    on_train = a2tg.evaluate(train, model, background=background)
    return {
        "psnr": on_test.psnr, "ssim": on_test.ssim, "lpips": on_test.lpips, "lpips_network": on_test.lpips_network,
        "train_psnr": on_train.psnr, "fps": on_test.frames_per_second,
    }  # fmt: skip


def background_of(scene: a2tg.Scene) -> tuple[float, float, float] | None:
    """White behind transparent photographs, whatever a system was trained on: all are measured alike."""
    return WHITE if scene.test[0].alpha is not None else None


def texture_sizes(model: a2tg.Model) -> dict[str, int]:
    """Splats by the size of their texture, "2x4" being two rows (v) and four columns (u); nothing without textures."""
    if model.textures is None or isinstance(model.appearance, Billboards):
        return {}
    pairs, counts = np.unique(model.textures[1].sizes, axis=0, return_counts=True)
    return {f"{rows}x{columns}": int(count) for (rows, columns), count in zip(pairs, counts, strict=True)}


def _milliseconds(history: a2tg.History) -> float:
    """Median time of a step, which compilation does not move; of whatever else ran beside it, it knows nothing."""
    paces = np.diff(history.seconds) / np.diff(history.iteration)
    return 1e3 * float(np.median(paces)) if len(paces) else float("nan")


def _ready(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
