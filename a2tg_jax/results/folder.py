"""The run folder: its layout, the marker that lists its files, its lock, and its replacement by another run.

    RUN/
      .a2tg-run                  the marker: a list of the files that this program wrote there
      run.toml                   the scene, the system with every number, the systems compared (`results.record`)
      checkpoints/NAME-*.npz     the newest two of the stage that is being trained, to resume from
      models/NAME.npz            the model of each finished stage, with cameras, world and background
      states/NAME.npz            the state at the end of a system's last stage, which --more continues
      corrections/NAME.json      exposure and pose of each training view, if they were learned
      history/NAME.csv           loss, PSNR, Gaussians, MB over the iterations
      tensorboard/events.*       the same for TensorBoard, with --tensorboard
      metrics.json, per_view.json
      test/NAME.png              photograph, renders and error side by side
      figures/                   curves, texture resolutions, some textures, depth, normals
      point_cloud.ply            the Gaussians, upright, for other programs
      viewer.html                the model in a browser, on one page
      report.html                everything on one page
      finish.json                the run that a2tg finish started from, and its options
      diverged/NAME-*.npz        checkpoint before a step whose numbers were not finite
      .a2tg-old/                 the run that this one replaces, until this one has its report

NAME is a stage's name in the run, such as `a2tg-gaussians` or `a2tg-textures`.
"""

import contextlib
import errno
import glob
import json
import os
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

from a2tg_jax.base.atomic import left_over, named_if_full, write_whole
from a2tg_jax.base.operating_system import flush_folder, try_lock
from a2tg_jax.base.regular_files import is_regular, read_regular
from a2tg_jax.base.text import first_names
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.data.other_runs import model_hint

# If the newest is damaged, training continues from the one before.
KEPT_CHECKPOINTS = 2
MARKER = "a2tg-jax run"
"""First line of a marker."""
MOST_NAMES = 100_000
"""Largest number of files in a marker."""
MOST_MARKER_BYTES = 1 << 24
DAMAGED = ".damaged"
"""Suffix added to the name of a damaged checkpoint."""
OLD = ".a2tg-old"
MADE = "run"
"""Name of the run folder in an output folder of a2tg make."""
IN_USE = "is not empty; add `resume` to continue it, `overwrite` to start again, or choose another `out`"
"""Error text of training for a folder that already holds a run."""


class StageFiles:
    """Models, states and checkpoints of stages in a folder."""

    def __init__(self, path: Path):
        self.path = path

    def own(self, path: Path) -> Path:
        """Return the path of a file that is about to be written."""
        return path

    def model(self, name: str) -> Path:
        return self.path / "models" / f"{name}.npz"

    def state(self, name: str) -> Path:
        return self.path / "states" / f"{name}.npz"

    def checkpoint(self, name: str, iteration: int) -> Path:
        return self.path / "checkpoints" / f"{name}-{iteration:010d}.npz"

    def checkpoints(self, name: str, ending: str = "") -> list[Path]:
        """Return the checkpoints of a stage, oldest first."""
        # Iterations have ten digits, so that names sort by number.
        return sorted((self.path / "checkpoints").glob(f"{glob.escape(name)}-{'[0-9]' * 10}.npz{ending}"))

    def newest(self, name: str) -> Path | None:
        """Return the model of a stage if it is finished, or else its newest checkpoint; None without either."""
        if is_regular(self.model(name)):
            return self.model(name)
        checkpoints = self.checkpoints(name)
        return checkpoints[-1] if checkpoints else None

    def drop_old_checkpoints(self, name: str) -> None:
        """Delete all checkpoints of a stage but the newest `KEPT_CHECKPOINTS`."""
        for path in self.checkpoints(name)[:-KEPT_CHECKPOINTS]:
            path.unlink()

    def drop_all_checkpoints(self, name: str) -> None:
        """Delete all checkpoints of a stage, damaged ones as well."""
        for path in [*self.checkpoints(name), *self.checkpoints(name, DAMAGED)]:
            path.unlink()

    def keep_state(self, name: str, iteration: int) -> None:
        """Keep the checkpoint of a stage's last iteration, if it is there, as its state at the end."""
        checkpoint = self.checkpoint(name, iteration)
        if checkpoint.is_file():
            state = self.own(self.state(name))
            state.parent.mkdir(exist_ok=True)
            checkpoint.replace(state)


class RunFolder(StageFiles):
    """Paths within one run folder, and its marker: the list of files that runs wrote there.

    Only listed files are ever replaced or deleted.
    """

    def __init__(self, path: Path):
        super().__init__(path)
        self.marker = path / ".a2tg-run"
        self.record = path / "run.toml"
        self.tensorboard = path / "tensorboard"
        self.metrics = path / "metrics.json"
        self.per_view = path / "per_view.json"
        self.finish = path / "finish.json"
        self.point_cloud = path / "point_cloud.ply"
        self.viewer = path / "viewer.html"
        self.report = path / "report.html"
        self.figures = path / "figures"
        self.test = path / "test"

    def baked(self, name: str) -> Path:
        """Plain splats of a model, kept for further files."""
        return self.path / "baked" / f"{name}.npz"

    def corrections(self, name: str) -> Path:
        return self.path / "corrections" / f"{name}.json"

    def diverged(self, name: str, iteration: int) -> Path:
        return self.path / "diverged" / f"{name}-{iteration:010d}.npz"

    def history(self, name: str) -> Path:
        return self.path / "history" / f"{name}.csv"

    def drop_all_checkpoints(self, name: str) -> None:
        """Delete all checkpoints of a stage, and their folder if it is empty then."""
        super().drop_all_checkpoints(name)
        remove_if_empty(self.path / "checkpoints", self.path)

    # The marker

    def own(self, path: Path) -> Path:
        """Return the path after listing it in the marker.

        A link to a file outside is removed, with a warning: a run folder may come from a stranger.
        """
        self.own_all([path.relative_to(self.path).as_posix()])
        if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(self.path.resolve()):
            target = os.readlink(path)
            warn(f"{path} was a link to {target}, which stays: runs write into their own folder")
            path.unlink()
        return path

    def own_all(self, names: Sequence[str]) -> None:
        """List several files in the marker at once, by names relative to the folder."""
        listed = set(self.written())
        lines = [f"{name}\n" for name in dict.fromkeys(names) if name not in listed]
        if not lines:
            return
        self.path.mkdir(parents=True, exist_ok=True)
        # Names reach the disk before their files, so that a crash never leaves an unlisted file.
        with named_if_full(self.marker), open(self.marker, "a", encoding="utf-8") as file:
            if os.fstat(file.fileno()).st_size == 0:
                file.write(f"{MARKER}\n")
            file.writelines(lines)
            file.flush()
            os.fsync(file.fileno())

    def written(self) -> list[str]:
        """Return the names in the marker, relative to the folder; none without a marker. Raises ValueError if it is not
        a run's marker, or lists more than `MOST_NAMES` files."""
        if not is_regular(self.marker) or not self.marker.stat().st_size:
            return []
        data = read_regular(self.marker, MOST_MARKER_BYTES)
        first, *names = data.decode("utf-8", errors="replace").splitlines()
        if first != MARKER:
            raise ValueError(f"{self.marker} is not the marker of a run; choose another folder with `out`")
        if len(names) > MOST_NAMES:
            raise ValueError(
                f"{self.marker} lists {len(names):,} files, and {MOST_NAMES:,} are the most that a run writes; "
                "choose another folder with `out`"
            )
        return names

    def files(self) -> list[Path]:
        """Return the paths of listed files that exist within the folder, except the marker."""
        root = self.path.resolve()
        files = []
        for name in dict.fromkeys(self.written()):
            path = self.path / name
            # A line cut off by a crash may name a folder, a damaged one an impossible path.
            with contextlib.suppress(OSError):
                if path != self.marker and path.is_file() and path.resolve().is_relative_to(root):
                    files.append(path)
        return files

    def clear(self) -> None:
        """Delete what runs wrote into their folder, and folders left empty. The marker stays, empty."""
        for path in self.files():
            path.unlink(missing_ok=True)
            remove_if_empty(path.parent, self.path)
        if self.marker.is_file():
            # The same file: it holds the lock of this process.
            os.truncate(self.marker, 0)
            self.own(self.marker)

    @property
    def is_begun(self) -> bool:
        """Whether a run wrote more than its record."""
        return any(path != self.record for path in self.files())

    @property
    def has_progress(self) -> bool:
        """Whether there is a checkpoint, a model or the state before a divergence."""
        return any(path.parent.name in ("checkpoints", "models", "diverged") for path in self.files())


def iteration_of(checkpoint: Path) -> int:
    """Return the iteration after which a checkpoint was written."""
    return int(checkpoint.stem.rpartition("-")[2])


def open_run(path: Path, otherwise: str = "a2tg train --out makes one") -> RunFolder:
    """Return an existing run folder.

    Args:
      path: the folder.
      otherwise: advice if no run and no model of another program is near.

    Raises:
      FileNotFoundError: if there is none at `path`, naming runs in and above it.
    """
    run = RunFolder(path)
    if not is_regular(run.record):
        hint = _run_hint(path) or model_hint(path) or f"; {otherwise}"
        raise FileNotFoundError(f"{path} is not a run folder (it has no run.toml){hint}")
    return run


def _run_hint(path: Path) -> str:
    """Return the hint at the run folder that a folder or file is in, or at the runs in it, to append to an error; ""
    without any."""
    for folder in path.parents[:2]:
        if is_regular(RunFolder(folder).record):
            return f": it is in the run folder {folder}; give that folder"
    runs = [shlex.quote(str(run.path)) for run in runs_in(path)]
    return f": it holds run folders; give one of them: {first_names(runs)}" if runs else ""


def runs_in(folder: Path) -> list[RunFolder]:
    """Return the runs whose folders are in a folder, or in output folders of a2tg make there, sorted by name."""
    entries = sorted(folder.iterdir()) if folder.is_dir() else []
    runs = []
    for entry in entries:
        # Unlike Path.is_file, os.path.isfile is False in folders of other users, such as lost+found.
        runs += [run for run in (RunFolder(entry), RunFolder(entry / MADE)) if os.path.isfile(run.record)]
    return runs


def check_free(path: Path, *, overwrite: bool = False, in_use: str = IN_USE) -> None:
    """Raise FileExistsError if `path` is anything but a free folder, which may hold the run.toml of a run that never
    began, or a run that may be replaced (`overwrite`). `in_use` is the error text for a run."""
    if not path.exists():
        return
    if not path.is_dir():
        raise FileExistsError(f"{path} is a file; choose another folder with `out`")
    run = RunFolder(path)
    written = run.written()
    # A process killed early leaves a marker, a record or partial files: nothing worth keeping.
    unused = {run.marker.name, run.record.name} if run.marker.is_file() else set()
    for partial, whole in left_over(path).items():
        if whole.name in written:
            unused.add(partial.name)
    if all(entry.name in unused for entry in path.iterdir()):
        return
    if not written:
        raise FileExistsError(f"{path} is not empty and not a run folder; choose another folder with `out`")
    if not overwrite:
        raise FileExistsError(f"{path} {in_use}")


def remove_if_empty(folder: Path, root: Path) -> None:
    """Remove a folder below another, if it is empty."""
    if folder != root and folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


# One process at a time


@contextlib.contextmanager
def claimed(run: RunFolder) -> Iterator[None]:
    """Lock a run folder against training and measuring by other processes; it is made if it does not exist.

    The operating system locks the marker until the process ends. Some file systems have no locks. Partial files of a
    killed process are removed, and a run that it was replacing is restored. Raises FileExistsError if another process
    has claimed the folder, and ValueError if the folder is not writable or the marker is not a run's.
    """
    run.written()
    run.path.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        try:
            # Append: opening must not empty the marker of a run that another process has claimed.
            file = stack.enter_context(open(run.marker, "a", encoding="utf-8"))
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
                raise ValueError(f"{run.path} is not writable ({error.strerror}): give a copy of this folder") from None
            raise
        if not try_lock(file.fileno()):
            raise FileExistsError(
                f"another process is training or measuring in {run.path}: wait until it ends, or choose another `out`"
            )
        run.own(run.marker)
        put_back_old(run)
        # Only partial files of listed files: others may be of another program.
        listed = {run.path / name for name in run.written()}
        for folder in {path.parent for path in listed}:
            for partial, whole in left_over(folder).items():
                if whole in listed:
                    partial.unlink(missing_ok=True)
        yield


@contextlib.contextmanager
def opened(path: Path) -> Iterator[RunFolder]:
    """Claim an existing run folder. Raises FileNotFoundError if there is none, and as `claimed`."""
    run = RunFolder(path)
    if not is_regular(run.marker):
        open_run(path)  # A process killed at its start left a marker, but no record.
    with claimed(run):
        yield open_run(path)


# Replacement of a run. The old one is kept in RUN/.a2tg-old, which is a run folder, until the new one has its report.
# Until the new one has a checkpoint, the old one can be restored. Its record is moved first and moved back last, so a
# folder without a record is one in which a process was killed between two moves.


def old_run(run: RunFolder) -> RunFolder | None:
    """Return the run that this one replaces, or None."""
    old = RunFolder(run.path / OLD)
    return old if old.path.is_dir() else None


def set_aside(run: RunFolder) -> None:
    """Move the files of a run to RUN/.a2tg-old. If an earlier run is still there, whose replacement never finished, it
    is kept and this one is deleted."""
    if old_run(run) is None:
        _move(run, RunFolder(run.path / OLD), is_record_first=True)
    run.clear()


def put_back_old(run: RunFolder) -> bool:
    """Restore the run that this one replaces, unless this one has a checkpoint or a model. Return whether it did."""
    old = old_run(run)
    if old is None:
        return False
    if not old.files():
        drop_old(run)  # A process was killed before the first move.
        return False
    is_moving = not run.record.is_file()
    if run.has_progress and not is_moving:
        return False
    if not is_moving:
        run.clear()
    _move(old, run, is_record_first=False)
    drop_old(run)
    return True


def drop_old(run: RunFolder) -> None:
    """Delete the run that was set aside, if any, and its folder unless it holds other files."""
    old = old_run(run)
    if old is not None:
        old.clear()
        old.marker.unlink(missing_ok=True)
        remove_if_empty(old.path, run.path)


def _move(source: RunFolder, target: RunFolder, *, is_record_first: bool) -> None:
    target.own_all(source.written())
    for path in sorted(source.files(), key=lambda path: (path == source.record) != is_record_first):
        moved = target.path / path.relative_to(source.path)
        moved.parent.mkdir(parents=True, exist_ok=True)
        os.replace(path, moved)
        remove_if_empty(path.parent, source.path)
    # Renames reach the disk before the old marker is emptied.
    flush_folder(target.path)


# JSON


def json_text(data: object) -> str:
    """Return indented JSON."""
    return json.dumps(data, indent=2, ensure_ascii=False)


def write_json(path: Path, data: object) -> None:
    write_whole(path, f"{json_text(data)}\n")
