"""Lossless coders of byte planes, from established libraries, with a bound on what they unpack.

A plane is a column of numbers of one byte each; C planes of n bytes are coded together, one after the other.
Nothing is allocated for more bytes than the caller says there are, whatever the coded bytes claim.
"""

import io
import lzma
import math
from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

import numpy as np
import zstandard
from PIL import Image

Coder = Literal["lzma", "zstd", "webp", "none"]
Choice = Literal["smallest", "lzma", "zstd", "webp", "none"]
"""Name of a coder, or "smallest" for the one with fewest bytes."""
ZSTD_LEVEL = 19
LZMA_FILTERS = [
    {"id": lzma.FILTER_LZMA1, "preset": 9 | lzma.PRESET_EXTREME, "lc": 0, "lp": 0, "pb": 0, "dict_size": 1 << 20}
]
"""Filters for LZMA: one adaptive model without contexts, because planes are noise around few values."""
WEBP_CHANNELS = 3
LONGEST_WEBP_SIDE = 16_383


class CodedError(ValueError):
    """Error for bytes that no coder wrote."""


def encode_smallest(planes: np.ndarray) -> tuple[Coder, bytes]:
    """Return the coder that makes least of planes [C, n], and what it makes."""
    fitting: list[Coder] = ["lzma", "zstd", "none"]
    if max(_webp_sides(*planes.shape)) <= LONGEST_WEBP_SIDE:
        fitting.append("webp")
    coded = {coder: encode(coder, planes) for coder in fitting}
    return min(coded.items(), key=lambda pair: len(pair[1]))


def encode(coder: Coder, planes: np.ndarray) -> bytes:
    """Code planes [C, n] of uint8; no planes give no bytes."""
    return CODERS[coder].encode(np.ascontiguousarray(planes)) if planes.size else b""


def decode(coder: str, data: bytes, num_planes: int, length: int) -> np.ndarray:
    """Return the planes [num_planes, length] of uint8 that `encode` was given.

    Raises:
      CodedError: if the bytes are damaged, or hold more or less than that.
    """
    if num_planes * length == 0:
        if data:
            raise CodedError("holds bytes where there should be none")
        return np.zeros((num_planes, length), np.uint8)
    try:
        planes = CODERS[coder].decode(data, num_planes, length)
    except Exception as error:  # Each library has errors of its own, and Pillow's differ by what is wrong.
        raise CodedError(f"is not what {coder} wrote ({error})") from error
    if planes.size != num_planes * length:
        raise CodedError(f"holds {planes.size} bytes; {num_planes * length} were announced")
    return planes.reshape(num_planes, length)


def _encode_zstd(planes: np.ndarray) -> bytes:
    """Return one frame; a plane begins a block of its own, with tables of its own."""
    stream = zstandard.ZstdCompressor(level=ZSTD_LEVEL).compressobj(size=planes.size)
    pieces = [stream.compress(plane.tobytes()) + stream.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK) for plane in planes]
    return b"".join([*pieces, stream.flush()])


def _decode_zstd(data: bytes, num_planes: int, length: int) -> np.ndarray:
    size = zstandard.get_frame_parameters(data).content_size
    if size != num_planes * length:  # The library would allocate what the frame says.
        raise ValueError(f"its frame is of {size} bytes")
    return np.frombuffer(zstandard.ZstdDecompressor().decompress(data, allow_extra_data=False), np.uint8)


def _encode_lzma(planes: np.ndarray) -> bytes:
    return lzma.compress(planes.tobytes(), format=lzma.FORMAT_RAW, filters=LZMA_FILTERS)


def _decode_lzma(data: bytes, num_planes: int, length: int) -> np.ndarray:
    stream = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=LZMA_FILTERS)
    found = stream.decompress(data, num_planes * length + 1)
    if not stream.eof or stream.unused_data:
        raise ValueError("it does not end where it should")
    return np.frombuffer(found, np.uint8)


def _webp_sides(num_planes: int, length: int) -> tuple[int, int]:
    """Return the height and width of the whole image."""
    num, height, width = _webp_shape(num_planes, length)
    return num * height, width


def _webp_shape(num_planes: int, length: int) -> tuple[int, int, int]:
    """Return the number of stacked images, and the height and width of one: a square for three planes."""
    width = math.isqrt(max(length - 1, 0)) + 1
    return -(-num_planes // WEBP_CHANNELS), -(-length // width), width


def _encode_webp(planes: np.ndarray) -> bytes:
    """Code three planes as the channels of an image, row by row."""
    num, height, width = _webp_shape(*planes.shape)
    if max(_webp_sides(*planes.shape)) > LONGEST_WEBP_SIDE:
        raise ValueError(f"coder: {planes.size} bytes are more than an image of WebP holds; choose another")
    pixels = np.zeros((num * WEBP_CHANNELS, height * width), np.uint8)
    pixels[: len(planes), : planes.shape[1]] = planes
    image = pixels.reshape(num, WEBP_CHANNELS, height * width).transpose(0, 2, 1).reshape(num * height, width, -1)
    file = io.BytesIO()
    Image.fromarray(image).save(file, "WEBP", lossless=True, quality=75, method=4, exact=True)
    return file.getvalue()


def _decode_webp(data: bytes, num_planes: int, length: int) -> np.ndarray:
    num, height, width = _webp_shape(num_planes, length)
    with Image.open(io.BytesIO(data), formats=["WEBP"]) as image:
        if image.size != (width, num * height):
            raise ValueError(f"its image is of {image.size} pixels")
        pixels = np.asarray(image.convert("RGB"))
    planes = pixels.reshape(num, height * width, WEBP_CHANNELS).transpose(0, 2, 1).reshape(-1, height * width)
    return planes[:num_planes, :length]


class _Functions(NamedTuple):
    encode: Callable[[np.ndarray], bytes]
    decode: Callable[[bytes, int, int], np.ndarray]


CODERS: Mapping[str, _Functions] = {
    "lzma": _Functions(_encode_lzma, _decode_lzma),
    "zstd": _Functions(_encode_zstd, _decode_zstd),
    "webp": _Functions(_encode_webp, _decode_webp),
    "none": _Functions(np.ndarray.tobytes, lambda data, num_planes, length: np.frombuffer(data, np.uint8)),
}
