"""Changed files go through every reader (tests/fuzz.py tries more), and whoever watches them is watched."""

import subprocess
import sys
from collections import Counter
from pathlib import Path

import fuzz
import numpy as np
import pytest
from fuzz_mutate import of_bytes, of_json, of_text
from fuzz_readers import READERS
from fuzz_worker import outcome

NUM_CASES = 96
MOST_MEGABYTES = 300


@pytest.mark.long
def test_changed_files_are_read_or_refused(tmp_path):
    """The worker that reads them is restarted when it hangs and when it crashes."""
    worker = fuzz.Worker(tmp_path)
    try:
        found = list(fuzz.run(worker, range(NUM_CASES // 2)))
        worker._process.kill()
        assert worker.ask(0, READERS[0].files[0])["kind"] == "crash -9"
        found += fuzz.run(worker, range(NUM_CASES // 2, NUM_CASES))
        worker.seconds = 0.0
        assert worker.ask(0, READERS[0].files[0])["kind"] == "hang"
    finally:
        worker.stop()
    assert not [answer for answer in found if answer["kind"] not in fuzz.WELL]
    assert {answer["reader"] for answer in found} == {reader.name for reader in READERS}
    assert max(answer["megabytes"] for answer in found) < MOST_MEGABYTES
    kinds = Counter(answer["kind"] for answer in found)
    assert kinds["read"] > 4 and kinds["refused"] > 45


def raising(error):
    def read():
        raise error

    return read


@pytest.mark.parametrize(
    ("read", "kind"),
    [
        (lambda: None, "read"),
        (raising(ValueError("x.npz: is damaged")), "refused"),
        (raising(FileNotFoundError("x.npz")), "refused"),
        (raising(ValueError("x\ny")), "many lines"),
        (raising(ValueError("x" * 10_000)), "many lines"),
        (raising(ValueError()), "many lines"),
        (raising(RecursionError()), "other error"),
        (raising(SystemExit()), "other error"),
        (raising(MemoryError()), "memory"),
        (raising(AssertionError()), "taken for sound"),
    ],
)
def test_outcomes_are_told_apart(read, kind):
    assert outcome(read)[0] == kind


CODES = {
    "open('inside/x', 'w').close()": "",
    "open('outside', 'w').close()": "wrote open",
    "os.mkdir('other')": "wrote os.mkdir",
    "os.rename('inside/y', 'inside/z')": "",
    "os.rename('inside/z', 'outside')": "wrote os.rename",
    "os.remove('x')": "wrote os.remove",
    "subprocess.run(['true'])": "ran subprocess.Popen",
    "pickle.loads(b'cos\\ngetcwd\\n.')": "ran pickle.find_class",
    "os.system('true')": "ran os.system",
}


def test_what_a_reader_does_besides_is_seen(tmp_path):
    (tmp_path / "inside").mkdir()
    (tmp_path / "x").touch()
    (tmp_path / "inside" / "y").touch()
    script = f"""
import os, pickle, subprocess, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
from fuzz_worker import Watch
watch = Watch(Path("inside"))
for code in {list(CODES)!r}:
    watch.is_on = True
    exec(code)
    watch.is_on = False
    print("; ".join(found for found in watch.taken() if "compile" not in found))
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True)
    for found, wanted in zip(done.stdout.split("\n"), CODES.values(), strict=False):
        assert wanted in found if wanted else not found


def test_a_case_is_the_same_every_time_and_a_change_changes():
    text = b'{"a": [1, 2.5, {"b": "c"}]}'
    data = bytes(range(200))
    for change, sound in ((of_bytes, data), (of_text, text), (of_json, text)):
        changed = [change(sound, np.random.default_rng(seed)) for seed in range(30)]
        assert changed == [change(sound, np.random.default_rng(seed)) for seed in range(30)]
        assert sum(found != sound for found in changed) > 20
