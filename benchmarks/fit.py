"""Growth of time: a + b·(Gaussians) + c·(pairs of a splat and a pixel), fitted to measured cases."""

from collections.abc import Iterable

import numpy as np


def fit_growth(cases: Iterable[dict]) -> list[dict]:
    """Fit the relative error by least squares, per number of threads, for forward and for forward + backward.

    Cases of all sections count if this library rendered them without textures, on a stated number of threads and with
    its own choice of compositor and tile size.
    """
    chosen = [case for case in cases if is_fitted(case)]
    found = []
    for threads in sorted({case["threads"] for case in chosen}):
        of_threads = [case for case in chosen if case["threads"] == threads]
        if len(of_threads) >= 4:
            found += [{"threads": threads, **fit(of_threads, which)} for which in ("forward", "both")]
    return found


def is_fitted(case: dict) -> bool:
    """Return whether a case counts."""
    is_plain = case["case"] in ("render", "trained") and case.get("textures", "none") == "none"
    return is_plain and {"threads", "composited_pairs"} <= case.keys() and not {"compositor", "tile_size"} & case.keys()


def fit(cases: list[dict], which: str) -> dict:
    """Return the coefficients for one kind of pass."""
    times = np.array([case[which]["ms"] for case in cases])
    columns = np.array([[1.0, case["num"], case["composited_pairs"]] for case in cases])
    weighted = columns / times[:, None]
    coefficients = np.linalg.lstsq(weighted, np.ones(len(times)), rcond=None)[0]
    return {
        "which": which,
        "num_cases": len(cases),
        "ms": float(coefficients[0]),
        "ns_per_gaussian": float(coefficients[1]) * 1e6,
        "ns_per_composited_pair": float(coefficients[2]) * 1e6,
        "largest_relative_error": float(np.abs(weighted @ coefficients - 1).max()),
    }
