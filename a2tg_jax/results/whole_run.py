"""Whole runs, from checks to report, begun or resumed by one process at a time."""

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from a2tg_jax.data import Scene
from a2tg_jax.host import signals
from a2tg_jax.host.errors import error_text
from a2tg_jax.host.machine import Devices
from a2tg_jax.parallel.processes import team
from a2tg_jax.results.first_stage import GivenSplats, given_splats
from a2tg_jax.results.folder import RunFolder, check_free, create_run, resuming_command
from a2tg_jax.results.lock import claimed
from a2tg_jax.results.preflight import check_new_run
from a2tg_jax.results.record import RunRecord, read_record, write_record
from a2tg_jax.results.run_evaluation import evaluate_run
from a2tg_jax.results.run_replacement import drop_old
from a2tg_jax.results.run_training import train_run
from a2tg_jax.results.several_processes import check_alike
from a2tg_jax.results.summary import RunResult
from a2tg_jax.training import Session
from a2tg_jax.training.loop import Watch, unwatched

LESS_MEMORY = (
    "close other programs, or start another run with a larger --downscale, or a smaller memory_budget or batch_size"
)
"""Advice of the command line for trainings that have run out of memory."""
Watched = Callable[[Scene], AbstractContextManager[Watch]]
"""Function that gives the watcher of a scene's training."""


def unseen(scene: Scene) -> AbstractContextManager[Watch]:
    """Watch nothing."""
    return contextlib.nullcontext(unwatched)


def begin_run(
    record: RunRecord,
    out: Path,
    *,
    overwrite: bool,
    lpips_weights: Path | None = None,
    max_memory: int | None = None,
    watched: Watched = unseen,
    session: Session | None = None,
    progress: bool = True,
    tensorboard: bool = False,
) -> RunResult:
    """Train and measure a new run, after checking everything about it.

    Args:
      record: what is trained.
      out: the run folder; made if it is not there.
      overwrite: the run that is in the folder is replaced, once this one has a checkpoint, and deleted once this one
        has its report.
      lpips_weights: a weights file for LPIPS; None leaves it out.
      max_memory: bytes that the process may take (`forecast.allowed_memory`).
      watched: who looks at the training of a scene meanwhile.
      session: what trainings of this process share, compiled shapes and devices; None: a new one.
      progress: show the progress of training.
      tensorboard: write files of TensorBoard.

    Raises:
      ValueError, OSError: as `check_new_run` and `train_run` do, or if another process is at that folder or the memory
        does not suffice.
      Stopped: if the process is asked to end; its `advice` tells how to go on.
    """
    given = given_splats(record)
    scene = check_new_run(
        record,
        out,
        given=given,
        overwrite=overwrite,
        lpips_weights=lpips_weights,
        max_memory=max_memory,
        num_devices=1 if session is None else session.num_devices,
    )
    run = RunFolder(out)
    with claimed(run):
        check_free(out, overwrite=overwrite)  # Another process may have been here meanwhile.
        replaced_by = record if overwrite and run.is_begun else None
        if replaced_by is None:
            write_record(create_run(out), record)
        return go_on(
            run,
            scene,
            lpips_weights=lpips_weights,
            replaced_by=replaced_by,
            watched=watched,
            session=session,
            progress=progress,
            tensorboard=tensorboard,
            given=given,
        )


def go_on(
    run: RunFolder,
    scene: Scene,
    *,
    lpips_weights: Path | None = None,
    replaced_by: RunRecord | None = None,
    watched: Watched = unseen,
    session: Session | None = None,
    progress: bool = True,
    tensorboard: bool = False,
    given: GivenSplats | None = None,
) -> RunResult:
    """Train the stages that are not finished yet, and measure. Arguments are those of `train_run` and `begin_run`,
    errors those of `begin_run`."""
    devices = None if session is None else session.devices
    with _advised(run, devices, is_replacing=replaced_by is not None):
        check_alike(replaced_by or read_record(run), scene, session)
        with signals.noted() as is_stopped, watched(scene) as watch:
            train_run(
                run,
                scene,
                replaced_by=replaced_by,
                progress=progress,
                is_stopped=is_stopped,
                watch=watch,
                session=session,
                tensorboard=tensorboard,
                given=given,
            )
        if (others := team()) is not None:
            others.leave()
        return measure(run, scene, lpips_weights=lpips_weights)


def measure(run: RunFolder, scene: Scene | None = None, *, lpips_weights: Path | None = None) -> RunResult:
    """Call `evaluate_run`, and delete a replaced run once all stages are trained."""
    result = evaluate_run(run, scene, lpips_weights=lpips_weights)
    if len(result.models) == len(result.plan.names):
        drop_old(run)
    return result


@contextlib.contextmanager
def _advised(run: RunFolder, devices: Devices | None, *, is_replacing: bool) -> Iterator[None]:
    """Add to whatever ends the training how to continue it."""
    before = _identity(run.record) if is_replacing else None

    def advice() -> str:
        is_untouched = is_replacing and run.record.is_file() and _identity(run.record) == before
        return f"the run that was in {run.path} is untouched" if is_untouched else how_to_go_on(run, devices)

    if (others := team()) is not None:
        others.advice = advice
    try:
        yield
    except KeyboardInterrupt as stop:
        number = stop.number if isinstance(stop, signals.Stopped) else signals.CTRL_C
        raise signals.Stopped(number, advice()) from None
    except Exception as error:
        told = error_text(error, LESS_MEMORY)
        if told is None:
            raise
        if others is not None:
            others.told(error)
        raise ValueError(f"{told}; {advice()}") from error


def _identity(path: Path) -> tuple[int, int]:
    """Return numbers that another file in this place would not share."""
    status = path.stat()
    return status.st_ino, status.st_mtime_ns


def how_to_go_on(run: RunFolder, devices: Devices | None = None) -> str:
    """Return the path of the newest checkpoint, and the command that resumes, as `resuming_command`."""
    names = read_record(run).plan.names
    checkpoints = [path for name in names for path in run.checkpoints(name)]
    finished = [run.model(name) for name in names if run.model(name).is_file()]
    last = f"the last checkpoint is {checkpoints[-1]}" if checkpoints else "there is no checkpoint yet"
    if finished and not checkpoints:
        last = f"the last model is {finished[-1]}"
    return f"{last}; continue with: {resuming_command(run, devices)}"
