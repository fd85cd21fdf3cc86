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
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax.data import Scene, View
from a2tg_jax.data.scene import views_by_kind
from a2tg_jax.host import signals
from a2tg_jax.io.model_file import load_model
from a2tg_jax.parallel.processes import broadcast, team
from a2tg_jax.results.plan import PlannedStage, RunPlan
from a2tg_jax.results.record import RunRecord
from a2tg_jax.training import DivergedError, Session, fit_stage, load_checkpoint
from a2tg_jax.training.loop import IsStopped

DIFFERING = ("options", "--devices", "views, cameras or points")
"""Facts that are compared with the first process."""


def check_alike(record: RunRecord, scene: Scene, session: Session) -> None:
    """Compare options, devices and the scene with the first process's; all processes call it together.

    Raises:
      ValueError: if they differ.
    """
    others = team()
    if others is None:
        return
    own = digests_of(record, scene, session)
    told = broadcast(b"".join(own))
    differing = [name for place, name in enumerate(DIFFERING) if told[32 * place : 32 * (place + 1)] != own[place]]
    if differing:
        raise ValueError(f"this process has other {' and '.join(differing)} than the first: start all with the same")
    others.has_met = True


def digests_of(record: RunRecord, scene: Scene, session: Session) -> list[bytes]:
    """Return 32 bytes for each of `DIFFERING` that differ if training would. Paths and the pixels of photographs, masks
    and depth maps are not compared."""
    systems = [(label, repr(system)) for label, system in record.systems.items()]
    mesh = session.mesh
    devices = [] if mesh is None else [(device.process_index, device.id) for device in mesh.devices.flat]
    views = [_told_of_view(view) for view in scene.train]
    rays = [_checksum(own[0].camera.rays) for own in views_by_kind(scene.train)]
    told = views, rays, _checksum(scene.points), _checksum(scene.colors), float(scene.scale)
    return [hashlib.sha256(repr(value).encode()).digest() for value in (systems, devices, told)]


def _told_of_view(view: View) -> tuple[Any, ...]:
    """Return what is compared of a view: its name, its size, what it has, its camera, and its points."""
    has = view.has_alpha, view.mask is not None, view.depth is not None
    points = None if view.points is None else [*map(_checksum, view.points)]
    return view.name, view.picture.size, has, _checksum(view.camera.viewmat), _checksum(view.camera.K), points


def _checksum(x: Any) -> tuple[tuple[int, ...], int] | None:
    """Return the shape of an array and a checksum of its bytes; None of None."""
    return None if x is None else (np.shape(x), zlib.crc32(np.ascontiguousarray(x).tobytes()))


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


def follow_first_process(record: RunRecord, scene: Scene, session: Session) -> None:
    """Train what the first process says until it says no more.

    Raises:
      ValueError: as `fit_stage` does.
      Stopped: if one of the processes is asked to end.
    """
    check_alike(record, scene, session)
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
