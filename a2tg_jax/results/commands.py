"""Command lines that messages, run.toml and the report quote. No other module of `results` words them."""

import contextlib
import dataclasses
import math
import os
import shlex
from pathlib import Path

from a2tg_jax.base.archive import read_archive_header
from a2tg_jax.base.config_json import config_from_dict, config_to_dict
from a2tg_jax.base.json_text import read_object
from a2tg_jax.base.machine import ALONE, Devices
from a2tg_jax.base.regular_files import is_regular
from a2tg_jax.finish.tuning import ITERATIONS
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.options import FinishOptions

QUICK_SIDE = 640
"""Longer side of photographs, in pixels, up to which the preset quick takes minutes on two cores."""
LEAST_SIDE = 240
"""Longer side of photographs, in pixels, below which they are not downscaled for less time."""


def training_command(run: RunFolder, out: str, *flags: str) -> str:
    """Return the command that trains with the options of a run, into another folder."""
    return shlex.join(["a2tg", "train", "--config", str(run.record), *flags, "--out", out])


def next_to(run: RunFolder, what: str) -> str:
    """Return the path of another run folder next to one, with an addition to its name."""
    # "." and ".." have no name to add to.
    path = run.path if run.path.name not in ("", "..") else run.path.resolve()
    return f"{path}-{what}"


def repeating_command(run: RunFolder) -> str:
    """Return the command that repeats a run, and its finishing, if any. Raises ValueError if finish.json is damaged."""
    again = next_to(run, "again")
    if not is_regular(run.finish):
        return training_command(run, again)
    trained = next_to(run, "trained")
    # It also names the source.
    given = read_object(run.finish)
    names = [field.name for field in dataclasses.fields(FinishOptions)]
    given = {name: given[name] for name in names if name in given}
    options = config_from_dict(FinishOptions, given, f"{run.finish}:")
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in config_to_dict(options).items()]
    finishing = shlex.join(["a2tg", "finish", trained, "--out", again, *flags])
    return f"{training_command(run, trained)} && {finishing}"


def resuming_command(run: RunFolder, devices: Devices | None = None) -> str:
    """Return the command that continues a training on these devices; None: the devices of its newest checkpoint."""
    if devices is None:
        devices = _devices_of_newest_checkpoint(run)
    words = ["a2tg", "train", "--out", str(run.path), "--resume"]
    if devices != ALONE:
        words += ["--devices", str(devices.each)]
    if devices.processes > 1:
        words += ["--coordinator", "HOST:PORT", "--num-processes", str(devices.processes), "--process-id", "I"]
    return shlex.join(words)


def viewing_command(run: RunFolder, model: str) -> str:
    """Return the command that shows a model of a run."""
    return shlex.join(["a2tg", "view", str(run.path), "--model", model])


def _devices_of_newest_checkpoint(run: RunFolder) -> Devices:
    # By time: checkpoints of several stages do not sort by name.
    checkpoints = sorted((run.path / "checkpoints").glob("*.npz"), key=os.path.getmtime)
    with contextlib.suppress(ValueError, OSError):  # It may be damaged.
        if checkpoints:
            return config_from_dict(Devices, read_archive_header(checkpoints[-1]).get("devices", {}), "devices")
    return ALONE


def first_training_command(scene: Path, flags: str = "--preset quick") -> str:
    """Return the command that trains a scene quickly, with flags such as `quick_flags`."""
    return f"{shlex.join(['a2tg', 'train', str(scene), '--out', f'runs/{scene.resolve().name}'])} {flags}"


def quick_flags(longest_side: int, downscale: int = 1) -> str:
    """Return the flags of a quick training with photographs of this longer side, already downscaled by a factor."""
    downscale *= max(1, math.ceil(longest_side / QUICK_SIDE))
    return "--preset quick" + (f" --downscale {downscale}" if downscale > 1 else "")


def quicker_advice(scene: Path, longest_side: int) -> str:
    """Return how a scene is trained in less time than by `quick_flags`, with photographs of this longer side."""
    making = shlex.join(["a2tg", "make", str(scene), "--minutes", "10"])
    advice = f"{making} chooses size and iterations for that time"
    downscale = 2 * max(1, math.ceil(longest_side / QUICK_SIDE))
    if longest_side >= downscale * LEAST_SIDE:
        advice = f"--downscale {downscale} trains 2 to 3 times as fast; {advice}"
    return advice


def file_command(run: RunFolder, size: str) -> str:
    """Return the command that writes the tuned file of a size of a finished run."""
    flags = ["--file-budget", size, "--tune-iterations", str(ITERATIONS)]
    return shlex.join(["a2tg", "compress", str(run.path), *flags])
