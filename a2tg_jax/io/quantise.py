"""Numbers as small integers, and back: uniform steps between two ends, bytes in planes, positions along a Z curve.

All arrays are numpy's, on the host; C columns of n numbers are [C, n]. A precision is a number of bits or a float type.
"""

import math
from typing import Literal, NamedTuple

import numpy as np

Precision = int | Literal["float32", "float16"]
MOST_BITS = 16
LARGEST_FLOAT = float(np.finfo(np.float32).max)


class Ends(NamedTuple):
    """Ends of a range: the first and the last step."""

    low: float
    high: float


def check_precision(name: str, precision: Precision) -> None:
    """Raise ValueError, naming the choice, unless it is a number of bits or a float type."""
    is_bits = isinstance(precision, int) and not isinstance(precision, bool) and 1 <= precision <= MOST_BITS
    if not is_bits and precision not in ("float32", "float16"):
        raise ValueError(f"{name} must be 1 to {MOST_BITS} bits, float32 or float16; got {precision!r}")


def ends_of(values: np.ndarray, bits: int) -> Ends:
    """Return the smallest and the largest of all numbers; 0 and 0 without numbers.

    Where 0 lies between them, they are moved apart, by a step together, so that a step lies on 0: most of what is added
    to something else is about 0.
    """
    if not values.size:
        return Ends(0.0, 0.0)
    low, high = float(values.min()), float(values.max())
    if low < 0 < high and bits > 1:
        step = (high - low) / ((1 << bits) - 2)
        low = -math.ceil(-low / step) * step
        high = low + step * ((1 << bits) - 1)
    return Ends(_short(np.float32(low)), _short(np.float32(high)))


def _short(value: np.float32) -> float:
    """Return the float of fewest digits that is the same float32."""
    return float(str(value))


def quantised(values: np.ndarray, ends: Ends, bits: int) -> np.ndarray:
    """Return the nearest of 2^bits even steps between the ends, as int64; all 0 if both ends are equal."""
    low, high = ends
    if high <= low:
        return np.zeros(values.shape, np.int64)
    steps = (1 << bits) - 1
    shares = (np.asarray(values, np.float64) - low) / (high - low)
    return np.rint(np.clip(shares, 0.0, 1.0) * steps).astype(np.int64)


def dequantised(codes: np.ndarray, ends: Ends, bits: int) -> np.ndarray:
    """Return the values of steps, float64: off by half a step at most, (high − low) / (2^bits − 1) / 2."""
    low, high = ends
    return low + codes * ((high - low) / ((1 << bits) - 1))


def num_bytes_of(bits: int) -> int:
    """Return bytes that so many bits take."""
    return -(-bits // 8)


def to_planes(codes: np.ndarray, bits: int) -> np.ndarray:
    """Return uint8 [C·bytes, n]: the lowest bytes of codes [C, n], column by column, then the next higher."""
    codes = np.atleast_2d(codes)
    planes = [(codes >> (8 * index)) & 255 for index in range(num_bytes_of(bits))]
    return np.concatenate(planes).astype(np.uint8) if planes else np.zeros((0, codes.shape[1]), np.uint8)


def from_planes(planes: np.ndarray, num_columns: int) -> np.ndarray:
    """Return the codes [num_columns, n] that `to_planes` was given, as int64."""
    codes = np.zeros((num_columns, planes.shape[1]), np.int64)
    for index in range(len(planes) // num_columns):
        codes |= planes[index * num_columns : (index + 1) * num_columns].astype(np.int64) << (8 * index)
    return codes


def to_byte_planes(values: np.ndarray) -> np.ndarray:
    """Return uint8 [C·itemsize, n]: the bytes of numbers [C, n] of any type, lowest first, as in `to_planes`."""
    values = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    num_columns, length = values.shape
    by_byte = values.view(np.uint8).reshape(num_columns, length, values.dtype.itemsize)
    return by_byte.transpose(2, 0, 1).reshape(values.dtype.itemsize * num_columns, length)


def from_byte_planes(planes: np.ndarray, num_columns: int, dtype: np.dtype) -> np.ndarray:
    """Return the numbers [num_columns, n] that `to_byte_planes` was given."""
    dtype = np.dtype(dtype).newbyteorder("<")
    by_byte = planes.reshape(dtype.itemsize, num_columns, planes.shape[1]).transpose(1, 2, 0)
    return np.ascontiguousarray(by_byte).view(dtype)[..., 0]


# Colours


def green_apart(codes: np.ndarray, bits: int) -> np.ndarray:
    """Return codes [3, n] of RGB as red − green, green, blue − green, modulo the range of their bytes."""
    red, green, blue = codes
    mask = (1 << 8 * num_bytes_of(bits)) - 1
    return np.stack([(red - green) & mask, green, (blue - green) & mask])


def with_green(codes: np.ndarray, bits: int) -> np.ndarray:
    """Return the inverse of `green_apart`."""
    red, green, blue = codes
    mask = (1 << 8 * num_bytes_of(bits)) - 1
    return np.stack([(red + green) & mask, green, (blue + green) & mask])


# Positions


class Contraction(NamedTuple):
    """asinh((x − centre) / spread): steps that grow with the distance, so that what is far away costs no bits."""

    centre: float
    spread: float

    @staticmethod
    def of(x: np.ndarray) -> "Contraction":
        """Return the compression of the numbers [n] of one axis; three quarters of them lie within the spread."""
        if not x.size:
            return Contraction(0.0, 1.0)
        centre = _short(np.float32(np.median(x)))
        spread = _short(np.float32(np.quantile(np.abs(x - centre), 0.75)))
        return Contraction(centre, spread if spread > 0 else 1.0)

    def contracted(self, x: np.ndarray) -> np.ndarray:
        return np.arcsinh((np.asarray(x, np.float64) - self.centre) / self.spread)

    def expanded(self, y: np.ndarray) -> np.ndarray:
        values: np.ndarray = self.centre + self.spread * np.sinh(y)
        return values


def morton(codes: np.ndarray, bits: int) -> np.ndarray:
    """Return [n] places along the Z curve of codes [3, n] of so many bits: theirs by turns, x lowest; int64."""
    key = np.zeros(codes.shape[1], np.int64)
    for bit in range(bits):
        for axis in range(3):
            key |= ((codes[axis] >> bit) & 1) << (3 * bit + axis)
    return key


def from_morton(key: np.ndarray, bits: int) -> np.ndarray:
    """Return the inverse of `morton`."""
    codes = np.zeros((3, len(key)), np.int64)
    for bit in range(bits):
        for axis in range(3):
            codes[axis] |= ((key >> (3 * bit + axis)) & 1) << bit
    return codes


# Rotations

HALF_TURNS = np.array(
    [
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]],
        [[0, 0, -1, 0], [0, 0, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]],
        [[0, 0, 0, -1], [0, 0, 1, 0], [0, -1, 0, 0], [1, 0, 0, 0]],
    ],
    np.float64,
)
"""Row k: the matrix of q → q·(1, i, j, k) on wxyz, a half-turn about no axis, the first, the second, the third."""


def nearest_half_turn(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit quaternions [n, 4] after a half-turn about an own axis, so that w is largest and not negative.

    A flat Gaussian is the same after half a turn about any of its axes; what is shown on it is mirrored along.

    Returns:
      The quaternions, float64, and [n] the axis about which each was turned: 0 is none, 1 to 3 are u, v and the normal.
    """
    quats = np.asarray(quats, np.float64)
    axis = np.argmax(np.abs(quats), axis=1)
    return with_positive_w(np.einsum("nij,nj->ni", HALF_TURNS[axis], quats)), axis


def with_positive_w(quats: np.ndarray) -> np.ndarray:
    """Return the same rotations as unit quaternions [n, 4], float64, of which no w is negative."""
    quats = np.asarray(quats, np.float64)
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    unit = np.where(norms > 0, quats / np.where(norms > 0, norms, 1.0), [1.0, 0.0, 0.0, 0.0])
    positive: np.ndarray = unit * np.where(unit[:, :1] < 0, -1.0, 1.0)
    return positive


def with_w(xyz: np.ndarray) -> np.ndarray:
    """Return unit quaternions [n, 4] from their last three numbers [3, n]; w is not negative."""
    squares = np.minimum(np.sum(xyz**2, axis=0), 1.0)
    quats = np.concatenate([np.sqrt(1.0 - squares)[None], xyz]).T
    units: np.ndarray = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
    return units
