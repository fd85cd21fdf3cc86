"""Depth maps of photographs: read when a training asks for them."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True, eq=False)
class DepthMap:
    """A depth map of a view, left where it is until it is read."""

    shape: tuple[int, int]
    """(H, W)."""
    load: Callable[[], np.ndarray] = dataclasses.field(repr=False)

    @staticmethod
    def of(values: "np.ndarray | DepthMap") -> "DepthMap":
        """Return the map of an array [H, W] of floats, NaN where unknown; a map is returned unchanged.

        Raises:
          ValueError: if it is no such array.
        """
        if isinstance(values, DepthMap):
            return values
        if not hasattr(values, "dtype"):
            raise ValueError(f"a depth map must be an array of floats [H, W]; got {type(values).__name__}")
        if values.ndim != 2 or not np.issubdtype(values.dtype, np.floating):
            raise ValueError(f"a depth map must be an array of floats [H, W]; got {values.dtype} {list(values.shape)}")
        height, width = values.shape
        return DepthMap((height, width), lambda: values)

    def __deepcopy__(self, memo: Any) -> "DepthMap":
        """Return the map itself, which nothing changes."""
        return self

    def __reduce__(self) -> Any:
        """Pickle the numbers that `read` returns."""
        return DepthMap.of, (self.read(),)

    def read(self) -> np.ndarray:
        """Return [H, W] float32, NaN where unknown, its largest magnitude 1 (scales are unknown anyway)."""
        values = np.array(self.load(), np.float32)
        values[~np.isfinite(values)] = np.nan
        largest = np.nanmax(np.abs(values), initial=0.0)
        return values / largest if largest > 0 else values
