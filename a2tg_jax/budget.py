"""Memory budgets: how one is written, how many Gaussians it has room for, and how they become that many."""

import decimal
import math
import re
from typing import Any

import jax.numpy as jnp
from jax import Array

from a2tg_jax.gaussians import floats_per_gaussian

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
            f"got {budget!r}"
        ) from None
    if not 0 < megabytes < math.inf:
        raise ValueError(f"{name} must be positive and finite; got {budget!r}")
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
