"""Jobs: one stage of one system on one scene, trained from where it stopped, measured, and written down.

A job's key says all that decides its result: the scene, its size, and every number of the stages so far. Whoever asks
for the same stage gets the same job, so that a first stage is trained once however many second stages follow it.
"""

import dataclasses
import functools
import hashlib
import resource
from pathlib import Path
from typing import Any

import numpy as np

import a2tg_jax as a2tg
from a2tg_jax.results.folder import write_json
from a2tg_jax.results.plan import fingerprint
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
    """Trains a job, from its checkpoint where it was stopped, and measures what it made (host)."""
    scene = folders.load_scene(job)
    result = _train(job, folders, scene)
    record = _record(job, scene, result, folders)
    a2tg.save_model(_ready(folders.model(job)), result.model)
    write_json(_ready(folders.record(job)), record)
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
        resume=a2tg.load_checkpoint(path, system=type(job.system)) if path.is_file() else None,
        on_checkpoint=lambda checkpoint: a2tg.save_checkpoint(path, checkpoint),
        checkpoint_every=max(500, job.iterations // 10),
        progress=False,
    )


def _record(job: Job, scene: a2tg.Scene, result: a2tg.StageResult, folders: Folders) -> Record:
    train = scene.train[:: -(-len(scene.train) // MOST_TRAIN_VIEWS)]
    on_test = a2tg.evaluate(scene.test, result.model, lpips_weights=folders.lpips_weights)
    on_train = a2tg.evaluate(train, result.model)
    first = scene.test[0].camera
    return {
        "scene": job.scene, "downscale": job.downscale, "pixels": [first.width, first.height],
        "system": reference_of(job.system), "options": differences(job.system), "stage": result.name,
        "iterations": job.iterations,
        "num": result.model.num, "mb": result.model.num_bytes / 1e6,
        "published_mb": result.model.num_published_bytes / 1e6, "sizes": texture_sizes(result.model),
        "psnr": on_test.psnr, "ssim": on_test.ssim, "lpips": on_test.lpips, "lpips_network": on_test.lpips_network,
        "train_psnr": on_train.psnr, "fps": on_test.frames_per_second,
        "seconds": result.seconds, "ms_per_step": _milliseconds(result.history),
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }  # fmt: skip


def texture_sizes(model: a2tg.Model) -> dict[str, int]:
    """Splats by the size of their texture, "2x4" being two rows (v) and four columns (u); nothing without textures."""
    if not isinstance(model.appearance, a2tg.Textured):
        return {}
    pairs, counts = np.unique(np.asarray(model.layout.sizes), axis=0, return_counts=True)
    return {f"{rows}x{columns}": int(count) for (rows, columns), count in zip(pairs, counts, strict=True)}


def _milliseconds(history: a2tg.History) -> float:
    """Median time of a step, which compilation does not move; of whatever else ran beside it, it knows nothing."""
    paces = np.diff(history.seconds) / np.diff(history.iteration)
    return 1e3 * float(np.median(paces)) if len(paces) else float("nan")


def _ready(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
