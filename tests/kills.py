"""Kills a training run at random moments, goes on with it, and compares what it leaves with a run that was left alone.

    python tests/kills.py --kills 20 --seed 0 --out kills.json

Half of the kills wait for a file that is being written. Where a run ends before all kills are done, another begins.
"""

import argparse
import dataclasses
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from a2tg_jax.results.folder import RunFolder, iteration_of
from a2tg_jax.results.history import read_history
from a2tg_jax.results.record import read_record

SMOKE = ("--preset", "smoke", "--downscale", "4", "--compare", "gaussians-2d-mcmc")
FOLDERS = ("checkpoints", "models", "history")
POLL = 2e-4
"""Seconds between two looks at the files."""
FIRST_SECONDS = 10.0


@dataclasses.dataclass(frozen=True)
class Kill:
    """One process that was killed."""

    run: int
    seconds: float
    """After its start."""
    stage: str
    """Being trained then, or "evaluation"."""
    iteration: int
    """Of the stage's newest checkpoint."""
    writing: str
    """The file that it was writing; "" for none."""


def start(out: Path, options: tuple[str, ...], cache: Path) -> subprocess.Popen:
    """The process that begins a run, or goes on with it."""
    is_begun = (out / "run.toml").is_file()
    words = (
        ["train", "--out", str(out), "--resume"] if is_begun else ["train", "synthetic", "--out", str(out), *options]
    )
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    command = [sys.executable, "-m", "a2tg_jax.cli", *words]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment)


def finish(process: subprocess.Popen) -> None:
    """Waits until a process is done.

    Raises:
      RuntimeError: if it fails.
    """
    _, told = process.communicate()
    if process.returncode:
        raise RuntimeError(f"exit code {process.returncode}: {told}")


def files(out: Path) -> set[Path]:
    """What a run has written."""
    return {path for name in FOLDERS for path in (out / name).glob("*.*") if not path.name.startswith(".")}


def partial_files(out: Path) -> list[str]:
    """Names of the files that are being written."""
    return [entry.name for name in FOLDERS for entry in (out / name).glob(".*.partial")]


@dataclasses.dataclass(frozen=True)
class Moment:
    """When a process is killed."""

    num_files: int
    """After so many further files of a run are there, …"""
    share: float
    """… and then so much of the time between two of them, or of the first seconds of the process."""
    is_writing: bool
    """Not before another one is being written."""

    @staticmethod
    def draw(rng: random.Random, index: int) -> "Moment":
        """Every second one while a file is written; whatever a run does takes part, its first seconds too."""
        return Moment(rng.choice((0, 1, 2, 3, 4)), rng.random(), index % 2 == 1)


def kill_at(process: subprocess.Popen, out: Path, moment: Moment) -> tuple[float, list[str]] | None:
    """Kills a process at a moment; None if it ended before.

    Returns:
      Seconds after now, and the files that it was writing.
    """
    began = last = time.perf_counter()
    gap, known, num_files = FIRST_SECONDS, files(out), 0
    while process.poll() is None:
        now = time.perf_counter()
        if files(out) - known:
            known |= files(out)
            num_files, gap, last = num_files + 1, now - last, now
        is_due = num_files >= moment.num_files and now - last >= moment.share * gap
        if is_due and (not moment.is_writing or partial_files(out)):
            process.send_signal(signal.SIGKILL)
            process.communicate()
            return now - began, partial_files(out)
        time.sleep(POLL)
    finish(process)
    return None


def standing(run: RunFolder) -> tuple[str, int]:
    """The stage that a run is in, and the iteration of its newest checkpoint."""
    if not run.record.is_file():
        return "beginning", 0
    for name in read_record(run).plan.names:
        if not run.model(name).is_file():
            checkpoints = run.checkpoints(name)
            return name, iteration_of(checkpoints[-1]) if checkpoints else 0
    return "evaluation", 0


def differences(run: RunFolder, whole: RunFolder) -> list[str]:
    """What two finished runs do not share, bit for bit; times aside."""
    found = []
    for name in read_record(whole).plan.names:
        with np.load(run.model(name)) as a, np.load(whole.model(name)) as b:
            found += [f"{name}: {key}" for key in b.files if not np.array_equal(a[key], b[key])]
        columns = [read_history(r.history(name)).to_dict() for r in (run, whole)]
        rows = [repr({key: values.tolist() for key, values in c.items() if key != "seconds"}) for c in columns]
        found += [f"history of {name}"] if rows[0] != rows[1] else []
    if run.per_view.read_text() != whole.per_view.read_text():
        found.append(run.per_view.name)
    left = [
        str(path.relative_to(run.path)) for path in run.path.rglob("*") if re.search("partial|checkpoints/", str(path))
    ]
    return found + [f"left over: {name}" for name in left]


def kill_runs(folder: Path, num_kills: int, seed: int, options: tuple[str, ...] = SMOKE) -> dict:
    """Kills runs that often, lets each end, and compares.

    Args:
      folder: for the runs.
      num_kills: in all.
      seed: of the moments.
      options: of `a2tg train synthetic`.

    Returns:
      What was done, and what differs.
    """
    rng, cache = random.Random(seed), folder / "cache"
    whole = RunFolder(folder / "whole")
    finish(start(whole.path, options, cache))
    kills: list[Kill] = []
    different: list[str] = []
    number = 0
    while len(kills) < num_kills or number == 0:
        run = RunFolder(folder / f"killed-{number}")
        while len(kills) < num_kills:
            process = start(run.path, options, cache)
            killed = kill_at(process, run.path, Moment.draw(rng, len(kills)))
            if killed is None:
                break
            kills.append(Kill(number, round(killed[0], 2), *standing(run), ", ".join(killed[1])))
            print(f"{len(kills)} of {num_kills}: {kills[-1]}", flush=True)
        else:
            finish(start(run.path, options, cache))
        different += [f"run {number}: {what}" for what in differences(run, whole)]
        number += 1
    return {
        "command": " ".join(["a2tg", "train", "synthetic", *options]),
        "seed": seed,
        "runs": number,
        "kills": [dataclasses.asdict(kill) for kill in kills],
        "kills_while_writing": sum(bool(kill.writing) for kill in kills),
        "differences": different,
    }


def main() -> None:
    """The command above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="JSON file")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = kill_runs(Path(folder), chosen.kills, chosen.seed)
    chosen.out.write_text(json.dumps(result, indent=2) + "\n")
    print(f"{len(result['kills'])} kills, {result['kills_while_writing']} while a file was written; ", end="")
    print(f"differences: {result['differences'] or 'none'}")
    sys.exit(bool(result["differences"]))


if __name__ == "__main__":
    main()
