"""Completeness of COLMAP's text files: every line has the right number of words.

pycolmap repeats the word before a missing one, and counts without end after a wrong count.
"""

import itertools
import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from a2tg_jax.data.colmap_binary import check_name, num_params_by_model
from a2tg_jax.host.regular_files import open_regular
from a2tg_jax.host.text import shortened

Words = list[bytes]
LONGEST_LINE = 1 << 26
"""Longest line in bytes. The points of an image with a million features take half of that."""
ANNOUNCED = re.compile(rb"# Number of \w+: (\d{1,18})\b")
"""COLMAP's comment on the number of lines, or of pairs of lines for images."""


def check_text(path: Path, copy: Path | None = None) -> None:
    """Refuse a text file of a kind in `LINES` unless all its lines are valid. Arguments as `check_binary`.

    Warn if the count in a comment is another: the file may be truncated, but other programs copy comments.

    Raises:
      ValueError: naming the file and the line.
    """
    announced, found = None, 0
    with open_regular(copy or path) as opened:
        lines = enumerate(_lines(opened, path), 1)
        for number, line in lines:
            words = line.split()
            if match := ANNOUNCED.match(line):
                announced = int(match[1])
            if not words or words[0].startswith(b"#"):
                continue
            points = next(lines, (0, None))[1] if path.stem == "images" else b""
            _check_line(path, number, words, points)
            if path.stem == "images":
                _check_image_name(path, number, words[9:])
            found += 1
    if announced not in (None, found):
        message = f"{path}: says that it has {announced} {path.stem}, and has {found}: if it is cut off, export it"
        warnings.warn(message, stacklevel=2)


def _lines(file: BinaryIO, path: Path) -> Iterator[bytes]:
    """Yield the lines of a file, each of bounded length."""
    while line := file.readline(LONGEST_LINE + 1):
        if len(line) > LONGEST_LINE:
            raise ValueError(f"{path}: has a line of more than {LONGEST_LINE:,} bytes; export the model again")
        yield line


def _check_line(path: Path, number: int, words: Words, points: bytes | None) -> None:
    try:
        if points is None or len(points.split()) % 3:
            raise ValueError("the line of its points is missing or cut off")
        LINES[path.stem](words)
    except (ValueError, IndexError) as error:
        told = shortened(str(error)) if isinstance(error, ValueError) else "it is cut off"
        raise ValueError(f"{path}: line {number} cannot be read ({told}); export the model again") from None


def _check_camera(words: Words) -> None:
    model = words[1].decode("ascii", "replace")
    wanted = num_params_by_model().get(model)
    if wanted is None:
        raise ValueError(f"COLMAP knows no camera model {shortened(model)}")
    if len(words) != 4 + wanted:
        raise ValueError(f"{model} has {wanted} parameters; got {len(words) - 4}")
    _check_numbers((words[0], *words[2:4]), words[4:])


def _check_image(words: Words) -> None:
    if len(words) < 10:
        raise ValueError(f"an image needs 10 words (id, pose, camera, name); got {len(words)}")
    _check_numbers((words[0], words[8]), words[1:8])


def _check_image_name(path: Path, number: int, words: Words) -> None:
    """Raise ValueError if an image's name is not UTF-8, or has spaces, at the first of which pycolmap ends it."""
    name = b" ".join(words)
    check_name(path, name)
    if len(words) > 1:
        raise ValueError(
            f"{path}: line {number} has the image name '{shortened(name.decode())}', but names in COLMAP's text files "
            "end at the first space; rename the photograph, or export the model as .bin"
        )


def _check_point(words: Words) -> None:
    if len(words) < 8 or len(words) % 2:
        raise ValueError(f"a point needs 8 words and pairs of its track; got {len(words)}")
    _check_numbers((words[0], *words[4:7], *words[8:]), words[1:4])


def _check_rig(words: Words) -> None:
    rest = iter(words[2:])
    for index in range(_count(words[1], len(words))):
        sensor = list(itertools.islice(rest, 3 if index else 2))
        has_pose = index > 0 and int(sensor[2]) != 0
        pose = list(itertools.islice(rest, 7 if has_pose else 0))
        _check_numbers(sensor[1:], pose)
        if len(pose) < 7 * has_pose or len(sensor) < 2:
            raise ValueError("it is cut off")
    if next(rest, None) is not None:
        raise ValueError("it continues past its end")


def _check_frame(words: Words) -> None:
    count = _count(words[9], len(words))
    if len(words) != 10 + 3 * count:
        raise ValueError(f"{count} data have {3 * count} words; got {len(words) - 10}")
    _check_numbers((words[0], words[1]), words[2:9])


LINES: dict[str, Callable[[Words], None]] = {
    "cameras": _check_camera,
    "images": _check_image,
    "points3D": _check_point,
    "rigs": _check_rig,
    "frames": _check_frame,
}
"""Check of a line, by file name."""


def _count(word: bytes, most: int) -> int:
    if not 0 <= int(word) <= most:
        raise ValueError(f"its count of {int(word)} does not match its list")
    return int(word)


def _check_numbers(integers: Words | tuple[bytes, ...], floats: Words) -> None:
    for word in integers:
        int(word)
    for word in floats:
        float(word)
