"""Kills a training at random moments, continues it, and compares the result with a run that was left alone.

    python tests/kills.py --kills 20 --seed 0 --out kills.json

Half of the kills wait for a file that is being written. If a run ends before all kills are done, another one begins.
"""

import argparse
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

from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.history import read_history
from a2tg_jax.results.record import read_record

SMOKE = ("--system", "a2tg", "--preset", "smoke", "--downscale", "4", "--compare", "gaussians-2d-mcmc")
FOLDERS = ("checkpoints", "models", "history")
POLL_SECONDS = 2e-4
FIRST_SECONDS = 10.0


def start(out: Path, options: tuple[str, ...], cache: Path) -> subprocess.Popen:
    """The process that begins or continues a run."""
    words = ["--resume"] if (out / "run.toml").is_file() else ["synthetic", *options]
    return subprocess.Popen(
        [sys.executable, "-m", "a2tg_jax", "train", *words, "--out", str(out)],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env={**os.environ, "XDG_CACHE_HOME": str(cache)},
    )  # fmt: skip


def finish(process: subprocess.Popen) -> None:
    """Waits until a process is done. Raises RuntimeError if it fails."""
    _, text = process.communicate()
    if process.returncode:
        raise RuntimeError(f"exit code {process.returncode}: {text}")


def kill_at(process: subprocess.Popen, out: Path, rng: random.Random, must_write: bool) -> dict | None:
    """Kills a process some files and a share of the time between two files later, or not before another file is being
    written. Returns the seconds after its start and the files that it was writing; None if it ended before."""

    def written() -> set[Path]:
        return {path for name in FOLDERS for path in (out / name).glob("*.*") if not path.name.startswith(".")}

    def partial() -> list[str]:
        return [entry.name for name in FOLDERS for entry in (out / name).glob(".*.partial")]

    least_files, share = rng.choice((0, 1, 2, 3, 4)), rng.random()
    began = last = time.perf_counter()
    gap, known, num_files = FIRST_SECONDS, written(), 0
    while process.poll() is None:
        now = time.perf_counter()
        if written() - known:
            known |= written()
            num_files, gap, last = num_files + 1, now - last, now
        if num_files >= least_files and now - last >= share * gap and (not must_write or partial()):
            process.send_signal(signal.SIGKILL)
            process.communicate()
            return {"seconds": round(now - began, 2), "writing": ", ".join(partial())}
        time.sleep(POLL_SECONDS)
    finish(process)
    return None


def stage_of(run: RunFolder) -> dict:
    """The stage that a run is in, and the iteration of its newest checkpoint."""
    if not run.record.is_file():
        return {"stage": "beginning", "iteration": 0}
    for name in read_record(run).plan.names:
        if not run.model(name).is_file():
            checkpoints = run.checkpoints(name)
            return {"stage": name, "iteration": int(checkpoints[-1].stem.rpartition("-")[2]) if checkpoints else 0}
    return {"stage": "evaluation", "iteration": 0}


def differences(run: RunFolder, whole: RunFolder) -> list[str]:
    """What two finished runs do not share, bit for bit, except times."""
    found = []
    for name in read_record(whole).plan.names:
        with np.load(run.model(name)) as a, np.load(whole.model(name)) as b:
            found += [f"{name}: {key}" for key in b.files if not np.array_equal(a[key], b[key])]
        columns = [read_history(each.history(name)).to_dict() for each in (run, whole)]
        rows = [repr({key: values.tolist() for key, values in c.items() if key != "seconds"}) for c in columns]
        found += [f"history of {name}"] if rows[0] != rows[1] else []
    if run.per_view.read_text() != whole.per_view.read_text():
        found.append(run.per_view.name)
    names = [path.relative_to(run.path).as_posix() for path in run.path.rglob("*")]
    return found + [f"left over: {name}" for name in names if re.search("partial|checkpoints/", name)]


def kill_runs(folder: Path, num_kills: int, seed: int, options: tuple[str, ...] = SMOKE) -> dict:
    """Kills runs of `a2tg train synthetic` with these options, lets each end, and returns the kills and differences."""
    rng, cache, kills, different, number = random.Random(seed), folder / "cache", [], [], 0
    whole = RunFolder(folder / "whole")
    finish(start(whole.path, options, cache))
    while len(kills) < num_kills or number == 0:
        run = RunFolder(folder / f"killed-{number}")
        while len(kills) < num_kills:
            killed = kill_at(start(run.path, options, cache), run.path, rng, must_write=len(kills) % 2 == 1)
            if killed is None:
                break
            kills.append({"run": number, **killed, **stage_of(run)})
            print(f"{len(kills)} of {num_kills}: {kills[-1]}", flush=True)
        else:
            finish(start(run.path, options, cache))
        different += [f"run {number}: {what}" for what in differences(run, whole)]
        number += 1
    return {
        "command": " ".join(["a2tg", "train", "synthetic", *options]),
        "seed": seed,
        "runs": number,
        "kills": kills,
        "kills_while_writing": sum(bool(kill["writing"]) for kill in kills),
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
