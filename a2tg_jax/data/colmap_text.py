"""Reading of COLMAP's text files. Every line must have the right number of words.

Files that other programs write differ from COLMAP's: they start with a byte order mark, lack the last empty line, have
names with spaces, or whole numbers such as 96.0. These are read as well.
"""

import itertools
import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from a2tg_jax.data.colmap_records import (
    NO_POINT,
    POINT,
    CameraRecord,
    FrameRecord,
    ImageRecord,
    RigRecord,
    camera_models,
    decoded_name,
)
from a2tg_jax.host.regular_files import open_regular
from a2tg_jax.host.text import shortened

Words = list[bytes]
LONGEST_LINE = 1 << 26
"""Longest line in bytes. The points of an image with a million features take half of that."""
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
ANNOUNCED = re.compile(rb"# Number of \w+: (\d{1,18})\b")
"""COLMAP's comment on the number of lines, or of pairs of lines for images."""


class _Entry(NamedTuple):
    """Record in a file: a line, and of images the line of points after it."""

    path: Path
    line: bytes
    points: bytes


def read_text(path: Path, kind: str) -> Any:
    """Return the records of a text file: a list, or of points3D an array [P] of `POINT`.

    Warn if the count in a comment is another: the file may be truncated, but other programs copy comments.

    Args:
      path: the file.
      kind: one of `colmap_records.KINDS`.

    Raises:
      ValueError: naming the file and the line.
    """
    announced: int | None = None
    found = []
    with open_regular(path) as opened:
        lines = _lines(opened, path)
        for number, line in lines:
            if match := ANNOUNCED.match(line):
                announced = int(match[1])
            if not _has_record(line):
                continue
            points = next(lines, (0, b""))[1] if kind == "images" else b""
            try:
                found.append(READERS[kind](_Entry(path, line, points)))
            except (ValueError, IndexError, OverflowError) as error:
                if str(error).startswith(str(path)):
                    raise
                told = "it is cut off" if isinstance(error, IndexError) else shortened(str(error))
                raise ValueError(f"{path}: line {number} cannot be read ({told}); export the model again") from None
    if announced not in (None, len(found)):
        message = f"{path}: says that it has {announced} {kind}, and has {len(found)}: if it is cut off, export it"
        warnings.warn(f"{message} again", stacklevel=2)
    return np.array(found, POINT) if kind == "points3D" else found


def count_text_images(path: Path) -> int:
    """Return the number of images in a text file of images, without reading their words."""
    with open_regular(path) as opened:
        lines = _lines(opened, path)
        # The next line, if there is one, has the image's points.
        return sum(1 for _, line in lines if _has_record(line) and next(lines, True))


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


def _camera(entry: _Entry) -> CameraRecord:
    words = entry.line.split()
    model = words[1].decode("ascii", "replace")
    wanted = dict(camera_models().values()).get(model)
    if wanted is None:
        raise ValueError(f"COLMAP knows no camera model {shortened(model)}")
    if len(words) != 4 + wanted:
        raise ValueError(f"{model} has {wanted} parameters; got {len(words) - 4}")
    width, height = _whole(words[2]), _whole(words[3])
    return CameraRecord(_whole(words[0]), model, width, height, _floats(words[4:]))


def _image(entry: _Entry) -> ImageRecord:
    words = entry.line.split(None, 9)  # The tenth is the name, which may have spaces.
    if len(words) < 10:
        raise ValueError(f"an image needs 10 words (id, pose, camera, name); got {len(words)}")
    points = entry.points.split()
    try:
        # Each feature has x, y and the id of its point.
        ids = [_point_id(point_id) for _, _, point_id in zip(*[iter(points)] * 3, strict=True)]
    except ValueError:
        raise ValueError("the line of its points is missing or cut off") from None
    name = decoded_name(entry.path, words[9].strip())
    pose, camera = _floats(words[1:8]), _whole(words[8])
    return ImageRecord(_whole(words[0]), pose, camera, name, np.array(ids, np.uint64))


def _point(entry: _Entry) -> tuple[int, list[float], list[int], float]:
    words = entry.line.split()
    if len(words) < 8 or len(words) % 2:
        raise ValueError(f"a point needs 8 words and pairs of its track; got {len(words)}")
    color = [min(max(round(float(word)), 0), 255) for word in words[4:7]]
    return _whole(words[0]), _floats(words[1:4]), color, float(words[7])


def _rig(entry: _Entry) -> RigRecord:
    words = entry.line.split()
    rest = iter(words[2:])
    translations: list[list[float] | None] = []
    for index in range(_count(words[1], len(words))):
        sensor = list(itertools.islice(rest, 3 if index else 2))
        _whole(sensor[1])
        if index:
            pose = _floats(list(itertools.islice(rest, 7))) if _whole(sensor[2]) else None
            if pose is not None and len(pose) < 7:
                raise ValueError("it is cut off")
            translations.append(pose and pose[4:])
    if next(rest, None) is not None:
        raise ValueError("it continues past its end")
    return RigRecord(_whole(words[0]), translations)


def _frame(entry: _Entry) -> FrameRecord:
    words = entry.line.split()
    count = _count(words[9], len(words))
    if len(words) != 10 + 3 * count:
        raise ValueError(f"{count} data have {3 * count} words; got {len(words) - 10}")
    _floats(words[2:9])
    images = [_whole(words[at + 2]) for at in range(10, len(words), 3) if words[at] == b"CAMERA"]
    return FrameRecord(_whole(words[0]), _whole(words[1]), images)


READERS: dict[str, Callable[[_Entry], Any]] = {
    "cameras": _camera,
    "images": _image,
    "points3D": _point,
    "rigs": _rig,
    "frames": _frame,
}
"""Function that reads one record of a file, by kind."""


def _count(word: bytes, most: int) -> int:
    count = _whole(word)
    if count > most:
        raise ValueError(f"its count of {count} does not match its list")
    return count


def _whole(word: bytes) -> int:
    """Return a whole number of at least 0, which may be written like 96.0."""
    number = int(word) if word.isdigit() else float(word)
    if not 0 <= number <= NO_POINT or number != int(number):  # NaN is refused, too.
        raise ValueError(f"{shortened(word.decode(errors='replace'))} is no whole number of at least 0")
    return int(number)


def _point_id(word: bytes) -> int:
    """Return the id of a feature's point; -1 stands for none."""
    return NO_POINT if word == b"-1" else _whole(word)


def _floats(words: Words) -> list[float]:
    return [float(word) for word in words]
