"""The command line `a2tg`. Commands are imported when they run, so that help and a mistyped name need no JAX."""

import contextlib
import importlib
import inspect
import os
import re
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from a2tg_jax.base.memory import check_ulimits
from a2tg_jax.base.text import did_you_mean, shortened
from a2tg_jax.host import signals
from a2tg_jax.host.errors import error_text
from a2tg_jax.host.startup import configure_cpu

BROKEN_PIPE = 128 + 13  # The number of SIGPIPE, which Windows lacks.
LONGEST_ERROR = 1000
"""Longest error line in characters."""
OVERVIEW = """usage: a2tg COMMAND [OPTIONS]

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
  a2tg compare runs/scene runs/b       write a page that shows two runs with a divider
  a2tg convert runs/scene scene.sog    convert splats to and from PLY, SPZ, SOG, glTF and others
  a2tg edit runs/scene --out x.npz     crop, turn upright, remove floaters, without a browser
  a2tg compress runs/scene             write a small file of the trained model
  a2tg info runs/scene                 print what a run folder, or a file of splats, holds
  a2tg doctor                          print what this machine computes with, and test it

Run a2tg COMMAND --help for a command, a2tg train --system NAME --help-all for the options of a system,
and a2tg --version for the version. The systems: bytewise, a2tg, gaussians-2d,
gaussians-2d-mcmc, textured-gaussians, supergaussians, bbsplat.
Set A2TG_DEBUG=1 to see the traceback of an error."""
COMMANDS = {
    "demo": "train:Demo", "train": "train:Train", "eval": "runs:Eval", "finish": "runs:Finish", "render": "runs:Render",
    "mesh": "runs:MeshCommand", "view": "runs:ViewCommand", "export": "runs:Export", "convert": "runs:Convert",
    "edit": "runs:EditCommand", "compare": "runs:Compare", "compress": "runs:Compress", "info": "runs:Info",
    "sfm": "inputs:Sfm", "download": "inputs:Download", "doctor": "doctor:Doctor",
}  # fmt: skip
"""Module of `a2tg_jax.cli` and dataclass of each command."""
WITHOUT_JAX = frozenset({"sfm", "download"})
"""Commands that do not start JAX."""
HELP = frozenset({"-h", "--help", "--help-all"})
SMALLER = {
    "train": "close other programs, or give a larger --downscale, or a smaller --memory-budget or --batch-size",
    "render": "lower --size or --supersample",
    "mesh": "lower --resolution, --radius, --max-memory or --texture-size",
}
"""What to do if a command runs out of memory; for other commands: close other programs."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
      argv: arguments without the program's name; None: arguments of the process.

    Returns:
      The exit code: 0, 2 after a user's error (on stderr), 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP, 138
      after SIGUSR1, 141 if the pipe that reads the output is closed.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    name = words[0] if words else "--help"
    arguments = words[1:]
    try:
        if name in COMMANDS:
            with warnings.catch_warnings(), signals.raised():
                warnings.showwarning = _show_warning
                exit_code = _run(name, arguments)
        elif name in ("-h", "--help"):
            exit_code = _printed(OVERVIEW)
        elif name == "--version":
            exit_code = _printed(version("a2tg-jax"))
        else:
            near = did_you_mean(name, COMMANDS)
            exit_code = _fail(f"there is no command {name!r}{near or ';'} the commands are {', '.join(COMMANDS)}")
        # A closed pipe raises here, not at exit.
        sys.stdout.flush()
        return exit_code
    except KeyboardInterrupt as interrupt:
        stopped = signals.Stopped.of(interrupt)
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
        # Errors begin with the name of an option: print it as typed.
        option, space, rest = text.partition(" ")
        flag = _flag(option)
        is_typed = any(word.partition("=")[0] == flag for word in arguments)
        return _fail(f"{flag}{space}{rest}" if is_typed else text)


def _run(name: str, arguments: Sequence[str]) -> int:
    """Run a command of `COMMANDS` and return its exit code."""
    if name not in WITHOUT_JAX and HELP.isdisjoint(arguments):
        check_ulimits()
    configure_cpu()
    try:
        here = os.getcwd()
    except FileNotFoundError:
        raise ValueError("the current folder was deleted: change to one that exists") from None
    if here not in sys.path:  # Custom systems are modules there. At the end, it hides no other module.
        sys.path.append(here)
    if name == "train" and {"-h", "--help"} & set(arguments):
        return _print_help_of_train(arguments)
    try:
        command = parsed(name, arguments)
    except SystemExit as end:  # tyro has printed help, or an error.
        return int(end.code or 0)
    command.run()
    return 0


def _print_help_of_train(arguments: Sequence[str]) -> int:
    from a2tg_jax.cli.train import Train, defaults_line

    print(f"usage: a2tg train SCENE --out RUN [OPTIONS]\n\n{inspect.getdoc(Train)}")
    with contextlib.suppress(ValueError, OSError, SystemExit):  # Help also with a wrong system or file.
        print(f"\n{defaults_line(arguments)}")
    return 0


def _printed(text: str) -> int:
    print(text)
    return 0


def command_class(name: str) -> Any:
    """Import and return the dataclass of a command."""
    module, _, kind = COMMANDS[name].partition(":")
    return getattr(importlib.import_module(f"a2tg_jax.cli.{module}"), kind)


def parsed(name: str, arguments: Sequence[str]) -> Any:
    """Return a command with its arguments. For a2tg train, the defaults come from the given system, preset or file.

    Raises:
      SystemExit: after help or an error of an argument, which are printed.
      ValueError, FileNotFoundError: if there is no such system, preset or file, or it is invalid.
    """
    from a2tg_jax.cli.arguments import at_home, parse

    arguments = [at_home(word) for word in arguments]
    kind = command_class(name)
    program = f"a2tg {name}"
    words = ["--help" if word == "--help-all" else word for word in arguments]
    if name != "train":
        return parse(kind, program, words)
    from a2tg_jax.cli.train import train_defaults

    return parse(kind, program, words, train_defaults(arguments))


def _fail(message: str) -> int:
    """Print an error as one line and return its exit code."""
    print(f"a2tg: error: {shortened(_with_flags(message), LONGEST_ERROR)}", file=sys.stderr)
    return 2


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    print(f"a2tg: warning: {' '.join(_with_flags(str(message)).split())}", file=sys.stderr)


def _with_flags(message: str) -> str:
    """Replace the names of options, which messages have in backticks, by their flags."""
    return re.sub(r"`([a-z][\w.]*)`", lambda name: _flag(name[1]), message)


def _flag(option: str) -> str:
    return f"--{option.replace('_', '-')}"
