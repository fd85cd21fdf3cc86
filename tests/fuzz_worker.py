"""Reads changed files, one a line of standard input, in a process of limited memory that is watched.

    python tests/fuzz_worker.py FOLDER

FOLDER gets the sound files first. A line says number of reader and file; the answer is a line of JSON: what happened,
how long it took, and how much more memory the process has had than before, in MB.
"""

import json
import os
import resource
import sys
import time
import traceback
import warnings
from pathlib import Path

ROOM = 1 << 30
"""Address space beyond that of a process that has read sound files."""
MODES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
CHANGING = ("os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.truncate", "shutil.rmtree")
RUNNING = (
    "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.startfile", "subprocess.Popen", "pty.spawn",
    "pickle.find_class", "socket.connect", "socket.bind",
)  # fmt: skip
LONGEST_MESSAGE = 1500


class Watch:
    """What was written outside of a folder, or run, since it was last asked."""

    def __init__(self, folder: Path):
        self.folder = str(folder.resolve())
        self.found = []
        self.is_on = False
        sys.addaudithook(self._hook)

    def _hook(self, event: str, arguments: tuple) -> None:
        if not self.is_on:
            return
        if event in RUNNING:
            self.found.append(f"ran {event} {arguments[:1]}"[:200])
        elif event == "open":
            path, mode, flags = arguments
            is_writing = any(letter in mode for letter in "wax+") if isinstance(mode, str) else bool(flags & MODES)
            if is_writing and isinstance(path, str | bytes | os.PathLike):
                self._check(event, path)
        elif event in CHANGING:
            for path in arguments[:2]:
                if isinstance(path, str | bytes | os.PathLike):
                    self._check(event, path)

    def _check(self, event: str, path) -> None:
        place = os.path.abspath(os.fsdecode(path))
        if not place.startswith(self.folder + os.sep) and place != os.devnull:
            self.found.append(f"wrote {event} {place}")

    def taken(self) -> list[str]:
        found = self.found
        self.found = []
        return found


def printed(error: BaseException) -> str:
    """The innermost place in this package, or anywhere, at which an error came up."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "a2tg_jax" in frame.filename] or frames
    return f"{type(error).__name__} at {Path(own[-1].filename).name}:{own[-1].name}: {str(error)[:150]}"


def outcome(read, *arguments) -> tuple[str, str]:
    """What reading led to, and of what is not well where."""
    try:
        read(*arguments)
    except (ValueError, OSError) as error:
        text = str(error)
        return (
            ("refused", "") if 0 < len(text) <= LONGEST_MESSAGE and "\n" not in text else ("many lines", printed(error))
        )
    except MemoryError as error:
        return "memory", printed(error)
    except AssertionError as error:
        return "taken for sound", printed(error)
    except BaseException as error:
        return "other error", printed(error)
    return "read", ""


def main() -> None:
    work = Path(sys.argv[1]).resolve()
    sys.path.insert(0, str(Path(__file__).parent))
    warnings.simplefilter("ignore")
    answers = sys.stdout
    sys.stdout = sys.stderr
    import fuzz_seeds
    from fuzz_readers import READERS
    from fuzz_targets import TARGETS

    seeds = work / "seeds"
    if not seeds.is_dir():
        fuzz_seeds.write_seeds(work / "new")
        os.rename(work / "new", seeds)
    for reader in READERS:
        for name in reader.files:
            TARGETS[reader.target](seeds / reader.folder, seeds / reader.folder / name)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, size + ROOM))
    watch = Watch(work)
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        number, name = json.loads(line)
        reader = READERS[number]
        folder = seeds / reader.folder
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        start = time.perf_counter()
        watch.is_on = True
        kind, where = outcome(TARGETS[reader.target], folder, folder / name)
        watch.is_on = False
        strayed = watch.taken()
        if strayed:
            kind = "code run" if strayed[0].startswith("ran") else "written elsewhere"
            where = "; ".join(strayed)
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
        answer = {"kind": kind, "where": where, "seconds": time.perf_counter() - start, "megabytes": grown}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
