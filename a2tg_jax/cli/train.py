"""The commands that train: `a2tg demo` and `a2tg train`."""

import contextlib
import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro
from tyro.conf import Fixed, Positional, Suppress, UseAppendAction, arg

from a2tg_jax.adapt import Upscale
from a2tg_jax.cli.arguments import check_path, defaulting_to, flag_of, flag_with_value
from a2tg_jax.cli.process_flags import HEARTBEAT_TIMEOUT, place_of
from a2tg_jax.cli.view import in_browser
from a2tg_jax.data.lenses import LensUse
from a2tg_jax.data.masks import AlphaMeaning
from a2tg_jax.host.machine import tidy_memory
from a2tg_jax.host.text import counted, shortened
from a2tg_jax.io.config_json import flatten_config
from a2tg_jax.mcmc import Mcmc
from a2tg_jax.parallel.processes import ProcessPlace, Team, joined
from a2tg_jax.results.folder import RunFolder, open_run, opened, resuming_command
from a2tg_jax.results.forecast import bytes_allowed, room_for_photographs
from a2tg_jax.results.history import check_tensorboard
from a2tg_jax.results.record import (
    DEFAULT_SYSTEM,
    SYNTHETIC,
    OnNan,
    RunFile,
    RunRecord,
    SceneSource,
    changed_compared,
    changed_numbers,
    read_record,
    read_run_file,
    scene_place,
    write_record,
)
from a2tg_jax.results.report import RunResult, summary_text
from a2tg_jax.results.run_training import RunOptions, begin_run, resume_run, unseen
from a2tg_jax.results.several_processes import follow_first_process
from a2tg_jax.systems.a2tg import A2tg
from a2tg_jax.training import SYSTEMS, Session, System, find_system

BASELINE = "gaussians-2d-mcmc"
DEFAULT_PRESET = "paper"
DEMO_SYSTEM = A2tg(
    stage1_iterations=400,
    stage2_iterations=250,
    densify=Mcmc(cap=1_500),
    texture=Upscale(fraction=0.5, at=(0.1, 0.2)),
    texel_rate=1e-2,
)
"""System of the demo. It has few iterations, so textures grow early and learn fast."""


@dataclasses.dataclass(frozen=True)
class Demo:
    """Train the built-in synthetic scene with and without textures.

    Takes about a minute on two cores. Open runs/demo/report.html for the results.
    """

    out: Path = Path("runs/demo")
    """Run folder."""
    resume: bool = False
    """Continue from the newest checkpoint in the run folder."""
    overwrite: bool = False
    """Replace an earlier run in that folder; it is kept until the new one has its report."""
    quiet: bool = False
    """Show no progress of training; forecasts, warnings and results stay."""

    def run(self) -> None:
        options = RunOptions(overwrite=self.overwrite, session=tidy_session(), progress=not self.quiet)
        if self.resume:
            _check_resumed_only(self.overwrite)
            with opened(self.out) as run:
                tell_result(resume_run(run, options), self.out)
            return
        record = RunRecord(SceneSource(SYNTHETIC), DEFAULT_SYSTEM, DEMO_SYSTEM, (BASELINE,))
        tell_result(begin_run(record, self.out, options), self.out)


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a scene, evaluate the model and write a report.

    Examples:
      a2tg train scenes/fox --out runs/fox --preset quick --downscale 2
      a2tg train scenes/fox --out runs/fox --resume
      a2tg train scenes/fox --out runs/small --memory-budget 20MB --baseline
      a2tg train synthetic --out runs/three --preset smoke --compare textured-gaussians --compare bbsplat
      a2tg train --config runs/fox/run.toml --out runs/again

    Checkpoints are written after every tenth of a stage, at least every 500 iterations, and on Ctrl-C or SIGTERM. The
    newest two are kept until the stage is finished.
    """

    scene: Annotated[Positional[str], arg(metavar="SCENE")]
    """Scene folder with photographs and cameras, its URL such as s3://bucket/scene, or "synthetic"; not needed with
    --config or --resume."""
    out: Path
    """Run folder for models, checkpoints, metrics, pictures and report.html."""
    config: Annotated[Path | None, arg(metavar="FILE")] = None
    """Configuration file (TOML), such as run.toml of another run. Flags take precedence over it."""
    system: Annotated[str, arg(metavar="NAME")] = DEFAULT_SYSTEM
    """System to train: a name listed by a2tg --help, or your own as package.module:NAME. Its options follow below."""
    preset: Annotated[str | None, defaulting_to(DEFAULT_PRESET, "NAME")] = None
    """Preset of the options below: paper, quick (minutes on two cores) or smoke (half a minute); a2tg also has official
    (the conventions of the authors' program), gaussians-2d also has surfaces (for a2tg mesh)."""
    downscale: int = 1
    """Factor k by which images are downscaled."""
    test_every: int = 8
    """Hold out every k-th image for testing."""
    alpha: AlphaMeaning = "transparency"
    """Meaning of the alpha channel: transparency before a background, or a mask that leaves pixels out."""
    lens: LensUse = "undistort"
    """Photographs of distorted cameras, such as fisheyes: undistort them to pinholes, or keep them as they are."""
    validation: bool = False
    """Hold out every eighth training image in place of the test images, to choose options without seeing these."""
    compare: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = ()
    """System to train for comparison; may be repeated. It takes every option above and below that it has."""
    baseline: bool = False
    """Compare with gaussians-2d-mcmc, the same iterations without textures."""
    on_nan: OnNan = "stop"
    """Action if training diverges (a loss or gradient is not finite, or the loss explodes): stop, or restore the newest
    checkpoint and continue with the views in another order."""
    init: Annotated[Path | None, arg(metavar="FILE")] = None
    """File of splats (PLY, SPZ, SOG, a checkpoint of gsplat, ...) in place of the first stage, in the world of the
    scene folder."""
    resume: bool = False
    """Continue from the newest checkpoint in the run folder."""
    overwrite: bool = False
    """Replace an earlier run in that folder; it is kept until the new one has its report."""
    lpips_weights: Annotated[Path | None, arg(metavar="FILE")] = None
    """Weights file (.npz) for LPIPS with AlexNet or SqueezeNet. Without it, LPIPS is not computed."""
    quiet: bool = False
    """Show no progress of training; forecasts, warnings and results stay."""
    tensorboard: bool = False
    """Write the histories as files of TensorBoard too, into RUN/tensorboard, at each checkpoint."""
    view: bool = False
    """Show the training in a browser, where you can pause it."""
    max_memory: Annotated[str | None, defaulting_to("all available", "SIZE")] = None
    """Memory limit of the process and of the GPU, such as 8GB or 800MB. Training refuses to start if it needs more.
    Photographs beyond a quarter of it stay on disk. --memory-budget bounds the model."""
    devices: Annotated[str, arg(metavar="N")] = "1"
    """Number of GPUs of each process that train the scene together, each with a share of its Gaussians; or all."""
    coordinator: Annotated[str | None, defaulting_to("one process", "HOST:PORT")] = None
    """Address of the first of several processes that train the scene together, or auto under Slurm, Open MPI or
    Kubernetes. Start the same command in each of them."""
    num_processes: Annotated[int | None, defaulting_to("that of the cluster", "N")] = None
    """Number of processes, with --coordinator HOST:PORT."""
    process_id: Annotated[int | None, defaulting_to("that of the cluster", "I")] = None
    """Number of this process, from 0, with --coordinator HOST:PORT. The first one, 0, writes the run folder."""
    heartbeat_timeout_seconds: Annotated[float | None, defaulting_to(f"{HEARTBEAT_TIMEOUT:g}", "SECONDS")] = None
    """Time after which a process that is silent counts as lost and the others stop, with --coordinator."""
    compare_options: Annotated[Mapping[str, Any], Fixed, Suppress] = dataclasses.field(default_factory=dict)
    """Options of the compared systems in the configuration file (`RunRecord.compare_options`)."""
    options: Annotated[System, arg(name="")] = dataclasses.field(default_factory=A2tg)

    def run(self) -> None:
        with joined(self.place) as team:
            if team is None or team.is_first:
                self._run()
            else:
                self._follow(team)

    @property
    def place(self) -> ProcessPlace | None:
        """Place of this process among those that train together; None if it is the only one.

        Raises:
          ValueError: if flags of several processes are missing, or exclude each other.
        """
        if self.coordinator is not None and self.view:
            raise ValueError("--view shows the training of one process: leave out --view or --coordinator")
        return place_of(self.coordinator, self.num_processes, self.process_id, self.heartbeat_timeout_seconds)

    def _follow(self, team: Team) -> None:
        """Train what the first process says, and be quiet."""
        run, session = RunFolder(self.out), tidy_session(devices_named(self.devices))
        team.advice = lambda: f"continue with: {resuming_command(run, session.devices)}"
        record = self._resumed(open_run(self.out), is_written=False) if self.resume else self.record
        scene = record.scene.load(room_for_photographs(bytes_allowed(self.max_memory)), is_divided=True)
        follow_first_process(record, scene, session)

    def _run(self) -> None:
        if self.tensorboard:
            check_tensorboard()
        options = RunOptions(
            overwrite=self.overwrite,
            lpips_weights=self.lpips_weights,
            max_memory=bytes_allowed(self.max_memory),
            tensorboard=self.tensorboard,
            progress=not self.quiet,
            watched=in_browser if self.view else unseen,
            session=tidy_session(devices_named(self.devices)),
        )
        if not self.resume:
            tell_result(begin_run(self.record, self.out, options), self.out)
            return
        _check_resumed_only(self.overwrite)
        with opened(self.out) as run:
            self._resumed(run)
            tell_result(resume_run(run, options), self.out)

    @property
    def record(self) -> RunRecord:
        """Record of the run that the flags ask for."""
        path = self.scene if self.scene == SYNTHETIC else scene_place(self.scene)
        compare = (*self.compare, BASELINE) if self.baseline else self.compare
        source = SceneSource(path, self.downscale, self.test_every, self.alpha, self.lens, self.validation)
        init = None if self.init is None else str(self.init.resolve())
        compare = tuple(dict.fromkeys(compare))
        main = source, self.system, self.options
        return RunRecord(*main, compare, self.preset, self.on_nan, init, self.compare_options)

    def _resumed(self, run: RunFolder, *, is_written: bool = True) -> RunRecord:
        """Return the record of an existing run, with further comparisons, or raise if a flag contradicts it.

        Unless it is written, this process follows another one, on whose machine the scene may have another path.
        """
        kept, asked = read_record(run), self.record
        if not is_written:
            kept = dataclasses.replace(kept, scene=dataclasses.replace(kept.scene, path=asked.scene.path))
        if asked.scene.path != kept.scene.path:
            raise ValueError(f"{run.path} was trained on {kept.scene.path}, not on {asked.scene.path}")
        changed = changed_numbers(asked, kept)
        if changed:
            raise ValueError(f"--resume takes every option from {run.record}; {self._told_changes(run, changed)}")
        beside = ", ".join(changed_compared(asked, kept))
        if beside:
            told = f"leave out --config {self.config}, which differs in {beside}"
            raise ValueError(f"--resume takes every option from {run.record}; {told}")
        compare = tuple(dict.fromkeys((*kept.compare, *asked.compare)))
        options = {**asked.compare_options, **kept.compare_options}
        record = dataclasses.replace(kept, compare=compare, on_nan=self.on_nan, compare_options=options)
        record.check()
        if record != kept and is_written:
            write_record(run, record)
        return record

    def _told_changes(self, run: RunFolder, changed: list[str]) -> str:
        """Return how to go on if these options differ from those of the run that is resumed."""
        names = ["system"] if "system" in changed else changed
        told, leaves = ", ".join(map(flag_of, names)), self.record.leaves()
        if self.config is not None:
            return f"leave out --config {self.config}, which differs in {told}"
        flags = " ".join(flag_with_value(name, leaves[name]) for name in names)
        return f"leave out {told}, or start a new run: a2tg train --config {run.record} {flags} --out …"


def train_defaults(arguments: list[str]) -> Train:
    """Fill unset options from the configuration file, or from run.toml when a run is resumed."""
    path = _value_of("--config", arguments)
    system, preset = _value_of("--system", arguments), _value_of("--preset", arguments)
    out = _value_of("--out", arguments)
    check_path(path)
    check_path(out)
    if out and "--resume" in arguments and "--overwrite" not in arguments:
        # Several processes read the folder at a time; the first one claims it later.
        is_alone = not _value_of("--coordinator", arguments)
        with opened(Path(out)) if is_alone else contextlib.nullcontext(open_run(Path(out))) as run:
            read_record(run)  # A run that another version refuses is named as such, before its options are read.
            path = path or str(run.record)
            preset = _checked_preset(run, preset)
    file = read_run_file(Path(path)) if path else RunFile()
    if preset or (system and system != file.system):
        # The numbers of the file are those of another preset or system.
        file = dataclasses.replace(
            file, system=system or file.system, preset=preset or None, version=None, options={}, compare_options={}
        )
    options = file.chosen(path)
    return Train(
        scene=tyro.MISSING if file.scene is None else file.scene,
        out=tyro.MISSING,
        system=file.system,
        preset=file.preset,
        downscale=file.downscale,
        test_every=file.test_every,
        alpha=file.alpha,
        lens=file.lens,
        validation=file.validation,
        compare=file.compare,
        on_nan=file.on_nan,
        init=None if file.init is None else Path(file.init),
        compare_options=file.compared(options, path),
        options=options,
    )


def other_systems_text(flag: str, system: str) -> str:
    """Return which systems have an option that one lacks; empty if none has it."""
    having = [name for name in SYSTEMS if flag in map(flag_of, flatten_config(find_system(name)))]
    return (
        f"; {system} has no such option, but {', '.join(having)} {'have' if len(having) > 1 else 'has'}"
        if having
        else ""
    )


def _checked_preset(run: RunFolder, preset: str) -> str:
    """Return an empty preset, which leaves the options of a resumed run as they are.

    Raises:
      ValueError: if another preset than the run's is asked for.
    """
    kept = read_run_file(run.record).preset or DEFAULT_PRESET
    if preset and preset != kept:
        raise ValueError(f"a resumed run keeps its preset, {kept}: leave out --preset {shortened(preset)}")
    return ""


def _value_of(flag: str, arguments: list[str]) -> str:
    """Return the value of `flag`, given as "--flag value" or "--flag=value", or an empty string."""
    for word, following in itertools.pairwise([*arguments, ""]):
        if word == flag:
            return following
        if word.startswith(flag + "="):
            return word.split("=", 1)[1]
    return ""


def _check_resumed_only(overwrite: bool) -> None:
    """Raise ValueError if a run that is resumed is to be replaced as well."""
    if overwrite:
        raise ValueError("--resume continues a run and --overwrite replaces it: give one of them")


def tidy_session(devices: Sequence[jax.Device] | None = None) -> Session:
    """Return a session that tidies this process's memory after each compilation."""
    return Session(after_compiling=tidy_memory, devices=devices)


def devices_named(text: str) -> list[jax.Device] | None:
    """Return the first N devices of each process, or all; None for one device of one process.

    Raises:
      ValueError: if the text is neither "all" nor a number from 1 to that of the devices.
    """
    devices: list[jax.Device] = jax.local_devices()
    if text == "all":
        text = str(len(devices))
    if not text.isdecimal() or not 1 <= int(text) <= len(devices):
        found = f"this machine has {counted(len(devices), f'{devices[0].platform.upper()} device')}"
        raise ValueError(f"--devices must be all, or a number from 1 to {len(devices)}; got {text!r}: {found}")
    by_process = [jax.local_devices(process_index=index) for index in range(jax.process_count())]
    chosen = [device for own in by_process for device in own[: int(text)]]
    return chosen if len(chosen) > 1 else None


def tell_result(result: RunResult, folder: Path) -> None:
    """Print the metrics and the path of the report."""
    print(summary_text(result))
    print(f"report: {RunFolder(folder).report}")
