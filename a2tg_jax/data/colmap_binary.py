"""Reading of COLMAP's binary files. Counts and lengths are checked against the size of the file.

The formats (`colmap_records` says what is in them), little-endian, after a uint64 count:

    cameras   uint32 id, int32 model, uint64 width and height, the model's parameters as float64
    images    uint32 id, 7 float64 of the pose, uint32 camera, the name, a zero, uint64 count of (2 float64, uint64)
    points3D  uint64 id, 3 float64, 3 bytes of colour, a float64 error, uint64 count of 2 uint32
    rigs      uint32 id, uint32 count of sensors: the first 8 bytes, each other 8, a byte, and 56 where that is not 0
    frames    uint32 id, uint32 rig, 7 float64, uint32 count of (int32 sensor, uint32, uint64 image)
"""

import mmap
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from a2tg_jax.data.colmap_records import (
    POINT,
    CameraRecord,
    FrameRecord,
    ImageRecord,
    RigRecord,
    camera_models,
    decoded_name,
)
from a2tg_jax.host.regular_files import open_regular

LONGEST_NAME = 4096
COUNT, SHORT_COUNT, PAIR = struct.Struct("<Q"), struct.Struct("<I"), struct.Struct("<II")
CAMERA, IMAGE, POSE, DATA = struct.Struct("<IiQQ"), struct.Struct("<I7dI"), struct.Struct("<7d"), struct.Struct("<iIQ")
FEATURE = np.dtype([("place", "<f8", 2), ("id", "<u8")])
TRACK_SIZE, SENSOR_SIZE = 8, 8
CAMERA_SENSOR = 0
"""Kind of the sensors that take images."""


class _Cursor:
    """Position in a file that cannot pass its end."""

    def __init__(self, path: Path, kind: str, data: mmap.mmap | bytes):
        self.path, self.kind, self.data, self.at = path, kind, data, 0
        self.num_records, self.record = 0, 0

    def skip(self, num_bytes: int) -> int:
        """Return the position from before."""
        left = len(self.data) - self.at
        if num_bytes > left:
            raise self.error(f"wants {num_bytes} bytes at byte {self.at}, and {left} are left")
        self.at += num_bytes
        return self.at - num_bytes

    def take(self, format: struct.Struct) -> tuple[Any, ...]:
        return format.unpack_from(self.data, self.skip(format.size))

    def take_name(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + LONGEST_NAME)
        if end < 0:
            raise self.error("has a name that does not end")
        start = self.skip(end + 1 - self.at)
        return decoded_name(self.path, self.data[start:end])

    def error(self, what: str) -> ValueError:
        place = f"number {self.record} of {self.num_records} {self.kind}" if self.record else "the count"
        return ValueError(f"{self.path}: is cut off or damaged: {place} {what}; export the model again")


def read_binary(path: Path, kind: str) -> Any:
    """Return the records of a binary file: a list, or of points3D an array [P] of `POINT`.

    Args:
      path: the file.
      kind: one of `colmap_records.KINDS`.

    Raises:
      ValueError: naming the file and the error, unless it ends where its counts say.
    """
    with open_regular(path) as opened:
        if os.fstat(opened.fileno()).st_size == 0:  # Nothing can be mapped.
            return _records(_Cursor(path, kind, b""))
        with mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _records(_Cursor(path, kind, data))


def count_binary(path: Path) -> int:
    """Return the number of records that a binary file announces; 0 if it is too short for that."""
    with open_regular(path) as opened:
        return int.from_bytes(opened.read(COUNT.size), "little")


def _records(cursor: _Cursor) -> Any:
    (cursor.num_records,) = cursor.take(COUNT)
    found = []
    for cursor.record in range(1, cursor.num_records + 1):  # noqa: B020 - each is told in an error
        found.append(READERS[cursor.kind](cursor))
    left = len(cursor.data) - cursor.at
    if left:
        raise cursor.error(f"is followed by {left} bytes")
    return np.frombuffer(b"".join(found), POINT) if cursor.kind == "points3D" else found


def _camera(cursor: _Cursor) -> CameraRecord:
    number, model, width, height = cursor.take(CAMERA)
    if model not in camera_models():
        raise cursor.error(f"has the model {model}, which COLMAP does not know")
    name, count = camera_models()[model]
    return CameraRecord(number, name, width, height, list(cursor.take(struct.Struct(f"<{count}d"))))


def _image(cursor: _Cursor) -> ImageRecord:
    number, *pose, camera = cursor.take(IMAGE)
    name = cursor.take_name()
    (count,) = cursor.take(COUNT)
    start = cursor.skip(FEATURE.itemsize * count)
    features = np.frombuffer(cursor.data, FEATURE, count, start) if count else np.empty(0, FEATURE)
    return ImageRecord(number, pose, camera, name, features["id"].copy())


def _point(cursor: _Cursor) -> bytes:
    start = cursor.skip(POINT.itemsize)
    point = cursor.data[start : cursor.at]
    (count,) = cursor.take(COUNT)
    cursor.skip(TRACK_SIZE * count)
    return point


def _rig(cursor: _Cursor) -> RigRecord:
    number, count = cursor.take(PAIR)
    translations: list[list[float] | None] = []
    for index in range(count):
        cursor.skip(SENSOR_SIZE)
        if index:
            has_pose = cursor.data[cursor.skip(1)]
            translations.append(list(cursor.take(POSE)[4:]) if has_pose else None)
    return RigRecord(number, translations)


def _frame(cursor: _Cursor) -> FrameRecord:
    number, rig = cursor.take(PAIR)
    cursor.skip(POSE.size)
    (count,) = cursor.take(SHORT_COUNT)
    data = [cursor.take(DATA) for _ in range(count)]
    return FrameRecord(number, rig, [image for sensor, _, image in data if sensor == CAMERA_SENSOR])


READERS: dict[str, Callable[[_Cursor], Any]] = {
    "cameras": _camera,
    "images": _image,
    "points3D": _point,
    "rigs": _rig,
    "frames": _frame,
}
"""Function that reads one record of a file, by kind."""
