"""Files that are changed at random, through every reader: `python tests/fuzz.py --cases 10000`.

Case number i is the same every time: a reader, one of its sound files, and a change of that. It is read in a process of
its own with limits of memory and time, which is started again after a case that ends it. All is well where the file is
read, and what was read makes sense, or where it is refused by a ValueError or OSError of one line. `--state FILE` keeps
the counts, from which the same command goes on. Cases that are not well are kept in `--keep FOLDER`.
"""

import argparse
import contextlib
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from fuzz_readers import READERS, Reader
from xla_flags import TEST_FLAGS

WELL = ("read", "refused")
SECONDS_A_CASE, SECONDS_TO_START = 60.0, 300.0
MOST_TOLD = 200
SEED = 7


class Worker:
    """The process that reads, started where it is needed."""

    def __init__(self, work: Path, seconds: float = SECONDS_A_CASE, is_rendering: bool = False):
        self.work, self.seconds, self.is_rendering = work, seconds, is_rendering
        self._process: subprocess.Popen | None = None

    def ask(self, number: int, name: str) -> dict:
        """What became of a case: the worker's answer, or its end."""
        assert self._process is not None and self._process.stdin is not None
        start = time.perf_counter()
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps([number, name]) + "\n")
            self._process.stdin.flush()
        line = self._line(self.seconds)
        if line:
            return json.loads(line)
        kind = "hang" if line is None else f"crash {self._process.wait()}"
        self.stop()
        return {"kind": kind, "where": "", "seconds": time.perf_counter() - start, "megabytes": 0.0}

    def start(self) -> None:
        if self._process is not None:
            return
        script = Path(__file__).with_name("fuzz_worker.py")
        (self.work / "tmp").mkdir(parents=True, exist_ok=True)
        environment = os.environ | {
            "JAX_PLATFORMS": "cpu", "PYTHONDONTWRITEBYTECODE": "1", "MALLOC_ARENA_MAX": "2", "OMP_NUM_THREADS": "1",
            "TMPDIR": str(self.work / "tmp"), "XDG_CACHE_HOME": str(self.work / "tmp"), "A2TG_NUM_THREADS": "1",
            "XLA_FLAGS": TEST_FLAGS,
        }  # fmt: skip
        with open(self.work / "worker.log", "ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, str(script), str(self.work), *(["--render"] if self.is_rendering else [])],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True, env=environment, cwd=self.work,
            )  # fmt: skip
        if (self._line(SECONDS_TO_START) or "").strip() != "ready":
            self.stop()
            raise RuntimeError(f"the worker did not start: {(self.work / 'worker.log').read_text()[-2000:]}")

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
        self._process = None

    def _line(self, seconds: float) -> str | None:
        """The next line; empty where there will be none, None where none has come in time."""
        assert self._process is not None and self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], seconds)
        return self._process.stdout.readline() if ready else None


def case(index: int, seeds: Path, seed: int = SEED) -> tuple[int, Reader, str, bytes]:
    """Number of the reader, the reader, its file, and what that is changed to."""
    number, rng = index % len(READERS), np.random.default_rng([seed, index])
    reader = READERS[number]
    name = reader.files[int(rng.integers(len(reader.files)))]
    change = reader.changes[int(rng.integers(len(reader.changes)))]
    return number, reader, name, change((seeds / reader.folder / name).read_bytes(), rng)


def run(
    worker: Worker, cases: range, keep: Path | None = None, on_case=lambda index, answer: None, seed: int = SEED
) -> dict:
    """Counts of what became of cases, by reader and kind; and what was not well, with places.

    Args:
      worker: is stopped in the end.
      cases: numbers.
      keep: where the changed files of cases that are not well go.
      on_case: called after each.
      seed: another one makes other cases.
    """
    counts: dict = {"readers": {}, "bad": [], "most_seconds": 0.0, "most_megabytes": 0.0}
    try:
        worker.start()
        for index in cases:
            answer = _run_case(index, worker, keep, seed)
            add(counts, index, answer)
            on_case(index, answer)
    finally:
        worker.stop()
    return counts


def _run_case(index: int, worker: Worker, keep: Path | None, seed: int) -> dict:
    seeds = worker.work / "seeds"
    number, reader, name, changed = case(index, seeds, seed)
    file = seeds / reader.folder / name
    sound = file.read_bytes()
    worker.start()  # It reads the sound files first.
    try:
        file.write_bytes(changed)
        answer = worker.ask(number, name)
    finally:
        file.write_bytes(sound)
    if keep is not None and answer["kind"] not in WELL:
        keep.mkdir(parents=True, exist_ok=True)
        (keep / f"{index}-{reader.name}-{Path(name).name}").write_bytes(changed)
    return {**answer, "reader": reader.name, "file": name}


def add(counts: dict, index: int, answer: dict) -> None:
    """Counts a case in."""
    of_reader = counts["readers"].setdefault(answer["reader"], {})
    of_reader[answer["kind"]] = of_reader.get(answer["kind"], 0) + 1
    if answer["kind"] not in WELL and len(counts["bad"]) < MOST_TOLD:
        counts["bad"].append({"case": index, **{key: answer[key] for key in ("reader", "file", "kind", "where")}})
    for key in ("seconds", "megabytes"):
        counts[f"most_{key}"] = max(counts[f"most_{key}"], round(answer[key], 2))


def table(counts: dict) -> str:
    """The counts as lines of text."""
    kinds = sorted({kind for found in counts["readers"].values() for kind in found}, key=lambda kind: kind not in WELL)
    rows = [["reader", "cases", *kinds]]
    for reader, found in sorted(counts["readers"].items()):
        rows.append([reader, str(sum(found.values())), *(str(found.get(kind, 0)) for kind in kinds)])
    totals = [sum(int(row[column]) for row in rows[1:]) for column in range(1, len(rows[0]))]
    rows.append(["all", *map(str, totals)])
    return "\n".join("  ".join(cell.rjust(max(10, len(kinds[0]))) for cell in row) for row in rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--state", type=Path, help="a JSON file of the counts, to go on from")
    parser.add_argument("--keep", type=Path, help="a folder for the files of cases that are not well")
    parser.add_argument("--case", type=int, help="try this case alone, and keep its file")
    parser.add_argument("--seed", type=int, default=SEED, help="another one makes other cases")
    parser.add_argument("--seconds", type=float, default=SECONDS_A_CASE, help="how long a case may take")
    parser.add_argument("--render", action="store_true", help="draw the models that were read")
    options = parser.parse_args()
    counts: dict = {"next": 0, "readers": {}, "bad": [], "most_seconds": 0.0, "most_megabytes": 0.0}
    if options.state and options.state.is_file():
        counts = json.loads(options.state.read_text())
    cases = range(counts["next"], options.cases) if options.case is None else range(options.case, options.case + 1)

    def on_case(index: int, answer: dict) -> None:
        add(counts, index, answer)
        counts["next"] = index + 1
        if answer["kind"] not in WELL:
            print(index, answer["reader"], answer["file"], answer["kind"], answer["where"], flush=True)
        if options.state and (index % 50 == 49 or index + 1 == cases.stop):
            partial = options.state.with_suffix(".partial")
            partial.write_text(json.dumps(counts, indent=1) + "\n")
            os.replace(partial, options.state)

    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, contextlib.suppress(KeyboardInterrupt):
        run(Worker(Path(folder), options.seconds, options.render), cases, options.keep, on_case, options.seed)
    print(table(counts))


if __name__ == "__main__":
    main()
