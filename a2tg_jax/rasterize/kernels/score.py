"""A score of windows of two images, as array code and native loops take it."""

from collections.abc import Callable
from typing import NamedTuple

from jax import Array


class Score(NamedTuple):
    """Score to average over windows; hashable."""

    function: Callable[[Array, Array, Array, Array], Array]
    """Element-wise function of the means of x, y, x² + y² and x·y."""
    taps: tuple[float, ...]  # weights of a window along one axis, symmetric
