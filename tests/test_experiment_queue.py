"""The queue of experiments trains each stage once, after the one it starts from."""

import concurrent.futures
import dataclasses
import signal
import time

import numpy as np
import pytest
from experiment_records import record
from lab import queue
from lab.grid import read_grid
from lab.jobs import Folders, Job, model_bytes

import a2tg_jax as a2tg


@dataclasses.dataclass(frozen=True)
class FakeJob:
    """Needs of a job, as the queue sees them."""

    key: str
    start: "FakeJob | None" = None


class FakePool:
    """Runs jobs at once, or fails them; writes down in which order."""

    shares_devices = False

    def __init__(self, folders, slots=2, memory=np.inf, outcomes=None):
        self.limit, self.num_aborted = queue.TimeLimit(), 0
        self.slots, self.memory, self.folders = slots, memory, folders
        self.outcomes, self.order, self.most = outcomes or {}, [], 0
        self.running, self.failures, self.record = [], [], record()

    def is_death(self, error):
        return isinstance(error, concurrent.futures.BrokenExecutor)

    def abort(self):
        self.num_aborted += 1

    def submit(self, job, folders):
        self.order.append(job.key)
        handle = concurrent.futures.Future()
        self.running = [other for other in self.running if not other.collected] + [handle]
        self.most = max(self.most, len(self.running))
        handle.collected = False
        result = handle.result

        def collect():
            handle.collected = True
            return result()

        handle.result = collect
        outcome = self.outcomes.get(job.key, [])
        error = outcome.pop(0) if outcome else None
        if error is not None:
            handle.set_exception(error)
        else:
            path = folders.model(job)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
            handle.set_result(self.record)
        return handle


@pytest.fixture
def folders(tmp_path, monkeypatch):
    monkeypatch.setattr(queue, "estimated_bytes", lambda job: 1.0)
    return Folders(tmp_path, tmp_path)


FIRST = FakeJob("first")
CHAIN = [FakeJob("second", FIRST), FakeJob("other", FIRST), FakeJob("alone")]


def run_queue(pool, folders, records, jobs=CHAIN):
    return queue.run_all(
        lambda records: iter(jobs), folders, pool, records, lambda job, record: None, pool.failures.append
    )


def test_each_job_runs_once_and_after_its_start(folders):
    pool, records = FakePool(folders), {}
    assert run_queue(pool, folders, records) == []
    assert sorted(pool.order) == ["alone", "first", "other", "second"] and pool.order.index("first") < 2
    assert set(records) == set(pool.order)
    again = FakePool(folders)
    assert run_queue(again, folders, records) == [] and again.order == [], "a finished run is never run again"


def test_a_start_whose_model_is_gone_is_made_again_where_it_is_needed(folders):
    pool = FakePool(folders)
    run_queue(pool, folders, {"first": record(), "second": record()})
    assert sorted(pool.order) == ["alone", "first", "other"]


def test_what_fails_is_told_and_takes_down_only_what_needs_it(folders):
    pool, records = FakePool(folders, outcomes={"first": [ValueError("no such scene")]}), {}
    (failure,) = run_queue(pool, folders, records)
    assert failure.job.key == "first" and "no such scene" in failure.reason and set(records) == {"alone"}
    assert pool.failures == [failure], "told at once"


def test_what_was_measured_without_lpips_is_measured_again_where_it_is_wanted(folders):
    finished = {job.key: record(lpips_network=None) for job in [*CHAIN, FIRST]}
    wanted = dataclasses.replace(folders, lpips_network="alex")
    assert run_queue(FakePool(folders), folders, dict(finished)) == []
    pool = FakePool(wanted)
    pool.record = record(lpips_network="alex")
    run_queue(pool, wanted, {**finished, "alone": pool.record})
    assert {"second", "other"} <= set(pool.order) and "alone" not in pool.order


def test_a_process_that_dies_is_tried_once_more(folders):
    died = concurrent.futures.BrokenExecutor("killed")
    pool, records = FakePool(folders, outcomes={"alone": [died]}), {}
    assert run_queue(pool, folders, records) == [] and pool.order.count("alone") == 2 and "alone" in records
    (failure,) = run_queue(FakePool(folders, outcomes={"alone": [died, died]}), folders, {}, [FakeJob("alone")])
    assert "died twice" in failure.reason


def test_a_neighbour_of_one_that_dies_is_not_blamed(folders):
    """Two that ran together are tried alone."""
    died = concurrent.futures.BrokenExecutor("killed")
    jobs = [FakeJob("guilty"), FakeJob("innocent"), FakeJob("third")]
    pool = FakePool(folders, outcomes={"guilty": [died, died], "innocent": [died]})
    records = {}
    (failure,) = run_queue(pool, folders, records, jobs)
    assert failure.job.key == "guilty" and set(records) == {"innocent", "third"}


def test_a_job_that_leaves_no_model_has_failed(folders):
    pool = FakePool(folders)
    lost = FakeJob("lost")
    submit = pool.submit

    def forget(job, folders):
        handle = submit(job, folders)
        folders.model(job).unlink()
        return handle

    pool.submit = forget
    (failure,) = run_queue(pool, folders, {}, [lost])
    assert "left no model" in failure.reason


def test_after_a_time_limit_nothing_starts_and_what_runs_is_ended(folders):
    pool, records = FakePool(folders), {}
    pool.limit = queue.TimeLimit(time.monotonic() + 100.0, spare=40.0)
    assert run_queue(pool, folders, records) == [] and pool.order == [] and records == {}, "80 s before the end"
    pool.limit = queue.TimeLimit(time.monotonic() + 1.5)
    pool.submit = lambda job, folders: pool.order.append(job.key) or concurrent.futures.Future()  # It never ends.
    assert run_queue(pool, folders, records) == []
    assert len(pool.order) == 2 and pool.num_aborted == 1 and records == {}


def test_a_training_that_stopped_at_the_limit_has_no_record_and_no_failure(folders):
    pool, records = FakePool(folders), {}
    pool.record = None
    submit = pool.submit

    def until_the_limit(job, folders):
        pool.limit = queue.TimeLimit(time.monotonic())
        return submit(job, folders)

    pool.submit = until_the_limit
    assert run_queue(pool, folders, records) == [] and pool.order == ["first"] and records == {}


def test_a_limit_keeps_time_for_checkpoints():
    before = time.monotonic()
    limit, short = queue.TimeLimit.of_minutes(9.0), queue.TimeLimit.of_minutes(0.5)
    assert 540.0 <= limit.end - before < 545.0 and limit.stop == limit.end - 30.0 and short.spare == 3.0
    assert not limit.is_too_late and not queue.TimeLimit().is_too_late and not queue.TimeLimit().is_over


@pytest.mark.parametrize("shares", [False, True])
def test_jobs_that_run_on_the_same_devices_are_noted(folders, shares):
    """Also the one that ran first; the note lasts until a record is there."""
    pool = FakePool(folders)
    pool.shares_devices, noted = shares, {}
    jobs = [FakeJob("one"), FakeJob("two"), FakeJob("last")]
    submit = pool.submit

    def submit_and_look(job, folders):
        noted[job.key] = {one.key for one in jobs if folders.shared(one).is_file()}
        return submit(job, folders)

    pool.submit = submit_and_look
    run_queue(pool, folders, {}, jobs)
    both = {"one", "two"} if shares else set()
    assert noted == {"one": set(), "two": both, "last": set()}
    assert not any(folders.shared(one).is_file() for one in jobs)


def test_processes_share_the_memory_of_a_gpu(monkeypatch):
    for name in ("CUDA_VISIBLE_DEVICES", *queue.MEMORY_FRACTIONS):
        monkeypatch.delenv(name, raising=False)
    assert queue.gpu_variables(3, 4, num_gpus=4) == {"CUDA_VISIBLE_DEVICES": "3"}
    found = [queue.gpu_variables(index, 3, num_gpus=2) for index in range(3)]
    assert [one["CUDA_VISIBLE_DEVICES"] for one in found] == ["0", "1", "0"]
    assert {one["XLA_CLIENT_MEM_FRACTION"] for one in found} == {"0.400"}
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5,7")
    monkeypatch.setenv("XLA_PYTHON_CLIENT_MEM_FRACTION", "0.2")
    assert queue.gpu_variables(1, 4, num_gpus=2) == {"CUDA_VISIBLE_DEVICES": "7"}, "the user's own share is kept"


def test_pools_know_whether_jobs_share_devices():
    cores = len(queue.LocalPool(1, np.inf)._cores or [0])
    assert not queue.LocalPool(cores, np.inf).shares_devices and queue.LocalPool(cores + 1, np.inf).shares_devices
    assert queue.LocalPool(2, np.inf, num_gpus=1).shares_devices
    assert not queue.LocalPool(2, np.inf, num_gpus=2).shares_devices


@pytest.mark.parametrize("memory, most", [(np.inf, 2), (1.5, 1), (0.1, 1)])
def test_jobs_run_beside_each_other_within_slots_and_memory(folders, memory, most):
    pool = FakePool(folders, memory=memory)
    run_queue(pool, folders, {}, [FakeJob(str(index)) for index in range(5)])
    assert pool.most == most


def test_what_is_wanted_is_asked_again_after_every_job(folders):
    def ask(records):
        yield FIRST
        if "first" in records:
            yield FakeJob("follows")

    pool, records = FakePool(folders), {}
    queue.run_all(ask, folders, pool, records, lambda job, record: None, pool.failures.append)
    assert pool.order == ["first", "follows"]


def test_an_estimate_of_memory_grows_with_splats_and_what_they_show():
    job = next(read_grid("fixed_memory", "full").jobs({}))
    small = dataclasses.replace(job, system=next(read_grid("fixed_memory", "smoke").jobs({})).system)
    assert queue.BASE_BYTES < queue.estimated_bytes(small) < queue.estimated_bytes(job)
    plain, billboards = (a2tg.find_system(name).preset("quick") for name in ("gaussians-2d-mcmc", "bbsplat"))
    assert model_bytes(plain) == plain.densify.cap * 58 * 4
    assert model_bytes(billboards) >= billboards.densify.cap * 1081 * 4, "pictures of 16×16 RGBA texels"


def test_a_preempted_job_is_queued_again(tmp_path):
    submitit = pytest.importorskip("submitit")
    job, folders = Job("synthetic", 2, a2tg.A2tg(), 0), Folders(tmp_path, tmp_path)
    again = submitit.core.utils.DelayedSubmission(queue.Elsewhere(), job, folders)._checkpoint_function()
    again.dump(tmp_path / "again.pickle")
    read = submitit.core.utils.DelayedSubmission.load(tmp_path / "again.pickle")
    assert isinstance(read.function, queue.Elsewhere) and read.args == (job, folders)


def test_errors_of_jobs_are_one_line():
    trace = "Job (task=0) failed with trace:\n----\nTraceback (most recent call last):\nValueError: no scene\n----"
    assert queue.error_text(RuntimeError(trace)) == "ValueError: no scene"
    assert queue.error_text(ValueError("one\nand two")) == "ValueError: one and two"


def test_processes_begin_without_ctrl_c():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with queue._interrupts_ignored():
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
