"""Untrusted .npz and .npy files of numbers: no allocation exceeds the file's possible content, nothing is unpickled."""

import ast
import math
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np

from a2tg_jax.base.regular_files import open_regular, room_of
from a2tg_jax.base.text import shortened

LONGEST_HEADER = 10_000
"""Largest array header in bytes."""
CHUNK = 1 << 24
LONGEST_REASON = 200


def read_npz(path: Path, is_wanted: Callable[[str], bool] = lambda name: True) -> dict[str, np.ndarray]:
    """Return the wanted arrays of an .npz, by name.

    Raises:
      OSError: if the file cannot be opened.
      ValueError: with the reason, if it is damaged, or an array is not numeric or larger than its data.
    """
    arrays: dict[str, np.ndarray] = {}
    with open_regular(path) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                room = room_of(os.fstat(file.fileno()).st_size)
                for entry in archive.infolist():
                    name = entry.filename.removesuffix(".npy")
                    if not is_wanted(name):
                        continue
                    # Over all entries: many that are within the bound add up.
                    room -= entry.file_size
                    if name in arrays:
                        raise ValueError(f"{name} occurs twice")
                    if room < 0:
                        raise ValueError(f"{name} would take more than the file may hold")
                    with archive.open(entry) as inner:
                        arrays[name] = _read_array(inner, name, entry.file_size)
        except Exception as error:  # Damaged zips raise errors from zlib.error to NotImplementedError.
            raise ValueError(shortened(str(error) or type(error).__name__, LONGEST_REASON)) from error
    return arrays


def read_npy(path: Path) -> np.ndarray:
    """Return the array in an .npy of numbers.

    Raises:
      OSError: if the file cannot be opened.
      Exception: of any class, such as SyntaxError, if it is damaged or not numeric.
    """
    with open_regular(path) as file:
        return _read_array(file, "it", os.fstat(file.fileno()).st_size)


def _read_array(file: IO[bytes], name: str, size: int) -> np.ndarray:
    """Return one array. Its entry must hold exactly its bytes after the header."""
    dtype, is_fortran, shape = _read_header(file, name)
    left = size - file.tell()
    # Python's integers do not overflow, NumPy's would.
    if math.prod(shape) * dtype.itemsize != left:
        raise ValueError(f"{name} claims the shape {shape} of {dtype}, but has {left} bytes")
    flat = np.empty(math.prod(shape), dtype)
    target = flat.view(np.uint8)
    for start in range(0, left, CHUNK):  # zipfile holds the unpacked bytes of one call in memory.
        piece = target[start : start + CHUNK]
        if file.readinto(memoryview(piece)) != len(piece):  # type: ignore[attr-defined, arg-type]
            raise ValueError(f"{name} is cut off")
    if file.read(1):  # Reading to the end also makes zipfile compare the checksum.
        raise ValueError(f"{name} continues past its end")
    return flat.reshape(shape, order="F" if is_fortran else "C").astype(dtype.newbyteorder("="), copy=False)


def _read_header(file: IO[bytes], name: str) -> tuple[np.dtype, bool, tuple[int, ...]]:
    """Return the dtype of one array, whether it is in Fortran order, and its shape."""
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise ValueError(f"{name} is .npy version {version}, which is not supported")
    # https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html
    length = int.from_bytes(file.read(2 if version == (1, 0) else 4), "little")
    if length > LONGEST_HEADER:
        raise ValueError(f"{name} has a header of {length} bytes")
    header: Any = ast.literal_eval(file.read(length).decode())
    dtype = np.dtype(header["descr"])
    shape = header["shape"]
    if dtype.kind not in "biuf" or dtype.itemsize > 8 or dtype.shape:  # Arrays of objects are pickles.
        raise ValueError(f"{name} must be of plain numbers; got {dtype}")
    # True is no size. NumPy before 2.0 has at most 32 dimensions.
    if type(shape) is not tuple or not all(type(side) is int and side >= 0 for side in shape) or len(shape) > 32:
        raise ValueError(f"{name} has no shape")
    return dtype, header["fortran_order"] is True, shape
