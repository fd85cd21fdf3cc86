"""Files of a COLMAP model, binary and text. They are read without pycolmap, which never looks for the end of a file.

What is in them, with the binary format (little-endian, after a uint64 count of the records):

    cameras   id, model, width and height, parameters: uint32, int32, 2 uint64, float64 as the model has them
    images    id, pose from world to camera, camera, name, features: uint32, 7 float64, uint32, bytes up to a zero,
              uint64 count of (2 float64, uint64 id of the observed point)
    points3D  id, position, colour, error, track: uint64, 3 float64, 3 bytes, float64, uint64 count of 2 uint32
    rigs      id, sensors, the first of which is the reference: uint32, uint32 count of 8 bytes; after each but the
              first a byte, and if that is not 0, its pose from the rig (7 float64)
    frames    id, rig, pose, data: 2 uint32, 7 float64, uint32 count of (int32 kind of sensor, uint32, uint64 image)

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
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from a2tg_jax.data.colmap_cameras import BY_NAME, MODELS, ColmapCamera
from a2tg_jax.host.regular_files import open_regular
from a2tg_jax.host.text import shortened

KINDS = ("cameras", "images", "points3D", "rigs", "frames")
"""Names of a model's files without suffix. A model has cameras and images, and the others if it needs them."""
POINT = np.dtype([("id", "<u8"), ("position", "<f8", 3), ("color", "u1", 3), ("error", "<f8")])
LONGEST_NAME = 4096
CAMERA_SENSOR = 0
"""Kind of the sensors that take images."""
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


class RigRecord(NamedTuple):
    """Sensors that are fixed to each other."""

    id: int
    translations: list[list[float] | None]
    """Translations from the rig to each sensor but the first; None if it is unknown."""


class FrameRecord(NamedTuple):
    """Images that a rig took at one time."""

    id: int
    rig_id: int
    image_ids: list[int]


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
            return _Binary(path, b"").read(kind)
        with mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _Binary(path, data).read(kind)


def _decoded_name(path: Path, name: bytes) -> str:
    try:
        return name.decode()
    except UnicodeDecodeError:
        shown = shortened(name.decode(errors="backslashreplace"))
        raise ValueError(
            f"{path}: the image name {shown} is not UTF-8; rename the photograph, and export the model again"
        ) from None


_little_endian = functools.cache(lambda format: struct.Struct(f"<{format}"))


class _Binary:
    """Reader of a binary file that never passes its end. Methods named after kinds return one record."""

    def __init__(self, path: Path, data: mmap.mmap | bytes):
        self.path, self.data, self.at, self.place = path, data, 0, "the count"

    def read(self, kind: str) -> Any:
        """Return all records; of points3D an array [P] of `POINT`."""
        (num,) = self.take("Q")
        record, found = getattr(self, kind), list[Any]()
        for number in range(1, num + 1):
            self.place = f"number {number} of {num} {kind}"
            found.append(record())
        if left := len(self.data) - self.at:
            raise self.error(f"is followed by {left} bytes")
        return np.frombuffer(b"".join(found), POINT) if kind == "points3D" else found

    def error(self, what: str) -> ValueError:
        return ValueError(f"{self.path}: is cut off or damaged: {self.place} {what}; export the model again")

    def skip(self, num_bytes: int) -> int:
        """Return the position from before."""
        left = len(self.data) - self.at
        if num_bytes > left:
            raise self.error(f"needs {num_bytes} bytes at byte {self.at}, and {left} are left")
        self.at += num_bytes
        return self.at - num_bytes

    def take(self, format: str) -> tuple[Any, ...]:
        numbers = _little_endian(format)
        return numbers.unpack_from(self.data, self.skip(numbers.size))

    def cameras(self) -> tuple[int, ColmapCamera]:
        number, model = self.take("Ii")
        if model not in MODELS:
            raise self.error(f"has the camera model {model}, which is none of COLMAP's")
        width, height, *params = self.take(f"2Q{MODELS[model].num_params}d")
        return number, ColmapCamera(MODELS[model].name, width, height, tuple(params))

    def images(self) -> ImageRecord:
        number, *pose, camera = self.take("I7dI")
        end = self.data.find(b"\0", self.at, self.at + LONGEST_NAME)
        if end < 0:
            raise self.error("has a name that does not end")
        name = _decoded_name(self.path, self.data[self.skip(end + 1 - self.at) : end])
        self.skip(24 * self.take("Q")[0])  # The features, which are not needed.
        return ImageRecord(number, pose, camera, name)

    def points3D(self) -> bytes:
        start = self.skip(POINT.itemsize)
        point = self.data[start : self.at]
        self.skip(8 * self.take("Q")[0])  # The track, which is not needed.
        return point

    def rigs(self) -> RigRecord:
        number, count = self.take("II")
        translations: list[list[float] | None] = []
        for index in range(count):
            self.take("iI")
            if index:  # The first sensor, the reference, has no pose.
                translations.append(list(self.take("7d")[4:]) if self.take("B")[0] else None)
        return RigRecord(number, translations)

    def frames(self) -> FrameRecord:
        number, rig, *_, count = self.take("II7dI")
        data = [self.take("iIQ") for _ in range(count)]
        return FrameRecord(number, rig, [image for kind, _, image in data if kind == CAMERA_SENSOR])


def _whole(word: bytes) -> int:
    """Return a whole number of at least 0, which may be written like 96.0."""
    number = int(word) if word.isdigit() else float(word)  # A float would round ids above 2^53.
    if not 0 <= number < 1 << 64 or number != int(number):  # NaN fails as well.
        raise ValueError(f"{shortened(word.decode(errors='replace'))} is not a whole number of at least 0")
    return int(number)


def _text_record(kind: str, path: Path, line: bytes, features: bytes) -> Any:
    """Return the record in a line, and of images in the line of features after it."""
    words = iter(line.split())

    def whole() -> int:
        return _whole(next(words))

    def floats(count: int) -> list[float]:
        return [float(next(words)) for _ in range(count)]

    record: Any
    if kind == "cameras":
        number, name = whole(), next(words).decode("ascii", "replace")
        if name not in BY_NAME:
            raise ValueError(f"COLMAP has no camera model {shortened(name)}")
        width, height, params = whole(), whole(), tuple(float(word) for word in words)
        if len(params) != BY_NAME[name].num_params:
            raise ValueError(f"{name} has {BY_NAME[name].num_params} parameters; got {len(params)}")
        record = number, ColmapCamera(name, width, height, params)
    elif kind == "images":
        number, pose, camera, _ = whole(), floats(7), whole(), next(words)
        name = _decoded_name(path, line.split(None, 9)[9].strip())  # The rest of the line, which may have spaces.
        words = iter(())  # The name took the rest of the line.
        # Each feature has x, y and the id of its point, or -1. If the line is missing, this is the next image's, which
        # ends with a name.
        triples = features.split()
        if len(triples) % 3 or not all(re.fullmatch(rb"-1|\d+(\.0*)?", word) for word in triples[2:3] + triples[-1:]):
            raise ValueError("the line of its points is missing or cut off")
        record = ImageRecord(number, pose, camera, name)
    elif kind == "points3D":
        number, position, color, error = whole(), floats(3), floats(3), floats(1)[0]
        if len(list(words)) % 2:
            raise ValueError("the track of a point must be pairs")
        record = number, position, [min(max(round(value), 0), 255) for value in color], error
    elif kind == "rigs":
        translations: list[list[float] | None] = []
        number = whole()
        for index in range(whole()):
            _, _ = next(words), whole()
            if index:
                translations.append(floats(7)[4:] if whole() else None)
        record = RigRecord(number, translations)
    else:
        number, rig, _, count = whole(), whole(), floats(7), whole()
        data = [(next(words), whole(), whole()) for _ in range(count)]
        record = FrameRecord(number, rig, [image for sensor, _, image in data if sensor == b"CAMERA"])
    if next(words, None) is not None:
        raise ValueError("it continues past its end")
    return record


def _read_text(file: BinaryIO, path: Path, kind: str) -> Any:
    announced: int | None = None
    found = []
    lines = _lines(file, path)
    for number, line in lines:
        if match := ANNOUNCED.match(line):
            announced = int(match[1])
        if not _has_record(line):
            continue
        try:
            found.append(_text_record(kind, path, line, next(lines, (0, b""))[1] if kind == "images" else b""))
        except (ValueError, OverflowError, StopIteration) as error:
            if str(error).startswith(str(path)):  # It names the file already.
                raise
            reason = "it is cut off" if isinstance(error, StopIteration) else shortened(str(error))
            raise ValueError(f"{path}: line {number} cannot be read ({reason}); export the model again") from None
    if announced not in (None, len(found)):
        message = f"{path}: says that it has {announced} {kind}, and has {len(found)}: if it is cut off, export it"
        warnings.warn(f"{message} again", stacklevel=3)
    return np.array(found, POINT) if kind == "points3D" else found


def _has_record(line: bytes) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith(b"#")


def _lines(file: BinaryIO, path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the lines of a file with their numbers from 1, each of bounded length."""
    number = 0
    while line := file.readline(LONGEST_LINE + 1):  # One byte more shows that a line is too long.
        number += 1
        if len(line) > LONGEST_LINE:
            raise ValueError(f"{path}: has a line of more than {LONGEST_LINE:,} bytes; export the model again")
        yield number, line.removeprefix(BYTE_ORDER_MARK) if number == 1 else line
