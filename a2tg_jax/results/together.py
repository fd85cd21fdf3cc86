"""A run that several processes train: the first one decides and writes files, the others follow it.

Before each stage the first process sends the others the checkpoint or model that the stage starts from, so that they
need no file of the run folder.
"""

import contextlib
import dataclasses
import hashlib
import json
import tempfile
import warnings
from pathlib import Path
from typing import Any

from a2tg_jax.data import Scene
from a2tg_jax.host import signals
from a2tg_jax.host.processes import broadcast, team
from a2tg_jax.io.model_file import load_model
from a2tg_jax.results.plan import PlannedStage, RunPlan
from a2tg_jax.results.record import RunRecord
from a2tg_jax.training import DivergedError, Session, fit_stage, load_checkpoint
from a2tg_jax.training.loop import IsStopped


def check_alike(record: RunRecord, scene: Scene) -> None:
    """Compare the options and the scene with the first process's; all processes call it together.

    Raises:
      ValueError: if they differ.
    """
    if team() is None:
        return
    own = digest_of(record, scene)
    if broadcast(own) != own:
        raise ValueError("this process has other options or another scene than the first: start all with the same")


def digest_of(record: RunRecord, scene: Scene) -> bytes:
    """Return 32 bytes that differ if training would: options, views, points. Paths may differ between machines."""
    systems = [(label, repr(system)) for label, system in record.systems.items()]
    views = [(view.name, view.picture.size) for view in scene.train]
    return hashlib.sha256(repr((systems, views, scene.points.shape, float(scene.scale))).encode()).digest()


def tell_stage(name: str, resume: Path | None, start: Path | None, num_restored: int | None) -> None:
    """Tell the other processes which stage is trained next, and from which checkpoint or model."""
    _tell({"name": name, "num_restored": num_restored}, [resume, start])


def tell_end() -> None:
    """Tell the other processes that all stages are trained."""
    _tell({"name": None}, [])


def _tell(header: dict[str, Any], files: list[Path | None]) -> None:
    if team() is not None:
        broadcast(json.dumps(header).encode())
        for file in files:
            broadcast(b"" if file is None else file.read_bytes())


def follow(record: RunRecord, scene: Scene, session: Session) -> None:
    """Train what the first process says until it says no more.

    Raises:
      ValueError: as `fit_stage` does.
      Stopped: if one of the processes is asked to end.
    """
    check_alike(record, scene)
    with warnings.catch_warnings(), signals.noted() as is_stopped:
        warnings.simplefilter("ignore")
        while (header := json.loads(broadcast(b"")))["name"] is not None:
            # A diverged stage is restored or given up by the first process.
            with contextlib.suppress(DivergedError):
                _follow_stage(record.plan, header, scene, session, is_stopped)


def _follow_stage(plan: RunPlan, header: dict[str, Any], scene: Scene, session: Session, is_stopped: IsStopped) -> None:
    planned: PlannedStage = plan[header["name"]]
    with tempfile.TemporaryDirectory() as folder:
        resume, start = (_received(Path(folder) / name) for name in ("resume.npz", "start.npz"))
        checkpoint = None if resume is None else load_checkpoint(resume, system=type(planned.system))
        fit_stage(
            scene,
            planned.system,
            planned.index,
            None if start is None else load_model(start),
            resume=None if checkpoint is None else dataclasses.replace(checkpoint, system=planned.system),
            on_checkpoint=lambda checkpoint: None,
            checkpoint_every=planned.checkpoint_every,
            progress=False,
            is_stopped=is_stopped,
            num_restored=header["num_restored"],
            session=session,
        )


def _received(path: Path) -> Path | None:
    """Return a file with what the first process sends; None for nothing."""
    data = broadcast(b"")
    if not data:
        return None
    path.write_bytes(data)
    return path
