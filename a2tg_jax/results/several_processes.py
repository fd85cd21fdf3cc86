"""A run that several processes train: the first one decides and writes files, the others follow it.

Before each stage the first process sends the others the checkpoint or model that the stage starts from, so that they
need no file of the run folder.
"""

import contextlib
import hashlib
import json
import tempfile
import warnings
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax.data import Scene
from a2tg_jax.data.scene import views_by_kind
from a2tg_jax.host import signals
from a2tg_jax.io.model_file import load_model
from a2tg_jax.parallel.processes import broadcast, team
from a2tg_jax.results.record import RunRecord
from a2tg_jax.training import DivergedError, Session, fit_stage, load_checkpoint

DIFFERING = ("options", "--devices", "views, cameras or points")
"""Facts that are compared with the first process."""


def check_alike(record: RunRecord, scene: Scene, session: Session) -> None:
    """Compare options, devices and the scene with the first process; all processes call it together.

    Raises:
      ValueError: if they differ.
    """
    others = team()
    if others is None:
        return
    own = digests_of(record, scene, session)
    first = broadcast(b"".join(own))
    differing = [name for place, name in enumerate(DIFFERING) if first[32 * place : 32 * (place + 1)] != own[place]]
    if differing:
        raise ValueError(f"this process has other {' and '.join(differing)} than the first: start all with the same")
    others.has_met = True


def digests_of(record: RunRecord, scene: Scene, session: Session) -> list[bytes]:
    """Return 32 bytes for each of `DIFFERING` that differ if training would. Paths and the pixels of photographs, masks
    and depth maps are not compared."""
    systems = [(label, repr(system)) for label, system in record.systems.items()]
    devices = [] if session.mesh is None else [(one.process_index, one.id) for one in session.mesh.devices.flat]
    views = []
    for view in scene.train:
        has = view.has_alpha, view.mask is not None, view.depth is not None
        arrays = view.camera.viewmat, view.camera.K, *(() if view.points is None else view.points)
        views.append((view.name, view.picture.size, has, *map(_checksum, arrays)))
    rays = [_checksum(own[0].camera.rays) for own in views_by_kind(scene.train)]
    compared = views, rays, _checksum(scene.points), _checksum(scene.colors), float(scene.scale)
    return [hashlib.sha256(repr(value).encode()).digest() for value in (systems, devices, compared)]


def _checksum(x: Any) -> tuple[tuple[int, ...], int] | None:
    """Return the shape of an array and a checksum of its bytes; None of None."""
    return None if x is None else (np.shape(x), zlib.crc32(np.ascontiguousarray(x).tobytes()))


def send_stage(name: str | None, files: Sequence[Path | None] = (), num_restored: int | None = None) -> None:
    """Send the other processes the name of the stage that is trained next, with the checkpoint and the model that it
    starts from, and None at the end."""
    if team() is not None:
        broadcast(json.dumps({"name": name, "num_restored": num_restored}).encode())
        for file in files:
            broadcast(b"" if file is None else file.read_bytes())


def follow_first_process(record: RunRecord, scene: Scene, session: Session) -> None:
    """Train what the first process sends until its end.

    Raises:
      ValueError: as `fit_stage` does.
      Stopped: if a signal ends one of the processes.
    """
    check_alike(record, scene, session)
    plan = record.plan
    with warnings.catch_warnings(), signals.noted() as is_stopped, tempfile.TemporaryDirectory() as folder:
        warnings.simplefilter("ignore")
        while (header := json.loads(broadcast(b"")))["name"] is not None:
            planned = plan[header["name"]]
            resume, start = (_received(Path(folder) / name) for name in ("resume.npz", "start.npz"))
            with contextlib.suppress(DivergedError):  # The first process restores the stage, or gives up.
                fit_stage(
                    scene,
                    planned.system,
                    planned.index,
                    None if start is None else load_model(start),
                    resume=None if resume is None else load_checkpoint(resume, system=type(planned.system)),
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
