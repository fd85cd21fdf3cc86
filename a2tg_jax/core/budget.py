"""Memory budgets: the number of Gaussians that fit, and the choice of where to spend bytes."""

import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.core.gaussians import floats_per_gaussian
from a2tg_jax.core.numerics import Integer

BYTES_PER_FLOAT = 4
MOST_ROOM = 0.5
"""Largest share of a budget that tables of degrees or textures, padding included, may take when they are allocated
before a stage, so that they can fill without another compilation."""
LARGEST_SHORTFALL = 0.005
"""Largest unused fraction of a budget without a warning."""


def bytes_per_gaussian(sh_degree: int, floats: float = 0) -> float:
    """Return the bytes of a Gaussian with `floats` appearance parameters."""
    return BYTES_PER_FLOAT * (floats_per_gaussian(sh_degree) + floats)


def number_to_reach(num: Array, cap: int, num_left: Integer) -> Array:
    """Return the number of Gaussians after an event, such that the last of r = `num_left` events reaches `cap`; int32.

    ⌈n·(cap/n)^(1/r)⌉: every event grows the present number n, at most the cap, by the same factor. Traceable.
    """
    present = num.astype(jnp.result_type(float))
    exponent = 1 / jnp.maximum(jnp.asarray(num_left, jnp.int32), 1).astype(present.dtype)
    grown = jnp.ceil(present * (cap / jnp.maximum(present, 1)) ** exponent)
    # Powers are rounded: the last event is a separate case, so that it reaches the cap exactly.
    return jnp.where(num_left > 1, jnp.clip(grown.astype(jnp.int32), num, cap), cap)


def within_budget(statistic: np.ndarray, can_grow: np.ndarray, cost: np.ndarray, budget_bytes: float) -> np.ndarray:
    """Return a mask [N] of the candidates chosen in descending order of statistic per byte while they fit.

    The unspent rest is less than the cheapest candidate that was not chosen. Statistics [N] are at least 0, costs [N]
    are bytes, positive for candidates. ValueError: the budget is negative.
    """
    if not budget_bytes >= 0:
        raise ValueError(f"budget_bytes must be at least 0; got {budget_bytes}")
    budget = budget_bytes
    candidates = np.flatnonzero(can_grow & (statistic >= 0))
    gain = statistic[candidates].astype(np.float64) / cost[candidates]
    # Stable: of equal gains the first Gaussian wins, on every machine.
    queue = candidates[np.argsort(-gain, kind="stable")]
    chosen = []
    # The rest of the budget only shrinks, so that a candidate that does not fit never will. Each round takes all up to
    # the first misfit and drops everything dearer than the rest: at most one round per distinct cost.
    while len(queue):
        spent = np.cumsum(cost[queue])
        num = int(np.searchsorted(spent, budget, side="right"))
        chosen.append(queue[:num])
        budget -= int(spent[num - 1]) if num else 0
        queue = queue[num:]
        queue = queue[cost[queue] <= budget]
    mask = np.zeros(len(statistic), bool)
    # The empty array keeps an integer dtype if nothing was chosen.
    mask[np.concatenate([np.zeros(0, np.int64), *chosen])] = True
    return mask


def event_budget(total_bytes: float, current_bytes: float, event_index: int, num_events: int) -> int:
    """Return the bytes that event j = `event_index` of m may add: 1/(m - j + 1) of the unspent memory budget, rounded
    down.

    Both numbers of bytes are counted as in reports (`measure.metrics.parameter_bytes`).

    Raises:
      ValueError: if the budget is already exceeded or the event does not exist.
    """
    if not 1 <= event_index <= num_events:
        raise ValueError(f"event_index must be in 1..{num_events}; got {event_index}")
    if total_bytes < current_bytes:
        raise ValueError(
            f"the memory budget of {total_bytes / 1e6:.3f} MB is below the {current_bytes / 1e6:.3f} MB the Gaussians "
            "already take: raise the budget or lower the number of Gaussians"
        )
    return int((total_bytes - current_bytes) // (num_events - event_index + 1))
