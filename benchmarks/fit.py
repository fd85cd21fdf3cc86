"""How time grows: a + b·(Gaussians) + c·(pairs of a splat and a pixel), fitted to measured cases."""

import numpy as np


def fit_growth(cases: list[dict]) -> list[dict]:
    """Least squares of the relative error, per number of threads, of untextured forward and forward + backward."""
    found = []
    for threads in sorted({case["threads"] for case in cases if "threads" in case}):
        chosen = [case for case in cases if case.get("threads") == threads and case.get("textures") == "none"]
        chosen = [case for case in chosen if "failed" not in case]
        if len(chosen) < 4:
            continue
        for which in ("forward", "both"):
            times = np.array([case[which]["ms"] for case in chosen])
            columns = [[1.0, case["num"], case["composited_pairs"]] for case in chosen]
            weighted = np.array(columns) / times[:, None]
            coefficients = np.linalg.lstsq(weighted, np.ones(len(times)), rcond=None)[0]
            error = np.abs(weighted @ coefficients - 1)
            found.append(
                {
                    "threads": threads,
                    "which": which,
                    "ms": float(coefficients[0]),
                    "ns_per_gaussian": float(coefficients[1]) * 1e6,
                    "ns_per_composited_pair": float(coefficients[2]) * 1e6,
                    "largest_relative_error": float(error.max()),
                }
            )
    return found
