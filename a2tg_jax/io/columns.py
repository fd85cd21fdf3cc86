"""Columns of numbers as small integers and compressed bytes, and back.

Numbers are rounded to even steps between two ends, and positions become places along a Z curve. The numbers of these
steps are split into planes of one byte each, which established libraries compress without loss. `ColumnReader` reads
the named columns of a `ColumnWriter`, and never unpacks more than its limit, whatever the bytes claim.

All arrays are numpy's, on the host; C columns of n numbers are [C, n]. A precision is a number of bits or a float type.
"""

import io
import lzma
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import zstandard
from PIL import Image

from a2tg_jax.appearance.parts import MOST_TANH
from a2tg_jax.base.json_text import number_array

Precision = int | Literal["float32", "float16"]
Choice = Literal["smallest", "lzma", "zstd", "webp", "deflate", "none"]
"""Name of a coder, or "smallest" for the one with fewest bytes. Browsers decode deflate and none."""
CODERS = ("lzma", "zstd", "deflate", "none", "webp")
# Codes of 16 bits fit two planes, and keys of three axes, 48 bits, an int64.
MOST_BITS = 16
MOST_LOG_EXPONENT = 1.5
"""Largest logarithm of an exponent that is read: half the coarsest step beyond the range."""
LEAST_OPACITY = 1e-7
ZSTD_LEVEL = 19  # Higher levels are zstd's "ultra", whose windows cost readers more memory.
LZMA_FILTERS = [
    {"id": lzma.FILTER_LZMA1, "preset": 9 | lzma.PRESET_EXTREME, "lc": 0, "lp": 0, "pb": 0, "dict_size": 1 << 20}
]
"""Filters for LZMA: one adaptive model without contexts, because planes are noise around few values."""
WEBP_CHANNELS = 3
LONGEST_WEBP_SIDE = 16_383  # 14 bits in WebP's header.


# Coders of byte planes


def encode(coder: str, planes: np.ndarray) -> bytes:
    """Code planes [C, n] of uint8; no planes give no bytes."""
    # Some coders write a header for nothing, and WebP has no empty images.
    if not planes.size or coder == "none":
        return planes.tobytes()
    if coder == "lzma":
        return lzma.compress(planes.tobytes(), format=lzma.FORMAT_RAW, filters=LZMA_FILTERS)
    if coder == "deflate":
        return zlib.compress(planes.tobytes(), 9)
    if coder == "zstd":  # In one frame, each plane begins a block, which has its own tables.
        stream = zstandard.ZstdCompressor(level=ZSTD_LEVEL).compressobj(size=planes.size)
        pieces = [stream.compress(row.tobytes()) + stream.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK) for row in planes]
        return b"".join([*pieces, stream.flush()])
    num, height, width = _webp_shape(*planes.shape)
    if max(num * height, width) > LONGEST_WEBP_SIDE:
        raise ValueError(f"coder: {planes.size} bytes are more than an image of WebP holds; choose another")
    # Lossless WebP predicts pixels from neighbours in rows and columns, so an image is about square.
    pixels = np.zeros((num * WEBP_CHANNELS, height * width), np.uint8)
    pixels[: len(planes), : planes.shape[1]] = planes
    image = pixels.reshape(num, WEBP_CHANNELS, height * width).transpose(0, 2, 1).reshape(num * height, width, -1)
    file = io.BytesIO()
    Image.fromarray(image).save(file, "WEBP", lossless=True, quality=75, method=4, exact=True)
    return file.getvalue()


def decode(coder: str, data: bytes, num_planes: int, length: int) -> np.ndarray:
    """Return the planes [num_planes, length] of uint8 that `encode` was given. ValueError: the bytes are damaged, or
    of another length."""
    size = num_planes * length
    # `encode` wrote no bytes for these.
    if size == 0:
        if data:
            raise ValueError("holds bytes where there should be none")
        return np.zeros((num_planes, length), np.uint8)
    try:
        planes = _decoded(coder, data, num_planes, length)
    except Exception as error:  # Each library raises its own errors, and Pillow's differ by what is wrong.
        raise ValueError(f"is not what {coder} wrote ({error})") from error
    if planes.size != size:
        raise ValueError(f"holds {planes.size} bytes; {size} were announced")
    return planes.reshape(num_planes, length)


def _decoded(coder: str, data: bytes, num_planes: int, length: int) -> np.ndarray:
    size = num_planes * length
    if coder == "none":
        return np.frombuffer(data, np.uint8)
    if coder in ("lzma", "deflate"):
        stream: Any = zlib.decompressobj()
        if coder == "lzma":
            stream = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=LZMA_FILTERS)
        decoded = stream.decompress(data, size + 1)  # One more byte reveals excess data.
        if not stream.eof or stream.unused_data:
            raise ValueError("it does not end where it should")
        return np.frombuffer(decoded, np.uint8)
    if coder == "zstd":
        return np.frombuffer(unzstd(data, size), np.uint8)
    num, height, width = _webp_shape(num_planes, length)
    with Image.open(io.BytesIO(data), formats=["WEBP"]) as image:
        # Before any pixel is decoded: the header alone decides how much Pillow allocates.
        if image.size != (width, num * height):
            raise ValueError(f"its image has {image.size} pixels")
        pixels = np.asarray(image.convert("RGB"))
    planes = pixels.reshape(num, height * width, WEBP_CHANNELS).transpose(0, 2, 1).reshape(-1, height * width)
    # The last image is padded to three channels, and each plane to a whole rectangle.
    return planes[:num_planes, :length]


def unzstd(data: bytes, size: int) -> bytes:
    """Return the bytes of a zstd frame. ValueError: it is damaged, or of another size."""
    try:
        announced = zstandard.get_frame_parameters(data).content_size
        # The library allocates what the frame announces.
        if announced not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise ValueError(f"its frame announces {announced:,} bytes")
        unpacked: bytes = zstandard.ZstdDecompressor().decompress(data, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from error
    if len(unpacked) != size:
        raise ValueError(f"it unpacks to {len(unpacked):,} bytes; {size:,} were announced")
    return unpacked


def _webp_shape(num_planes: int, length: int) -> tuple[int, int, int]:
    """Return the number of stacked images, and the height and width of one: a square for three planes as channels."""
    width = math.isqrt(max(length - 1, 0)) + 1
    return -(-num_planes // WEBP_CHANNELS), -(-length // width), width


# Numbers as steps


class Ends(NamedTuple):
    """Ends of a range: the first and the last step."""

    low: float
    high: float


def ends_of(values: np.ndarray, bits: int) -> Ends:
    """Return the smallest and the largest of all numbers; 0 and 0 without numbers.

    If 0 is between them, they are moved apart, by a step in total, so that 0 is a step: residuals are mostly near 0.
    """
    if not values.size:
        return Ends(0.0, 0.0)
    low = float(values.min())
    high = float(values.max())
    if low < 0 < high and bits > 1:
        # One step fewer leaves room for moving the ends, so that no number is cut.
        step = (high - low) / ((1 << bits) - 2)
        low = -math.ceil(-low / step) * step
        high = low + step * ((1 << bits) - 1)
    # Ends are JSON in the header: short decimals, from which each reader gets the same float32.
    return Ends(_short(low), _short(high))


def _short(value: Any) -> float:
    """Return the float with the fewest digits that rounds to the same float32."""
    return float(str(np.float32(value)))


def quantised(values: np.ndarray, ends: Ends, bits: int) -> np.ndarray:
    """Return the nearest of 2^bits even steps between the ends, as int64; all 0 if both ends are equal."""
    low, high = ends
    # A group of equal numbers has no step to divide by.
    if high <= low:
        return np.zeros(values.shape, np.int64)
    steps = (1 << bits) - 1
    shares = (np.asarray(values, np.float64) - low) / (high - low)
    return np.rint(np.clip(shares, 0.0, 1.0) * steps).astype(np.int64)


def dequantised(codes: np.ndarray, ends: Ends, bits: int) -> np.ndarray:
    """Return the values of steps, float64: off by half a step at most, (high − low) / (2^bits − 1) / 2."""
    low, high = ends
    return low + codes * ((high - low) / ((1 << bits) - 1))


def with_green(codes: np.ndarray, bits: int, sign: int = 1) -> np.ndarray:
    """Return codes [3, n] as red + green, green, blue + green, modulo the range of their bytes; `sign` -1 undoes it.

    Colours are stored as differences from green, which are near 0.
    """
    red, green, blue = codes
    mask = (1 << 8 * num_bytes_of(bits)) - 1
    return np.stack([(red + sign * green) & mask, green, (blue + sign * green) & mask])


def opacities_of(logits: np.ndarray) -> np.ndarray:
    """Return the opacities of logits, float64."""
    # Clipped so that exp cannot overflow; opacities of logits beyond ±80 are 0 or 1 for any purpose.
    return 1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -80, 80)))


def logits_of(opacities: np.ndarray) -> np.ndarray:
    """Return the finite logits of opacities, float64."""
    # Bits may round an opacity to exactly 0 or 1, whose logit is infinite.
    inside = np.clip(opacities.astype(np.float64), LEAST_OPACITY, 1 - LEAST_OPACITY)
    return np.log(inside) - np.log1p(-inside)


def log_exponents_of(shapes: np.ndarray) -> np.ndarray:
    """Return the logarithms of the exponents of kernels' shapes, within ±1, float64."""
    return np.tanh(np.asarray(shapes, np.float64))


def checked_shapes(log_exponents: np.ndarray) -> np.ndarray:
    """Return the shapes of kernels of logarithms of exponents, float64. Logarithms that rounding has moved beyond ±1
    are cut to ±1; ValueError: one is NaN or farther out than rounding moves it."""
    logarithms = np.asarray(log_exponents, np.float64)
    if not (np.abs(logarithms) <= MOST_LOG_EXPONENT).all():
        raise ValueError("the logarithms of the exponents of kernels must be within ±1")
    return np.arctanh(np.clip(logarithms, -MOST_TANH, MOST_TANH))


def with_w(xyz: np.ndarray) -> np.ndarray:
    """Return unit quaternions [n, 4] from their last three numbers [3, n]; w is not negative."""
    # Rounding may push x² + y² + z² above 1.
    squares = np.minimum(np.sum(xyz**2, axis=0), 1.0)
    quats = np.concatenate([np.sqrt(1.0 - squares)[None], xyz]).T
    return quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)


# Positions


class AxisSteps(NamedTuple):
    """Even steps of asinh((x − centre) / spread), which grow with the distance, so that far positions cost few bits."""

    centre: float
    spread: float
    low: float
    high: float

    @staticmethod
    def of(x: np.ndarray, bits: int) -> "AxisSteps":
        """Return the steps of the numbers [n] of one axis; three quarters of them are within the spread."""
        # Median and quartile: a few splats far in the background must not stretch the steps.
        centre = _short(np.median(x)) if x.size else 0.0
        spread = _short(np.quantile(np.abs(x - centre), 0.75)) if x.size else 0.0
        # A spread of 0 (most positions equal) would divide by 0.
        steps = AxisSteps(centre, spread if spread > 0 else 1.0, 0.0, 0.0)
        low, high = ends_of(steps.contracted(x), bits)
        return steps._replace(low=low, high=high)

    def contracted(self, x: np.ndarray) -> np.ndarray:
        return np.arcsinh((np.asarray(x, np.float64) - self.centre) / self.spread)

    def codes(self, x: np.ndarray, bits: int) -> np.ndarray:
        """Return the nearest steps, as int64."""
        return quantised(self.contracted(x), Ends(self.low, self.high), bits)

    def values(self, codes: np.ndarray, bits: int) -> np.ndarray:
        """Return the numbers of steps, float64."""
        return self.centre + self.spread * np.sinh(dequantised(codes, Ends(self.low, self.high), bits))


def morton(codes: np.ndarray, bits: int) -> np.ndarray:
    """Return [n] places along the Z curve of codes [3, n]: their bits interleaved, x lowest; int64."""
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


# Byte planes


def num_bytes_of(bits: int) -> int:
    """Return the number of whole bytes that hold this number of bits."""
    return -(-bits // 8)


def to_byte_planes(values: np.ndarray) -> np.ndarray:
    """Return uint8 [C·itemsize, n]: the lowest bytes of numbers [C, n] of any type, column by column, then the next."""
    # Little-endian on any machine: the lowest byte comes first in the file.
    values = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    num_columns, length = values.shape
    # High bytes of neighbours are alike, low ones are noise: apart, they compress better.
    by_byte = values.view(np.uint8).reshape(num_columns, length, values.dtype.itemsize)
    return by_byte.transpose(2, 0, 1).reshape(values.dtype.itemsize * num_columns, length)


def from_byte_planes(planes: np.ndarray, num_columns: int, dtype: np.dtype) -> np.ndarray:
    """Return the numbers [num_columns, n] that `to_byte_planes` was given."""
    dtype = np.dtype(dtype).newbyteorder("<")
    by_byte = planes.reshape(dtype.itemsize, num_columns, planes.shape[1]).transpose(1, 2, 0)
    return np.ascontiguousarray(by_byte).view(dtype)[..., 0]


def to_planes(codes: np.ndarray, bits: int) -> np.ndarray:
    """Return uint8 [C·bytes, n]: codes [C, n] as `to_byte_planes`, without the bytes that these bits leave empty."""
    codes = np.atleast_2d(codes).astype(np.int64)
    return to_byte_planes(codes)[: num_bytes_of(bits) * len(codes)]


def from_planes(planes: np.ndarray, num_columns: int) -> np.ndarray:
    """Return the codes [num_columns, n] that `to_planes` was given, as int64."""
    empty = np.zeros((8 * num_columns - len(planes), planes.shape[1]), np.uint8)
    return from_byte_planes(np.concatenate([planes, empty]), num_columns, np.dtype(np.int64))


# Named columns in one body


class ColumnWriter:
    """Collector of columns as byte planes, in sequence, which it codes when all are there.

    Args:
      ends: first and last step of each group kept in bits, for each axis of the means after centre and spread.
    """

    def __init__(self, ends: Mapping[str, Sequence[float]]):
        self.ends = ends
        self.num_unpacked = 0
        """Bytes before coding."""
        self._planes: list[tuple[str, np.ndarray]] = []

    def coded(self, choice: Choice) -> tuple[list[tuple[str, str, int]], bytes]:
        """Return name, coder and number of bytes of each part, and the coded bytes of all parts, in order."""
        parts = []
        pieces = []
        for name, planes in self._planes:
            num, height, width = _webp_shape(*planes.shape)
            # WebP, the last of CODERS, cannot hold large planes.
            tried: Sequence[str] = (choice,)
            if choice == "smallest":
                tried = CODERS if max(num * height, width) <= LONGEST_WEBP_SIDE else CODERS[:-1]
            coded = {coder: encode(coder, planes) for coder in tried}
            coder, piece = min(coded.items(), key=lambda pair: len(pair[1]))
            parts.append((name, coder, len(piece)))
            pieces.append(piece)
        return parts, b"".join(pieces)

    def planes(self, name: str, planes: np.ndarray) -> None:
        """Add uint8 [C, n]."""
        # A copy, because planes are often the lowest bytes of much larger numbers, which would stay in memory.
        self._planes.append((name, planes.copy()))
        self.num_unpacked += planes.size

    def exact(self, name: str, values: np.ndarray) -> None:
        """Add numbers of any shape and type exactly."""
        self.planes(name, to_byte_planes(values.reshape(1, -1)))

    def indices(self, name: str, indices: np.ndarray, count: int) -> None:
        """Add [n] integers below `count`; no bytes if there is one."""
        self.planes(name, to_planes(indices, max(count - 1, 0).bit_length()))

    def numbers(self, name: str, values: np.ndarray, precision: Precision, *, is_color: bool = False) -> None:
        """Add floats [C, n]; columns of colours are red, green, blue. ValueError: they overflow float16."""
        if not isinstance(precision, int):
            self.planes(name, to_byte_planes(_finite(name, np.asarray(values), precision)))
            return
        ends = Ends(*self.ends[name])
        # A constant needs no planes: its ends are enough.
        if ends.low == ends.high:
            self.planes(name, np.zeros((0, values.shape[1]), np.uint8))
            # Readers count these numbers against the room, although they have no bytes.
            self.num_unpacked += values.size
            return
        codes = quantised(values, ends, precision)
        self.planes(name, to_planes(with_green(codes, precision, -1) if is_color else codes, precision))

    def means(self, keys: np.ndarray, bits: int) -> None:
        """Add positions as places [n] along the Z curve, which ascend."""
        # Neighbours on the curve have keys that differ little: most high bytes of the differences are 0.
        self.planes("means", to_planes(np.diff(keys, prepend=0), 3 * bits))


class ColumnReader:
    """Reader of a `ColumnWriter`'s parts, in order for each name.

    Args:
      body: the coded bytes.
      parts: name, coder and number of bytes of each part, from `ColumnWriter.coded`.
      ends: `ColumnWriter.ends`.
      room: largest number of bytes to unpack.

    Raises:
      ValueError: if the lengths do not fit the body.
    """

    def __init__(self, body: bytes, parts: Iterable[Sequence[Any]], ends: Mapping[str, Any], room: int):
        self._ends_by_name = ends
        self._room = room
        self._parts: dict[str, list[tuple[str, bytes]]] = {}
        start = 0
        for name, coder, length in parts:
            # Not isinstance: JSON's true is an int in Python.
            if type(length) is not int or not 0 <= length <= len(body) - start:
                raise ValueError(f"its parts must have {len(body)} bytes in all; the part {name} has {length}")
            self._parts.setdefault(name, []).append((coder, body[start : start + length]))
            start += length
        if start != len(body):
            raise ValueError(f"its parts must have {len(body)} bytes in all; got {start}")

    def planes(self, name: str, num_planes: int, length: int) -> np.ndarray:
        """Read uint8 [num_planes, length]. ValueError: the part is missing or damaged, or there is no room left."""
        # Before decoding: what a header claims decides what the decoder allocates.
        self._take_room(name, num_planes * length)
        if not self._parts.get(name):
            raise ValueError(f"the part {name} is missing")
        coder, data = self._parts[name].pop(0)
        if coder not in CODERS:
            raise ValueError(f"the part {name} has the unknown coder {coder}")
        try:
            return decode(coder, data, num_planes, length)
        except ValueError as error:
            raise ValueError(f"the part {name} {error}") from error

    def _take_room(self, name: str, num_bytes: int) -> None:
        """Raise ValueError if these are more bytes than a file of this size may unpack to."""
        if num_bytes > self._room:
            raise ValueError(f"{name} would take {num_bytes} bytes, which the file is too small for")
        self._room -= num_bytes

    def end(self) -> None:
        """Raise ValueError unless all parts were read."""
        for name, parts in self._parts.items():
            if parts:
                raise ValueError(f"the part {name} is unknown")

    def exact(self, name: str, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        planes = self.planes(name, np.dtype(dtype).itemsize, math.prod(shape))
        return from_byte_planes(planes, 1, dtype).reshape(shape).astype(dtype)

    def indices(self, name: str, length: int, count: int) -> np.ndarray:
        if count == 0 and length:
            raise ValueError(f"{name} refer to an empty table")
        self._take_room(name, length)  # A table of one row has no bytes, but its indices take memory.
        num_planes = num_bytes_of(max(count - 1, 0).bit_length())
        indices: np.ndarray = from_planes(self.planes(name, num_planes, length), 1)[0]
        if length and indices.max() >= count:
            raise ValueError(f"{name} must be below {count}; got {indices.max()}")
        return indices

    def numbers(
        self, name: str, num_columns: int, length: int, precision: Precision, *, is_color: bool = False
    ) -> np.ndarray:
        """Read float32 [num_columns, length]."""
        if not isinstance(precision, int):
            dtype = np.dtype(precision)
            planes = self.planes(name, num_columns * dtype.itemsize, length)
            return _finite(name, from_byte_planes(planes, num_columns, dtype))
        ends = Ends(*self._ends(name, 2))
        if ends.low == ends.high:  # No bytes, but the numbers take memory.
            self._take_room(name, num_columns * length)
            self.planes(name, 0, length)
            return np.full((num_columns, length), ends.low, np.float32)
        codes = from_planes(self.planes(name, num_columns * num_bytes_of(precision), length), num_columns)
        codes = with_green(codes, precision) if is_color else codes
        return _finite(name, dequantised(codes, ends, precision))

    def means(self, length: int, precision: Precision) -> np.ndarray:
        """Read float32 [3, length]."""
        if not isinstance(precision, int):
            return self.numbers("means", 3, length, precision)
        # Per axis centre, spread, low and high, as `ColumnWriter.means` wrote them.
        known = np.reshape(self._ends("means", 12), (3, 4)).tolist()
        planes = self.planes("means", num_bytes_of(3 * precision), length)
        # sinh overflows for ends that a damaged file claims; `_finite` reports this.
        with np.errstate(over="ignore"):
            codes = from_morton(np.cumsum(from_planes(planes, 1)[0]), precision)
            axes = [AxisSteps(*steps).values(axis, precision) for axis, steps in zip(codes, known, strict=True)]
        return _finite("means", np.stack(axes))

    def _ends(self, name: str, count: int) -> list[float]:
        return number_array(self._ends_by_name[name], count, f"the ends of {name}").tolist()


def _finite(name: str, values: np.ndarray, dtype: Any = np.float32) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):
        values = values.astype(dtype)
    if not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite as {np.dtype(dtype)}; some are not")
    return values
