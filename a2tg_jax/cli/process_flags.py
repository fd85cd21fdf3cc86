"""The flags that say which of several processes this one is."""

import math
import re

from a2tg_jax.parallel.processes import AUTO, ProcessPlace

HEARTBEAT_TIMEOUT = 60.0
"""Default of --heartbeat-timeout-seconds."""


def place_of(
    coordinator: str | None, num_processes: int | None, process_id: int | None, seconds: float | None
) -> ProcessPlace | None:
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
        given += [] if seconds is None else ["--heartbeat-timeout-seconds"]
        if given:
            raise ValueError(f"{given[0]} wants --coordinator HOST:PORT, the address of the first process")
        return None
    seconds = HEARTBEAT_TIMEOUT if seconds is None else seconds
    if not 0 < seconds < math.inf:
        raise ValueError(f"--heartbeat-timeout-seconds must be positive and finite; got {seconds:g}")
    if coordinator != AUTO:
        missing = [flag for flag in flags if flag not in given]
        if missing:
            raise ValueError(f"--coordinator HOST:PORT also wants {' and '.join(missing)}")
        _check_address(coordinator)
    _check_number(num_processes, process_id)
    return ProcessPlace(coordinator, num_processes, process_id, seconds)


def _check_address(coordinator: str) -> None:
    """Raise ValueError unless the text is HOST:PORT, with IPv6 addresses in brackets."""
    if not re.fullmatch(r"(\[[0-9A-Fa-f:.]+(%[\w.-]+)?\]|[^:\[\]]+):\d+", coordinator):
        raise ValueError(f"--coordinator must be HOST:PORT, [IPv6]:PORT or auto; got {coordinator!r}")


def _check_number(num_processes: int | None, process_id: int | None) -> None:
    """Raise ValueError unless there is a process of that number among so many; None: the cluster says it."""
    if num_processes is not None and num_processes < 1:
        raise ValueError(f"--num-processes must be at least 1; got {num_processes}")
    if process_id is not None and process_id < 0:
        raise ValueError(f"--process-id must be at least 0; got {process_id}")
    if num_processes is not None and process_id is not None and process_id >= num_processes:
        raise ValueError(
            f"--process-id must be from 0 to {num_processes - 1}, one less than --num-processes; got {process_id}"
        )
