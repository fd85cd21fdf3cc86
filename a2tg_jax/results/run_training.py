"""Runs in their folders: begun or resumed, trained stage by stage with checkpoints, and measured."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from a2tg_jax import (
    Checkpoint,
    DivergedError,
    Progress,
    Scene,
    Session,
    StageResult,
    fit_stage,
    save_checkpoint,
    save_model,
)
from a2tg_jax.base.machine import Devices
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.finish.tuning import ITERATIONS
from a2tg_jax.host import signals
from a2tg_jax.host.errors import error_text
from a2tg_jax.host.training_bar import ProgressBar
from a2tg_jax.io.formats import load_splats
from a2tg_jax.model_file import number_in_file
from a2tg_jax.results.commands import file_command, resuming_command, viewing_command
from a2tg_jax.results.compression import SUFFIX, compress
from a2tg_jax.results.folder import RunFolder, check_free, claimed, iteration_of, put_back_old, set_aside
from a2tg_jax.results.forecast import checked_forecast, doubts_about, room_for_photographs, time_after
from a2tg_jax.results.history import EventWriter, write_history
from a2tg_jax.results.model_source import check_init, write_first_stage
from a2tg_jax.results.options import CompressOptions
from a2tg_jax.results.output_paths import check_apart, check_output
from a2tg_jax.results.plan import PlannedStage
from a2tg_jax.results.record import OnNan, RunRecord, is_finished, read_record, write_record
from a2tg_jax.results.report import RunResult
from a2tg_jax.results.run_evaluation import check_weights, evaluate_run
from a2tg_jax.results.run_processes import check_alike, leave_others, send_stage
from a2tg_jax.results.stage_training import check_finished, train_stage
from a2tg_jax.training.registry import system_to_dict
from a2tg_jax.training.start import check_points

LESS_MEMORY = (
    "close other programs, or start another run with a larger `downscale`, or a smaller `memory_budget` or `batch_size`"
)
"""Advice for trainings that run out of memory."""
MOST_RESTORED = 5
"""Largest number of restorations of a diverged stage, each with another order of the views."""
Watched = Callable[[Scene], AbstractContextManager[Callable[..., float]]]
"""Function that returns the watcher of a scene's training (`Session.watch`)."""


def unseen(scene: Scene) -> AbstractContextManager[Callable[..., float]]:
    """Watch nothing."""
    return contextlib.nullcontext(lambda run, is_stopped: 0.0)


def warn_of_doubts(doubts: Sequence[str]) -> None:
    """Warn of each doubt."""
    for doubt in doubts:
        warn(doubt)


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
    on_note: Callable[[str], object] = lambda line: None
    """Function that receives lines about the run."""
    confirm: Callable[[Sequence[str]], None] = warn_of_doubts
    """Function called with the doubts about a new run (`doubts_about`), if there are any; it may raise ValueError."""
    session: Session = dataclasses.field(default_factory=Session)


def begin_run(record: RunRecord, out: Path, options: RunOptions) -> RunResult:
    """Train and measure a new run in a folder, which is made if needed, after all checks.

    Raises:
      ValueError, OSError: if the run cannot be trained, naming the option, weights, folder, scene, disk or memory; if
        another process has claimed the folder; or as `train_run`.
      Stopped: if a signal ends the training; its `advice` says how to continue.
    """
    # Cheap checks come before the scene is loaded.
    record.check()
    check_weights(options.lpips_weights)
    if not record.scene.is_built_in:
        check_apart(out, Path(record.scene.path))
    check_free(out, overwrite=options.overwrite)
    given = None if record.init is None else check_init(Path(record.init), out, record.options)
    num_given = None if given is None else given.num
    check_output(out)
    scene = record.scene.load(room_for_photographs(options.max_memory))
    for system in record.systems.values():
        for stage in system.all_stages():
            stage.check_views(scene.train)
        if given is None or system is not record.options:
            check_points(scene, system)
    doubts = doubts_about(scene, record)
    if doubts:
        options.confirm(doubts)
    forecast = checked_forecast(scene, record, options.max_memory, options.session.num_devices, num_given, out)
    options.on_note(forecast)
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
    record = read_record(run)
    if is_finished(run, record):
        options.on_note(f"{run.path} is finished; to train it on: {resuming_command(run)} --more 2000")
    scene = record.scene.load(room_for_photographs(options.max_memory))
    if record.init is not None and not run.model(record.plan.main[0]).is_file():
        write_first_stage(run, record, load_splats(Path(record.init)), scene)
    num_given = _num_given(run, record)
    options.on_note(checked_forecast(scene, record, options.max_memory, options.session.num_devices, num_given))
    return _train_and_measure(run, record, scene, options)


def _num_given(run: RunFolder, record: RunRecord) -> int | None:
    """Return the number of Gaussians of the file that replaces the first stage; None without one."""
    return None if record.init is None else number_in_file(run.model(record.plan.main[0]))


def _train_and_measure(run: RunFolder, record: RunRecord, scene: Scene, options: RunOptions) -> RunResult:
    """Train, measure, and write the file of a file budget. Errors and signals come with advice on how to continue; a
    replaced run is restored if there is no checkpoint yet."""
    try:
        check_alike(record, scene, options.session)
        with signals.stop_on_signals() as is_stopped, options.watched(scene) as options.session.watch:
            train_run(run, scene, options, is_stopped=is_stopped)
        leave_others()
        result = evaluate_run(run, scene, lpips_weights=options.lpips_weights)
        if record.file_bytes is not None:
            _write_file(run, record, record.file_bytes, scene, options)
        return result
    except KeyboardInterrupt as interrupt:
        number = getattr(interrupt, "number", signals.CTRL_C)
        raise signals.Stopped(number, _advice(run, options)) from None
    except Exception as error:
        text = error_text(error, LESS_MEMORY)
        if text is None:
            raise
        raise ValueError(f"{text}; {_advice(run, options)}") from error


def _advice(run: RunFolder, options: RunOptions) -> str:
    if put_back_old(run):
        return f"the run that was in {run.path} is untouched"
    return how_to_go_on(run, options.session.devices)


def how_to_go_on(run: RunFolder, devices: Devices | None = None) -> str:
    """Return the newest file of the training and the command that shows it, and the command that resumes, as
    `resuming_command`, with the flag that finishes soon."""
    kept = "there is no checkpoint yet"
    hint = ""
    for name in read_record(run).plan.names:
        path = run.newest(name)
        if path is not None:
            hint = " (add --finish-now to finish soon)"
            what = "model" if path == run.model(name) else "checkpoint"
            kept = f"the last {what} is {path}; show it with: {viewing_command(run, name)}"
    return f"{kept}; continue with: {resuming_command(run, devices)}{hint}"


def _write_file(run: RunFolder, record: RunRecord, max_bytes: int, scene: Scene, options: RunOptions) -> None:
    """Write the file of a file budget, unless it is there; warn if none is small enough."""
    model = run.model(record.plan.main[-1])
    path = model.with_suffix(SUFFIX)
    if path.is_file() and path.stat().st_size <= max_bytes and path.stat().st_mtime >= model.stat().st_mtime:
        return
    aim = CompressOptions(file_budget=record.file_budget, tune_iterations=ITERATIONS)
    try:
        line = compress(run.path, None, aim, scene=scene, progress=options.progress, on_note=options.on_note)
        options.on_note(line)
    except ValueError as error:
        another = file_command(run, "SIZE")
        warn(f"no file was written: {error}; to try another size: {another}")


# Training of the stages


def train_run(
    run: RunFolder, scene: Scene, options: RunOptions, *, is_stopped: Callable[[], bool] = lambda: False
) -> None:
    """Train every stage of the run's record that is not finished yet, from its newest checkpoint. When a stage ends,
    its history and its model are written, and its checkpoints deleted.

    Raises:
      ValueError: as `fit` does, or if a checkpoint or model is damaged, of another version, or made with other options
        than the record's.
    """
    record = read_record(run)
    plan = record.plan
    fit = functools.partial(
        fit_stage,
        scene,
        is_stopped=is_stopped,
        session=options.session,
        max_memory=options.max_memory,
    )
    to_train = [name for name in plan.names if not run.model(name).is_file()]
    num_tuning = 0 if record.file_bytes is None else ITERATIONS
    after = time_after(scene, plan, to_train, _num_given(run, record), num_tuning)
    for planned in plan.stages:
        name = planned.name
        path = run.model(name)
        if path.is_file():
            check_finished(path, planned)
        else:
            events = EventWriter(run, name) if options.tensorboard else None
            bar = Progress(ProgressBar if options.progress else None, name, after[name])
            fit_this = functools.partial(fit, progress=bar, checkpoint_every=planned.checkpoint_every)
            result = _train_stage(run, planned, scene, fit_this, events)
            if events is not None:
                events.add(result.history)
                events.close()
            write_history(run.own(run.history(name)), result.history)
            # After the history: a model says that its stage is finished.
            save_model(run.own(path), result.model, {"system": system_to_dict(planned.system)})
        # Also if the model was there: a process may have been killed between the two.
        if name in plan.kept_states:
            run.keep_state(name, planned.stage.iterations)
        run.drop_all_checkpoints(name)
    # Ends `follow_first_process`.
    send_stage(None)


def _train_stage(
    run: RunFolder,
    planned: PlannedStage,
    scene: Scene,
    fit: Callable[..., StageResult],
    events: EventWriter | None,
) -> StageResult:
    """Train a stage as `train_stage`; after a divergence, restore it if allowed."""

    def skip(checkpoint: Checkpoint) -> None:
        if events is not None:
            events.skip(checkpoint.history)

    record = read_record(run)

    def add(checkpoint: Checkpoint) -> None:
        if events is not None:
            events.add(checkpoint.history)
        # At once, so that a run that is killed repeats it.
        if checkpoint.shortened_at is not None and planned.name not in record.shortened_at:
            write_record(run, record.shortened_from(planned.name, checkpoint.shortened_at))

    num_restored = None
    while True:
        try:
            return train_stage(
                run,
                planned,
                scene,
                fit,
                num_restored=num_restored,
                shortened_at=record.shortened_at.get(planned.name),
                on_resume=skip,
                on_checkpoint=add,
            )
        except DivergedError as error:
            num_restored = _restored(run, planned.name, error, record.on_nan)


def _restored(run: RunFolder, name: str, error: DivergedError, on_nan: OnNan) -> int:
    """Keep the state before a divergence, and return the number of restorations with the next one. Raises ValueError if
    the stage may not be restored."""
    before = error.checkpoint
    path = run.own(run.diverged(name, before.iteration))
    save_checkpoint(path, before)
    text = f"{error}, in {path}"
    if on_nan == "stop":
        raise ValueError(f"{text}; `on_nan` restore continues with the views in another order") from error
    num_restored = before.num_restored + 1
    if num_restored > MOST_RESTORED:
        raise ValueError(f"{text}; the stage was restored {MOST_RESTORED} times already") from error
    checkpoints = run.checkpoints(name)
    back = f"iteration {iteration_of(checkpoints[-1])}" if checkpoints else "its beginning"
    times = f"({num_restored} of {MOST_RESTORED} times)"
    warn(f"{text}; the stage restarts from {back} with the views in another order {times}")
    return num_restored
