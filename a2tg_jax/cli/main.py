"""The command line `a2tg`: demo, train, eval, finish, render, mesh, view, export, convert, compress, info, sfm,
download, doctor."""

import inspect
import os
import re
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from a2tg_jax.cli.arguments import parse
from a2tg_jax.cli.doctor import Doctor
from a2tg_jax.cli.inputs import Download, Sfm
from a2tg_jax.cli.runs import Compress, Eval, Finish, Info, MeshCommand, Render
from a2tg_jax.cli.scenes import Convert, Export, ViewCommand
from a2tg_jax.cli.train import Demo, Train, train_defaults
from a2tg_jax.host import signals
from a2tg_jax.host.errors import error_text
from a2tg_jax.host.startup import configure_cpu
from a2tg_jax.host.text import did_you_mean, shortened
from a2tg_jax.results.run_training import LESS_MEMORY
from a2tg_jax.training import SYSTEMS

BROKEN_PIPE = 128 + 13
LONGEST_ERROR = 1000
"""Longest error line in characters."""
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

Run a2tg COMMAND --help for a command, a2tg train --system NAME --help-all for the options of a system,
and a2tg --version for the version. The systems: {", ".join(SYSTEMS)}.
Set A2TG_DEBUG=1 to see the traceback of an error."""


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
      The exit code: 0, 2 after a user's error (on stderr), 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP, 141
      if the pipe that reads the output is closed.
    """
    name, *arguments = (sys.argv[1:] if argv is None else list(argv)) or ["--help"]
    if name in ("-h", "--help", "--version"):
        print(version("a2tg-jax") if name == "--version" else OVERVIEW)
        return 0
    if name not in COMMANDS:
        near = did_you_mean(name, COMMANDS)
        return _fail(f"there is no command {name!r}{near or ';'} the commands are {', '.join(COMMANDS)}")
    if name == "train" and {"-h", "--help"} & set(arguments):
        print(f"usage: a2tg train SCENE --out RUN [OPTIONS]\n\n{inspect.getdoc(Train)}")
        return 0
    try:
        with warnings.catch_warnings(), signals.raised():
            warnings.showwarning = _show_warning
            configure_cpu()
            _add_current_folder()
            try:
                command = parsed(name, arguments)
            except SystemExit as end:  # tyro has printed help, or an error.
                return int(end.code or 0)
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
        text = error_text(error, SMALLER.get(name, "close other programs"))
        if text is None or os.environ.get("A2TG_DEBUG"):
            raise
        option, space, rest = text.partition(" ")
        flag = f"--{option.replace('_', '-')}"  # An error begins with the name of an option: print it as it was typed.
        is_typed = any(word.partition("=")[0] == flag for word in arguments)
        return _fail(f"{flag}{space}{rest}" if is_typed else text)
    return 0


def parsed(name: str, arguments: Sequence[str]) -> Any:
    """Return the command for some arguments. Of a training, system, preset and file are read first: they set the
    defaults.

    Raises:
      SystemExit: after help or an error of an argument, which are printed.
      ValueError, FileNotFoundError: if there is no such system, preset or file, or it is invalid.
    """
    kind, default = COMMANDS[name], train_defaults(arguments) if name == "train" else None
    arguments = ["--help" if word == "--help-all" else word for word in arguments]
    return parse(kind, f"a2tg {name}", arguments, default)


def _add_current_folder() -> None:
    """Have Python look for modules in the current folder, too: custom systems are modules there."""
    try:
        here = os.getcwd()
    except FileNotFoundError:
        raise ValueError("the current folder was deleted: change to one that exists") from None
    if here not in sys.path:
        sys.path.append(here)


def _fail(message: str) -> int:
    """Print an error as one line and return its exit code."""
    print(f"a2tg: error: {shortened(_with_flags(message), LONGEST_ERROR)}", file=sys.stderr)
    return 2


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    print(f"a2tg: warning: {' '.join(_with_flags(str(message)).split())}", file=sys.stderr)


def _with_flags(message: str) -> str:
    """Replace the names of options, which messages have in backticks, by their flags."""
    return re.sub(r"`([a-z][\w.]*)`", lambda name: f"--{name[1].replace('_', '-')}", message)
