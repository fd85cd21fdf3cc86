"""Training of one run by several processes. The first one decides and writes files, and the others follow it.

Before each stage the first process sends the others the checkpoint or model to start from, so that they need no access
to the run folder.
"""

import contextlib
import dataclasses
import hashlib
import json
import tempfile
import warnings
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from a2tg_jax import DivergedError, Scene, Session, fit_stage, load_checkpoint, load_model
from a2tg_jax.host import signals
from a2tg_jax.parallel import any_process, broadcast, leave
from a2tg_jax.results.record import RunRecord
from a2tg_jax.scene import views_by_kind

COMPARED = ("options", "`devices`", "views, cameras or points")
"""Facts that processes compare with the first one's."""


def check_batch_sizes(record: RunRecord, session: Session) -> None:
    """Raise ValueError if the devices of all processes cannot share the views of a step evenly."""
    for system in record.systems.values():
        session.check_batch_size(system.batch_size)


def check_alike(record: RunRecord, scene: Scene, session: Session) -> None:
    """Compare options, devices and the scene with the first process; all processes call it together. Raises ValueError
    if they differ."""
    if jax.process_count() == 1:
        return
    differing = []
    for name, digest in zip(COMPARED, digests_of(record, scene, session), strict=True):
        if any_process(session.mesh, broadcast(digest) != digest):
            differing.append(name)
    if differing:
        raise ValueError(f"the processes have different {' and '.join(differing)}: start all with the same")


def digests_of(record: RunRecord, scene: Scene, session: Session) -> list[bytes]:
    """Return 32 bytes for each of `COMPARED` that differ if training would. Paths and the pixels of photographs, masks
    and depth maps are left out."""
    # A dataclass's repr has every option.
    systems = [(label, repr(system)) for label, system in record.systems.items()]
    devices = [] if session.mesh is None else [(one.process_index, one.id) for one in session.mesh.devices.flat]
    views = []
    for view in scene.train:
        has = (view.has_alpha, view.mask is not None, view.depth is not None)
        views.append((view.name, view.picture.size, has, _checksum(view.camera.viewmat), _checksum(view.camera.K)))
    lenses = [alike[0].camera.rays for alike in views_by_kind(scene.train)]
    rays = [None if lens is None else _checksum(lens) for lens in lenses]
    content = (views, rays, _checksum(scene.points), _checksum(scene.colors), float(scene.scale))
    return [hashlib.sha256(repr(fact).encode()).digest() for fact in (systems, devices, content)]


def _checksum(x: Any) -> tuple[tuple[int, ...], int]:
    return np.shape(x), zlib.crc32(np.ascontiguousarray(x).tobytes())


def send_stage(
    name: str | None,
    files: Sequence[Path | None] = (),
    num_restored: int | None = None,
    shortened_at: int | None = None,
) -> None:
    """Send the other processes the name of the next stage, with the checkpoint and the model that it starts from, and
    arguments of `fit_stage`; None at the end."""
    if jax.process_count() > 1:
        header = {"name": name, "num_restored": num_restored, "shortened_at": shortened_at}
        broadcast(json.dumps(header).encode())
        for file in files:
            broadcast(b"" if file is None else file.read_bytes())


def leave_others() -> None:
    """End the common work after the last stage; the first process measures alone."""
    leave()


def follow_first_process(record: RunRecord, scene: Scene, session: Session) -> None:
    """Train what the first process sends, until it ends. Raises ValueError as `fit_stage`, and Stopped if a signal ends
    one of the processes."""
    check_alike(record, scene, session)
    plan = record.plan
    # The first process reports warnings; the others would only repeat them.
    with warnings.catch_warnings(), signals.stop_on_signals() as is_stopped, tempfile.TemporaryDirectory() as folder:
        warnings.simplefilter("ignore")
        while True:
            header = json.loads(broadcast(b""))
            if header["name"] is None:
                return
            planned = plan[header["name"]]
            resume_file = _received(Path(folder, "resume.npz"))
            start_file = _received(Path(folder, "start.npz"))
            resume = None
            if resume_file is not None:
                # The first process has checked its options.
                checkpoint = load_checkpoint(resume_file, system=type(planned.system))
                resume = dataclasses.replace(checkpoint, system=planned.system)
            with contextlib.suppress(DivergedError):  # The first process restores the stage or gives up.
                fit_stage(
                    scene,
                    planned.system,
                    planned.index,
                    None if start_file is None else load_model(start_file),
                    resume=resume,
                    on_checkpoint=lambda checkpoint: None,
                    checkpoint_every=planned.checkpoint_every,
                    is_stopped=is_stopped,
                    num_restored=header["num_restored"],
                    shortened_at=header["shortened_at"],
                    session=session,
                )


def _received(path: Path) -> Path | None:
    """Return the path after writing the file that the first process sends; None if it sends none."""
    content = broadcast(b"")
    path.write_bytes(content)
    return path if content else None
