"""Photographs of views, their masks and depth maps, in memory or read on demand."""

import dataclasses
import os
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from a2tg_jax.base.named_fields import NamedFields


def how_to_convert(values: object, name: str) -> str:
    """Return how to make uint8 of colours in [0, 1], [0, 255] or 16 bits, judged by their values; else ""."""
    values = np.asarray(values)
    is_float, is_integer = (np.issubdtype(values.dtype, kind) for kind in (np.floating, np.integer))
    largest = np.nanmax(values, initial=0)
    if is_float and largest <= 1:
        return f": use np.rint(255 * {name}).astype(np.uint8) of [0, 1]"
    if (is_float or is_integer) and largest <= 255:
        return f": use np.clip(np.rint({name}), 0, 255).astype(np.uint8) of [0, 255]"
    return f": use ({name} // 257).astype(np.uint8) of 16 bits" if values.dtype == np.uint16 else ""


@dataclasses.dataclass(frozen=True, eq=False)
class Picture(NamedFields):
    """Pixels, in memory or on disk. `read` always returns the same."""

    shape: tuple[int, ...]
    """[H, W, 3] or, with straight alpha, [H, W, 4]."""
    read: Callable[[], np.ndarray]
    """Function that returns the pixels; do not write to them."""
    is_held: bool = False
    """Whether they are in memory."""
    dtype: DTypeLike = np.uint8
    """Type of the pixels."""
    checksum: int | None = None
    """CRC-32 of its pixels; None if they have not been read."""

    @staticmethod
    def of(pixels: "np.ndarray | Picture") -> "Picture":
        """Return a picture of pixels held in memory; a picture is returned unchanged.

        Raises:
          ValueError: unless they are uint8, [H, W, 3], [H, W, 4], or grey [H, W] or [H, W, 1].
        """
        if isinstance(pixels, Picture):
            return pixels
        wanted = "a picture must be an array uint8 [H, W, 3], or [H, W, 4] with alpha"
        if isinstance(pixels, str | os.PathLike) or not hasattr(pixels, "dtype"):
            raise ValueError(f"{wanted}; got {type(pixels).__name__}")
        is_grey = len(pixels.shape) == 2 or pixels.shape[2:] == (1,)
        is_image = (is_grey or (len(pixels.shape) == 3 and pixels.shape[2] in (3, 4))) and min(pixels.shape) > 0
        if not is_image or pixels.dtype != np.uint8:
            advice = how_to_convert(pixels, "image") if is_image else ""
            raise ValueError(f"{wanted}; got {pixels.dtype} {[*pixels.shape]}{advice}")
        if is_grey:  # A view of the same memory with three equal channels.
            pixels = np.broadcast_to(np.reshape(pixels, (*pixels.shape[:2], 1)), (*pixels.shape[:2], 3))
        return Picture(pixels.shape, lambda: pixels, True, pixels.dtype, checksum=checksum_of(pixels))

    def __deepcopy__(self, memo: object) -> "Picture":
        """Return the picture itself, which nothing changes."""
        return self

    def __reduce__(self) -> Any:
        """Pickle the pixels."""
        return Picture.of, (self.read(),)

    def __repr__(self) -> str:
        place = "in memory" if self.is_held else "on disk"
        return f"Picture({np.dtype(self.dtype)}{[*self.shape]}, {place})"

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.shape[0], self.shape[1]

    @property
    def nbytes(self) -> int:
        """Bytes of its pixels, in memory or on disk."""
        return int(np.prod(self.shape)) * np.dtype(self.dtype).itemsize


@dataclasses.dataclass(frozen=True)
class Mask(NamedFields):
    """[H, W] bool, True where a pixel counts, as compressed bits. All masks of a scene take less than one
    photograph."""

    shape: tuple[int, int]
    """(H, W)."""
    num: int
    """Number of pixels that count."""
    data: bytes = dataclasses.field(repr=False)
    """Compressed bits; `read` decodes them."""

    @staticmethod
    def of(counts: "np.ndarray | Mask") -> "Mask":
        """Return the mask of an array [H, W]; a mask is returned unchanged.

        Raises:
          ValueError: unless it is bool, [H, W].
        """
        if isinstance(counts, Mask):
            return counts
        _check_plane(counts, "a mask must be an array bool [H, W], True where pixels count", np.bool_)
        height, width = counts.shape
        return Mask((height, width), int(counts.sum()), zlib.compress(np.packbits(counts).tobytes(), 1))

    @property
    def is_full(self) -> bool:
        """Whether all pixels count."""
        return self.num == self.shape[0] * self.shape[1]

    @property
    def checksum(self) -> int:
        """CRC-32 of its bits."""
        return zlib.crc32(zlib.decompress(self.data))

    def read(self) -> np.ndarray:
        """Return [H, W] bool."""
        bits = np.frombuffer(zlib.decompress(self.data), np.uint8)
        # packbits filled up the last byte.
        return np.unpackbits(bits, count=self.shape[0] * self.shape[1]).view(bool).reshape(self.shape)


@dataclasses.dataclass(frozen=True, eq=False)
class DepthMap(NamedFields):
    """A depth map of a view, loaded each time it is read."""

    shape: tuple[int, int]
    """(H, W)."""
    load: Callable[[], np.ndarray] = dataclasses.field(repr=False)
    """Function that returns the map, [H, W] floats, NaN where unknown."""

    @staticmethod
    def of(values: "np.ndarray | DepthMap") -> "DepthMap":
        """Return the map of an array [H, W] of floats, NaN where unknown; a map is returned unchanged.

        Raises:
          ValueError: if it is no such array.
        """
        if isinstance(values, DepthMap):
            return values
        _check_plane(values, "a depth map must be an array of floats [H, W]", np.floating)
        height, width = values.shape
        return DepthMap((height, width), lambda: values)

    def __deepcopy__(self, memo: object) -> "DepthMap":
        """Return the map itself, which nothing changes."""
        return self

    def __reduce__(self) -> Any:
        """Pickle the numbers that `read` returns."""
        return DepthMap.of, (self.read(),)

    def read(self) -> np.ndarray:
        """Return [H, W] float32, NaN where unknown, its largest magnitude 1 (scales are unknown anyway)."""
        values = np.array(self.load(), np.float32)  # A copy, written to below.
        values[~np.isfinite(values)] = np.nan
        largest = np.nanmax(np.abs(values), initial=0.0)
        return values / largest if largest > 0 else values


def _check_plane(values: Any, wanted: str, kind: type) -> None:
    """Raise ValueError unless values are an array [H, W] of a kind of dtype."""
    if not hasattr(values, "dtype"):
        raise ValueError(f"{wanted}; got {type(values).__name__}")
    if values.ndim != 2 or not np.issubdtype(values.dtype, kind):
        raise ValueError(f"{wanted}; got {values.dtype} {[*values.shape]}")


def checksum_of(pixels: np.ndarray) -> int:
    """Return the CRC-32 of pixels."""
    return zlib.crc32(np.ascontiguousarray(pixels).data)
