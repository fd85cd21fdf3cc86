"""Files that are changed at random, through every reader: `python tests/fuzz.py --cases 10000`.

Case number i is the same every time: a reader, one of its sound files, and a change of that. It is read in a process
with limits of memory and time, which is started again after a case that ends it. All is well where the file is read,
and what was read makes sense, or where it is refused by a ValueError or OSError of one line. Cases that are not well
are kept in `--keep FOLDER`.
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
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from fuzz_readers import READERS
from xla_flags import TEST_FLAGS

WELL = ("read", "refused")
SECONDS_A_CASE, SECONDS_TO_START = 60.0, 300.0
SEED = 7


class Worker:
    """The process that reads, started where it is needed."""

    def __init__(self, work: Path, seconds: float = SECONDS_A_CASE):
        self.work = work
        self.seconds = seconds
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
                [sys.executable, str(script), str(self.work)],
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


def run(worker: Worker, cases: range, keep: Path | None = None, seed: int = SEED) -> Iterator[dict]:
    """What became of each case: its number, reader, file, kind, place, seconds and megabytes.

    Changed files of cases that are not well go to the folder `keep`.
    """
    for index in cases:
        worker.start()  # It reads the sound files first.
        number = index % len(READERS)
        rng = np.random.default_rng([seed, index])
        reader = READERS[number]
        name = reader.files[int(rng.integers(len(reader.files)))]
        change = reader.changes[int(rng.integers(len(reader.changes)))]
        file = worker.work / "seeds" / reader.folder / name
        sound = file.read_bytes()
        changed = change(sound, rng)
        try:
            file.write_bytes(changed)
            answer = worker.ask(number, name)
        finally:
            file.write_bytes(sound)
        if keep is not None and answer["kind"] not in WELL:
            keep.mkdir(parents=True, exist_ok=True)
            (keep / f"{index}-{reader.name}-{Path(name).name}").write_bytes(changed)
        yield {"case": index, "reader": reader.name, "file": name, **answer}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--keep", type=Path, help="a folder for the files of cases that are not well")
    parser.add_argument("--seed", type=int, default=SEED, help="another one makes other cases")
    options = parser.parse_args()
    counts: Counter = Counter()
    cases = range(options.first, options.first + options.cases)
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, contextlib.suppress(KeyboardInterrupt):
        worker = Worker(Path(folder))
        try:
            for found in run(worker, cases, options.keep, options.seed):
                counts[found["reader"], found["kind"]] += 1
                if found["kind"] not in WELL:
                    print(*found.values(), flush=True)
        finally:
            worker.stop()
    for (reader, kind), count in sorted(counts.items()):
        print(f"{reader:>12} {kind:>16} {count:>6}")


if __name__ == "__main__":
    main()
