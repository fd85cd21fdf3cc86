"""The command line `a2tg`. What commands work with is imported when they run, so that help, a mistyped word and a
missing path need no JAX."""

import contextlib
import importlib
import os
import re
import shlex
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from a2tg_jax.base.memory import check_ulimits
from a2tg_jax.base.regular_files import expanded
from a2tg_jax.base.text import did_you_mean, shortened
from a2tg_jax.host import signals
from a2tg_jax.host.errors import error_text
from a2tg_jax.host.startup import configure_cpu

BROKEN_PIPE = 128 + 13  # The number of SIGPIPE, which Windows lacks.
LONGEST_ERROR = 1000
"""Longest error line in characters."""
OVERVIEW = """usage: a2tg COMMAND [OPTIONS]

Adaptive anisotropic textured 2D Gaussian splatting: from photographs to a textured scene.

  a2tg demo                            train a built-in scene, one to two minutes on two cores
  a2tg make photos/ --minutes 10       a page from photographs or a video, by the commands below
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
  a2tg mask runs/scene --out masks     masks of the photographs, to train the subject alone
  a2tg compress runs/scene             write a small file of the trained model
  a2tg info runs/scene                 print what a run folder, or a file of splats, holds
  a2tg doctor                          print what this machine computes with, and test it

Run a2tg COMMAND --help for a command, a2tg train --system NAME --help-all for the options of a system,
and a2tg --version for the version. The systems: bytewise, a2tg, gaussians-2d,
gaussians-2d-mcmc, textured-gaussians, supergaussians, bbsplat.
Set A2TG_DEBUG=1 to see the traceback of an error."""
TRAIN_HELP = """usage: a2tg train SCENE --out RUN [OPTIONS]

Train a scene, evaluate the model and write a report.

  SCENE                  scene folder with photographs and cameras, or built in: "synthetic", "cells"
  --out RUN              run folder for models, checkpoints, metrics, pictures and report.html
  --system NAME          method: bytewise (default; the best picture for its bytes), a2tg (the paper's), ...
  --preset NAME          paper (default), quick (minutes on two cores) or smoke (half a minute)
  --downscale K          divide the width and height of the photographs by K
  --memory-budget SIZE   cap the model's size in memory during training, such as 20MB
  --file-budget SIZE     write a compact file of at most this size, such as 60kB, when training is over
  --baseline             train plain Gaussians as well, and compare
  --compare NAME         train another system as well, and compare; may be repeated
  --view                 show the training in a browser, where you can pause it
  --max-memory SIZE      memory limit of the process and the GPU, such as 8GB
  --config FILE          take options from a file, such as run.toml of another run
  --resume               continue from the newest checkpoint in the run folder
  --resume --more N      train a finished run on, for N more iterations of the last stage
  --overwrite            replace an earlier run in that folder
  --yes                  train without a question about tiny photographs, or tiny or huge budgets
  --quiet                hide the progress of training

a2tg train --help-all lists every option by group, with its default; add --system NAME for the options of another
system, --preset NAME for the defaults of a preset. Flags take precedence over --config.

Checkpoints are written after every tenth of a stage, at least every 500 iterations, and on Ctrl-C or SIGTERM. The
newest two are kept until the stage is finished.

Examples:
  a2tg train scenes/fox --out runs/fox --preset quick --downscale 2
  a2tg train --out runs/fox --resume
  a2tg train scenes/fox --out runs/small --memory-budget 20MB --baseline
  a2tg train synthetic --out runs/three --preset smoke --compare textured-gaussians --compare bbsplat
  a2tg train --config runs/fox/run.toml --out runs/again"""
COMMANDS = {
    "demo": "first_steps:Demo", "make": "make:Make", "train": "train:Train", "eval": "runs:Eval",
    "finish": "runs:Finish", "render": "runs:Render", "mesh": "runs:MeshCommand", "view": "runs:ViewCommand",
    "export": "runs:Export", "convert": "runs:Convert", "edit": "runs:EditCommand", "mask": "runs:MaskCommand",
    "compare": "runs:Compare", "compress": "runs:Compress", "info": "runs:Info", "sfm": "inputs:Sfm",
    "download": "inputs:Download", "doctor": "first_steps:Doctor",
}  # fmt: skip
"""Module of `a2tg_jax.cli` and dataclass of each command."""
WITHOUT_JAX = frozenset({"sfm", "download"})
"""Commands that do not start JAX."""
CONTINUING = frozenset({"make", "download"})
"""Commands that continue when they are repeated."""
WITHOUT_PATH = frozenset({"demo", "download", "doctor"})
"""Commands whose first argument is no path."""
BUILT_IN = frozenset({"synthetic", "cells"})
"""Built-in scenes of `a2tg train`."""
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
        advice = stopped.advice
        if name in CONTINUING:  # Instead of the advice of the step that was interrupted.
            advice = f"repeat the same command to continue: {shlex.join(['a2tg', *words])}"
        print(f"a2tg: interrupted{advice and '; ' + advice}", file=sys.stderr)
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
    asks_for_help = not HELP.isdisjoint(arguments)
    if name not in WITHOUT_JAX and not asks_for_help:
        check_ulimits()
    try:
        here = os.getcwd()
    except FileNotFoundError:
        raise ValueError("the current folder was deleted: change to one that exists") from None
    if here not in sys.path:  # Custom systems are modules there. At the end, it hides no other module.
        sys.path.append(here)
    if not asks_for_help:
        _check_first_path(name, arguments)
    if name == "train" and {"-h", "--help"} & set(arguments):
        return _print_help_of_train(arguments)
    try:
        command = parsed(name, arguments)
    except SystemExit as end:  # tyro has printed help, or an error.
        return int(end.code or 0)
    if name not in WITHOUT_JAX:
        configure_cpu()
    command.run()
    return 0


def _check_first_path(name: str, arguments: Sequence[str]) -> None:
    """Raise FileNotFoundError if a command begins with a path that is missing, before JAX is imported."""
    if name in WITHOUT_PATH or not arguments or arguments[0].startswith("-"):
        return
    if not expanded(arguments[0]).exists() and not (name == "train" and arguments[0] in BUILT_IN):
        raise FileNotFoundError(f"{arguments[0]}: no such file or folder")


def _print_help_of_train(arguments: Sequence[str]) -> int:
    from a2tg_jax.cli.arguments import deciding_options

    print(TRAIN_HELP, flush=True)  # Before the import of JAX, which the defaults need.
    with contextlib.suppress(ValueError, OSError, SystemExit):  # Help also with a wrong system or file.
        given = deciding_options(arguments)
        from a2tg_jax.cli.train import defaults_line

        print(f"\n{defaults_line(given)}")
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
    from a2tg_jax.cli.arguments import at_home, deciding_options, parse

    arguments = [at_home(word) for word in arguments]
    program = f"a2tg {name}"
    words = ["--help" if word == "--help-all" else word for word in arguments]
    if name != "train":
        return parse(command_class(name), program, words)
    given = deciding_options(arguments)
    configure_cpu()  # Custom systems may compute when they are imported.
    from a2tg_jax.cli.train import Train, train_defaults

    return parse(Train, program, words, train_defaults(given))


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
