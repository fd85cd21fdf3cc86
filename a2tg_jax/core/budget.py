"""Memory budgets: how one is written, how many Gaussians it has room for, and where its bytes bring most."""

import decimal
import math
import re
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from a2tg_jax.core.gaussians import floats_per_gaussian
from a2tg_jax.host.text import shortened

BYTES_PER_FLOAT = 4
MEGABYTE = 10**6
MEGABYTES = {"": "1", "kb": "1e-3", "mb": "1", "gb": "1e3"}
"""Of each unit; a number without one is of megabytes."""
LARGEST_SHORTFALL = 0.005
"""A model that leaves a larger share of its budget unused is warned of."""


def megabytes_of(budget: float | str | None, name: str = "memory_budget") -> float | None:
    """A budget in MB (10^6 bytes), from "1.5MB", "800 kB", "2GB" or a number of MB; None stays None.

    Raises:
      ValueError: if it is none of these, or not positive.
    """
    if budget is None or budget == "None":
        return None
    found = re.fullmatch(r"\s*([0-9.]+(?:e[+-]?[0-9]+)?)\s*([a-z]*)\s*", str(budget).lower())
    try:
        number, unit = found.groups() if found else ("", "")
        megabytes = float(decimal.Decimal(number) * decimal.Decimal(MEGABYTES[unit]))
    except (KeyError, decimal.InvalidOperation):
        raise ValueError(
            f"{name} must be a number of MB (10^6 bytes), or one with a unit, such as 1.5MB, 800kB or 2GB; "
            f"got {shortened(budget)}"
        ) from None
    if not 0 < megabytes < math.inf:
        raise ValueError(f"{name} must be positive and finite; got {shortened(budget)}")
    return megabytes


def bytes_of(megabytes: float) -> int:
    """Whole bytes of a budget."""
    return round(megabytes * MEGABYTE)


def bytes_per_gaussian(sh_degree: int, floats: float = 0) -> float:
    """Bytes of a Gaussian that shows `floats` floats besides its own."""
    return BYTES_PER_FLOAT * (floats_per_gaussian(sh_degree) + floats)


def number_to_reach(num: Array, cap: int, num_left: Any) -> Array:
    """How many Gaussians an event leaves, so that the last of `num_left` like it, itself included, leaves `cap`.

    ⌈n·(cap/n)^(1/r)⌉: all of them grow by one factor. Traceable.

    Args:
      num: n int32, how many there are, at most the cap.
      cap: how many there shall be.
      num_left: r int32, at least 1.

    Returns:
      int32.
    """
    now = num.astype(jnp.result_type(float))
    exponent = 1 / jnp.maximum(jnp.asarray(num_left, jnp.int32), 1).astype(now.dtype)
    wanted = jnp.ceil(now * (cap / jnp.maximum(now, 1)) ** exponent)
    # Powers are rounded: the last event is told apart, so that it leaves the cap itself.
    return jnp.where(num_left > 1, jnp.clip(wanted.astype(jnp.int32), num, cap), cap)


def within_budget(statistic: np.ndarray, can_grow: np.ndarray, cost: np.ndarray, budget_bytes: float) -> np.ndarray:
    """[N] who is chosen: in descending order of statistic per byte each that still fits into the budget.

    What stays unspent is less than the cheapest candidate that was not chosen.

    Args:
      statistic: [N] of what is gained, at least 0.
      can_grow: [N] the candidates.
      cost: [N] bytes, positive for candidates.
      budget_bytes: what may be spent.

    Raises:
      ValueError: if the budget is negative.
    """
    if not budget_bytes >= 0:
        raise ValueError(f"budget_bytes must be at least 0; got {budget_bytes}")
    budget = budget_bytes
    candidates = np.flatnonzero(can_grow & (statistic >= 0))
    gain = statistic[candidates].astype(np.float64) / cost[candidates]
    queue = candidates[np.argsort(-gain, kind="stable")]
    chosen = []
    # Whatever fails once fails for good, for the rest of the budget only shrinks. So each round takes all up to the
    # first that does not fit and drops everything dearer than the rest: one round per distinct cost at most.
    while len(queue):
        spent = np.cumsum(cost[queue])
        num = int(np.searchsorted(spent, budget, side="right"))
        chosen.append(queue[:num])
        budget -= int(spent[num - 1]) if num else 0
        queue = queue[num:]
        queue = queue[cost[queue] <= budget]
    mask = np.zeros(len(statistic), bool)
    mask[np.concatenate([np.zeros(0, np.int64), *chosen])] = True
    return mask


def event_budget(total_bytes: float, current_bytes: float, event_index: int, num_events: int) -> int:
    """Bytes that event j of m may add: 1/(m - j + 1) of what is left of the memory budget, rounded down.

    Args:
      total_bytes: largest reported memory (`measure.metrics.parameter_bytes`).
      current_bytes: reported memory now.
      event_index: j, from 1.
      num_events: m.

    Raises:
      ValueError: if the budget is already exceeded or the event does not exist.
    """
    if not 1 <= event_index <= num_events:
        raise ValueError(f"event_index must lie in 1..{num_events}; got {event_index}")
    if total_bytes < current_bytes:
        raise ValueError(
            f"the memory budget of {total_bytes / 1e6:.3f} MB is below the {current_bytes / 1e6:.3f} MB the Gaussians "
            "already take: raise the budget or lower the number of Gaussians"
        )
    return int((total_bytes - current_bytes) // (num_events - event_index + 1))
