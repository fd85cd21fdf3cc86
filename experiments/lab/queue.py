"""A queue of jobs that depend on each other's results: each is run once, several at a time, within memory.

The wanted jobs are asked for again after every finished job, because the number of splats that fit into another run's
bytes is known only then. Jobs run in processes of this machine (`LocalPool`) or wherever submitit sends them.

submitit's local executor does not replace `LocalPool`. It starts a process a job, so nothing compiled is kept from one
job to the next. It gives every job all cores and GPUs. Its processes outlive a killed parent. It is an optional
dependency, and experiments run without it.
"""

import collections
import concurrent.futures
import contextlib
import dataclasses
import math
import multiprocessing
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from a2tg_jax.base.text import shortened
from lab.jobs import Folders, Job, Record, run_job

POLL_SECONDS = 0.5
LONGEST_REASON = 400
"""Largest number of characters of the reason of a failure."""
BASE_BYTES = 4.0e9
"""Bytes of a process that trains: libraries, a small scene, and the compiled programs of a hundred jobs."""
COPIES = 12
"""Copies of a trained number: itself, gradients, Adam's moments, sums of threads."""
GPU_SHARE = 0.8
"""Share of a GPU's memory for all processes that train on it; the rest is for their programs and for this process."""
MEMORY_FRACTIONS = ("XLA_CLIENT_MEM_FRACTION", "XLA_PYTHON_CLIENT_MEM_FRACTION")
"""Variables with the share of a GPU's memory for a process: JAX's present one and its former one. JAX refuses both
together."""
SPARE_SHARE = 0.1
"""Time before a limit at which trainings stop, to write their checkpoints, as a share of the limit."""
MOST_SPARE = 30.0
"""Largest such time, in seconds."""

Records = Mapping[str, Record]
Ask = Callable[[Records], Iterable[Job]]
"""Function that returns the wanted jobs, given the records of finished ones."""


@dataclasses.dataclass(frozen=True)
class Failure:
    """A job that failed, with the reason."""

    job: Job
    reason: str


@dataclasses.dataclass(frozen=True)
class TimeLimit:
    """Time limit of a call. Times are from `time.monotonic`, which the processes of a machine share."""

    end: float = math.inf
    """Time at which jobs that still run are ended."""
    spare: float = 0.0
    """Seconds before the end at which trainings stop."""

    @classmethod
    def of_minutes(cls, minutes: float) -> "TimeLimit":
        """Return the limit of a call that begins now."""
        return cls(time.monotonic() + 60 * minutes, min(MOST_SPARE, SPARE_SHARE * 60 * minutes))

    @property
    def stop(self) -> float:
        """Time at which trainings write their checkpoints and stop."""
        return self.end - self.spare

    @property
    def is_too_late(self) -> bool:
        """Whether a job that starts now would have no time to train."""
        return time.monotonic() >= self.stop - 2 * self.spare

    @property
    def is_over(self) -> bool:
        """Whether the end has come."""
        return time.monotonic() >= self.end


class LocalPool:
    """Processes of this machine, each with its share of the cores and GPUs.

    They stay for one job after another, so that compiled programs are used again.
    """

    def __init__(self, slots: int, memory: float, num_gpus: int = 0, limit: TimeLimit = TimeLimit()):
        self.slots = slots
        self.memory = memory
        self.limit = limit
        self._num_gpus = num_gpus
        self._cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        self._executor = self._new_executor()

    @property
    def shares_devices(self) -> bool:
        """Whether jobs that run at the same time may be on one GPU or on the same cores."""
        return self.slots > (self._num_gpus or len(self._cores) or os.cpu_count() or 1)

    def _new_executor(self) -> concurrent.futures.ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        shares = context.Queue()
        for index in range(self.slots):
            gpu = gpu_variables(index, self.slots, self._num_gpus) if self._num_gpus else {}
            shares.put((self._cores[index :: self.slots] or self._cores, gpu))
        return concurrent.futures.ProcessPoolExecutor(self.slots, context, _begin_worker, (shares,))

    def submit(self, job: Job, folders: Folders) -> concurrent.futures.Future:
        with _interrupts_ignored():  # The processes that begin here leave Ctrl-C to this one.
            try:
                return self._executor.submit(run_job, job, folders, self.limit.stop)
            except concurrent.futures.BrokenExecutor:
                self._executor = self._new_executor()
                return self._executor.submit(run_job, job, folders, self.limit.stop)

    def is_death(self, error: Exception) -> bool:
        """Return whether an error means that a job's process died, not that the job failed."""
        return isinstance(error, concurrent.futures.BrokenExecutor)

    def abort(self) -> None:
        """End the running jobs at once; they continue from their checkpoints."""
        for process in multiprocessing.active_children():
            process.terminate()

    def close(self) -> None:
        """Release processes and memory."""
        self._executor.shutdown(cancel_futures=True)


@contextlib.contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Ignore Ctrl-C within the block, and in processes that begin in it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _begin_worker(shares: Any) -> None:
    """Prepare a process for its first job."""
    from tqdm import tqdm

    import a2tg_jax

    tqdm.set_lock(threading.RLock())  # Its own lock is shared by processes, and one that is ended leaks it.
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cores, gpu = shares.get()
    if cores:
        os.sched_setaffinity(0, cores)
    os.environ |= gpu
    a2tg_jax.configure_cpu()


def gpu_variables(index: int, slots: int, num_gpus: int) -> dict[str, str]:
    """Return the environment of a process that trains on a GPU: which one, and its share of the memory.

    JAX reads these variables when it first uses a device. By default each process would take three quarters of the
    memory at once (https://docs.jax.dev/en/latest/gpu_memory_allocation.html). The share is an upper bound if
    XLA_PYTHON_CLIENT_PREALLOCATE is false, as `run.py` sets it.
    """
    gpu = index % num_gpus
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    variables = {"CUDA_VISIBLE_DEVICES": given.split(",")[gpu] if given else str(gpu)}
    together = math.ceil(slots / num_gpus)
    if together > 1 and not any(name in os.environ for name in MEMORY_FRACTIONS):
        variables[MEMORY_FRACTIONS[0]] = f"{GPU_SHARE / together:.3f}"
    return variables


def _end_with_parent() -> None:
    """End this process if the program that hands out jobs was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class SubmititPool:
    """Other machines, or processes of this one, through submitit."""

    def __init__(self, cluster: str, folder: Path, slots: int, memory: float, **parameters: Any):
        """Args:
        cluster: "slurm", "local", or another of submitit's clusters.
        folder: folder of the logs.
        slots: largest number of jobs at a time.
        memory: bytes that the jobs may take together.
        parameters: parameters of `submitit.AutoExecutor.update_parameters`, such as slurm_partition, mem_gb.

        Raises:
          ValueError: if submitit is not installed.
        """
        try:
            import submitit
        except ImportError as error:
            raise ValueError("--cluster needs submitit: pip install 'a2tg-jax[experiments]'") from error
        self.slots = slots
        self.memory = memory
        self.limit = TimeLimit()
        self.shares_devices = cluster == "local" and slots > 1
        # Pickled jobs name this package, which their processes must find.
        paths = [str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
        self._executor = submitit.AutoExecutor(folder, cluster=cluster)
        self._executor.update_parameters(**parameters)
        self._sent: list[Any] = []

    def submit(self, job: Job, folders: Folders) -> Any:
        self._sent.append(self._executor.submit(Elsewhere(), job, folders))
        return self._sent[-1]

    def is_death(self, error: Exception) -> bool:
        """Return whether a job was killed or out of time; it continues from its checkpoint."""
        return type(error).__name__ == "UncompletedJobError"

    def abort(self) -> None:
        """Leave it to `close`, which cancels what was sent."""

    def close(self) -> None:
        for handle in self._sent:
            if not handle.done():
                handle.cancel()


Pool = LocalPool | SubmititPool


class Elsewhere:
    """Call of submitit's that runs a job; if it is preempted or out of time it is queued again, and continues."""

    def __call__(self, job: Job, folders: Folders) -> Record | None:
        import a2tg_jax

        a2tg_jax.configure_cpu()
        return run_job(job, folders)

    def checkpoint(self, job: Job, folders: Folders) -> Any:
        """Return what is queued in place of this call: the same, since a job finds its own newest checkpoint."""
        import submitit

        return submitit.helpers.DelayedSubmission(self, job, folders)


def error_text(error: Exception) -> str:
    """Return an error on one line; of a trace that submitit quotes, the line of its error."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [""]
    quoted = [line for line in lines if re.match(r"[A-Za-z_][\w.]*(Error|Exception|Interrupt|Exit)\b", line)]
    if len(lines) > 1 and quoted:
        return shortened(quoted[-1], LONGEST_REASON)
    return shortened(f"{type(error).__name__}: {' '.join(lines)}", LONGEST_REASON)


def log_text(handle: Any) -> str:
    """Return where the log of a job lies, if it has one."""
    paths = getattr(handle, "paths", None)
    return f"; log: {paths.stderr}" if paths is not None else ""


def run_all(
    ask: Ask,
    folders: Folders,
    pool: Pool,
    records: dict[str, Record],
    on_record: Callable[[Job, Record], None],
    on_failure: Callable[[Failure], None],
    on_start: Callable[[Job], None] = lambda job: None,
) -> list[Failure]:
    """Run all wanted jobs that are not finished, and add their records.

    Args:
      ask: function that returns the wanted jobs; called again after every finished job.
      folders: folders of the jobs.
      pool: processes that run them.
      records: records of finished jobs by key, to which those of this call are added.
      on_record: called with each finished job.
      on_failure: called with each failed job.
      on_start: called with each job when it starts.

    Returns:
      The failed jobs. Jobs that need their results are not run. At the pool's time limit, running jobs have left
      checkpoints.
    """
    running: dict[str, tuple[Job, Any]] = {}
    failures: dict[str, Failure] = {}
    deaths: collections.Counter[str] = collections.Counter()

    def fail(job: Job, reason: str) -> None:
        failures[job.key] = Failure(job, reason)
        on_failure(failures[job.key])

    wanted = list(ask(records))
    while True:
        for job in _ready(wanted, folders, records):
            others = [other for other, _ in running.values()]
            is_open = job.key not in running and job.key not in failures
            if is_open and _fits(job, others, pool, deaths) and not pool.limit.is_too_late:
                if pool.shares_devices and others:
                    _mark_shared([*others, job], folders)
                on_start(job)
                running[job.key] = job, pool.submit(job, folders)
        if not running:
            return list(failures.values())
        was_alone = len(running) == 1
        ended = [key for key, (_, handle) in running.items() if handle.done()]
        for key in ended:
            job, handle = running.pop(key)
            try:
                record = handle.result()
            except Exception as error:
                if not pool.is_death(error):
                    fail(job, f"{error_text(error)}{log_text(handle)}")
                elif deaths[key] and was_alone:
                    twice = "its process died twice, the second time with nothing beside it; of memory?"
                    fail(job, f"{twice} {error_text(error)}{log_text(handle)}")
                else:
                    deaths[key] += 1
            else:
                if record is None:
                    continue  # Its time was over, and it left a checkpoint.
                if folders.model(job).is_file():
                    folders.shared(job).unlink(missing_ok=True)
                    records[key] = record
                    on_record(job, record)
                else:
                    fail(job, f"it was run, but left no model at {folders.model(job)}")
        if ended:
            wanted = list(ask(records))
        elif pool.limit.is_over:
            pool.abort()
            return list(failures.values())
        else:
            time.sleep(POLL_SECONDS)


def _fits(job: Job, others: list[Job], pool: Pool, deaths: Mapping[str, int]) -> bool:
    """Return whether a job may run beside others; a job that died, or whose neighbour did, runs alone."""
    if not others:
        return True
    if len(others) >= pool.slots or any(deaths.get(one.key) for one in [*others, job]):
        return False
    return sum(map(estimated_bytes, [*others, job])) <= pool.memory


def _mark_shared(jobs: Iterable[Job], folders: Folders) -> None:
    """Note that jobs run at the same time on the same devices."""
    for job in jobs:
        path = folders.shared(job)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def _ready(jobs: Iterable[Job], folders: Folders, records: Records) -> list[Job]:
    """Return the first unfinished job of every chain."""
    found = (_first_open(job, folders, records) for job in jobs)
    return list({job.key: job for job in found if job is not None}.values())


def is_finished(job: Job, folders: Folders, records: Records) -> bool:
    """Return whether a job has its record, with the LPIPS that is wanted."""
    record = records.get(job.key)
    return record is not None and folders.lpips_network in (None, record.get("lpips_network"))


def _first_open(job: Job, folders: Folders, records: Records, *, is_start: bool = False) -> Job | None:
    """Return the job, or the one before it that it needs; None if it is finished."""
    if is_finished(job, folders, records) and (not is_start or folders.model(job).is_file()):
        return None
    before = None if job.start is None else _first_open(job.start, folders, records, is_start=True)
    return before or job


def estimated_bytes(job: Job) -> float:
    """Return about how much memory a job takes, so that no more run at once than fit."""
    return BASE_BYTES + COPIES * job.model_bytes
