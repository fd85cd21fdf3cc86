"""Place where training diverged, found after the fact: views, and rows of parameters (host)."""

from collections.abc import Iterator, Sequence

import jax
import numpy as np

from a2tg_jax.training.checkpoint import Checkpoint
from a2tg_jax.training.history import History
from a2tg_jax.training.step import Attempt

EXPLOSION = 100.0
"""A loss is an explosion if it exceeds the stage's first logged loss by this factor, and `SMALL_LOSS`."""
SMALL_LOSS = 10.0
NAMED_ROWS = 5


class DivergedError(ValueError):
    """A loss or gradient is not finite, or the loss exploded. The state before that step is unharmed."""

    def __init__(self, message: str, checkpoint: Checkpoint):
        """The checkpoint is the state before the step."""
        super().__init__(message)
        self.checkpoint = checkpoint

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (str(self), self.checkpoint)  # by default, pickle calls __init__ with the message alone


def largest_loss(history: History) -> float:
    """Return the largest loss that a stage may have; infinite before the first logged iteration."""
    return max(SMALL_LOSS, EXPLOSION * float(history.loss[0])) if len(history.loss) else float("inf")


def what_diverged(tried: Attempt, names: Sequence[str]) -> str:
    """Return the views and parameters whose numbers are not finite, or the loss if all of them are finite, given the
    step that could not be taken, in NumPy arrays, and the names of its views."""
    losses = np.asarray(tried.views.value)
    lost = [f"the loss of {name} is {loss}" for name, loss in zip(names, losses, strict=True) if not np.isfinite(loss)]
    lost += [f"the gradient by {place}" for place in _not_finite(tried.grads)]
    model = tried.state.model
    corrections = tuple(correction.rows for correction in tried.state.corrections)
    lost += [f"after the step, {place}" for place in _not_finite((model.gaussians, model.appearance, corrections))]
    return "; ".join(lost) or f"the loss of {', '.join(names)} is {np.mean(losses):.4g}"


def _not_finite(parameters: tuple[object, ...]) -> Iterator[str]:
    """Yield in words each leaf of (gaussians, appearance, corrections) with numbers that are not finite."""
    for prefix, part in zip(("", "appearance", "corrections"), parameters, strict=True):
        for path, leaf in jax.tree_util.tree_flatten_with_path(part)[0]:
            numbers = np.atleast_1d(leaf)
            is_bad = ~np.isfinite(numbers).all(axis=tuple(range(1, numbers.ndim)))  # There may be 0 rows.
            if is_bad.any():
                rows = np.flatnonzero(is_bad)
                first = ", ".join(map(str, rows[:NAMED_ROWS])) + (", …" if len(rows) > NAMED_ROWS else "")
                name = (prefix + jax.tree_util.keystr(path)).lstrip(".")
                yield f"{name} is not finite in {len(rows):,} of {len(numbers):,} rows ({first})"
