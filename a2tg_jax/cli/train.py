"""Arguments of `a2tg train`, whose options are the ones of its system."""

import contextlib
import dataclasses
import math
import re
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Fixed, Positional, Suppress, UseAppendAction, arg

from a2tg_jax.base.config_json import flatten_config
from a2tg_jax.base.text import budget_in_bytes
from a2tg_jax.cli.arguments import FLAGS, SCENE_IS_MISSING, DecidingOptions, LpipsWeights, defaulting_to, print_now
from a2tg_jax.cli.processes import AUTO, ProcessPlace, joined
from a2tg_jax.data.load import SceneSource
from a2tg_jax.results.commands import file_command, resuming_command
from a2tg_jax.results.folder import RunFolder, open_run, opened
from a2tg_jax.results.record import (
    RunRecord,
    contradictions,
    is_finished,
    read_record,
    read_run_file,
    write_record,
)

FLAGS[SceneSource] = {"path": (Positional, arg(metavar="SCENE", help_behavior_hint="(required)"))}
FLAGS[RunRecord] = {
    "scene": (arg(name=""),),
    "system": (arg(metavar="NAME"),),
    "options": (arg(name=""),),
    "compare": (UseAppendAction, arg(metavar="NAME")),
    "preset": (arg(metavar="NAME", help_behavior_hint="(default: paper)"),),
    "init": (arg(metavar="FILE"),),
    "file_budget": (arg(metavar="SIZE"),),
    "compare_options": (Fixed, Suppress),
    "shortened_at": (Fixed, Suppress),
}
BASELINE = "gaussians-2d-mcmc"
HEARTBEAT_TIMEOUT = 60.0
"""Default of --heartbeat-timeout-seconds."""
ADDRESS = re.compile(r"(\[[0-9A-Fa-f:.]+(%[\w.-]+)?\]|[^:\[\]]+):\d+")
"""HOST:PORT, with IPv6 addresses in brackets."""
IMPORTANT = ("stage1_iterations", "stage2_iterations", "densify.cap", "sh_degree")
"""Options whose defaults the short help shows."""


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a scene, evaluate the model and write a report."""

    record: Annotated[RunRecord, arg(name="")]
    out: Path
    """Run folder for models, checkpoints, metrics, pictures and report.html."""
    config: Annotated[Path | None, arg(metavar="FILE")] = None
    """Configuration file (TOML), such as run.toml of another run. Flags take precedence over it."""
    baseline: bool = False
    """Compare with plain Gaussians, gaussians-2d-mcmc. With --memory-budget both get the same bytes."""
    resume: bool = False
    """Continue from the newest checkpoint in the run folder."""
    finish_now: bool = False
    """With --resume, finish soon: what is left of each stage is done in a tenth of the steps, at least 100. Schedules
    reach their end, so that budgets are kept."""
    overwrite: bool = False
    """Replace an earlier run in that folder; it is kept until the new one has its report."""
    lpips_weights: LpipsWeights = None
    yes: bool = False
    """Train even if the photographs or the memory budget are so small that little can be seen, or the budget has room
    for more Gaussians than the photographs have pixels. Without it you are asked."""
    quiet: bool = False
    """Hide the progress of training, but not forecasts, warnings and results."""
    tensorboard: bool = False
    """Also write the histories as TensorBoard files, into RUN/tensorboard, at each checkpoint."""
    view: bool = False
    """Show the training in a browser, where you can pause it."""
    max_memory: Annotated[str | None, defaulting_to("all available", "SIZE")] = None
    """Memory limit of the process and of the GPU, such as 8GB or 800MB. A stage is not trained if it needs more.
    Photographs beyond a quarter of it stay on disk. For a limit on the model, use --memory-budget."""
    devices: Annotated[str, arg(metavar="N")] = "1"
    """Number of GPUs per process that train the scene together, or all. Each draws whole views: without --batch-size,
    a step takes one view for each of them."""
    coordinator: Annotated[str | None, defaulting_to("one process", "HOST:PORT")] = None
    """Address of the first of several processes that train the scene together, or auto under Slurm, Open MPI or
    Kubernetes. Start the same command for each process."""
    num_processes: Annotated[int | None, defaulting_to("as the cluster says", "N")] = None
    """Number of processes, with --coordinator HOST:PORT."""
    process_id: Annotated[int | None, defaulting_to("as the cluster says", "I")] = None
    """Number of this process, from 0, with --coordinator HOST:PORT. Process 0 writes the run folder."""
    heartbeat_timeout_seconds: Annotated[float | None, defaulting_to(f"{HEARTBEAT_TIMEOUT:g}", "SECONDS")] = None
    """Time without a sign of life after which a process counts as lost and the others stop, with --coordinator."""

    def run(self) -> None:
        import jax

        from a2tg_jax import Session
        from a2tg_jax.base.memory import tidy_memory
        from a2tg_jax.cli import training
        from a2tg_jax.results.forecast import room_for_photographs
        from a2tg_jax.results.history import tensorboard_library
        from a2tg_jax.results.run_processes import check_batch_sizes, follow_first_process
        from a2tg_jax.results.run_training import RunOptions, begin_run, unseen, warn_of_doubts

        if self.finish_now and not self.resume:
            raise ValueError("--finish-now shortens a training that was stopped: add --resume")
        if not self.record.scene.path:
            raise ValueError(SCENE_IS_MISSING)
        # Processes must join before anything starts the devices of JAX.
        with joined(self.place, lambda: f"continue with: {resuming_command(RunFolder(self.out))}"):
            session = Session(after_compiling=tidy_memory, devices=training.devices_named(self.devices))
            session.is_shortened = self.finish_now
            most = budget_in_bytes(self.max_memory, "max_memory")
            record = self.whole_record
            if not self.resume:
                record = training.with_view_for_each(record, session.num_devices)
            check_batch_sizes(record, session)
            if jax.process_index() > 0:  # It trains with the first process and prints nothing.
                record = self.resumed(open_run(self.out), is_first=False) if self.resume else record
                follow_first_process(record, record.scene.load(room_for_photographs(most)), session)
                return
            if self.tensorboard:
                tensorboard_library()  # Raises before training if it is not installed.
            options = RunOptions(
                overwrite=self.overwrite,
                lpips_weights=self.lpips_weights,
                max_memory=most,
                tensorboard=self.tensorboard,
                progress=not self.quiet,
                watched=training.in_browser if self.view else unseen,
                on_note=print_now,
                confirm=warn_of_doubts if self.yes else training.ask,
                session=session,
            )
            if self.resume:
                training.resume(self.out, options, self.resumed)
            else:
                if record.options.batch_size != self.record.options.batch_size:
                    print(f"{session.num_devices} devices: {record.options.batch_size} views a step (--batch-size)")
                training.print_result(begin_run(record, self.out, options), self.out)

    @property
    def place(self) -> ProcessPlace | None:
        """Place of this process among several that train together; None if it is the only one.

        Raises:
          ValueError: if flags of several processes are missing or wrong, or exclude each other.
        """
        number = self.num_processes
        index = self.process_id
        seconds = self.heartbeat_timeout_seconds
        values = {"--num-processes": number, "--process-id": index}
        if self.coordinator is None:
            for flag, value in {**values, "--heartbeat-timeout-seconds": seconds}.items():
                if value is not None:
                    raise ValueError(f"{flag} needs --coordinator HOST:PORT, the address of the first process")
            return None
        if self.view:
            raise ValueError("--view shows the training of one process: leave out --view or --coordinator")
        if seconds is None:
            seconds = HEARTBEAT_TIMEOUT
        if not 0 < seconds < math.inf:
            raise ValueError(f"--heartbeat-timeout-seconds must be positive and finite; got {seconds:g}")
        if self.coordinator != AUTO:
            missing = [flag for flag, value in values.items() if value is None]
            if missing:
                raise ValueError(f"--coordinator HOST:PORT also needs {' and '.join(missing)}")
            if not ADDRESS.fullmatch(self.coordinator):
                raise ValueError(f"--coordinator must be HOST:PORT, [IPv6]:PORT or auto; got {self.coordinator!r}")
        if number is not None and number < 1:
            raise ValueError(f"--num-processes must be at least 1; got {number}")
        if index is not None and index < 0:
            raise ValueError(f"--process-id must be at least 0; got {index}")
        if number is not None and index is not None and index >= number:
            raise ValueError(f"--process-id must be from 0 to {number - 1}, one less than --num-processes; got {index}")
        return ProcessPlace(self.coordinator, number, index, seconds)

    @property
    def whole_record(self) -> RunRecord:
        """Record with full paths, the memory budget, and the baseline."""
        compare = (*self.record.compare, BASELINE) if self.baseline else self.record.compare
        # A dict keeps the order and drops repetitions, such as of --baseline by --compare.
        return dataclasses.replace(self.record.placed().budgeted(), compare=tuple(dict.fromkeys(compare)))

    def resumed(self, run: RunFolder, *, is_first: bool = True) -> RunRecord:
        """Return the record of a run to resume, with further comparisons, which the first of several processes writes.

        The scene may have another path on the machines of the other processes.

        Raises:
          ValueError: if a flag contradicts the record.
        """
        kept = read_record(run)
        size = self.record.file_budget
        if size != kept.file_budget:
            another = file_command(run, f"{size}MB" if size else "SIZE")
            raise ValueError(f"--file-budget is for new runs; for another file of a finished one: {another}")
        more = self.record.options.more
        record = self.whole_record.with_options(more=kept.options.more)
        changed = [f"--{name.replace('_', '-')}" for name in contradictions(record, kept)]
        if is_first and record.scene.path != kept.scene.path:
            changed.insert(0, f"{record.scene.path}, as it was trained on {kept.scene.path}")
        if changed:
            raise ValueError(
                f"--resume takes every option from {run.record}: leave out {', '.join(changed)}, or start a new run "
                f"with a2tg train --config {run.record}, these options and another --out"
            )
        if more and not is_finished(run, kept):
            raise ValueError(f"--more trains a finished run on: first finish this one with {resuming_command(run)}")
        if more and self.coordinator is not None:
            raise ValueError("--more with --resume is for one process: leave out --coordinator")
        record = record.with_options(more=(*kept.options.more, *more))
        record.check()
        if is_first and record != kept:
            write_record(run, record)
        return record


def train_defaults(given: DecidingOptions) -> Train:
    """Return the command with the options of the configuration file, or of run.toml when a run is resumed.

    Raises:
      ValueError, FileNotFoundError: if there is no such system, preset, file or run, or it is invalid.
    """
    record = RunRecord(SceneSource())
    if given.takes_run:
        out = Path(given.out)
        # Several processes read the folder at once; the first one locks it later.
        with contextlib.nullcontext(open_run(out)) if given.coordinator else opened(out) as run:
            # Further iterations that are given are added, so that the same number may be given twice.
            record = read_record(run).with_options(more=())
    elif given.config:
        record = read_run_file(Path(given.config))
    # A resumed run keeps its system and preset; `resumed` reports other ones.
    if not given.resume and (given.preset or given.system not in ("", record.system)):
        record = record.with_system(given.system or record.system, given.preset or None)
    return Train(record, tyro.MISSING)  # tyro requires what is MISSING.


def defaults_line(given: DecidingOptions) -> str:
    """Return the most important defaults of the given system and preset."""
    record = train_defaults(given).record
    options = flatten_config(record.options)
    flags = [f"--{name.replace('_', '-')} {options[name]}" for name in IMPORTANT if name in options]
    return f"Defaults of {record.system} with the preset {record.preset or 'paper'}: {' '.join(flags)}"
