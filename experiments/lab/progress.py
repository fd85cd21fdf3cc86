"""Progress of a sweep: a line when a stage starts and one when it ends, on the screen and in a log file."""

import datetime
from collections.abc import Mapping, Sequence
from pathlib import Path

from a2tg_jax.base.text import counted
from lab.grid import Grid
from lab.jobs import Job, Record
from lab.queue import Failure
from lab.stages import stages_of


class Progress:
    """Lines about the stages of some grids."""

    def __init__(self, grids: Sequence[Grid], records: Mapping[str, Record], log: Path):
        self._grids = grids
        self._records = records
        self._log = log
        self._stages = stages_of(grids, records)
        self._total = sum(key not in records for key in self._stages)
        self._numbers: dict[str, int] = {}

    def begin(self, at_a_time: int) -> None:
        """Tell how many stages there are."""
        if self._total:
            self._tell(f"{counted(self._total, 'stage')} to train, {at_a_time} at a time at most; log: {self._log}")

    def start(self, job: Job) -> None:
        """Tell that a stage starts."""
        self._numbers.setdefault(job.key, len(self._numbers) + 1)
        self._total = max(self._total, len(self._numbers))
        self._tell(f"{self._place(job)} start: {self.as_text(job)}")

    def done(self, job: Job, record: Record) -> None:
        """Tell the figures of a finished stage."""
        seconds, pace = (record[name] for name in ("seconds", "ms_per_step"))
        self._tell(
            f"{self._place(job)} done: {self.as_text(job)}: {record['num']:,} Gaussians, {record['mb']:.2f} MB, "
            f"{record['psnr']:.2f} dB{'' if seconds is None else f'; {seconds:.0f} s'}"
            f"{'' if pace is None else f', {pace:.0f} ms a step'}"
        )

    def failed(self, failure: Failure) -> None:
        """Tell a failure."""
        self._tell(f"{self._place(failure.job)} FAILED: {self.as_text(failure.job)}: {failure.reason}")

    def as_text(self, job: Job) -> str:
        """Return a stage in words; those at equal bytes have a name once the bytes are known."""
        if job.key not in self._stages:
            self._stages |= stages_of(self._grids, self._records)
        return str(self._stages[job.key]) if job.key in self._stages else job.key

    def _place(self, job: Job) -> str:
        return f"{self._numbers.get(job.key, 0)} of {self._total}"

    def _tell(self, line: str) -> None:
        print(line, flush=True)
        self._log.parent.mkdir(parents=True, exist_ok=True)
        with open(self._log, "a", encoding="utf-8") as file:
            file.write(f"{datetime.datetime.now().isoformat(' ', 'seconds')} {line}\n")
