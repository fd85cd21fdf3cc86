"""A kill of a tiny run at a random moment; `tests/kills.py` does more, and docs/reliability.md has its results."""

import pytest
from kills import kill_runs

TINY = (
    *("--system", "gaussians-2d-mcmc", "--downscale", "6", "--stage1-iterations", "60", "--initial-gaussians", "60"),
    *("--densify.cap", "60", "--more", "40"),
)


@pytest.mark.long
def test_a_killed_run_ends_as_if_left_alone(tmp_path):
    result = kill_runs(tmp_path, 1, seed=0, options=TINY)
    assert len(result["kills"]) == 1 and not result["differences"]
