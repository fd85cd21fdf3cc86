"""Warnings that name the line of the user's code."""

import inspect
import warnings

PASSED = (__name__.partition(".")[0], "jax", "contextlib", "functools")
"""Top-level modules whose lines are not the user's: this package, and what calls it back."""


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the nearest line outside of this package that led here."""
    level = 1
    frame = inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in PASSED:
        frame = frame.f_back
        level += 1
    warnings.warn(message, category, stacklevel=level)
