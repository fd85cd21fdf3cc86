"""Spending a number of bytes where they bring most."""

import numpy as np


def within_budget(statistic: np.ndarray, can_grow: np.ndarray, cost: np.ndarray, budget: float) -> np.ndarray:
    """[N] who is chosen: in descending order of statistic per byte each that still fits into the budget.

    What stays unspent is less than the cheapest candidate that was not chosen.

    Args:
      statistic: [N] of what is gained, at least 0.
      can_grow: [N] the candidates.
      cost: [N] bytes, positive for candidates.
      budget: bytes.

    Raises:
      ValueError: if the budget is negative.
    """
    if not budget >= 0:
        raise ValueError(f"budget_bytes must be at least 0; got {budget}")
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
