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

import mmap
import os
import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from a2tg_jax.base.regular_files import open_regular
from a2tg_jax.base.text import shortened
from a2tg_jax.base.user_warnings import warn
from a2tg_jax.data.colmap_cameras import BY_NAME, MODELS, ColmapCamera

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


# Binary files


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
        """Return numbers, which are little-endian."""
        format = f"<{format}"
        return struct.unpack_from(format, self.data, self.skip(struct.calcsize(format)))


def _camera_of_bytes(source: _Bytes) -> tuple[int, ColmapCamera]:
    number, model_number, width, height = source.take("IiQQ")
    if model_number not in MODELS:
        raise source.error(f"has the camera model {model_number}, which is none of COLMAP's")
    model = MODELS[model_number]
    return number, ColmapCamera(model.name, width, height, source.take(f"{model.num_params}d"))


def _image_of_bytes(source: _Bytes) -> ImageRecord:
    number, *pose, camera_id = source.take("I7dI")
    end = source.data.find(b"\0", source.at, source.at + LONGEST_NAME)
    if end < 0:
        raise source.error("has a name that does not end")
    name = _decoded_name(source.path, source.data[source.skip(end + 1 - source.at) : end])
    (num_features,) = source.take("Q")
    source.skip(24 * num_features)
    return ImageRecord(number, pose, camera_id, name)


def _point_of_bytes(source: _Bytes) -> bytes:
    start = source.skip(POINT.itemsize)
    point = source.data[start : source.at]
    (num_observations,) = source.take("Q")
    source.skip(8 * num_observations)
    return point


OF_BYTES: dict[str, Callable[[_Bytes], Any]] = {
    "cameras": _camera_of_bytes, "images": _image_of_bytes, "points3D": _point_of_bytes,
}  # fmt: skip


def _read_binary(path: Path, data: mmap.mmap | bytes, kind: str) -> Any:
    source = _Bytes(path, data)
    (num,) = source.take("Q")
    records = []
    for number in range(1, num + 1):
        source.place = f"number {number} of {num} {kind}"
        records.append(OF_BYTES[kind](source))
    left = len(data) - source.at
    if left:
        raise source.error(f"is followed by {left} bytes")
    return np.frombuffer(b"".join(records), POINT) if kind == "points3D" else records


# Text files


def _words(line: bytes, least: int) -> list[bytes]:
    words = line.split()
    if len(words) < least:
        raise ValueError("it is cut off")
    return words


def _whole(word: bytes) -> int:
    """Return a whole number of at least 0, which may be written like 96.0."""
    number = int(word) if word.isdigit() else float(word)  # A float would round ids above 2^53.
    if not 0 <= number < 1 << 64 or number != int(number):  # NaN fails as well.
        raise ValueError(f"{shortened(word.decode(errors='replace'))} is not a whole number of at least 0")
    return int(number)


def _camera_of_line(path: Path, line: bytes, _: bytes) -> tuple[int, ColmapCamera]:
    number, model, width, height, *params = _words(line, 4)
    name = model.decode("ascii", "replace")
    if name not in BY_NAME:
        raise ValueError(f"COLMAP has no camera model {shortened(name)}")
    if len(params) != BY_NAME[name].num_params:
        raise ValueError(f"{name} has {BY_NAME[name].num_params} parameters; got {len(params)}")
    return _whole(number), ColmapCamera(name, _whole(width), _whole(height), tuple(map(float, params)))


def _image_of_line(path: Path, line: bytes, features: bytes) -> ImageRecord:
    number, *numbers, camera_id = _words(line, 10)[:9]
    # The name is the rest of the line, which may have spaces.
    name = _decoded_name(path, line.split(None, 9)[9].strip())
    # Each feature has x, y and the id of its point, or -1. If the line is missing, this is the next image's, which
    # ends with a name.
    triples = features.split()
    ids = triples[2:3] + triples[-1:]
    if len(triples) % 3 or not all(re.fullmatch(rb"-1|\d+(\.0*)?", word) for word in ids):
        raise ValueError("the line of its points is missing or cut off")
    return ImageRecord(_whole(number), [float(word) for word in numbers], _whole(camera_id), name)


def _point_of_line(path: Path, line: bytes, _: bytes) -> tuple[int, list[float], list[int], float]:
    number, *numbers = _words(line, 8)
    *position, red, green, blue, error = map(float, numbers[:7])
    if len(numbers[7:]) % 2:
        raise ValueError("the track of a point must be pairs")
    color = [min(max(round(value), 0), 255) for value in (red, green, blue)]
    return _whole(number), position, color, error


OF_LINE: dict[str, Callable[[Path, bytes, bytes], Any]] = {
    "cameras": _camera_of_line, "images": _image_of_line, "points3D": _point_of_line,
}  # fmt: skip


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
            records.append(OF_LINE[kind](path, line, features))
        except (ValueError, OverflowError) as error:
            if str(error).startswith(str(path)):  # It names the file already.
                raise
            raise ValueError(
                f"{path}: line {number} cannot be read ({shortened(str(error))}); export the model again"
            ) from None
    if announced not in (None, len(records)):
        warn(f"{path}: says that it has {announced} {kind}, and has {len(records)}: if it is cut off, export it again")
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
