"""Runs in their folders: begun or resumed, trained stage by stage with checkpoints, and measured.

If several processes train a run, the first one decides and writes files. Before each stage it sends the others the
checkpoint or model to start from, so that they need no access to the run folder.
"""

import contextlib
import dataclasses
import functools
import hashlib
import json
import tempfile
import warnings
import zlib
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import jax
import numpy as np

from a2tg_jax.data.scene import Scene, views_by_kind
from a2tg_jax.finish.tuning import ITERATIONS
from a2tg_jax.host import signals
from a2tg_jax.host.errors import error_text
from a2tg_jax.host.machine import Devices, this_machine
from a2tg_jax.host.remote_files import is_url
from a2tg_jax.io.archive import read_archive_header
from a2tg_jax.io.config_json import flatten_config
from a2tg_jax.io.formats import load_splats
from a2tg_jax.io.model_file import FORMAT, load_model, number_in_file, save_model
from a2tg_jax.parallel import any_process, broadcast, leave
from a2tg_jax.results.compression import SUFFIX, CompressOptions, command_for_file, compress
from a2tg_jax.results.folder import (
    DAMAGED,
    RunFolder,
    check_apart,
    check_free,
    check_output,
    claimed,
    iteration_of,
    put_back_old,
    resuming_command,
    set_aside,
)
from a2tg_jax.results.forecast import doubts_about, print_forecast, room_for_photographs, time_after
from a2tg_jax.results.history import EventWriter, write_history
from a2tg_jax.results.model_source import check_init, write_first_stage
from a2tg_jax.results.record import OnNan, PlannedStage, RunPlan, RunRecord, is_finished, read_record, write_record
from a2tg_jax.results.report import RunResult
from a2tg_jax.results.run_evaluation import check_held_out, check_weights, evaluate_run
from a2tg_jax.training import (
    Checkpoint,
    DivergedError,
    Session,
    StageResult,
    System,
    fit_stage,
    load_checkpoint,
    save_checkpoint,
)
from a2tg_jax.training.loop import IsStopped, Watch, never, unwatched
from a2tg_jax.training.recorded_views import check_names
from a2tg_jax.training.registry import system_from_dict, system_to_dict
from a2tg_jax.training.start import check_loss_data, check_start

LESS_MEMORY = (
    "close other programs, or start another run with a larger `downscale`, or a smaller `memory_budget` or `batch_size`"
)
"""Advice on the command line for trainings that run out of memory."""
MOST_RESTORED = 5
"""Largest number of restorations of a diverged stage, each with another order of the views."""
DIFFERING = ("options", "`devices`", "views, cameras or points")
"""Facts that processes compare with the first one's."""
Watched = Callable[[Scene], AbstractContextManager[Watch]]
"""Function that returns the watcher of a scene's training."""


def unseen(scene: Scene) -> AbstractContextManager[Watch]:
    """Watch nothing."""
    return contextlib.nullcontext(unwatched)


def warn(doubts: Sequence[str]) -> None:
    """Warn of each doubt."""
    for doubt in doubts:
        warnings.warn(doubt, stacklevel=3)


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """Options of a run's execution. They do not affect the model, except for last bits on other devices."""

    overwrite: bool = False
    """Replace the run that is in the folder; it is deleted once the new run has its report."""
    lpips_weights: Path | None = None
    """Weights file for LPIPS; None leaves it out."""
    max_memory: int | None = None
    """Bytes that the process may take; None: what the machine has available."""
    tensorboard: bool = False
    """Write the histories for TensorBoard as well, at each checkpoint."""
    progress: bool = True
    """Show progress bars."""
    watched: Watched = unseen
    confirm: Callable[[Sequence[str]], None] = warn
    """Function called with the doubts about a new run (`doubts_about`), if there are any; it may raise ValueError."""
    session: Session = dataclasses.field(default_factory=Session)


def begin_run(record: RunRecord, out: Path, options: RunOptions) -> RunResult:
    """Train and measure a new run in a folder, which is made if needed, after all checks.

    Raises:
      ValueError, OSError: if the run cannot be trained, naming the option, weights, folder, scene, disk or memory; if
        another process has claimed the folder; or as `train_run`.
      Stopped: if a signal ends the training; its `advice` says how to continue.
    """
    record.check()
    check_weights(options.lpips_weights)
    # Neither is a folder here.
    if not record.scene.is_built_in and not is_url(record.scene.path):
        check_apart(out, Path(record.scene.path))
    # Cheap checks come before the scene is loaded.
    check_free(out, overwrite=options.overwrite)
    given = None if record.init is None else check_init(Path(record.init), out, record.options)
    check_output(out)
    scene = record.scene.load(room_for_photographs(options.max_memory))
    num_given = None if given is None else given.num
    for system in record.systems.values():
        check_loss_data(scene.train, system.all_stages())
        if given is None or system is not record.options:
            check_start(scene, system)
    if doubts := doubts_about(scene, record):
        options.confirm(doubts)
    print_forecast(scene, record, options.max_memory, options.session.num_devices, num_given, out)
    run = RunFolder(out)
    with claimed(run):
        check_free(out, overwrite=options.overwrite)  # Another process may have been here meanwhile.
        if run.is_begun:
            set_aside(run)
        # Before any checkpoint, so that a killed run can be resumed.
        write_record(run, record)
        if given is not None:
            write_first_stage(run, record, given, scene)
        del given  # The training takes its memory.
        return _train_and_measure(run, record, scene, options)


def resume_run(run: RunFolder, options: RunOptions) -> RunResult:
    """Train the stages of a claimed run that are not finished yet, and measure. Raises as `begin_run`."""
    check_weights(options.lpips_weights)
    record, num_given = read_record(run), None
    if is_finished(run, record):
        print(f"{run.path} is finished; to train it on: {resuming_command(run)} --more 2000", flush=True)
    scene = record.scene.load(room_for_photographs(options.max_memory))
    if record.init is not None:
        first = run.model(record.plan.main[0])
        if not first.is_file():
            write_first_stage(run, record, load_splats(Path(record.init)), scene)
        num_given = number_in_file(first)
    print_forecast(scene, record, options.max_memory, options.session.num_devices, num_given)
    return _train_and_measure(run, record, scene, options)


def _train_and_measure(run: RunFolder, record: RunRecord, scene: Scene, options: RunOptions) -> RunResult:
    """Train, measure, and write the file of a file budget. Errors and signals come with advice on how to continue; a
    replaced run is restored if there is no checkpoint yet."""

    def advice() -> str:
        if put_back_old(run):
            return f"the run that was in {run.path} is untouched"
        return how_to_go_on(run, options.session.devices)

    try:
        check_alike(record, scene, options.session)
        with signals.noted() as is_stopped, options.watched(scene) as watch:
            train_run(run, scene, options, is_stopped=is_stopped, watch=watch)
        leave()
        result = evaluate_run(run, scene, lpips_weights=options.lpips_weights)
        if record.file_bytes is not None:
            _write_file(run, record, record.file_bytes, scene, progress=options.progress)
        return result
    except KeyboardInterrupt as stop:
        number = getattr(stop, "number", signals.CTRL_C)
        raise signals.Stopped(number, advice()) from None
    except Exception as error:
        text = error_text(error, LESS_MEMORY)
        if text is None:
            raise
        raise ValueError(f"{text}; {advice()}") from error


def _write_file(run: RunFolder, record: RunRecord, max_bytes: int, scene: Scene, *, progress: bool) -> None:
    """Write the file of a file budget, unless it is there, and print a line about it; warn if none is small enough."""
    model = run.model(record.plan.main[-1])
    path = model.with_suffix(SUFFIX)
    if path.is_file() and path.stat().st_size <= max_bytes and path.stat().st_mtime >= model.stat().st_mtime:
        return
    budget = record.file_budget
    try:
        options = CompressOptions(file_budget=budget, tune_iterations=ITERATIONS)
        line = compress(run.path, None, options, scene=scene, progress=progress)
        print(line, flush=True)
    except ValueError as error:
        again = command_for_file(run, "SIZE")
        warnings.warn(f"no file was written: {error}; to try another size: {again}", stacklevel=2)


def how_to_go_on(run: RunFolder, devices: Devices | None = None) -> str:
    """Return the path of the newest checkpoint, or else model, and the command that resumes, as `resuming_command`."""
    names = read_record(run).plan.names
    found = [f"the last model is {run.model(name)}" for name in names if run.model(name).is_file()]
    found += [f"the last checkpoint is {path}" for name in names for path in run.checkpoints(name)]
    return f"{['there is no checkpoint yet', *found][-1]}; continue with: {resuming_command(run, devices)}"


def train_run(
    run: RunFolder, scene: Scene, options: RunOptions, *, is_stopped: IsStopped = never, watch: Watch = unwatched
) -> None:
    """Train every stage of the run's record that is not finished yet, from its newest checkpoint. When a stage ends,
    its history and its model are written, and its checkpoints deleted.

    Raises:
      ValueError: as `fit` does, or if a checkpoint or model is damaged, of another version, or made with other options
        than the record's.
    """
    record = read_record(run)
    fit = functools.partial(
        fit_stage,
        scene,
        progress=options.progress,
        is_stopped=is_stopped,
        watch=watch,
        session=options.session,
        max_memory=options.max_memory,
    )
    num_given = None if record.init is None else number_in_file(run.model(record.plan.main[0]))
    to_train = [name for name in record.plan.names if not run.model(name).is_file()]
    after = time_after(scene, record.plan, to_train, num_given, 0 if record.file_bytes is None else ITERATIONS)
    for planned in record.plan.stages:
        path = run.model(planned.name)
        if path.is_file():
            try:
                made = read_archive_header(path, format=FORMAT).get("system")
            except ValueError as error:
                raise ValueError(f"{error}; delete it to train {planned.name} again") from error
            if made is not None:  # The first stage may be from a file.
                _check_options(path, system_from_dict(made, str(path), type(planned.system)), planned.system)
        else:
            events = EventWriter(run, planned.name) if options.tensorboard else None
            own = functools.partial(fit, after=after[planned.name])
            result = _train_stage(run, record.plan, planned, scene, own, events, record.on_nan)
            if events is not None:
                events.add(result.history)
                events.close()
            write_history(run.own(run.history(planned.name)), result.history)
            # After the history: a model says that its stage is finished.
            save_model(run.own(path), result.model, {"system": system_to_dict(planned.system)})
        # Also if the model was there: a process may have been killed between the two.
        if planned.name in record.plan.kept_states:
            run.keep_state(planned.name, planned.stage.iterations)
        run.drop_old_checkpoints(planned.name, keep=0)
    # Ends `follow_first_process`.
    _send_stage(None)


def _train_stage(
    run: RunFolder,
    plan: RunPlan,
    planned: PlannedStage,
    scene: Scene,
    fit: Callable[..., StageResult],
    events: EventWriter | None,
    on_nan: OnNan,
) -> StageResult:
    """Train a stage from its newest checkpoint or its beginning; after a divergence, restore it if allowed."""

    def keep(checkpoint: Checkpoint) -> None:
        if checkpoint.iteration == 0:
            return  # The stage's start gives the same state.
        if events is not None:
            events.add(checkpoint.history)
        save_checkpoint(run.own(run.checkpoint(planned.name, checkpoint.iteration)), checkpoint)
        run.drop_old_checkpoints(planned.name)

    num_restored = None
    while True:
        resume = _newest_checkpoint(run, planned)
        if events is not None and resume is not None:
            events.skip(resume.history)
        # Files, not arrays: other processes read them exactly as the first one does.
        resumed = None if resume is None else run.checkpoint(planned.name, resume.iteration)
        model, start = None, None if planned.start is None else run.model(planned.start)
        if start is not None:
            model = load_model(start)
            check_held_out(model, scene, start)
            if model.origin is not None:
                trained = [
                    name for name, is_test in zip(model.origin.names, model.origin.is_test, strict=True) if not is_test
                ]
                advice = "restore the photographs, or train in a new folder"
                check_names(trained, [view.name for view in scene.train], str(start), advice)
        if resume is None and planned.stage.continues and planned.start is not None:
            resume = _last_state(run, plan[planned.start], planned.name)
            resumed = None if resume is None else run.state(planned.start)
        _send_stage(planned.name, [resumed, start], num_restored)
        try:
            return fit(
                planned.system,
                planned.index,
                model,
                resume=resume,
                on_checkpoint=keep,
                checkpoint_every=planned.checkpoint_every,
                title=planned.name,
                num_restored=num_restored,
            )
        except DivergedError as error:
            before, checkpoints = error.checkpoint, run.checkpoints(planned.name)
            path = run.own(run.diverged(planned.name, before.iteration))
            save_checkpoint(path, before)
            text, num_restored = f"{error}, in {path}", before.num_restored + 1
            if on_nan == "stop":
                raise ValueError(f"{text}; `on_nan` restore continues with the views in another order") from error
            if num_restored > MOST_RESTORED:
                raise ValueError(f"{text}; the stage was restored {MOST_RESTORED} times already") from error
            back = f"iteration {iteration_of(checkpoints[-1])}" if checkpoints else "its beginning"
            order = f"({num_restored} of {MOST_RESTORED} times)"
            warnings.warn(
                f"{text}; the stage restarts from {back} with the views in another order {order}", stacklevel=3
            )


def _newest_checkpoint(run: RunFolder, planned: PlannedStage) -> Checkpoint | None:
    """Return the newest readable checkpoint of a stage, made with the same options; None if there are no checkpoints.
    Raises ValueError if none of them can be read."""
    damaged: list[tuple[Path, ValueError]] = []
    # Newest first; after a damaged one, the one before is tried.
    for path in reversed(run.checkpoints(planned.name)):
        try:
            checkpoint = load_checkpoint(path, system=type(planned.system))
        except ValueError as error:
            damaged.append((path, error))
            continue
        _check_made_alike(path, checkpoint, planned)
        for damaged_path, damage in damaged:
            aside = damaged_path.replace(run.own(damaged_path.with_name(damaged_path.name + DAMAGED)))
            warnings.warn(
                f"{damage}; it was renamed to {aside.name}, and training continues from {path.name}", stacklevel=2
            )
        return checkpoint
    if damaged:
        raise ValueError(
            f"{damaged[0][1]}; there is no other checkpoint: delete it to train {planned.name} from its beginning"
        )
    return None


def _last_state(run: RunFolder, before: PlannedStage, name: str) -> Checkpoint | None:
    """Return the state at the end of a stage, which the stage of that name continues; None, with a warning, if it was
    not kept. Raises ValueError if it cannot be read, or was made with other options."""
    path = run.state(before.name)
    if not path.is_file():
        warnings.warn(
            f"{name} continues {before.name} without Adam's moments, so that the first iterations may make pictures "
            f"worse: there is no {path}",
            stacklevel=3,
        )
        return None
    try:
        state = load_checkpoint(path, system=type(before.system))
    except ValueError as error:
        raise ValueError(f"{error}; delete it to train {name} without Adam's moments") from error
    _check_made_alike(path, state, before)
    return state


def _check_made_alike(path: Path, checkpoint: Checkpoint, planned: PlannedStage) -> None:
    """Raise ValueError if a checkpoint was made with other options than the record's; warn if on another machine."""
    _check_options(path, checkpoint.system, planned.system)
    differences = [] if checkpoint.machine is None else checkpoint.machine.differences(this_machine())
    if differences:
        warnings.warn(
            f"{path.name} was made on another machine, so last bits will differ: {'; '.join(differences)}",
            stacklevel=3,
        )


def _check_options(path: Path, made: System, wanted: System) -> None:
    """Raise ValueError if a checkpoint or model was made with other options than the record's."""
    before, now = flatten_config(made), flatten_config(wanted)
    names = ", ".join(name for name, value in now.items() if before.get(name) != value)
    if names:
        raise ValueError(
            f"{path} was made with another {names} than in run.toml: restore that, or train in a new folder"
        )


# Several processes


def check_alike(record: RunRecord, scene: Scene, session: Session) -> None:
    """Compare options, devices and the scene with the first process; all processes call it together. Raises ValueError
    if they differ."""
    if jax.process_count() == 1:
        return
    differing = []
    for name, digest in zip(DIFFERING, digests_of(record, scene, session), strict=True):
        if any_process(session.mesh, broadcast(digest) != digest):
            differing.append(name)
    if differing:
        raise ValueError(f"the processes have different {' and '.join(differing)}: start all with the same")


def digests_of(record: RunRecord, scene: Scene, session: Session) -> list[bytes]:
    """Return 32 bytes for each of `DIFFERING` that differ if training would. Paths and the pixels of photographs, masks
    and depth maps are left out."""

    def checksum(x: Any) -> tuple[tuple[int, ...], int]:
        return np.shape(x), zlib.crc32(np.ascontiguousarray(x).tobytes())

    # A dataclass's repr has every option.
    systems = [(label, repr(system)) for label, system in record.systems.items()]
    devices = [] if session.mesh is None else [(one.process_index, one.id) for one in session.mesh.devices.flat]
    views = []
    for view in scene.train:
        has = view.has_alpha, view.mask is not None, view.depth is not None
        arrays = view.camera.viewmat, view.camera.K
        views.append((view.name, view.picture.size, has, *map(checksum, arrays)))
    lenses = [own[0].camera.rays for own in views_by_kind(scene.train)]
    rays = [None if lens is None else checksum(lens) for lens in lenses]
    compared = views, rays, checksum(scene.points), checksum(scene.colors), float(scene.scale)
    return [hashlib.sha256(repr(value).encode()).digest() for value in (systems, devices, compared)]


def _send_stage(name: str | None, files: Sequence[Path | None] = (), num_restored: int | None = None) -> None:
    """Send the other processes the name of the next stage, with the checkpoint and the model that it starts from; None
    at the end."""
    if jax.process_count() > 1:
        broadcast(json.dumps({"name": name, "num_restored": num_restored}).encode())
        for file in files:
            broadcast(b"" if file is None else file.read_bytes())


def follow_first_process(record: RunRecord, scene: Scene, session: Session) -> None:
    """Train what the first process sends, until it ends. Raises ValueError as `fit_stage`, and Stopped if a signal ends
    one of the processes."""
    check_alike(record, scene, session)
    plan = record.plan

    def received(path: Path) -> Path | None:
        data = broadcast(b"")
        path.write_bytes(data)
        return path if data else None

    # The first process reports warnings; the others would only repeat them.
    with warnings.catch_warnings(), signals.noted() as is_stopped, tempfile.TemporaryDirectory() as folder:
        warnings.simplefilter("ignore")
        while (header := json.loads(broadcast(b"")))["name"] is not None:
            planned = plan[header["name"]]
            resume, start = (received(Path(folder) / name) for name in ("resume.npz", "start.npz"))
            with contextlib.suppress(DivergedError):  # The first process restores the stage or gives up.
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
