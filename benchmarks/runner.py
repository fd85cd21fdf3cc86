"""Run one case in a process of its own and read the line of JSON that it prints."""

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

OURS = (sys.executable, "-m", "benchmarks.measure")


def measure_all(cases: Iterable[Mapping[str, Any]], largest: int) -> list[dict]:
    """Return the figures of this library for the cases with at most `largest` Gaussians."""
    return [measure(case) for case in cases if case["num"] <= largest]


def measure(
    case: Mapping[str, Any],
    command: Sequence[str] = OURS,
    *,
    environment: Mapping[str, str] | None = None,
    timeout: float = 1200,
) -> dict:
    """Return the case with its figures, or with its failure, and print it as a line."""
    figures = {**case, **run(case, command, environment or {}, timeout)}
    print(line(figures), flush=True)
    return figures


def run(case: Mapping[str, Any], command: Sequence[str], environment: Mapping[str, str], timeout: float) -> dict:
    """Return the last line of the command, called with the case as its last argument, or the failure."""
    try:
        done = subprocess.run(
            [*command, json.dumps(case)],
            capture_output=True, text=True, timeout=timeout, check=True, env={**os.environ, **environment},
        )  # fmt: skip
        return dict(json.loads(done.stdout.strip().splitlines()[-1]))
    except subprocess.TimeoutExpired:
        return {"failed": f"took longer than {timeout:g} s"}
    except subprocess.CalledProcessError as error:
        return {"failed": f"exit status {error.returncode}: {error.stderr[-500:].strip()}"}
    except OSError as error:
        return {"failed": str(error)}
    except (ValueError, TypeError, IndexError):
        return {"failed": f"the last line of {shlex.join(command)} is not a JSON object: {done.stdout[-500:]!r}"}


def line(figures: Mapping[str, Any]) -> str:
    """Return a case as one line of text."""
    words = []
    for name, value in figures.items():
        if isinstance(value, dict):
            words.append(f"{name} {value['ms']:.1f}")
        elif isinstance(value, float):
            words.append(f"{name} {value:.4g}")
        else:
            words.append(f"{name} {value}")
    return "  ".join(words)
