"""Ranges and steps of numbers in files of other programs: what they refuse, cut or round too far."""

import dataclasses
import math
import warnings

import numpy as np

from a2tg_jax.core.display import counted
from a2tg_jax.core.gaussians import SH_C0, Gaussians

SPZ_STEP = 2.0**-12
SPZ_REACH = 2048 - SPZ_STEP
"""Largest coordinate of SPZ, which wraps those beyond."""
SOG_LEVELS = 2**16 - 1
MOST_ROUNDING = 0.1
"""Largest rounding of a typical position, in scales of its Gaussian, without a warning."""
SLACK = 1e-3
"""Part of a range that numbers may leave it by without being counted."""


@dataclasses.dataclass(frozen=True)
class NumberRange:
    """Largest numbers that a format holds; it cuts others."""

    first: float = math.inf
    """Largest size of a coefficient of degree 0."""
    rest: float = math.inf
    """Largest size of a coefficient above degree 0."""
    log_scales: tuple[float, float] = (-math.inf, math.inf)


RANGES = {
    "SPZ": NumberRange(0.5 / 0.15, 1.0, (-10.0, 255 / 16 - 10)),
    "compressed PLY": NumberRange(rest=4.0),
    ".splat": NumberRange(0.5 / SH_C0),
    ".ksplat": NumberRange(0.5 / SH_C0),
}
"""Ranges by the name of a format; the others have none."""


def check_positions(kind: str, gaussians: Gaussians, name: str) -> None:
    """Raise ValueError if a format cannot hold the positions; warn if it rounds them too far.

    Args:
      kind: gaussforge's name of the format.
      gaussians: in the world of the file, at least one.
      name: the file, for messages.
    """
    means = np.asarray(gaussians.means, np.float64)
    farthest = np.abs(means).max()
    if kind == "spz" and farthest > SPZ_REACH:
        raise ValueError(
            f"{name}: SPZ holds positions up to {SPZ_REACH:.0f} units from the origin, but one is {farthest:,.0f} "
            "units away; write *.ply or *.sog, or move or scale the scene"
        )
    scales = np.exp(np.asarray(gaussians.log_scales, np.float64).mean(axis=1))
    rounding = float(np.median(_rounding(kind, means) / scales))
    if rounding > MOST_ROUNDING:
        others = "*.ply or *.sog" if kind == "spz" else "*.ply"
        message = (
            f"{name}: positions are rounded by {rounding:.2g} times the scale of a typical Gaussian; write {others}, "
            f"or {'enlarge' if kind == 'spz' else 'recentre'} the scene"
        )
        warnings.warn(message, stacklevel=4)


def cut_numbers(name: str, gaussians: Gaussians) -> list[str]:
    """Return in words how many Gaussians a format of `RANGES` cuts the colours and the scales of."""
    found, sizes = RANGES[name], np.abs(np.asarray(gaussians.sh))
    if name == ".splat":
        sizes = sizes[:, :1]
    largest = np.where(np.arange(sizes.shape[1]) == 0, found.first, found.rest)[:, None] * (1 + SLACK)
    low, high = found.log_scales
    log_scales = np.asarray(gaussians.log_scales)
    cut = {
        "colours": np.any(sizes > largest, axis=(1, 2)),
        "scales": np.any((log_scales < low - SLACK) | (log_scales > high + SLACK), axis=1),
    }
    return [
        f"{what} of {counted(int(rows.sum()), 'Gaussian')} beyond the format's range (cut)"
        for what, rows in cut.items()
        if rows.any()
    ]


def _rounding(kind: str, means: np.ndarray) -> np.ndarray:
    """Return the largest rounding [N] of the coordinates of each position."""
    if kind == "spz":
        return np.full(len(means), SPZ_STEP / 2)
    if kind != "sog":
        return np.zeros(len(means))
    logarithms = np.sign(means) * np.log1p(np.abs(means))
    step = np.ptp(logarithms, axis=0) / SOG_LEVELS
    single = np.spacing(np.abs(logarithms).astype(np.float32))
    rounding: np.ndarray = ((1 + np.abs(means)) * np.maximum(step, single) / 2).max(axis=1)
    return rounding
