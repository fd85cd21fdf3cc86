"""Ranges and steps of numbers in files of other programs: what they refuse, cut or round too far."""

import dataclasses
import math
import warnings

import numpy as np

from a2tg_jax.core.gaussians import SH_C0, Gaussians
from a2tg_jax.core.origin import Origin
from a2tg_jax.core.similarity import Similarity
from a2tg_jax.host.text import counted
from a2tg_jax.io.validate import check_origin

SPZ_STEP = 2.0**-12
SPZ_REACH = 2048 - SPZ_STEP
"""Largest coordinate of SPZ, which wraps those beyond."""
SOG_LEVELS = 2**16 - 1
MOST_ROUNDING = 0.1
"""Largest rounding of a typical position by a format, in scales of its Gaussian, without a warning."""
MOST_SINGLE_ROUNDING = 0.01
"""Largest rounding of a typical position by float32, in scales of its Gaussian, that keeps the origin."""
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


OFFSET_PLACES = {
    "ply": "the comment 'offset' in the file says so; a2tg convert --float64 keeps world coordinates",
    "compressed.ply": "the comment 'offset' in the file says so",
    "sog": "'offset' in its meta.json says so",
}
"""Where a file says what its positions are relative to, by the name of its format."""


def offset_for(kind: str, means: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    """Return whole numbers [3] to subtract from positions so that a file can hold them; zeros if it can as they are.

    Args:
      kind: gaussforge's name of the format.
      means: [N, 3] float64, in the original world.
      log_scales: [N, 2], in the same world.
    """
    if not len(means):
        return np.zeros(3)
    with np.errstate(all="ignore"):  # Numbers that are not finite are refused later.
        offset: np.ndarray = np.rint(np.median(means, axis=0)) + 0.0  # Not -0.0.
        scales = np.exp(np.asarray(log_scales, np.float64).mean(axis=1))
        before, after = (_excess(kind, positions, scales) for positions in (means, means - offset))
        is_outside = kind == "spz" and bool(np.abs(means).max() > SPZ_REACH)
    return offset if is_outside or (before > 1 and after < before / 2) else np.zeros(3)


def origin_at(offset: np.ndarray) -> Origin | None:
    """Return the origin, without cameras, of a model whose positions are relative to an offset [3]; None for zeros.

    Raises:
      ValueError: if the offset is not finite or too large.
    """
    if not offset.any():
        return None
    origin = Origin.of_cameras([], transform=Similarity(1.0, np.eye(3), -offset))
    check_origin(origin)
    return origin


def warn_of_offset(kind: str, offset: np.ndarray, name: str) -> None:
    """Warn that the positions of a file are relative to an offset [3], unless it is zero."""
    if offset.any():
        place = OFFSET_PLACES.get(kind, "the file has no place to say so: write this down")
        message = (
            f"{name}: positions are relative to {place_in_words(offset)}, because the format would round such large "
            f"coordinates too far; {place}"
        )
        warnings.warn(message, stacklevel=4)


def place_in_words(offset: np.ndarray) -> str:
    """Return an offset [3] as "(431233, 5411222, 312)"."""
    return f"({', '.join(offset_words(offset))})"


def offset_words(offset: np.ndarray) -> list[str]:
    """Return the three numbers of an offset as text that a float64 is read back from."""
    return [repr(float(value)).removesuffix(".0") for value in offset]


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
            "units away; write *.ply or *.sog, or scale the scene"
        )
    scales = np.exp(np.asarray(gaussians.log_scales, np.float64).mean(axis=1))
    rounding = float(np.median(_rounding(kind, means) / scales))
    if rounding > MOST_ROUNDING:
        advice = "write *.ply or *.sog, or enlarge the scene" if kind == "spz" else "write *.ply"
        message = f"{name}: positions are rounded by {rounding:.2g} times the scale of a typical Gaussian; {advice}"
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
    """Return the largest rounding [N] by the format of the coordinates of each position."""
    if kind == "spz":
        return np.full(len(means), SPZ_STEP / 2)
    if kind != "sog":
        return np.zeros(len(means))
    logarithms = np.sign(means) * np.log1p(np.abs(means))
    step = np.ptp(logarithms, axis=0) / SOG_LEVELS
    single = np.spacing(np.abs(logarithms).astype(np.float32))
    rounding: np.ndarray = ((1 + np.abs(means)) * np.maximum(step, single) / 2).max(axis=1)
    return rounding


def _excess(kind: str, means: np.ndarray, scales: np.ndarray) -> float:
    """Return the rounding of a typical position as a multiple of what is allowed, by float32 or else by the format."""
    single = np.abs(means - means.astype(np.float32)).max(axis=1)
    by_single = np.median(single / scales) / MOST_SINGLE_ROUNDING
    return float(max(by_single, np.median(_rounding(kind, means) / scales) / MOST_ROUNDING))
