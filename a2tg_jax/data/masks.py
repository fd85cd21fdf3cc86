"""Masks: pixels of a photograph that count, compressed in memory."""

import base64
import dataclasses
import zlib
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class Mask:
    """[H, W] bool, True where a pixel counts, as compressed bits. All masks of a scene take less than one
    photograph."""

    shape: tuple[int, int]
    """(H, W)."""
    num: int
    """Number of pixels that count."""
    data: bytes = dataclasses.field(repr=False)

    @staticmethod
    def of(counts: "np.ndarray | Mask") -> "Mask":
        """Return the mask of an array [H, W]; a mask is returned unchanged.

        Raises:
          ValueError: unless it is bool, [H, W].
        """
        if isinstance(counts, Mask):
            return counts
        wanted = "a mask must be an array bool [H, W], True where pixels count"
        if not hasattr(counts, "dtype"):
            raise ValueError(f"{wanted}; got {type(counts).__name__}")
        if counts.ndim != 2 or counts.dtype != bool:
            raise ValueError(f"{wanted}; got {counts.dtype} {[*counts.shape]}")
        height, width = counts.shape
        return Mask((height, width), int(counts.sum()), zlib.compress(np.packbits(counts).tobytes(), 1))

    def to_json(self) -> list[Any]:
        """Return values that can be written as JSON."""
        return [*self.shape, self.num, base64.b64encode(self.data).decode()]

    @staticmethod
    def from_json(values: list[Any]) -> "Mask":
        """Return the mask whose `to_json` gave these values."""
        height, width, num, data = values
        return Mask((height, width), num, base64.b64decode(data))

    @property
    def is_full(self) -> bool:
        """Whether all pixels count."""
        return self.num == self.shape[0] * self.shape[1]

    def read(self) -> np.ndarray:
        """Return [H, W] bool."""
        bits = np.frombuffer(zlib.decompress(self.data), np.uint8)
        return np.unpackbits(bits, count=self.shape[0] * self.shape[1]).view(bool).reshape(self.shape)
