"""The flags that say which of several processes this one is."""

import re

from a2tg_jax.host.processes import AUTO, Place


def place_of(
    coordinator: str | None, num_processes: int | None, process_id: int | None, seconds: float
) -> Place | None:
    """Return the place of this process; None if it is the only one.

    Args:
      coordinator, num_processes, process_id, seconds: values of --coordinator, --num-processes, --process-id and
        --heartbeat-timeout-seconds.

    Raises:
      ValueError: if a flag is missing or wrong.
    """
    flags = {"--num-processes": num_processes, "--process-id": process_id}
    given = [flag for flag, value in flags.items() if value is not None]
    if coordinator is None:
        if given:
            raise ValueError(f"{given[0]} wants --coordinator HOST:PORT, the address of the first process")
        return None
    if seconds <= 0:
        raise ValueError(f"--heartbeat-timeout-seconds must be positive; got {seconds:g}")
    if coordinator != AUTO:
        missing = [flag for flag in flags if flag not in given]
        if missing:
            raise ValueError(f"--coordinator HOST:PORT also wants {' and '.join(missing)}")
        if not re.fullmatch(r".+:\d+", coordinator):
            raise ValueError(f"--coordinator must be HOST:PORT or auto; got {coordinator!r}")
        _check_number(num_processes or 0, process_id or 0)
    return Place(coordinator, num_processes, process_id, seconds)


def _check_number(num_processes: int, process_id: int) -> None:
    """Raise ValueError unless there is a process of that number among so many."""
    if num_processes < 1:
        raise ValueError(f"--num-processes must be at least 1; got {num_processes}")
    if not 0 <= process_id < num_processes:
        raise ValueError(
            f"--process-id must be from 0 to {num_processes - 1}, one less than --num-processes; got {process_id}"
        )
