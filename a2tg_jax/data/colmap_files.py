"""Files of a COLMAP model, binary and text. They are read without pycolmap, which never looks for the end of a file.

What is in them, with the binary format (little-endian, after a uint64 count of the records):

    cameras   id, model, width and height, parameters: uint32, int32, 2 uint64, float64 as the model has them
    images    id, pose from world to camera, camera, name, features: uint32, 7 float64, uint32, bytes up to a zero,
              uint64 count of (2 float64, uint64 id of the observed point)
    points3D  id, position, colour, error, track: uint64, 3 float64, 3 bytes, float64, uint64 count of 2 uint32

A pose is a quaternion (w, x, y, z) and a translation. Text files have the same in words, a record a line, and images
their features in a second line. References to records that do not exist are ignored, so that an image can be removed
from its file alone.
"""

import functools
import mmap
import os
import re
import struct
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from a2tg_jax.base.regular_files import open_regular
from a2tg_jax.base.text import shortened
from a2tg_jax.data.colmap_cameras import BY_NAME, MODELS, CameraModel, ColmapCamera

KINDS = ("cameras", "images", "points3D")
"""Names of the files that are read, without suffix. A model has cameras and images."""
POINT = np.dtype([("id", "<u8"), ("position", "<f8", 3), ("color", "u1", 3), ("error", "<f8")])
LONGEST_NAME = 4096
LONGEST_LINE = 1 << 26
"""Longest line in bytes. The points of an image with a million features take half of that."""
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
ANNOUNCED = re.compile(rb"# Number of \w+: (\d{1,18})\b")
"""COLMAP's comment on the number of lines, or of pairs of lines for images."""


class ImageRecord(NamedTuple):
    """Registered photograph."""

    id: int
    pose: list[float]
    """Quaternion and translation from world to camera."""
    camera_id: int
    name: str


def num_images(path: Path) -> int:
    """Return the number of images that a binary file announces, or that a text file has, without reading them."""
    with open_regular(path) as opened:
        if path.suffix.lower() == ".bin":
            return int.from_bytes(opened.read(8), "little")
        lines = _lines(opened, path)
        # The next line, if there is one, has the image's features.
        return sum(1 for _, line in lines if _has_record(line) and next(lines, True))


def read_file(path: Path, kind: str) -> Any:
    """Return the records of a binary or text file of a kind in `KINDS`: a list, or of points3D an array [P] of `POINT`.

    Binary files must end where their counts say, and lines of text have the right number of words. Text files that
    other programs write are read as well: with a byte order mark, without the last empty line, with spaces in names, or
    whole numbers such as 96.0. Warn if the count in a comment is another: the file may be truncated, but other programs
    copy comments.

    Raises:
      ValueError: naming the file, and the record or the line that cannot be read.
    """
    with open_regular(path) as opened:
        if path.suffix.lower() != ".bin":
            return _read_text(opened, path, kind)
        if os.fstat(opened.fileno()).st_size == 0:  # mmap rejects empty files.
            return _read_binary(path, b"", kind)
        with mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _read_binary(path, data, kind)


def _decoded_name(path: Path, name: bytes) -> str:
    try:
        return name.decode()
    except UnicodeDecodeError:
        shown = shortened(name.decode(errors="backslashreplace"))
        raise ValueError(
            f"{path}: the image name {shown} is not UTF-8; rename the photograph, and export the model again"
        ) from None


@functools.cache
def _little_endian(format: str) -> struct.Struct:
    return struct.Struct(f"<{format}")


class _Bytes:
    """What is in a binary file, in order. Reading never passes its end."""

    def __init__(self, path: Path, data: mmap.mmap | bytes):
        self.path = path
        self.data = data
        self.at = 0
        self.place = "the count"
        """Part of the file that is being read, for messages."""

    def error(self, what: str) -> ValueError:
        return ValueError(f"{self.path}: is cut off or damaged: {self.place} {what}; export the model again")

    def skip(self, num_bytes: int) -> int:
        """Return the position from before."""
        start = self.at
        left = len(self.data) - start
        if num_bytes > left:
            raise self.error(f"needs {num_bytes} bytes at byte {start}, and {left} are left")
        self.at += num_bytes
        return start

    def take(self, format: str) -> tuple[Any, ...]:
        numbers = _little_endian(format)
        return numbers.unpack_from(self.data, self.skip(numbers.size))

    def whole(self, format: str = "I") -> int:
        (number,) = self.take(format)
        return int(number)

    def floats(self, count: int) -> list[float]:
        return list(self.take(f"{count}d"))

    def model(self) -> CameraModel:
        number = self.whole("i")
        if number not in MODELS:
            raise self.error(f"has the camera model {number}, which is none of COLMAP's")
        return MODELS[number]

    def params(self, model: CameraModel) -> list[float]:
        return self.floats(model.num_params)

    def name(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + LONGEST_NAME)
        if end < 0:
            raise self.error("has a name that does not end")
        return _decoded_name(self.path, self.data[self.skip(end + 1 - self.at) : end])

    def skip_features(self) -> None:
        self.skip(24 * self.whole("Q"))

    def point(self) -> bytes:
        start = self.skip(POINT.itemsize)
        point = self.data[start : self.at]
        self.skip(8 * self.whole("Q"))  # The track, which is not needed.
        return point


class _Words:
    """What is in a line of a text file, in order; of images also the line of features after it."""

    def __init__(self, path: Path, line: bytes, features: bytes):
        self.path = path
        self.line = line
        self.features = features
        self.words = iter(line.split())

    def whole(self, format: str = "") -> int:
        """Return a whole number of at least 0, which may be written like 96.0."""
        word = next(self.words)
        number = int(word) if word.isdigit() else float(word)  # A float would round ids above 2^53.
        if not 0 <= number < 1 << 64 or number != int(number):  # NaN fails as well.
            raise ValueError(f"{shortened(word.decode(errors='replace'))} is not a whole number of at least 0")
        return int(number)

    def floats(self, count: int) -> list[float]:
        return [float(next(self.words)) for _ in range(count)]

    def model(self) -> CameraModel:
        name = next(self.words).decode("ascii", "replace")
        if name not in BY_NAME:
            raise ValueError(f"COLMAP has no camera model {shortened(name)}")
        return BY_NAME[name]

    def params(self, model: CameraModel) -> list[float]:
        params = [float(word) for word in self.words]
        if len(params) != model.num_params:
            raise ValueError(f"{model.name} has {model.num_params} parameters; got {len(params)}")
        return params

    def name(self) -> str:
        next(self.words)
        self.words = iter(())  # The name is the rest of the line, which may have spaces.
        return _decoded_name(self.path, self.line.split(None, 9)[9].strip())

    def skip_features(self) -> None:
        # Each feature has x, y and the id of its point, or -1. If the line is missing, this is the next image's, which
        # ends with a name.
        triples = self.features.split()
        ids = triples[2:3] + triples[-1:]
        if len(triples) % 3 or not all(re.fullmatch(rb"-1|\d+(\.0*)?", word) for word in ids):
            raise ValueError("the line of its points is missing or cut off")

    def point(self) -> tuple[int, list[float], list[int], float]:
        number = self.whole()
        position = self.floats(3)
        color = [min(max(round(value), 0), 255) for value in self.floats(3)]
        (error,) = self.floats(1)
        if len(list(self.words)) % 2:
            raise ValueError("the track of a point must be pairs")
        return number, position, color, error


Source = _Bytes | _Words


def _camera(source: Source) -> tuple[int, ColmapCamera]:
    number = source.whole()
    model = source.model()
    width = source.whole("Q")
    height = source.whole("Q")
    return number, ColmapCamera(model.name, width, height, tuple(source.params(model)))


def _image(source: Source) -> ImageRecord:
    image = ImageRecord(source.whole(), source.floats(7), source.whole(), source.name())
    source.skip_features()
    return image


RECORDS: dict[str, Callable[[Source], Any]] = {
    "cameras": _camera,
    "images": _image,
    "points3D": lambda source: source.point(),
}


def _read_binary(path: Path, data: mmap.mmap | bytes, kind: str) -> Any:
    source = _Bytes(path, data)
    num = source.whole("Q")
    records = []
    for number in range(1, num + 1):
        source.place = f"number {number} of {num} {kind}"
        records.append(RECORDS[kind](source))
    left = len(data) - source.at
    if left:
        raise source.error(f"is followed by {left} bytes")
    return np.frombuffer(b"".join(records), POINT) if kind == "points3D" else records


def _read_text(file: BinaryIO, path: Path, kind: str) -> Any:
    announced: int | None = None
    records = []
    lines = _lines(file, path)
    for number, line in lines:
        comment = ANNOUNCED.match(line)
        if comment is not None:
            announced = int(comment[1])
        if not _has_record(line):
            continue
        try:
            _, features = next(lines, (0, b"")) if kind == "images" else (0, b"")
            source = _Words(path, line, features)
            records.append(RECORDS[kind](source))
            if next(source.words, None) is not None:
                raise ValueError("it continues past its end")
        except (ValueError, OverflowError, StopIteration) as error:
            if str(error).startswith(str(path)):  # It names the file already.
                raise
            reason = "it is cut off" if isinstance(error, StopIteration) else shortened(str(error))
            raise ValueError(f"{path}: line {number} cannot be read ({reason}); export the model again") from None
    if announced not in (None, len(records)):
        message = f"{path}: says that it has {announced} {kind}, and has {len(records)}: if it is cut off, export it"
        warnings.warn(f"{message} again", stacklevel=3)
    return np.array(records, POINT) if kind == "points3D" else records


def _has_record(line: bytes) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith(b"#")


def _lines(file: BinaryIO, path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the lines of a file with their numbers from 1, each of bounded length."""
    # One byte more shows that a line is too long.
    for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE + 1), b""), 1):
        if len(line) > LONGEST_LINE:
            raise ValueError(f"{path}: has a line of more than {LONGEST_LINE:,} bytes; export the model again")
        yield number, line.removeprefix(BYTE_ORDER_MARK) if number == 1 else line
