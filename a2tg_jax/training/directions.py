"""Directions that are spread evenly over a part of the sphere that can only be asked about."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

NUMS_TRIED = 20_000, 200_000
"""Directions all around that tell where the part is; the second number if too few of the first are in it."""
LEAST_FOUND = 5
"""Smallest number of these that must be in the part."""
NEAR = 3.0
"""Largest distance of a direction of the part from one of those found, in spacings of these."""
MOST_TRIED = 2_000_000
"""Largest number of directions all around, of which those in the part are taken."""
MORE = 1.02
"""Factor by which more directions are tried than are likely to be enough."""


def even_directions(num: int, is_sky: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, float]:
    """Return evenly spread unit directions [num, 3] that are sky, and the angle between neighbours.

    Args:
      num: how many.
      is_sky: returns [M] bool for directions [M, 3]. It is asked about `NUMS_TRIED` and about those nearby.

    Raises:
      ValueError: if there is hardly any, or the sky is too small for so many.
    """
    coarse, tried = _coarse(is_sky)
    near, share = cKDTree(coarse), len(coarse) / tried
    reach, found = NEAR * spacing(tried), np.zeros((0, 3))
    while len(found) < num:
        total = int(MORE * num / share) + 1
        if total > MOST_TRIED:
            raise ValueError(
                f"sky_gaussians is {num:,}, but the sky that training views share is small, with room for about "
                f"{int(share * MOST_TRIED / MORE):,}: lower sky_gaussians"
            )
        found = fibonacci(total)
        found = found[np.isfinite(near.query(found, distance_upper_bound=reach)[0])]
        found = found[is_sky(found)]
        share = min(max(len(found), 1) / total, share / MORE)
    chosen = np.linspace(0, len(found) - 1, num).round().astype(int)
    return found[chosen], spacing(total) * float(np.sqrt(len(found) / num))


def _coarse(is_sky: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, int]:
    """Return directions that are sky, and how many were tried all around."""
    for tried in NUMS_TRIED:
        found = fibonacci(tried)
        found = found[is_sky(found)]
        if len(found) >= LEAST_FOUND:
            return found, tried
    raise ValueError(
        "sky_gaussians: too few training views see the same part of a sky, or it is tiny: leave out sky_gaussians"
    )


def spacing(num: int) -> float:
    """Return the angle between neighbours of so many directions all around."""
    return float(np.sqrt(4 * np.pi / num))


def fibonacci(num: int) -> np.ndarray:
    """Return unit vectors [num, 3] spread evenly over the sphere, a Fibonacci lattice."""
    index = np.arange(num) + 0.5
    z, angle = 1 - 2 * index / num, np.pi * (1 + 5**0.5) * index
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
