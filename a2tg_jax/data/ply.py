"""Untrusted PLY files: their header and tables, and points with colours from them."""

import itertools
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
from scipy.spatial.transform import Rotation

from a2tg_jax.base.regular_files import is_regular, open_regular
from a2tg_jax.base.text import shortened
from a2tg_jax.core.sh import SH_C0
from a2tg_jax.data.assembly import PointCloud

OLD_TYPES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
NEW_TYPES = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
NUMPY_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
PLY_TYPES = dict(zip(OLD_TYPES + NEW_TYPES, NUMPY_TYPES * 2, strict=True))
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST_LINE = 4096
MOST_LINES = 10_000
MOST_DIGITS = 20
NOT_NUMBERS = re.compile(rb"[+-]?(1\.#\w+|nan\(\w*\))", re.IGNORECASE)
"""Words such as -nan(ind) and 1.#QNAN."""
OFFSET = "offset"
"""First word of the comment with the origin of positions."""
ROTATION = "rotation"
"""First word of the comment with the rotation (wxyz) from the original world to the file's."""
RGB: tuple[str, ...] = ("red", "green", "blue")
COLORS = (RGB, ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
"""Names of colours, in order of preference."""
SH_DEGREE0: tuple[str, ...] = ("f_dc_0", "f_dc_1", "f_dc_2")
FLOAT_RANGES = (1, 255, 65535)
INTEGER_RANGES = (255, 65535, 2**32 - 1)
"""Largest values of colours in files."""


class PlyFile:
    """An open PLY file, whose elements are read in order, if they are lists of numbers.

    Raises:
      ValueError: naming the file, if it is no PLY, or its header does not end.
    """

    def __init__(self, file: BinaryIO, path: Path):
        self.path = path
        self.encoding = ""
        self._file = file
        self.comments: list[list[str]] = []
        self.counts: dict[str, int] = {}
        self.fields: dict[str, dict[str, str]] = {}
        """NumPy type of each property, by element and property, in order."""
        self._unreadable: dict[str, str] = {}
        if file.readline(LONGEST_LINE).strip() != b"ply":
            raise ValueError(f"{path}: is not a PLY file")
        name = ""
        for _ in range(MOST_LINES):
            line = file.readline(LONGEST_LINE)
            words = line.decode("ascii", "replace").split()
            if words == ["end_header"]:
                return
            if not line.endswith(b"\n"):  # The end of the file, or a line that is too long.
                break
            match words:
                case ["format", encoding, *_]:
                    if encoding not in BYTE_ORDERS:
                        raise ValueError(
                            f"{path}: is a PLY in {shortened(encoding)}; {', '.join(BYTE_ORDERS)} are known"
                        )
                    self.encoding = encoding
                case ["element", name, number]:
                    if name in self.counts or not number.isdecimal() or len(number) > MOST_DIGITS:
                        got = f"{shortened(number)} of {shortened(name)}"
                        raise ValueError(f"{path}: announces {got}; a number is expected, once for each element")
                    self.counts[name] = int(number)
                    self.fields[name] = {}
                case ["property", kind, field] if name and kind in PLY_TYPES and field not in self.fields[name]:
                    self.fields[name][field] = PLY_TYPES[kind]
                # A list, an unknown type or a second one of its name; an error only if the element is read.
                case ["property", *_]:
                    self._unreadable.setdefault(name, shortened(" ".join(words[1:])))
                case ["comment", *text]:
                    self.comments.append(text)
        raise ValueError(f"{path}: its PLY header does not end")

    def require(self, element: str, names: Iterable[str], wanted: str) -> None:
        """Raise ValueError unless an element can be read and has the named properties."""
        if element in self._unreadable:
            raise ValueError(f"{self.path}: cannot read the {element} property '{self._unreadable[element]}'")
        missing = [name for name in names if name not in self.fields[element]]
        if missing:
            raise ValueError(f"{self.path}: has no attribute {', '.join(missing)}; {wanted} is expected")

    def require_vertices(self, names: Iterable[str], wanted: str) -> None:
        """Skip what is before the vertices. Raise ValueError unless all that can be read, and they have the named
        properties."""
        if not self.encoding:
            raise ValueError(f"{self.path}: its PLY header has no format line")
        if "vertex" not in self.counts:
            raise ValueError(f"{self.path}: has no vertices; its elements are {shortened([*self.counts])}")
        self.require("vertex", names, wanted)
        for element in itertools.takewhile(lambda name: name != "vertex", self.counts):
            self.require(element, (), wanted)
            if self.fields[element]:
                self.read(element)

    def read(self, element: str) -> np.ndarray:
        """Return the structured rows [count] of the next element, which must be required before; float64 from text.

        Raises:
          ValueError: if they are cut off, or no numbers.
        """
        count = self.counts[element]
        fields = self.fields[element]
        is_text = self.encoding == "ascii"
        dtype = np.dtype([(name, BYTE_ORDERS[self.encoding] + kind) for name, kind in fields.items()])
        # No room is made for more rows than there can be: a number in text takes a digit and a separator.
        size = 2 * len(fields) - 1 if is_text else dtype.itemsize
        start = self._file.tell()
        left = self._file.seek(0, os.SEEK_END) - start
        self._file.seek(start)
        if count * size > left:
            raise ValueError(
                f"{self.path}: is cut off; {count} rows of {size} bytes were announced for {element}, and {left} bytes "
                "are left; export it again"
            )
        if not is_text:
            return np.frombuffer(self._file.read(count * size), dtype, count)
        rows = np.empty((count, len(fields)))
        for index in range(count):
            line = self._file.readline(LONGEST_LINE)
            while line.isspace():
                line = self._file.readline(LONGEST_LINE)
            # As programs of Microsoft's compiler write NaN and infinity.
            words = [b"nan" if NOT_NUMBERS.fullmatch(word) else word for word in line.split()]
            try:
                numbers = [float(word) for word in words]
            except ValueError:
                numbers = []
            if len(numbers) != len(fields):
                got = shortened(line.decode("ascii", "replace")) or "the end of the file"
                raise ValueError(
                    f"{self.path}: row {index:,} (from 0) of {element} must be {len(fields)} numbers; got {got}; "
                    "export it again"
                )
            rows[index] = numbers
        return rows.view([(name, np.float64) for name in fields])[:, 0]

    @property
    def offset(self) -> np.ndarray:
        """[3] float64 origin of positions: zeros without the comment "offset X Y Z"."""
        offset = self._comment(OFFSET, 3)
        return np.zeros(3) if offset is None else offset

    @property
    def turn(self) -> np.ndarray:
        """[3, 3] rotation from the original world: none without the comment "rotation W X Y Z"."""
        return turn_of(self._comment(ROTATION, 4))

    def _comment(self, first: str, count: int) -> np.ndarray | None:
        """Return the numbers of the first comment that is a word and this many numbers."""
        for word, *numbers in filter(None, self.comments):
            if word == first and len(numbers) == count:
                try:
                    return np.array([float(number) for number in numbers])
                except ValueError:
                    continue  # A comment of another program.
        return None


def turn_of(quat: np.ndarray | None) -> np.ndarray:
    """Return the rotation [3, 3] of a quaternion (wxyz); none without one, or if it is none."""
    if quat is None or not np.isfinite(quat).all() or not quat.any():
        return np.eye(3)
    return np.asarray(Rotation.from_quat(quat, scalar_first=True).as_matrix())


def read_ply_points(path: Path) -> PointCloud:
    """Return the points of a PLY file whose first element is `vertex` with x, y, z.

    Positions that are turned upright, or relative to an offset as map coordinates, by `save_ply`, come back to the
    original world.

    Colours are whole numbers of 8 bits or, if some are above 255, of 16 or 32; or floats in [0, 1] or, if their mean
    is above 1, in 0..255 (above 255: 0..65535). Numbers beyond are clipped. Gaussians have the colours of their f_dc.
    Points without colours are mid-grey.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: naming the file, if it is no such PLY or is truncated.
    """
    if not is_regular(path):
        raise FileNotFoundError(f"{path}: no such point file, but transforms.json names it; correct ply_file_path")
    with open_regular(path) as file:
        ply = PlyFile(file, path)
        ply.require_vertices("xyz", "a PLY file of points")
        vertices = ply.read("vertex")
    # In map coordinates, float32 has steps of half a metre.
    points = np.stack([vertices[name].astype(np.float64) for name in "xyz"], axis=-1) + ply.offset
    points = points @ ply.turn  # By the inverse: the transpose, for rows.
    return PointCloud(points, _colors(vertices, ply.fields["vertex"]))


def largest_color(colors: np.ndarray, *, is_float: bool) -> int:
    """Return the number that means full brightness, guessed from finite colours [N, 3]: 1, 255, 65535 or 2³² − 1."""
    if is_float:  # Some floats are a little above 1, or far: the mean decides.
        mean = np.clip(colors, 0, FLOAT_RANGES[-1]).mean()
        return next(largest for largest in FLOAT_RANGES if mean <= largest)
    return next((largest for largest in INTEGER_RANGES if colors.max() <= largest), INTEGER_RANGES[-1])


def _colors(vertices: np.ndarray, fields: Mapping[str, str]) -> np.ndarray:
    names = next((names for names in (*COLORS, SH_DEGREE0) if set(names).issubset(fields)), None)
    if names is None or not len(vertices):
        return np.full((len(vertices), 3), 128, np.uint8)
    # NaN as uint8 is undefined.
    given = np.nan_to_num(np.stack([vertices[name] for name in names], axis=-1).astype(np.float64))
    is_float = fields[names[0]].startswith("f")
    colors = 0.5 + SH_C0 * given if names == SH_DEGREE0 else given / largest_color(given, is_float=is_float)
    return np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)
