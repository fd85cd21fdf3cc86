"""The command line `a2tg`: demo, train, eval, finish, render, mesh, view, export, convert, compress, info, sfm,
download, doctor."""

import dataclasses
import functools
import inspect
import os
import sys
import warnings
from collections.abc import Sequence, Set
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, TextIO

from tyro.conf import Positional, arg

from a2tg_jax.cli.arguments import check_path, defaulting_to, in_flags, parse, typed_paths
from a2tg_jax.cli.convert import Convert
from a2tg_jax.cli.doctor import Doctor
from a2tg_jax.cli.download import Download
from a2tg_jax.cli.finish import Finish
from a2tg_jax.cli.mesh import MeshCommand
from a2tg_jax.cli.render import Render
from a2tg_jax.cli.sfm import Sfm
from a2tg_jax.cli.train import Demo, Train, other_systems_text, tell_result, train_defaults
from a2tg_jax.cli.view import Export, ViewCommand
from a2tg_jax.host import signals
from a2tg_jax.host.errors import error_text
from a2tg_jax.host.remote_files import is_url
from a2tg_jax.host.startup import configure_cpu
from a2tg_jax.host.text import did_you_mean, shortened
from a2tg_jax.io.config_json import flatten_config
from a2tg_jax.results.checks import check_weights
from a2tg_jax.results.compression import compress
from a2tg_jax.results.folder import json_text, open_run, opened
from a2tg_jax.results.info import describe_run, run_facts
from a2tg_jax.results.report import metrics_json
from a2tg_jax.results.run_training import LESS_MEMORY, measure
from a2tg_jax.training import SYSTEMS

BROKEN_PIPE = 128 + 13
LONGEST_ERROR = 1000
"""Characters of the line that tells an error."""
SMALLER = {
    "train": LESS_MEMORY,
    "render": "lower --size or --supersample",
    "mesh": "lower --resolution, --radius, --max-memory or --texture-size",
}
"""Advice by command for a lack of memory; other commands say "close other programs"."""
OVERVIEW = f"""usage: a2tg COMMAND [OPTIONS]

Adaptive anisotropic textured 2D Gaussian splatting: from photographs to a textured scene.

  a2tg demo                            train a built-in scene, about a minute on two cores
  a2tg sfm photos/ scene/              find camera poses for photographs or a video with COLMAP
  a2tg download --list                 benchmark data sets that can be downloaded
  a2tg train scene/ --out runs/scene --preset quick --downscale 4
                                       train a scene in minutes, evaluate it, write a report
  a2tg eval runs/scene                 evaluate a run again
  a2tg finish runs/scene --out runs/f  shrink and polish the trained model, in a new run folder
  a2tg render runs/scene               render frames and a video of a flight, or the test views
  a2tg mesh runs/scene                 write the surface as triangles: GLB, PLY or OBJ
  a2tg view runs/scene                 show a run in a browser; also *.npz, *.ply, *.spz, ...
  a2tg export runs/scene --web out/    write the viewer for a web server, or as one HTML file
  a2tg export runs/scene --ply x.ply   write the Gaussians for other programs
  a2tg convert runs/scene scene.sog    convert splats to and from PLY, SPZ, SOG, glTF and others
  a2tg compress runs/scene             write a small file of the trained model
  a2tg info runs/scene                 print what a run folder holds
  a2tg doctor                          print what this machine computes with, and test it

Run a2tg COMMAND --help for a command, a2tg train --system NAME --help for the options of a system, and
a2tg --version for the version. The systems: {", ".join(SYSTEMS)}.
Set A2TG_DEBUG=1 to see the traceback of an error."""


@dataclasses.dataclass(frozen=True)
class Eval:
    """Evaluate the finished stages of a run again.

    Rewrites metrics, pictures and report.

    Example:
      a2tg eval runs/fox --lpips-weights lpips_alex.npz
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """Run folder."""
    lpips_weights: Annotated[Path | None, arg(metavar="FILE")] = None
    """Weights file (.npz) for LPIPS with AlexNet or SqueezeNet. Without it, the LPIPS in metrics.json is kept if the
    models are the same."""
    json: bool = False
    """Print metrics.json, for programs, in place of a table."""

    def run(self) -> None:
        check_weights(self.lpips_weights)
        with opened(self.folder) as run:
            result = measure(run, lpips_weights=self.lpips_weights)
            if self.json:
                print(json_text(metrics_json(result)))
            else:
                tell_result(result, self.folder)


@dataclasses.dataclass(frozen=True)
class Compress:
    """Write the smallest file of a model within a given loss of PSNR.

    The loss is measured on at most 16 training views. If the photographs are missing, it is estimated from renders, for
    a model of 30 dB. A table lists the loss and the bytes of each choice of bits. This takes minutes on a CPU. With
    --tune-iterations the model is trained further while its numbers are rounded, so that fewer bits suffice.

    Examples:
      a2tg compress runs/fox
      a2tg compress runs/fox --tune-iterations 1000
      a2tg compress scene.npz --out scene.a2tgz --max-loss 0.02
    """

    source: Annotated[Positional[Path], arg(metavar="RUN_OR_MODEL")]
    """Model file (*.npz), or run folder, whose last model is taken."""
    out: Annotated[Path | None, defaulting_to("NAME.a2tgz beside the model", "FILE")] = None
    """Output file, *.a2tgz."""
    max_loss: float = 0.05
    """Largest loss of PSNR in dB."""
    tune_iterations: int = 0
    """Iterations of training with rounding, which makes up for fewer bits; 1000 is a good number. It happens up to 4
    times, for other bits each time: first those that lose 0.5 dB, or twice --max-loss if that is more. 0: numbers are
    only rounded."""
    overwrite: bool = False
    """Replace the output file. The default of a run is always replaced once a2tg compress has written it."""

    def run(self) -> None:
        iterations = self.tune_iterations
        table = compress(
            self.source, self.out, max_loss=self.max_loss, tune_iterations=iterations, overwrite=self.overwrite
        )
        print(table)


@dataclasses.dataclass(frozen=True)
class Info:
    """Print the scene, the progress of each stage, the models and the metrics of a run.

    Example:
      a2tg info runs/fox --json
    """

    folder: Annotated[Positional[Path], arg(metavar="RUN")]
    """Run folder."""
    json: bool = False
    """Print JSON, for programs."""

    def run(self) -> None:
        run = open_run(self.folder)
        print(json_text(run_facts(run)) if self.json else describe_run(run))


Command = (
    Demo | Train | Eval | Finish | Render | MeshCommand | ViewCommand | Export | Convert | Compress | Info | Sfm
    | Download
)  # fmt: skip
COMMANDS: dict[str, type] = {
    "demo": Demo, "train": Train, "eval": Eval, "finish": Finish, "render": Render, "mesh": MeshCommand,
    "view": ViewCommand, "export": Export, "convert": Convert, "compress": Compress, "info": Info, "sfm": Sfm,
    "download": Download, "doctor": Doctor,
}  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
      argv: arguments without the program's name; None takes those of the process.

    Returns:
      The exit code: 0, 2 after a user's error (one line on stderr), 130 after Ctrl-C, 143 after SIGTERM, 129 after
      SIGHUP, 141 if the pipe that reads the output is closed.
    """
    name, *arguments = (sys.argv[1:] if argv is None else list(argv)) or ["--help"]
    if name in ("-h", "--help", "--version"):
        print(version("a2tg-jax") if name == "--version" else OVERVIEW)
        return 0
    if name not in COMMANDS:
        near = did_you_mean(name, COMMANDS)
        return _fail(f"there is no command {name!r}{near or ';'} the commands are {', '.join(COMMANDS)}")
    try:
        configure_cpu()
        _find_own_systems()
    except ValueError as error:
        return _fail(str(error))
    paths = typed_paths(arguments)  # What errors and warnings call an option is printed as its flag.
    try:
        with warnings.catch_warnings(), signals.raised():
            warnings.showwarning = functools.partial(_show_warning, paths)
            command = _parse(name, arguments)
            if isinstance(command, Train):
                paths.update(path for path in flatten_config(command.options) if "." in path or "_" in path)
            command.run()
            sys.stdout.flush()
    except KeyboardInterrupt as stop:
        stopped = signals.Stopped.of(stop)
        print(f"a2tg: interrupted{stopped.advice and '; ' + stopped.advice}", file=sys.stderr)
        return stopped.exit_code
    except BrokenPipeError:
        # Python would otherwise flush the buffer again at exit and fail.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except Exception as error:
        told = error_text(error, SMALLER.get(name, "close other programs"))
        if told is None or os.environ.get("A2TG_DEBUG"):
            raise
        return _fail(in_flags(told, paths))
    return 0


def _find_own_systems() -> None:
    """Have Python look for modules in the current folder, too: users' own systems are modules there."""
    try:
        here = os.getcwd()
    except FileNotFoundError:
        raise ValueError("the current folder was deleted: change to one that exists") from None
    if here not in sys.path:
        sys.path.append(here)


def _fail(message: str) -> int:
    """Print an error as one line and return its exit code."""
    print(f"a2tg: error: {shortened(message, LONGEST_ERROR)}", file=sys.stderr)
    return 2


def _parse(name: str, arguments: list[str]) -> Command:
    """Return the command that the arguments ask for. System, preset and file are read first: they set the defaults.

    Raises:
      ValueError, FileNotFoundError: if there is no such system, preset or file, or the file or an argument is invalid.
    """
    kind = COMMANDS[name]
    options: dict[str, Any] = {"description": inspect.getdoc(kind)}
    if kind is Train:
        options["default"] = defaults = train_defaults(arguments)
        options["hint"] = lambda flag: other_systems_text(flag, defaults.system)
    command: Command = parse(kind, f"a2tg {name}", arguments, **options)
    _check_urls(arguments, command)
    return command


def _check_urls(arguments: Sequence[str], command: Command) -> None:
    """Raise ValueError for a URL that is not the scene to train; as a path it would name a folder of this machine."""
    values = [word.partition("=")[2] if word.startswith("--") else word for word in arguments]
    paths = [value for value in vars(command).values() if isinstance(value, Path)]
    for url in filter(is_url, values):
        if url != getattr(command, "scene", None) or Path(url) in paths:
            check_path(url)


def _show_warning(
    paths: Set[str],
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    print(f"a2tg: warning: {in_flags(' '.join(str(message).split()), paths)}", file=sys.stderr)
