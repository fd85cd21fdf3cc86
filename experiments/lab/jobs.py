"""Jobs: one stage of one system on one scene, trained from its checkpoint, measured, and recorded.

A job's key holds all that decides its result: the scene, its size, and every number of the stages so far. Equal stages
are equal jobs, so a first stage is trained once for all second stages that follow it.
"""

import dataclasses
import datetime
import functools
import hashlib
import math
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import a2tg_jax as a2tg
from a2tg_jax.base.even_spacing import evenly_chosen
from a2tg_jax.base.json_text import read_json
from a2tg_jax.base.memory import tidy_memory
from a2tg_jax.base.threads import num_threads
from a2tg_jax.core.budget import BYTES_PER_FLOAT
from a2tg_jax.core.gaussians import floats_per_gaussian
from a2tg_jax.core.origin import WHITE
from a2tg_jax.data.assembly import with_validation_views
from a2tg_jax.data.load import SceneSource
from a2tg_jax.data.synthetic import BUILT_IN
from a2tg_jax.host.source_commit import source_commit
from a2tg_jax.results.folder import StageFiles, write_json
from a2tg_jax.results.plan import PlannedStage
from a2tg_jax.results.stage_training import train_stage
from a2tg_jax.training import fit_stage
from a2tg_jax.training.options import own_options
from a2tg_jax.training.registry import reference_of
from lab.fingerprint import fingerprint
from lab.scenes import few_views, from_random_points
from lab.timing import TrainingTime
from lab.versions import is_from_before

TEST = "test"
"""The test views of the scene are held out."""
VALIDATION = "validation"
"""Every eighth of its training views is held out."""
MOST_TRAIN_VIEWS = 16
"""Largest number of training views that are measured, evenly chosen."""
DEFAULT_GAUSSIANS = 100_000
"""Assumed number of Gaussians of a system that sets no limit."""
TIMES = ("seconds", "ms_per_step", "training_seconds", "fps")
"""Figures that count for a job that had its GPU or its cores to itself; None for others."""
Record = dict[str, Any]
"""Figures of a finished job, in JSON."""


@dataclasses.dataclass(frozen=True)
class Job:
    """One stage to train."""

    scene: str
    """Path below the folder of scenes, absolute path, or the name of a built-in scene."""
    downscale: int
    system: a2tg.System
    stage: int
    """Index of the system's stage, from 0."""
    validation: bool = False
    """Whether validation views, taken from the training views, are held out instead of the test views."""
    fold: int | None = None
    """Number of the split of a capture of few views (`scenes.few_views`); None: all training and test views."""
    random_start: bool = False
    """Whether it starts from random points (`scenes.from_random_points`)."""

    @property
    def views(self) -> str:
        """Return which views are held out, for records."""
        parts = [] if self.fold is None else [f"fold {self.fold}"]
        return ", ".join([*parts, VALIDATION] if self.validation else parts or [TEST])

    @property
    def start(self) -> "Job | None":
        """Return the job whose model it starts from."""
        return dataclasses.replace(self, stage=self.stage - 1) if self.stage else None

    @property
    def chain(self) -> tuple["Job", ...]:
        """Return the jobs of all stages so far, this one last."""
        return tuple(dataclasses.replace(self, stage=stage) for stage in range(self.stage + 1))

    @property
    def planned(self) -> PlannedStage:
        """Return the stage under the name that its files have."""
        start = None if self.start is None else self.start.planned
        return PlannedStage(self.key, self.system, self.stage, start, self.system.stages()[self.stage])

    @property
    def iterations(self) -> int:
        """Return the iterations of its stage."""
        return self.system.stages()[self.stage].iterations

    @property
    def all_iterations(self) -> tuple[int, ...]:
        """Return the iterations of its stage and of those before it."""
        return tuple(job.iterations for job in self.chain)

    @property
    def model_bytes(self) -> float:
        """Return the bytes of its model: its budget, or its Gaussians with all floats."""
        budget = self.system.budget_bytes
        return model_bytes(self.system) if budget is None else budget

    @property
    def key(self) -> str:
        """Return a unique key that is a valid file name."""
        return _key(self)


@functools.lru_cache(maxsize=10_000)
def _key(job: Job) -> str:
    numbers = [fingerprint(job.system, index) for index in range(job.stage + 1)]
    others = [job.views] if job.views != TEST else []
    others += ["random start"] if job.random_start else []
    digest = hashlib.sha256(repr((job.scene, job.downscale, numbers, *others)).encode()).hexdigest()[:12]
    return f"{_readable(job.scene)}-{job.downscale}-{job.system.stages()[job.stage].name}-{digest}"


def _readable(scene: str) -> str:
    """Return a part of a file name: the folder's name of an absolute path, and all of a path below --scenes."""
    path = Path(scene)
    return path.name if path.is_absolute() else scene.replace("/", "-")


def num_gaussians(system: a2tg.System) -> int:
    """Return the number of Gaussians that the events of a system let training start from at most.

    Densification stops at the same number. Systems without such an event count their initial Gaussians.
    """
    events = [event for stage in system.stages() for event in stage.events]
    caps = [event.most_gaussians for event in events if event.most_gaussians is not None]
    return max(caps, default=system.initial_gaussians or DEFAULT_GAUSSIANS)


@functools.lru_cache(maxsize=10_000)
def model_bytes(system: a2tg.System) -> float:
    """Return the bytes of the largest model of a system's stages; only shapes are computed, no device is used."""
    num = num_gaussians(system)
    largest = 0.0
    for stage in system.stages():
        floats = floats_per_gaussian(system.initial_sh_degree) + stage.floats_shown
        size = BYTES_PER_FLOAT * num * floats + stage.shared_bytes
        for event in stage.events:
            size = event.most_bytes(size, num, stage.iterations)
        largest = max(largest, size)
    return largest


@dataclasses.dataclass(frozen=True)
class Folders:
    """Folders that an experiment reads and writes."""

    scenes: Path
    work: Path
    """Folder of models, checkpoints and records of single jobs; large, and made again if missing."""
    lpips_weights: Path | None = None
    lpips_network: str | None = None
    """Network of the weights; jobs measured with another one are measured again."""

    @property
    def files(self) -> StageFiles:
        """Return models and checkpoints of stages, by the keys of their jobs."""
        return StageFiles(self.work)

    def model(self, job: Job) -> Path:
        return self.files.model(job.key)

    def record(self, job: Job) -> Path:
        return self.work / "records" / f"{job.key}.json"

    def time_so_far(self, job: Job) -> Path:
        """Return the file with the training time up to the newest checkpoint."""
        return self.work / "checkpoints" / f"{job.key}.json"

    def shared(self, job: Job) -> Path:
        """Return the file whose presence says that others ran on the job's GPU or cores, also in an earlier call."""
        return self.work / "shared" / job.key

    def load_scene(self, job: Job, room: int | None = None) -> a2tg.Scene:
        """Return a job's scene; `room` as in `SceneSource.load`."""
        is_folder = job.scene not in BUILT_IN
        path = str(self.scenes / job.scene) if is_folder else job.scene
        scene = SceneSource(path, job.downscale).load(room)
        scene = scene if job.fold is None else few_views(scene, job.fold)
        scene = from_random_points(scene) if job.random_start else scene
        return with_validation_views(scene) if job.validation else scene


def run_job(job: Job, folders: Folders, stop_at: float = math.inf) -> Record | None:
    """Train a job, from its checkpoint if it was stopped, and measure its model (host).

    A job that was trained before, but measured without LPIPS or with another network's, is only measured again.

    Args:
      job: the job.
      folders: its folders.
      stop_at: time of `time.monotonic` at which training writes a checkpoint and stops.

    Returns:
      The record, or None if training was stopped.
    """
    scene = folders.load_scene(job)
    path = folders.record(job)
    model = folders.model(job)
    if path.is_file() and model.is_file() and not is_from_before(read_json(path)):
        times: tuple[str, ...] = ("fps",)
        record = {**read_json(path), **_quality(scene, a2tg.load_model(model), folders)}
    else:
        try:
            result, seconds = _train(job, folders, scene, stop_at)
        except a2tg.Interrupted:
            return None
        a2tg.save_model(_ready(model), result.model)
        times = TIMES
        facts = _training_facts(job, scene, result) | {"training_seconds": seconds}
        record = {**facts, **_quality(scene, result.model, folders)}
        record["alone"] = not folders.shared(job).is_file()
    if folders.shared(job).is_file():
        record |= dict.fromkeys(times)
    write_json(_ready(path), record)
    folders.files.drop_all_checkpoints(job.key)
    folders.time_so_far(job).unlink(missing_ok=True)
    return record


def _train(job: Job, folders: Folders, scene: a2tg.Scene, stop_at: float) -> tuple[a2tg.StageResult, float | None]:
    """Return the result of the stage, and its time without compilation; None for that if a program that did not keep
    it had begun."""
    time_path = folders.time_so_far(job)
    training = TrainingTime()

    def take_time(checkpoint: a2tg.Checkpoint) -> None:
        training.earlier = read_json(time_path) if time_path.is_file() else math.nan

    def keep_time(checkpoint: a2tg.Checkpoint) -> None:
        write_json(time_path, training.seconds)

    def fit(*stage: Any, **options: Any) -> a2tg.StageResult:
        with training:
            return fit_stage(
                scene,
                *stage,
                **options,
                checkpoint_every=max(500, job.iterations // 10),
                is_stopped=lambda: time.monotonic() >= stop_at,
                session=_session(),
            )

    result = train_stage(folders.files, job.planned, scene, fit, on_resume=take_time, on_checkpoint=keep_time)
    return result, None if math.isnan(training.seconds) else training.seconds


@functools.cache
def _session() -> a2tg.Session:
    """Return the session that all jobs of this process share."""
    return a2tg.Session(after_compiling=tidy_memory)


def _training_facts(job: Job, scene: a2tg.Scene, result: a2tg.StageResult) -> Record:
    """Return what was trained and what it took."""
    first = scene.test[0].camera
    changed = own_options(job.system, type(job.system)())
    return {
        "scene": job.scene, "downscale": job.downscale, "pixels": [first.width, first.height],
        "system": reference_of(job.system), "version": job.system.version, "options": changed,
        "stage": result.name, "iterations": job.iterations, "num": result.model.num, "mb": result.model.num_bytes / 1e6,
        "published_mb": result.model.num_published_bytes / 1e6, "sizes": texture_sizes(result.model),
        "seconds": result.seconds, "ms_per_step": milliseconds(result.history),
        "seed": job.system.seed, "views": job.views,
        "commit": source_commit(), "device": jax.devices()[0].device_kind, "threads": num_threads(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        **({"random_start": True} if job.random_start else {}),
    }  # fmt: skip


def _quality(scene: a2tg.Scene, model: a2tg.Model, folders: Folders) -> Record:
    """Return quality on the held-out views and on some training views."""
    train = evenly_chosen(scene.train, MOST_TRAIN_VIEWS)
    background = background_of(scene)
    on_test = a2tg.evaluate(scene.test, model, background=background, lpips_weights=folders.lpips_weights)
    on_train = a2tg.evaluate(train, model, background=background)
    return {
        "psnr": on_test.psnr, "ssim": on_test.ssim, "lpips": on_test.lpips, "lpips_network": on_test.lpips_network,
        "train_psnr": on_train.psnr, "fps": on_test.frames_per_second,
        "per_view": {view.name: [view.psnr, view.ssim, view.lpips] for view in on_test.per_view},
    }  # fmt: skip


def background_of(scene: a2tg.Scene) -> tuple[float, float, float] | None:
    """Return white for transparent photographs, whatever background a system was trained on."""
    return WHITE if scene.test[0].alpha is not None else None


def texture_sizes(model: a2tg.Model) -> dict[str, int]:
    """Return the number of Gaussians by texture size, "2x4" being two rows (v) and four columns (u); empty without."""
    if model.textures is None:
        return {}
    pairs, counts = np.unique(model.textures.sizes, axis=0, return_counts=True)
    return {f"{rows}x{columns}": int(count) for (rows, columns), count in zip(pairs, counts, strict=True)}


def milliseconds(history: a2tg.History) -> float | None:
    """Return the median time of a step, free of compilation but not of other programs beside it; None for a stage too
    short to tell."""
    paces = np.diff(history.seconds) / np.diff(history.iteration)
    return 1e3 * float(np.median(paces)) if len(paces) else None


def _ready(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
