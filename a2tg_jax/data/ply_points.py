"""Points with colours from PLY files, ASCII or binary, as nerfstudio and point-cloud programs write them."""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from a2tg_jax.data.scene import PointCloud

OLD_TYPES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
NEW_TYPES = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
NUMPY_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
PLY_TYPES = dict(zip(OLD_TYPES + NEW_TYPES, NUMPY_TYPES * 2, strict=True))
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_ply_points(path: Path) -> PointCloud:
    """The points of a PLY file whose first element is `vertex` with x, y, z; mid-grey where it has no red, green, blue.

    Points that are not finite are left out; colours given as floats are taken to be in [0, 1].

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: naming the file, if it is no such PLY or is cut off.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such point file, but transforms.json names it; correct ply_file_path")
    with open(path, "rb") as file:
        encoding, count, fields = _read_header(file, path)
        if encoding == "ascii":
            vertices = _read_ascii(file, count, fields, path)
        else:
            dtype = np.dtype([(name, BYTE_ORDERS[encoding] + kind) for name, kind in fields])
            data = file.read(count * dtype.itemsize)
            if len(data) < count * dtype.itemsize:
                raise ValueError(f"{path}: is cut off, {count} vertices were announced; export the points again")
            vertices = np.frombuffer(data, dtype, count)
    points = np.stack([vertices[name].astype(np.float64) for name in "xyz"], axis=-1)
    is_finite = np.isfinite(points).all(axis=1)
    return PointCloud(points[is_finite], _colors(vertices)[is_finite])


def _read_header(file: BinaryIO, path: Path) -> tuple[str, int, list[tuple[str, str]]]:
    """(encoding, number of vertices, [(property, numpy type)]), with the file left at the first vertex."""
    encoding, count = "", -1
    elements: list[str] = []
    fields: list[tuple[str, str]] = []
    is_ply = file.readline().strip() == b"ply"
    while is_ply and (line := file.readline()) and (words := line.decode("ascii", "replace").split()) != ["end_header"]:
        match words:
            case ["format", encoding, *_]:
                pass
            case ["element", name, number]:
                elements.append(name)
                count = int(number) if name == "vertex" else count
            case ["property", kind, name] if elements == ["vertex"] and kind in PLY_TYPES:
                fields.append((name, PLY_TYPES[kind]))
    names = {name for name, _ in fields}
    if encoding not in BYTE_ORDERS or elements[:1] != ["vertex"] or not names.issuperset("xyz"):
        raise ValueError(f"{path}: is not a PLY file of points; vertices with x, y, z are wanted")
    return encoding, count, fields


def _read_ascii(file: BinaryIO, count: int, fields: list[tuple[str, str]], path: Path) -> np.ndarray:
    """Structured array [count] of the vertices, one a line."""
    try:
        rows = [tuple(map(float, file.readline().split()[: len(fields)])) for _ in range(count)]
        return np.array(rows, np.dtype([(name, "f8" if kind in ("f4", "f8") else kind) for name, kind in fields]))
    except ValueError:
        raise ValueError(f"{path}: a line of it is not a vertex of {len(fields)} numbers; export it again") from None


def _colors(vertices: np.ndarray) -> np.ndarray:
    """uint8 colours [P, 3] of the vertices."""
    names = vertices.dtype.names or ()
    if not {"red", "green", "blue"}.issubset(names):
        return np.full((len(vertices), 3), 128, np.uint8)
    colors = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=-1)
    if colors.dtype.kind == "f":
        colors = np.rint(np.clip(colors, 0, 1) * 255)
    return colors.astype(np.uint8)
