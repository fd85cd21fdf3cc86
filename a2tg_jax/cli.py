"""The command line `a2tg`: demo, train, eval, render, view, export, compress, info, sfm."""

import dataclasses
import inspect
import itertools
import os
import shlex
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional, UseAppendAction, arg

from a2tg_jax import signals
from a2tg_jax.arguments import parse
from a2tg_jax.cli_view import Export, View, in_browser
from a2tg_jax.data import run_sfm
from a2tg_jax.data.mask_files import AlphaMeaning
from a2tg_jax.results.checks import check_apart, check_weights
from a2tg_jax.results.claim import opened
from a2tg_jax.results.compress import compress, compression_text
from a2tg_jax.results.folder import RunFolder, open_run
from a2tg_jax.results.forecast import bytes_allowed, room_for_photographs, tell_forecast
from a2tg_jax.results.frames import Route, render_frames, write_video
from a2tg_jax.results.info import describe_run
from a2tg_jax.results.record import (
    DEFAULT_SYSTEM,
    SYNTHETIC,
    OnNan,
    RunFile,
    RunRecord,
    SceneSource,
    changed_numbers,
    read_record,
    read_run_file,
    write_record,
)
from a2tg_jax.results.summary import RunResult, summary_text
from a2tg_jax.results.whole_run import begin_run, go_on, measure, unseen
from a2tg_jax.startup import configure_cpu
from a2tg_jax.systems.a2tg import A2tg, TextureConfig
from a2tg_jax.systems.stage1 import McmcConfig
from a2tg_jax.training import SYSTEMS, System

BASELINE = "gaussians-2d-mcmc"
BROKEN_PIPE = 128 + 13
DEMO_SYSTEM = A2tg(
    stage1_iterations=400,
    stage2_iterations=250,
    densify=McmcConfig(cap=1_500),
    texture=TextureConfig(fraction=0.5, upscale_at=(0.1, 0.2), rate=1e-2),
)
"""Few iterations, so textures grow early and learn fast."""

OVERVIEW = f"""usage: a2tg COMMAND [OPTIONS]

Adaptive anisotropic textured 2D Gaussian splatting: from photographs to a textured scene.

  a2tg demo                            a whole run on a built-in scene, about a minute on two cores
  a2tg sfm photos/ scene/              camera poses for plain photographs, by COLMAP
  a2tg train scene/ --out runs/scene   train a scene, evaluate, write a report
  a2tg eval runs/scene                 measure a run again
  a2tg render runs/scene               frames and a video of a flight, or the test views
  a2tg view runs/scene                 look at it in a browser; also *.npz, *.a2tgz and *.ply
  a2tg export runs/scene --web out/    the same for a web server, or as one HTML file
  a2tg compress runs/scene             a small file of the model that it left
  a2tg info runs/scene                 what a run folder holds

a2tg COMMAND --help explains a command, a2tg train --system NAME --help the options of a system; a2tg --version tells
the version. The systems: {", ".join(SYSTEMS)}.
With A2TG_DEBUG=1 in the environment an error shows its traceback."""


@dataclasses.dataclass(frozen=True)
class Demo:
    """Train the built-in synthetic scene with textures and, for comparison, without.

    Takes about a minute on two cores and writes a report with pictures: open runs/demo/report.html.
    """

    out: Path = Path("runs/demo")
    """Run folder."""
    overwrite: bool = False
    """Replace an earlier run in that folder; it is kept until the new one has its report."""

    def run(self) -> None:
        record = RunRecord(SceneSource(SYNTHETIC), DEFAULT_SYSTEM, DEMO_SYSTEM, (BASELINE,))
        _tell(begin_run(record, self.out, overwrite=self.overwrite), self.out)


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a scene with a system, evaluate it and write a report.

    Examples:
      a2tg train scenes/fox --out runs/fox --preset quick --downscale 2
      a2tg train scenes/fox --out runs/fox --resume
      a2tg train scenes/fox --out runs/small --memory-budget 20MB --baseline
      a2tg train synthetic --out runs/three --preset smoke --compare textured-gaussians --compare bbsplat
      a2tg train --config runs/fox/run.toml --out runs/again

    A checkpoint is written every tenth of a stage, at least every 500 iterations, and when the program is stopped by
    Ctrl-C or SIGTERM; the newest two are kept until the stage is finished.
    """

    scene: Annotated[Positional[str], arg(metavar="SCENE")]
    """Scene folder (COLMAP, transforms.json or Blender), or "synthetic"; --config and --resume know it already."""
    out: Path
    """Run folder: models, checkpoints, metrics, pictures and report.html go there."""
    config: Path | None = None
    """A TOML file that says any of this, such as the run.toml of a run; flags have precedence."""
    system: str = DEFAULT_SYSTEM
    """One of those that a2tg --help lists, or your own as package.module:NAME; its options stand below."""
    preset: str | None = None
    """Where the numbers below start from: paper (the defaults), quick (minutes on two cores), smoke (half a minute)."""
    downscale: int = 1
    """Use the images at 1/k of their size."""
    test_every: int = 8
    """Every k-th image is kept for testing."""
    alpha: AlphaMeaning = "transparency"
    """What the alpha channel of images is: the transparency of what they show, or a mask, which leaves pixels out."""
    compare: UseAppendAction[tuple[str, ...]] = ()
    """Also train this system, to compare with: with the options above and below, where it has any of that name."""
    baseline: bool = False
    """Short for --compare gaussians-2d-mcmc: the same iterations without textures."""
    on_nan: OnNan = "stop"
    """Where a loss or gradient is not finite, or a loss explodes: stop, or restore the newest checkpoint and go on with
    the views in another order."""
    resume: bool = False
    """Go on from the newest checkpoint in the run folder."""
    overwrite: bool = False
    """Replace an earlier run in that folder; it is kept until the new one has its report."""
    lpips_weights: Path | None = None
    """Weights of LPIPS with AlexNet or SqueezeNet (.npz); without it LPIPS is left out."""
    view: bool = False
    """Show the training in a browser as it runs, where it can be paused."""
    max_memory: str | None = None
    """Refuse what would take more memory, of the process or of the GPU, than 8GB, 800MB, … (default: all that there
    is); of the photographs, those beyond a quarter of it stay on disk. --memory-budget bounds the model instead."""
    options: Annotated[System, arg(name="")] = dataclasses.field(default_factory=A2tg)

    def run(self) -> None:
        weights, most = self.lpips_weights, bytes_allowed(self.max_memory)
        watched = in_browser if self.view else unseen
        if not self.resume:
            result = begin_run(
                self.record, self.out, overwrite=self.overwrite, lpips_weights=weights, max_memory=most, watched=watched
            )
            _tell(result, self.out)
            return
        if self.overwrite:
            raise ValueError("--resume goes on with a run and --overwrite replaces it: give one of them")
        check_weights(weights)
        with opened(self.out) as run:
            record = self._resumed(run)
            scene = record.scene.load(room_for_photographs(most))
            tell_forecast(scene, record.plan, most)
            _tell(go_on(run, scene, lpips_weights=weights, watched=watched), self.out)

    @property
    def record(self) -> RunRecord:
        """The run that the flags ask for."""
        path = self.scene if self.scene == SYNTHETIC else str(Path(self.scene).resolve())
        compare = (*self.compare, BASELINE) if self.baseline else self.compare
        source = SceneSource(path, self.downscale, self.test_every, self.alpha)
        return RunRecord(source, self.system, self.options, tuple(dict.fromkeys(compare)), self.preset, self.on_nan)

    def _resumed(self, run: RunFolder) -> RunRecord:
        """The record of an existing run, after a check that no flag contradicts it; with what is compared besides."""
        kept, asked = read_record(run), self.record
        if asked.scene.path != kept.scene.path:
            raise ValueError(f"{run.path} was trained on {kept.scene.path}, not on {asked.scene.path}")
        changed = changed_numbers(asked, kept)
        if changed:
            flags = ", ".join("--" + name.replace("_", "-") for name in changed)
            advice = f"leave out {flags}" if self.preset is None else f"leave out --preset, which differs in {flags}"
            raise ValueError(f"--resume takes every number from {run.record}; {advice}")
        compare = tuple(dict.fromkeys((*kept.compare, *asked.compare)))
        record = dataclasses.replace(kept, compare=compare, on_nan=self.on_nan)
        record.check()
        if record != kept:
            write_record(run, record)
        return record


@dataclasses.dataclass(frozen=True)
class Eval:
    """Measure the finished stages of a run again and rewrite metrics, pictures and report.

    Example:
      a2tg eval runs/fox --lpips-weights lpips_alex.npz
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """Run folder."""
    lpips_weights: Path | None = None
    """Weights of LPIPS with AlexNet or SqueezeNet (.npz); without it, what stands in metrics.json of the same models is
    kept."""

    def run(self) -> None:
        check_weights(self.lpips_weights)
        with opened(self.folder) as run:
            _tell(measure(run, lpips_weights=self.lpips_weights), self.folder)


@dataclasses.dataclass(frozen=True)
class Render:
    """Render frames of a finished run: PNG files and, of a flight and where ffmpeg is installed, a video.

    The photographs are not needed.

    Examples:
      a2tg render runs/fox --frames 240
      a2tg render runs/fox --path test --out fox-test
      a2tg render runs/fox --path path.json --out fox-flight
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """Run folder."""
    path: Route | Path = "smooth"
    """A smooth flight past the cameras, the test views, or a flight through the views that a2tg view saved (*.json)."""
    frames: int = 120
    """Length of the flight in frames, 30 a second."""
    out: Path | None = None
    """Folder for the frames (default: RUN/frames)."""
    model: str | None = None
    """Which model is drawn, by the name that a2tg info tells (default: the last of the run's main system)."""

    def run(self) -> None:
        run = open_run(self.folder)
        out = self.out or run.path / "frames"
        paths = render_frames(run, out, route=self.path, num_frames=self.frames, name=self.model)
        print(f"{len(paths)} frames in {out}")
        if self.path != "test":
            video = out / "flight.mp4"
            made = write_video(out, video)
            print(f"video: {video}" if made else "no video: ffmpeg is not installed")


@dataclasses.dataclass(frozen=True)
class Compress:
    """Write the smallest file of a model whose PSNR on the training views is about that of the model.

    A table tells what each choice of bits costs. Where the photographs are not there, losses are those of a model of
    30 dB, as its renders tell them.

    Examples:
      a2tg compress runs/fox
      a2tg compress scene.npz --out scene.a2tgz --max-loss 0.02
    """

    source: Annotated[Positional[Path], arg(metavar="RUN_OR_MODEL")]
    """Run folder, whose last model is taken, or a model, *.npz."""
    out: Path | None = None
    """The file (default: beside the model, NAME.a2tgz)."""
    max_loss: float = 0.05
    """How many dB of PSNR may be lost."""

    def run(self) -> None:
        result = compress(self.source, self.out, max_loss=self.max_loss)
        print(compression_text(result))
        print(f"file: {result.path}")


@dataclasses.dataclass(frozen=True)
class Info:
    """Print what a run folder holds: scene, progress of each stage, models, metrics."""

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """Run folder."""

    def run(self) -> None:
        print(describe_run(open_run(self.folder)))


@dataclasses.dataclass(frozen=True)
class Sfm:
    """Find camera poses and points for plain photographs with COLMAP's features, matching and mapping.

    Example:
      a2tg sfm photos/fox scenes/fox && a2tg train scenes/fox --out runs/fox
    """

    photos: Positional[Path]
    """Folder of photographs of one scene."""
    out: Positional[Path]
    """Scene folder to make: images and sparse model, ready for a2tg train."""

    def run(self) -> None:
        check_apart(self.out, self.photos)
        found = run_sfm(self.photos, self.out)
        print(f"{found.num_registered} of {found.num_photos} photographs registered, {found.num_points:,} points")
        print(f"scene: {self.out}; go on with: a2tg train {shlex.quote(str(self.out))} --out runs/{self.out.name}")


Command = Demo | Train | Eval | Render | View | Export | Compress | Info | Sfm
COMMANDS: dict[str, type] = {
    "demo": Demo, "train": Train, "eval": Eval, "render": Render, "view": View, "export": Export,
    "compress": Compress, "info": Info, "sfm": Sfm,
}  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
      argv: arguments without the program's name; None: those of the process.

    Returns:
      The exit code: 0, 2 after a user's error (one line on stderr), 130 after Ctrl-C, 143 after SIGTERM, 129 after
      SIGHUP, 141 where nobody reads what is printed.
    """
    name, *arguments = (sys.argv[1:] if argv is None else list(argv)) or ["--help"]
    if name in ("-h", "--help", "--version"):
        print(version("a2tg-jax") if name == "--version" else OVERVIEW)
        return 0
    if name not in COMMANDS:
        return _fail(f"there is no command {name!r}; the commands are {', '.join(COMMANDS)}")
    try:
        configure_cpu()
    except ValueError as error:
        return _fail(str(error))
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # Where the modules of one's own systems are.
    try:
        with warnings.catch_warnings(), signals.raised():
            warnings.showwarning = _show_warning
            _parse(name, arguments).run()
            sys.stdout.flush()
    except KeyboardInterrupt as stop:
        stopped = stop if isinstance(stop, signals.Stopped) else signals.Stopped(signals.CTRL_C)
        print(f"a2tg: interrupted{stopped.advice and '; ' + stopped.advice}", file=sys.stderr)
        return stopped.exit_code
    except BrokenPipeError:
        # What is left in the buffer is not to be tried again when the process ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except (ValueError, OSError) as error:
        if os.environ.get("A2TG_DEBUG"):
            raise
        return _fail(str(error))
    return 0


def _fail(message: str) -> int:
    """Prints an error as one line and returns its exit code."""
    print(f"a2tg: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _parse(name: str, arguments: list[str]) -> Command:
    """The command that the arguments ask for. System, preset and file are looked at first: they decide the defaults.

    Raises:
      ValueError, FileNotFoundError: if there is no such system, preset or file, or the file or an argument is wrong.
    """
    kind = COMMANDS[name]
    options: dict[str, Any] = {"description": inspect.getdoc(kind)}
    if kind is Train:
        options["default"] = _train_defaults(arguments)
    return parse(kind, f"a2tg {name}", arguments, **options)


def _train_defaults(arguments: list[str]) -> Train:
    """What is not said on the command line: from the file; when a run is resumed, from its own."""
    path = _value_of("--config", arguments)
    system, preset = _value_of("--system", arguments), _value_of("--preset", arguments)
    out = _value_of("--out", arguments)
    if out and "--resume" in arguments and "--overwrite" not in arguments:
        with opened(out) as run:
            path = path if path or preset else str(run.record)
    file = read_run_file(Path(path)) if path else RunFile()
    if preset or (system and system != file.system):
        # The numbers of the file are those of another preset or system.
        file = dataclasses.replace(file, system=system or file.system, preset=preset or None, options={})
    return Train(
        scene=tyro.MISSING if file.scene is None else file.scene,
        out=tyro.MISSING,
        system=file.system,
        preset=file.preset,
        downscale=file.downscale,
        test_every=file.test_every,
        alpha=file.alpha,
        compare=file.compare,
        on_nan=file.on_nan,
        options=file.chosen(path),
    )


def _value_of(flag: str, arguments: list[str]) -> str:
    """The value after `flag`, as "--flag value" or "--flag=value"; empty without it."""
    for word, following in itertools.pairwise([*arguments, ""]):
        if word == flag:
            return following
        if word.startswith(flag + "="):
            return word.split("=", 1)[1]
    return ""


def _tell(result: RunResult, folder: Path) -> None:
    """The figures, and where the report is."""
    print(summary_text(result))
    print(f"report: {RunFolder(folder).report}")


def _show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    print(f"a2tg: warning: {' '.join(str(message).split())}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
