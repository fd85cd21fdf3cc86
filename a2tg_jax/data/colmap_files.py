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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.host.regular_files import open_regular
from a2tg_jax.host.text import shortened

KINDS = ("cameras", "images", "points3D", "rigs", "frames")
"""Names of a model's files without suffix. A model has cameras and images, and the others if it needs them."""
POINT = np.dtype([("id", "<u8"), ("position", "<f8", 3), ("color", "u1", 3), ("error", "<f8")])
FEATURE = np.dtype([("place", "<f8", 2), ("id", "<u8")])
NO_POINT = (1 << 64) - 1
"""Id of the point of a feature that observed none."""
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
    point_ids: np.ndarray
    """[N] uint64 ids of the points that its features observed, or `NO_POINT`."""


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
        if os.fstat(opened.fileno()).st_size == 0:  # Nothing can be mapped.
            return _Binary(path, kind, b"").records()
        with mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _Binary(path, kind, data).records()


@functools.cache
def _camera_models() -> dict[int, tuple[str, int]]:
    """Return the name and the number of parameters of COLMAP's camera models, by their number."""
    return {
        int(model): (name, len(pycolmap().Camera.create_from_model_name(0, name, 1.0, 1, 1).params))
        for name, model in pycolmap().CameraModelId.__members__.items()
        if name != "INVALID"
    }


def _decoded_name(path: Path, name: bytes) -> str:
    try:
        return name.decode()
    except UnicodeDecodeError:
        told = shortened(name.decode(errors="backslashreplace"))
        raise ValueError(
            f"{path}: the image name {told} is not UTF-8; rename the photograph, and export the model again"
        ) from None


_little_endian = functools.cache(lambda format: struct.Struct(f"<{format}"))


class _Binary:
    """Position in a binary file, which cannot pass the file's end. Methods return the next values."""

    def __init__(self, path: Path, kind: str, data: mmap.mmap | bytes):
        self.path, self.kind, self.data, self.at = path, kind, data, 0
        self.num_records, self.record = 0, 0

    def records(self) -> Any:
        """Return all records; of points3D an array [P] of `POINT`."""
        self.num_records = self.whole("Q")
        read, found = READERS[self.kind], list[Any]()
        for self.record in range(1, self.num_records + 1):  # noqa: B020 - each is named in an error
            found.append(read(self))
        if left := len(self.data) - self.at:
            raise self.error(f"is followed by {left} bytes")
        return np.frombuffer(b"".join(found), POINT) if self.kind == "points3D" else found

    def error(self, what: str) -> ValueError:
        place = f"number {self.record} of {self.num_records} {self.kind}" if self.record else "the count"
        return ValueError(f"{self.path}: is cut off or damaged: {place} {what}; export the model again")

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

    def whole(self, format: str) -> int:
        return int(self.take(format)[0])

    def floats(self, count: int) -> list[float]:
        return list(self.take(f"{count}d"))

    def model(self) -> tuple[str, int]:
        """Return the name of a camera model and the number of its parameters."""
        model = self.whole("i")
        if model not in _camera_models():
            raise self.error(f"has the model {model}, which COLMAP does not have")
        return _camera_models()[model]

    def name(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + LONGEST_NAME)
        if end < 0:
            raise self.error("has a name that does not end")
        return _decoded_name(self.path, self.data[self.skip(end + 1 - self.at) : end])

    def point_ids(self) -> np.ndarray:
        count = self.whole("Q")
        start = self.skip(FEATURE.itemsize * count)
        features = np.frombuffer(self.data, FEATURE, count, start) if count else np.empty(0, FEATURE)
        return features["id"].copy()

    def point(self) -> bytes:
        start = self.skip(POINT.itemsize)
        point = self.data[start : self.at]
        self.skip(8 * self.whole("Q"))
        return point

    def is_camera(self) -> bool:
        """Return whether a sensor takes images."""
        return bool(self.take("iI")[0] == CAMERA_SENSOR)


class _Text:
    """Position in the words of a record: a line, and of images the line of features after it. Methods return the next
    values; formats of numbers are for binary files."""

    def __init__(self, path: Path, line: bytes, features: bytes):
        self.path, self.line, self.features, self.words, self.at = path, line, features, line.split(), 0

    def take(self, count: int) -> list[bytes]:
        words = self.words[self.at : self.at + count]
        if len(words) < count:
            raise ValueError(f"it is cut off after {len(self.words)} words")
        self.at += count
        return words

    def whole(self, format: str) -> int:
        return _whole(*self.take(1))

    def floats(self, count: int) -> list[float]:
        return [float(word) for word in self.take(count)]

    def model(self) -> tuple[str, int]:
        """Return the name of a camera model and the number of its parameters, which end the line."""
        name = self.take(1)[0].decode("ascii", "replace")
        count = dict(_camera_models().values()).get(name)
        if count is None:
            raise ValueError(f"COLMAP has no camera model {shortened(name)}")
        if len(self.words) != 4 + count:
            raise ValueError(f"{name} has {count} parameters; got {len(self.words) - 4}")
        return name, count

    def name(self) -> str:
        """Return the rest of the line, which may have spaces."""
        before = self.at
        self.take(1)
        self.at = len(self.words)
        return _decoded_name(self.path, self.line.split(None, before)[before].strip())

    def point_ids(self) -> np.ndarray:
        try:
            # Each feature has x, y and the id of its point; -1 stands for none.
            features = zip(*[iter(self.features.split())] * 3, strict=True)
            ids = [NO_POINT if word == b"-1" else _whole(word) for _, _, word in features]
        except ValueError:
            raise ValueError("the line of its points is missing or cut off") from None
        return np.array(ids, np.uint64)

    def point(self) -> tuple[int, list[float], list[int], float]:
        words, self.at = self.words, len(self.words)
        if len(words) < 8 or len(words) % 2:
            raise ValueError(f"a point needs 8 words and pairs of its track; got {len(words)}")
        color = [min(max(round(float(word)), 0), 255) for word in words[4:7]]
        return _whole(words[0]), [float(word) for word in words[1:4]], color, float(words[7])

    def is_camera(self) -> bool:
        """Return whether a sensor takes images."""
        kind, number = self.take(2)
        _whole(number)
        return kind == b"CAMERA"


def _whole(word: bytes) -> int:
    """Return a whole number of at least 0, which may be written like 96.0."""
    number = int(word) if word.isdigit() else float(word)
    if not 0 <= number <= NO_POINT or number != int(number):  # NaN fails as well.
        raise ValueError(f"{shortened(word.decode(errors='replace'))} is no whole number of at least 0")
    return int(number)


Source = _Binary | _Text


def _camera(source: Source) -> tuple[int, Any]:
    """Return the id of a camera, and its pycolmap.Camera."""
    number, (name, count) = source.whole("I"), source.model()
    width, height, params = source.whole("Q"), source.whole("Q"), source.floats(count)
    return number, pycolmap().Camera(model=name, width=width, height=height, params=params)


def _image(source: Source) -> ImageRecord:
    return ImageRecord(source.whole("I"), source.floats(7), source.whole("I"), source.name(), source.point_ids())


def _rig(source: Source) -> RigRecord:
    number = source.whole("I")
    translations: list[list[float] | None] = []
    for index in range(source.whole("I")):
        source.is_camera()
        if index:
            translations.append(source.floats(7)[4:] if source.whole("B") else None)
    return RigRecord(number, translations)


def _frame(source: Source) -> FrameRecord:
    number, rig, _ = source.whole("I"), source.whole("I"), source.floats(7)
    data = [(source.is_camera(), source.whole("Q")) for _ in range(source.whole("I"))]
    return FrameRecord(number, rig, [image for is_camera, image in data if is_camera])


READERS: dict[str, Callable[[Any], Any]] = {
    "cameras": _camera, "images": _image, "points3D": lambda source: source.point(), "rigs": _rig, "frames": _frame,
}  # fmt: skip
"""Function that reads one record of a file, by kind."""


def _read_text(file: BinaryIO, path: Path, kind: str) -> Any:
    announced: int | None = None
    found = []
    lines = _lines(file, path)
    for number, line in lines:
        if match := ANNOUNCED.match(line):
            announced = int(match[1])
        if not _has_record(line):
            continue
        source = _Text(path, line, next(lines, (0, b""))[1] if kind == "images" else b"")
        try:
            found.append(READERS[kind](source))
            if source.at < len(source.words):
                raise ValueError("it continues past its end")
        except (ValueError, OverflowError) as error:
            if str(error).startswith(str(path)):
                raise
            told = shortened(str(error))
            raise ValueError(f"{path}: line {number} cannot be read ({told}); export the model again") from None
    if announced not in (None, len(found)):
        message = f"{path}: says that it has {announced} {kind}, and has {len(found)}: if it is cut off, export it"
        warnings.warn(f"{message} again", stacklevel=3)
    return np.array(found, POINT) if kind == "points3D" else found


def _has_record(line: bytes) -> bool:
    """Return whether a line is neither empty nor a comment."""
    return bool(line.strip()) and not line.lstrip().startswith(b"#")


def _lines(file: BinaryIO, path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the lines of a file with their numbers from 1, each of bounded length."""
    number = 0
    while line := file.readline(LONGEST_LINE + 1):
        number += 1
        if len(line) > LONGEST_LINE:
            raise ValueError(f"{path}: has a line of more than {LONGEST_LINE:,} bytes; export the model again")
        yield number, line.removeprefix(BYTE_ORDER_MARK) if number == 1 else line
