"""Completeness of COLMAP's binary files: counts and lengths against the size of the file.

pycolmap never checks for the end of a file. A truncated file makes it hang and use up memory, or load wrong numbers in
silence. So each file is checked here first, without copies. The formats, little-endian, after a uint64 count:

    cameras   uint32 id, int32 model, uint64 width and height, the model's parameters as float64
    images    uint32 id, 7 float64 of the pose, uint32 camera, the name, a zero, uint64 count of (2 float64, uint64)
    points3D  uint64 id, 3 float64, 3 bytes of colour, a float64 error, uint64 count of 2 uint32
    rigs      uint32 id, uint32 count of sensors: the first 8 bytes, each other 8, a byte, and 56 where that is not 0
    frames    uint32 id, uint32 rig, 7 float64, uint32 count of (int32, uint32, uint64)
"""

import functools
import mmap
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.host.regular_files import open_regular
from a2tg_jax.host.text import shortened

LONGEST_NAME = 4096
COUNT, SHORT_COUNT = struct.Struct("<Q"), struct.Struct("<I")
CAMERA = struct.Struct("<IiQQ")
IMAGE_SIZE, POINT2D_SIZE, POINT3D_SIZE, TRACK_SIZE = 64, 24, 43, 8
SENSOR_SIZE, POSE_SIZE, FRAME_SIZE, DATA_SIZE = 8, 56, 64, 16


class _Cursor:
    """Position in a file that cannot pass its end."""

    def __init__(self, path: Path, data: mmap.mmap | bytes):
        self.path, self.data, self.at = path, data, 0
        self.num_records, self.record = 0, 0

    def skip(self, num_bytes: int) -> None:
        left = len(self.data) - self.at
        if num_bytes > left:
            raise self.error(f"wants {num_bytes} bytes at byte {self.at}, and {left} are left")
        self.at += num_bytes

    def take(self, format: struct.Struct) -> tuple[Any, ...]:
        start = self.at
        self.skip(format.size)
        return format.unpack_from(self.data, start)

    def skip_text(self) -> None:
        end = self.data.find(b"\0", self.at, self.at + LONGEST_NAME)
        if end < 0:
            raise self.error("has a name that does not end")
        check_name(self.path, self.data[self.at : end])
        self.skip(end + 1 - self.at)

    def error(self, what: str) -> ValueError:
        place = f"number {self.record} of {self.num_records} {self.path.stem}" if self.record else "the count"
        return ValueError(f"{self.path}: is cut off or damaged: {place} {what}; export the model again")


def check_name(path: Path, name: bytes) -> None:
    """Raise ValueError, naming the file, unless the name of an image is UTF-8, as pycolmap wants it."""
    try:
        name.decode()
    except UnicodeDecodeError:
        told = shortened(name.decode(errors="backslashreplace"))
        raise ValueError(
            f"{path}: the image name {told} is not UTF-8; rename the photograph, and export the model again"
        ) from None


def check_binary(path: Path, copy: Path | None = None) -> None:
    """Refuse a binary file of a kind in `RECORDS` unless it ends where its counts say.

    Args:
      path: the file, which messages name.
      copy: a copy of it that is read in its place.

    Raises:
      ValueError: naming the file and the error.
    """
    with open_regular(copy or path) as opened:
        if os.fstat(opened.fileno()).st_size == 0:  # Nothing can be mapped.
            _check_records(_Cursor(path, b""))
        else:
            with mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as data:
                _check_records(_Cursor(path, data))


def _check_records(cursor: _Cursor) -> None:
    check = RECORDS[cursor.path.stem]
    (cursor.num_records,) = cursor.take(COUNT)
    for cursor.record in range(1, cursor.num_records + 1):  # noqa: B020 - each is told in an error
        check(cursor)
    left = len(cursor.data) - cursor.at
    if left:
        raise cursor.error(f"is followed by {left} bytes")


def _check_camera(cursor: _Cursor) -> None:
    _, model, _, _ = cursor.take(CAMERA)
    if model not in num_params_by_model():
        raise cursor.error(f"has the model {model}, which COLMAP does not know")
    cursor.skip(8 * num_params_by_model()[model])


def _check_image(cursor: _Cursor) -> None:
    cursor.skip(IMAGE_SIZE)
    cursor.skip_text()
    (count,) = cursor.take(COUNT)
    cursor.skip(POINT2D_SIZE * count)


def _check_point(cursor: _Cursor) -> None:
    cursor.skip(POINT3D_SIZE)
    (count,) = cursor.take(COUNT)
    cursor.skip(TRACK_SIZE * count)


def _check_rig(cursor: _Cursor) -> None:
    cursor.skip(SHORT_COUNT.size)
    (count,) = cursor.take(SHORT_COUNT)
    for index in range(count):
        cursor.skip(SENSOR_SIZE)
        if index:
            cursor.skip(1)
            cursor.skip(POSE_SIZE if cursor.data[cursor.at - 1] else 0)


def _check_frame(cursor: _Cursor) -> None:
    cursor.skip(FRAME_SIZE)
    (count,) = cursor.take(SHORT_COUNT)
    cursor.skip(DATA_SIZE * count)


RECORDS: dict[str, Callable[[_Cursor], None]] = {
    "cameras": _check_camera,
    "images": _check_image,
    "points3D": _check_point,
    "rigs": _check_rig,
    "frames": _check_frame,
}
"""Function that skips one record of a file, by file name."""


@functools.cache
def num_params_by_model() -> dict[int | str, int]:
    """Return the number of parameters of COLMAP's camera models, by number and by name."""
    found: dict[int | str, int] = {}
    for name, model in pycolmap().CameraModelId.__members__.items():
        if name != "INVALID":
            count = len(pycolmap().Camera.create_from_model_name(0, name, 1.0, 1, 1).params)
            found |= {int(model): count, name: count}
    return found
