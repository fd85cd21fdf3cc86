"""A few of many items, and directions, evenly spaced."""

from typing import Any

import numpy as np


def evenly_chosen(items: Any, most: int) -> Any:
    """Return at most `most` items of a list, a tuple or an array, evenly spaced from the first to the last one; 1: the
    first."""
    if len(items) <= most:
        return items
    chosen = np.linspace(0, len(items) - 1, most).round().astype(int)
    return [items[index] for index in chosen] if isinstance(items, list | tuple) else items[chosen]


def fibonacci(num: int, turn: float = 0.0) -> np.ndarray:
    """Return unit vectors [num, 3] spread evenly over the sphere, a Fibonacci lattice, turned by radians about z."""
    index = np.arange(num) + 0.5
    z = 1 - 2 * index / num
    # π·(1 + √5) is 2π times the golden ratio.
    angle = np.pi * (1 + 5**0.5) * index + turn
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
